"""Windows and interpolation, compared with drawn rectangles, a gradient and the renderer's mask."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sts_jax as sts
from sts_jax import objects, physics
from sts_jax.statespace import window

SIZE = 64
PLACE = (np.arange(SIZE) + 0.5) / SIZE
locate, cut = jax.jit(window.locate), jax.jit(window.cut, static_argnums=2)


def rectangle(centre, angle, extent):
    """An image of a turned rectangle. Lengths are shares of the side, and the angle is in radians."""
    x, y = np.meshgrid(PLACE - centre[0], PLACE - centre[1])
    along, across = np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x
    inside = (np.abs(along) < extent[0] / 2) & (np.abs(across) < extent[1] / 2)
    return np.repeat(inside[..., None], 3, axis=-1).astype(np.float32) * 0.5


@pytest.mark.parametrize("angle", [0.0, 0.5, -1.2, np.pi / 2 - 0.1])
def test_window_follows_a_rectangle(angle):
    centre, extent = (0.45, 0.55), (0.5, 0.2)
    found = locate(rectangle(centre, angle, extent)[None])
    np.testing.assert_allclose(found.centre[0], centre, atol=0.01)
    line = np.array([np.cos(angle), np.sin(angle)])
    assert abs(np.dot(found.angle[0], line)) > np.cos(0.03)  # up to its sign
    np.testing.assert_allclose(found.side[0], window.MARGIN * extent[0], atol=2.5 / SIZE)


def test_window_ignores_noise():
    size = 128
    rng = np.random.default_rng(0)
    clean = np.repeat(np.repeat(rectangle((0.45, 0.55), 0.5, (0.5, 0.2)), 2, 0), 2, 1)
    noisy = clean + rng.normal(0, 4 / 255, (8, size, size, 3)).astype(np.float32)
    assert jax.jit(window.shows)(noisy - clean).sum((1, 2)).min() > 50
    expected, found = locate(clean[None]), locate(noisy)
    np.testing.assert_allclose(found.centre, np.repeat(expected.centre, 8, 0), atol=1.5 / size)
    np.testing.assert_allclose(found.angle, np.repeat(expected.angle, 8, 0), atol=0.01)
    np.testing.assert_allclose(found.side, np.repeat(expected.side, 8), atol=2.5 / size)


def test_window_of_an_unchanged_image_is_the_whole_image():
    faint = jnp.full((1, SIZE, SIZE, 3), 0.9 * window.THRESHOLD, jnp.float32)
    found = locate(faint)
    np.testing.assert_array_equal(found.centre, [[0.5, 0.5]])
    np.testing.assert_array_equal(found.angle, [[1, 0]])
    np.testing.assert_array_equal(found.side, [1])
    np.testing.assert_allclose(cut(faint, found, SIZE // 2), 0.9 * window.THRESHOLD, rtol=1e-5)


def test_cut_of_a_gradient_is_the_gradient_along_the_window():
    column, row = np.meshgrid(PLACE, PLACE)
    image = (0.2 * column + 0.5 * row)[None, :, :, None].astype(np.float32)
    cos, sin = np.cos(0.4), np.sin(0.4)
    square = window.Window(jnp.array([[0.5, 0.45]]), jnp.array([[cos, sin]], jnp.float32), jnp.array([0.4]))
    x, y = np.meshgrid(*[((np.arange(8) + 0.5) / 8 - 0.5) * 0.4] * 2)
    expected = 0.2 * (0.5 + cos * x - sin * y) + 0.5 * (0.45 + sin * x + cos * y)
    np.testing.assert_allclose(cut(image, square, 8)[0, ..., 0], expected, atol=1e-5)


def test_sample_fades_to_zero_over_one_pixel_outside_the_image():
    places = jnp.array([[[7, 7], [7.5, 3], [3, -0.25], [8, 8], [-1, 3], [1e4, -1e4]]], jnp.float32)
    found = jax.jit(window.sample)(jnp.ones((1, 8, 8, 3)), places)
    np.testing.assert_allclose(found[0, :, 0], [1, 0.5, 0.75, 0, 0, 0], atol=1e-6)


@pytest.mark.parametrize("category", ["camera", "scissors"])
def test_shows_includes_the_object_and_excludes_its_shadow(category):
    """For an object at rest, compared with the renderer's segmentation."""
    sensor, body = sts.Sensor(), objects.make(jax.random.key(0), category)
    pose, wrench = physics.place(body, sensor)
    resting = sts.sense(sensor, body, pose, wrench, resolution=(SIZE, SIZE))
    away = sts.sense(sensor, body, pose.at[2].set(-1), 0 * wrench, resolution=(SIZE, SIZE))
    shown = np.asarray(window.shows((resting.visual - away.visual)[None]))[0] > 0
    mask = np.asarray(resting.segmentation) > 0
    assert (mask & ~shown).sum() < 0.05 * mask.sum()
    faintly = np.abs(resting.visual - away.visual).max(-1) > 4 / 255
    shadow = (faintly & ~mask).sum()
    assert shadow > 0.5 * mask.sum()  # a smaller threshold would include it
    assert (shown & ~mask).sum() < 0.4 * shadow
