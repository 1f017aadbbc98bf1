"""Shards: what is written is read, torn files are named, a full disk loses nothing."""

import numpy as np
import pytest

from sts_jax import dataset
from sts_jax.dataset import records


def some_images(num: int = 5) -> records.Images:
    rng = np.random.default_rng(0)
    return records.Images(
        rng.integers(0, 256, (num, 9, 7, 3), dtype=np.uint8),
        rng.integers(0, 256, (num, 9, 7, 3), dtype=np.uint8),
        rng.random((num, 9, 7)) < 0.5,
    )


def test_frames_come_back_in_the_order_asked_for(tmp_path):
    images, path = some_images(), tmp_path / "a.array_record"
    records.write_images(
        path, [records.Images(*(leaf[:3] for leaf in images)), records.Images(*(x[3:] for x in images))]
    )
    back = records.read_images(path, np.array([4, 0, 2]), resolution=(9, 7), total=5)
    for there, here in zip(images, back, strict=True):
        np.testing.assert_array_equal(there[[4, 0, 2]], here)


def test_same_frames_same_bytes(tmp_path):
    for name in ("a", "b"):
        records.write_images(tmp_path / f"{name}.array_record", [some_images()])
        records.write_arrays(tmp_path / f"{name}.npz", {"x": np.arange(3)})
    for ending in ("array_record", "npz"):
        assert (tmp_path / f"a.{ending}").read_bytes() == (tmp_path / f"b.{ending}").read_bytes()


@pytest.mark.parametrize("keep", [0.0, 0.5, 0.9])
def test_a_truncated_file_is_named(tmp_path, keep):
    path = tmp_path / "a.array_record"
    records.write_images(path, [some_images(50)])
    path.write_bytes(path.read_bytes()[: int(keep * path.stat().st_size)])
    with pytest.raises(dataset.TornFileError, match=r"a\.array_record"):
        records.read_images(path, np.arange(50), resolution=(9, 7), total=50)
    arrays = tmp_path / "a.npz"
    records.write_arrays(arrays, {"x": np.arange(3000)})
    arrays.write_bytes(arrays.read_bytes()[: int(keep * arrays.stat().st_size)])
    with pytest.raises(dataset.TornFileError, match=r"a\.npz"):
        records.read_arrays(arrays)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"b\.array_record"):
        records.read_images(tmp_path / "b.array_record", np.arange(1), resolution=(9, 7), total=1)


def test_a_kill_in_the_middle_of_writing_leaves_nothing(tmp_path):
    def frames():
        yield some_images()
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        records.write_images(tmp_path / "a.array_record", frames())
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_named_and_leaves_nothing(tmp_path):
    def full(path):
        path.write_bytes(b"half")
        raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match=r"x\.npz.*Free some disk space"):
        records.write_whole(tmp_path / "x.npz", full)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_made_with_another_config_is_refused(tmp_path):
    path = tmp_path / "config.json"
    dataset.claim(path, {"seed": 0, "sizes": (1, 2)})
    dataset.claim(path, {"seed": 0, "sizes": (1, 2)})
    with pytest.raises(ValueError, match=r"config\.json.*seed = 0, asked for now is 1"):
        dataset.claim(path, {"seed": 1, "sizes": (1, 2)})
    path.write_text('{"seed"')
    with pytest.raises(dataset.TornFileError, match=r"config\.json"):
        dataset.claim(path, {"seed": 0, "sizes": (1, 2)})
