"""Reduction of images to a lower resolution, compared with OpenCV and with counts of pixels."""

import cv2
import numpy as np
import pytest

from sts_jax import dataset


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
    with pytest.raises(
        ValueError, match=f"size is {size}, but the images are {shape[0]} x {shape[1]} pixels: .*multiple"
    ):
        dataset.reduced_images({"visual": np.zeros(shape, np.uint8)}, size)
