"""Bilinear interpolation against SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

from sts_jax import _sampling

RNG = np.random.default_rng(0)
IMAGE = RNG.uniform(size=(7, 9, 3)).astype(np.float32)
COLUMN, ROW = RNG.uniform(-12, 20, (2, 40, 5)).astype(np.float32)


def scipys(image, column, row, mode):
    channels = [ndimage.map_coordinates(image[..., k], [row, column], order=1, mode=mode) for k in range(3)]
    return np.stack(channels, -1)


@pytest.mark.parametrize(("wrap", "mode"), [(False, "nearest"), (True, "grid-wrap")])
def test_bilinear_equals_scipy_also_beyond_the_image(wrap, mode):
    found = jax.jit(lambda *given: _sampling.bilinear(*given, wrap=wrap))(IMAGE, COLUMN, ROW)
    np.testing.assert_allclose(found, scipys(IMAGE, COLUMN, ROW, mode), atol=1e-5)
    one = _sampling.bilinear(jnp.asarray(IMAGE[..., 0]), jnp.asarray(COLUMN), jnp.asarray(ROW), wrap=wrap)
    np.testing.assert_allclose(one, found[..., 0], atol=1e-6)


def test_bilinear_batch_equals_scipy_for_each_image():
    images = np.stack([IMAGE, IMAGE[::-1]])
    column, row = COLUMN.reshape(2, -1), ROW.reshape(2, -1)
    found = jax.jit(_sampling.bilinear_batch)(images, column, row)
    for k in range(2):
        np.testing.assert_allclose(found[k], scipys(images[k], column[k], row[k], "nearest"), atol=1e-5)


@pytest.mark.parametrize("offset", [(0.0, 0.0), (2.25, -1.5), (-8.9, 6.9), (30.0, -0.5)])
def test_shifted_equals_scipy_with_zeros_around_the_image(offset):
    image = IMAGE[..., 0]
    around = np.pad(image, ((8, 8), (10, 10)))
    found = _sampling.shifted(jnp.asarray(around), *map(jnp.float32, offset), image.shape)
    column, row = np.meshgrid(np.arange(9) + offset[0], np.arange(7) + offset[1])
    expected = ndimage.map_coordinates(np.pad(image, 1), [row + 1, column + 1], order=1, mode="constant")
    np.testing.assert_allclose(found, expected, atol=1e-5)
