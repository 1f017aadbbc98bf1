"""Shards are read as they were written, torn files are named, and a full disk loses nothing."""

import resource

import numpy as np
import pytest

from sts_jax import storage
from sts_jax.dataset import records


def some_images(num: int = 5) -> records.Images:
    rng = np.random.default_rng(0)
    return records.Images(
        rng.integers(0, 256, (num, 9, 7, 3), dtype=np.uint8),
        rng.integers(0, 256, (num, 9, 7, 3), dtype=np.uint8),
        rng.random((num, 9, 7)) < 0.5,
    )


def test_frames_are_read_in_the_given_order(tmp_path):
    images, path = some_images(), tmp_path / "a.array_record"
    records.write_images(
        path, [records.Images(*(leaf[:3] for leaf in images)), records.Images(*(x[3:] for x in images))]
    )
    back = records.read_images(path, np.array([4, 0, 2]), resolution=(9, 7), total=5)
    for there, here in zip(images, back, strict=True):
        np.testing.assert_array_equal(there[[4, 0, 2]], here)


def test_views_after_frames_are_read_in_the_given_order(tmp_path):
    images, path = some_images(), tmp_path / "a.array_record"
    views = np.random.default_rng(1).integers(0, 256, (3, 9, 7, 3), dtype=np.uint8)
    records.write_images(path, [images, (views,)])
    back = records.read_views(path, np.array([7, 5]), resolution=(9, 7), total=8)
    np.testing.assert_array_equal(back, views[[2, 0]])
    with pytest.raises(storage.DamagedFileError, match=r"number of records is 8 instead of 5"):
        records.read_images(path, np.arange(5), resolution=(9, 7), total=5)


def test_equal_frames_give_equal_bytes(tmp_path):
    for name in ("a", "b"):
        records.write_images(tmp_path / f"{name}.array_record", [some_images()])
        storage.write_arrays(tmp_path / f"{name}.npz", {"x": np.arange(3)})
    for ending in ("array_record", "npz"):
        assert (tmp_path / f"a.{ending}").read_bytes() == (tmp_path / f"b.{ending}").read_bytes()


@pytest.mark.parametrize("keep", [0.0, 0.5, 0.9])
def test_a_truncated_file_is_named(tmp_path, keep):
    path = tmp_path / "a.array_record"
    records.write_images(path, [some_images(50)])
    path.write_bytes(path.read_bytes()[: int(keep * path.stat().st_size)])
    with pytest.raises(storage.DamagedFileError, match=r"a\.array_record"):
        records.read_images(path, np.arange(50), resolution=(9, 7), total=50)
    arrays = tmp_path / "a.npz"
    storage.write_arrays(arrays, {"x": np.arange(3000)})
    arrays.write_bytes(arrays.read_bytes()[: int(keep * arrays.stat().st_size)])
    with pytest.raises(storage.DamagedFileError, match=r"a\.npz is damaged .*: delete it\."):
        storage.read_arrays(arrays, "delete it")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"b\.array_record"):
        records.read_images(tmp_path / "b.array_record", np.arange(1), resolution=(9, 7), total=1)


