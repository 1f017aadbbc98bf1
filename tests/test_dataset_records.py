"""Images are read as they were written, a torn file is named, a full disk loses nothing, and reduced images."""

import resource

import cv2
import numpy as np
import pytest

from sts_jax import dataset, storage
from sts_jax.dataset import records


def some_images(num: int = 5) -> records.Images:
    rng = np.random.default_rng(0)
    return records.Images(
        rng.integers(0, 256, (num, 9, 7, 3), dtype=np.uint8),
        rng.integers(0, 256, (num, 9, 7, 3), dtype=np.uint8),
        rng.random((num, 9, 7)) < 0.5,
    )


def test_frames_and_the_views_after_them_are_read_in_the_given_order(tmp_path):
    images, path = some_images(), tmp_path / "a.array_record"
    views = np.random.default_rng(1).integers(0, 256, (3, 9, 7, 3), dtype=np.uint8)
    halves = [records.Images(*(leaf[part] for leaf in images)) for part in (slice(3), slice(3, 5))]
    records.write_images(path, [*halves, (views,)])
    shard = records.Shard(path, resolution=(9, 7), total=8)
    back = shard.images(np.array([4, 0, 2]))
    for written, read in zip(images, back, strict=True):
        np.testing.assert_array_equal(written[[4, 0, 2]], read)
    np.testing.assert_array_equal(shard.views(np.array([7, 5])), views[[2, 0]])
    with pytest.raises(storage.DamagedFileError, match=r"it has 8 records, but should have 5"):
        records.Shard(path, resolution=(9, 7), total=5)
    with pytest.raises(storage.DamagedFileError, match=r"a record does not have 386 bytes"):
        shard.images(np.array([5]))


@pytest.mark.parametrize("keep", [0.0, 0.5, 0.9])
def test_a_truncated_file_is_named(tmp_path, keep):
    path = tmp_path / "a.array_record"
    records.write_images(path, [some_images(50)])
    path.write_bytes(path.read_bytes()[: int(keep * path.stat().st_size)])
    with pytest.raises(storage.DamagedFileError, match=r"a\.array_record"):
        records.Shard(path, resolution=(9, 7), total=50).images(np.arange(50))
    arrays = tmp_path / "a.npz"
    storage.write_arrays(arrays, {"x": np.arange(3000)})
    arrays.write_bytes(arrays.read_bytes()[: int(keep * arrays.stat().st_size)])
    with pytest.raises(storage.DamagedFileError, match=r"a\.npz is damaged .*: delete it\."):
        storage.read_arrays(arrays, "delete it")


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_an_error_while_rendering_is_raised_unchanged_and_leaves_no_file(tmp_path, error):
    def frames():
        yield some_images()
        raise error("no such colour")

    with pytest.raises(error, match=r"^no such colour$"):
        records.write_images(tmp_path / "a.array_record", frames())
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_named_and_leaves_no_file(tmp_path):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, hard))  # no file of this process may be longer
    try:
        with pytest.raises(OSError, match=r"cannot write .*a\.array_record: .*Free some disk space"):
            records.write_images(tmp_path / "a.array_record", [some_images(1000)])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("factor", [1, 2, 3, 16])
def test_pixels_are_the_rounded_means_of_blocks(factor):
    images = np.random.default_rng(factor).integers(0, 256, (2, 3, 4 * factor, 4 * factor, 3), dtype=np.uint8)
    images[0, 0] = 255  # the largest sum of a block
    small = dataset.reduced_images({"visual": images}, 4)["visual"]
    exact = np.array(
        [[cv2.resize(x.astype(np.float64), (4, 4), interpolation=cv2.INTER_AREA) for x in y] for y in images]
    )
    assert small.dtype == np.uint8
    assert small.shape == exact.shape
    assert np.abs(small - exact).max() <= 0.5 + 1e-9


def test_a_bool_pixel_is_true_if_at_least_half_of_its_block_is_true():
    blocks = np.array([[[0, 0], [0, 0]], [[1, 0], [0, 0]], [[0, 1], [1, 0]], [[1, 1], [0, 1]]], bool)
    small = dataset.reduced_images({"segmentation": blocks[..., None]}, 1)["segmentation"]
    assert small.dtype == bool
    assert small.ravel().tolist() == [False, False, True, True]


@pytest.mark.parametrize(("shape", "size"), [((6, 6, 3), 4), ((4, 6, 3), 2), ((4, 4, 3), 0)])
def test_a_size_that_does_not_divide_square_images_is_refused(shape, size):
    with pytest.raises(ValueError, match=f"size is {size}, but the images are {shape[0]} x {shape[1]} pixels: .*mult"):
        dataset.reduced_images({"visual": np.zeros(shape, np.uint8)}, size)
