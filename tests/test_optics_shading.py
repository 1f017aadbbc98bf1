"""Shading against loops in NumPy float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sts_jax import optics


@pytest.fixture(autouse=True)
def strict_ranks():
    with jax.numpy_rank_promotion("raise"):
        yield


def test_srgb_is_the_standards():
    values = np.linspace(0, 1, 257)
    linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(optics.to_linear(jnp.asarray(values)), linear, atol=1e-6)
    np.testing.assert_allclose(optics.to_srgb(jnp.asarray(linear)), values, atol=1e-6)
    assert np.all(np.isfinite(jax.vmap(jax.grad(optics.to_srgb))(jnp.zeros(3))))


def test_texture_is_bilinear_with_its_first_row_at_v_zero():
    texture = np.random.default_rng(0).uniform(size=(8, 8, 3))
    texels = (np.stack(np.meshgrid(np.arange(8), np.arange(8)), -1) + 0.5) / 8
    sample = jax.jit(optics.sample_texture)
    table = jnp.asarray(texture, jnp.float32)
    np.testing.assert_allclose(sample(table, jnp.asarray(texels, jnp.float32)), texture, atol=1e-6)
    between = jnp.full((1, 1, 2), 3 / 8)  # the corner of four texels
    np.testing.assert_allclose(sample(table, between)[0, 0], texture[2:4, 2:4].mean((0, 1)), atol=1e-5)
    np.testing.assert_allclose(sample(table, between + 1), sample(table, between), atol=1e-5)


@pytest.mark.parametrize("shape", [(64, 64), (97, 53), (200, 200)])
def test_shading_is_lamberts_law_in_haze(shape):
    room = optics.Room()
    rng = np.random.default_rng(0)
    albedo, empty = rng.uniform(size=(2, *shape, 3))
    normals = rng.normal(size=(*shape, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    heights = rng.uniform(-0.002, 0.2, shape)
    arrays = [jnp.asarray(a, jnp.float32) for a in (albedo, normals, heights, empty)]
    got = np.asarray(jax.jit(optics.shade)(room, *arrays))
    for i, j in zip(rng.integers(shape[0], size=100), rng.integers(shape[1], size=100), strict=True):
        light = np.array(room.ambient, float)
        for direction, color in zip(np.asarray(room.directions, float), np.asarray(room.colors), strict=True):
            light = light + max(direction @ normals[i, j] / np.linalg.norm(direction), 0) * color
        through = np.exp(-max(heights[i, j], 0) / room.haze)
        expected = through * albedo[i, j] * light + (1 - through) * empty[i, j]
        np.testing.assert_allclose(got[i, j], expected, atol=1e-5)


def test_the_empty_view_has_the_originals_colour_in_its_middle():
    room = optics.Room()
    image = optics.empty_view(room, jnp.array([[0.0, 1.0], [2.0, 2.0]]), jnp.array([[1.0, 1.0], [1.0, 0.0]]))
    assert np.array_equal(np.round(np.asarray(optics.to_srgb(image))[0, 0] * 255), [178, 178, 204])
    assert np.all(np.diff(np.asarray(image).reshape(-1, 3)[:, 0]) < 0)