def test_an_interruption_while_writing_leaves_no_file(tmp_path):
    def frames():
        yield some_images()
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        records.write_images(tmp_path / "a.array_record", frames())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("a.array_record", lambda path: records.write_images(path, [some_images(1000)])),
        ("a.npz", lambda path: storage.write_arrays(path, {"x": np.zeros(10_000)})),
    ],
)
def test_a_full_disk_is_named_and_leaves_no_file(tmp_path, name, write):
    path = tmp_path / name
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, hard))  # no file of this process may be longer
    try:
        with pytest.raises(OSError, match=rf"cannot write {path}: .*Free some disk space"):
            write(path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert list(tmp_path.iterdir()) == []


def test_an_error_while_rendering_is_not_reported_as_a_full_disk(tmp_path):
    def frames():
        yield some_images()
        raise ValueError("no such colour")

    with pytest.raises(ValueError, match=r"^no such colour$"):
        records.write_images(tmp_path / "a.array_record", frames())
    assert list(tmp_path.iterdir()) == []


COLLECTION, SENSOR = "c" * 64, "s" * 64


def shard(folder, index, seed=0, collection=COLLECTION):
    """A shard's record file, written with five images, two views and arrays that hold nothing."""
    path = folder / f"{index}.array_record"
    images = some_images()._replace(visual=np.random.default_rng(seed).integers(0, 256, (5, 9, 7, 3), dtype=np.uint8))
    arrays = {name: np.arange(3) for name in records.ARRAYS}
    records.write_shard(path, [images, (images.visual[:2],)], arrays, records.Identity(collection, SENSOR, index))
    return path


def test_a_shard_is_read_as_it_was_written(tmp_path):
    arrays = records.read_shard(shard(tmp_path, 0), records.Identity(COLLECTION, SENSOR, 0))
    assert set(arrays) == records.ARRAYS
    np.testing.assert_array_equal(arrays["frames"], np.arange(3))


def test_images_of_another_shard_are_refused(tmp_path):
    one, other = shard(tmp_path, 0, seed=1), shard(tmp_path, 1, seed=2)
    assert one.stat().st_size == other.stat().st_size  # both hold noise of equal length
    one.write_bytes(other.read_bytes())
    with pytest.raises(storage.DamagedFileError, match=r"0\.array_record is damaged or belongs to another shard"):
        records.read_shard(one, records.Identity(COLLECTION, SENSOR, 0))
    assert records.read_shard(other, records.Identity(COLLECTION, SENSOR, 1))


def test_both_files_of_another_shard_are_refused(tmp_path):
    one, other = shard(tmp_path, 0), shard(tmp_path, 1)
    for ending in (".array_record", ".npz"):
        one.with_suffix(ending).write_bytes(other.with_suffix(ending).read_bytes())
    with pytest.raises(
        storage.DamagedFileError, match=r"0\.npz contains the data of shard 1 instead of shard 0: delete 0\.npz and"
    ):
        records.read_shard(one, records.Identity(COLLECTION, SENSOR, 0))


@pytest.mark.parametrize("changed", ["collection", "sensor"])
def test_a_shard_of_another_collection_or_sensor_is_refused(tmp_path, changed):
    wanted = records.Identity(COLLECTION, SENSOR, 0)._replace(**{changed: "f" * 64})
    with pytest.raises(storage.DamagedFileError, match=rf"0\.npz was made with a {changed}\.json that differs"):
        records.read_shard(shard(tmp_path, 0), wanted)


def test_a_flipped_bit_is_found_or_changes_no_array(tmp_path):
    path, identity = shard(tmp_path, 0), records.Identity(COLLECTION, SENSOR, 0)
    before = records.read_shard(path, identity)
    rng = np.random.default_rng(0)
    for ending in (".array_record", ".npz"):
        file = path.with_suffix(ending)
        whole = file.read_bytes()
        unnoticed = 0
        for bit in rng.integers(0, 8 * len(whole), 200):
            torn = bytearray(whole)
            torn[bit // 8] ^= 1 << bit % 8
            file.write_bytes(torn)
            try:
                after = records.read_shard(path, identity)
            except storage.DamagedFileError:
                continue
            unnoticed += 1  # dates and the like in a zip's directory
            assert all(np.array_equal(after[name], before[name]) for name in records.ARRAYS)
            assert ending == ".npz"
        assert unnoticed < 100
        file.write_bytes(whole)


def test_a_missing_array_is_named(tmp_path):
    path = shard(tmp_path, 0)
    arrays = storage.read_arrays(path.with_suffix(".npz"), "delete it")
    del arrays["trajectory/pose"]
    storage.write_arrays(path.with_suffix(".npz"), arrays)
    with pytest.raises(storage.DamagedFileError, match=r"0\.npz lacks the arrays trajectory/pose: delete"):
        records.read_shard(path, records.Identity(COLLECTION, SENSOR, 0))


def test_a_missing_record_file_is_named(tmp_path):
    path = shard(tmp_path, 0)
    path.unlink()
    with pytest.raises(FileNotFoundError, match=r"0\.array_record is missing: delete 0\.npz and collect again"):
        records.read_shard(path, records.Identity(COLLECTION, SENSOR, 0))
