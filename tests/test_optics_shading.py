"""Shading against loops in NumPy float64, and the hidden sky against traced rays."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from optics_bodies import rays_hidden

from sts_jax import optics

pytestmark = pytest.mark.usefixtures("strict_ranks")

PAD = (0.15, 0.15)  # m


def test_srgb_conversion_equals_the_standard():
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
    plain = sample(jnp.full((1, 1, 3), 0.5), jnp.zeros((7, 2)))
    np.testing.assert_array_equal(plain, np.full((7, 3), 0.5))


def test_shading_equals_lamberts_law_behind_a_milky_skin():
    room, shape = optics.Room(), (97, 53)
    rng = np.random.default_rng(0)
    albedo, empty = rng.uniform(size=(2, *shape, 3))
    normals = rng.normal(size=(*shape, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    heights, hidden = rng.uniform(-0.002, 0.2, shape), rng.uniform(size=shape)
    arrays = [jnp.asarray(a, jnp.float32) for a in (albedo, normals, heights, empty, hidden)]
    got = np.asarray(jax.jit(optics.shade)(room, *arrays))
    for i, j in zip(rng.integers(shape[0], size=100), rng.integers(shape[1], size=100), strict=True):
        light = np.array(room.ambient, float)
        for direction, color in zip(np.asarray(room.directions, float), np.asarray(room.colors), strict=True):
            light = light + max(direction @ normals[i, j] / np.linalg.norm(direction), 0) * color
        height = max(heights[i, j], 0)
        light *= 1 - room.crease * hidden[i, j] * np.exp(-height / room.crease_height)
        through = np.exp(-height / room.haze)
        behind = through * np.asarray(room.tint) * albedo[i, j] * light + (1 - through) * empty[i, j]
        sky = empty[i, j] / (1 - room.milk * hidden[i, j])
        expected = (1 - room.milk) * behind + room.milk * (1 - hidden[i, j]) * sky
        np.testing.assert_allclose(got[i, j], expected, atol=1e-5)


def test_the_empty_view_has_the_papers_colour_with_vignette_walls_and_shadow():
    room, shape = optics.Room(), (97, 53)
    rng = np.random.default_rng(0)
    radius, walls, hidden = rng.uniform(0, 2.8, shape), rng.uniform(size=shape), rng.uniform(size=shape)
    image = np.asarray(jax.jit(optics.empty_view)(room, *map(jnp.float32, (radius, walls, hidden))))
    colour = ((np.array([178, 178, 204]) / 255 + 0.055) / 1.055) ** 2.4
    light = (1 - room.vignette * radius) * walls**2 * (1 - room.milk * hidden)
    np.testing.assert_allclose(image, light[..., None] * colour, atol=1e-5)
    middle = optics.empty_view(room, jnp.zeros(()), jnp.ones(()), jnp.zeros(()))
    assert np.array_equal(np.round(np.asarray(optics.to_srgb(middle)) * 255), [178, 178, 204])


def test_walls_get_darker_with_depth():
    room, distance = optics.Room(), 0.1
    places = np.array([[0.0, 0.0], [0.074, -0.074], [0.076, 0.0], [0.0, -0.09], [-0.1, 0.02], [0.09, 0.1]])
    on_pad = jnp.array([True, True, False, False, False, False])
    got = optics.housing(room, on_pad, jnp.asarray(places, jnp.float32), PAD, distance)
    expected = []
    for x, y in places:
        # The ray (0, 0, -distance) + s (x, y, distance) meets the nearest of the walls |x| = 75 mm, |y| = 75 mm.
        s = min(0.075 / abs(x) if x else np.inf, 0.075 / abs(y) if y else np.inf)
        expected.append(1.0 if s > 1 else room.rim * np.exp(-distance * (1 - s) / room.rim_depth))
    np.testing.assert_allclose(got, expected, atol=1e-6)
    assert np.all(np.asarray(got)[2:] < 0.35)
    assert got[2] > got[3] > got[4] > 0


def centres(cells):
    return ((np.arange(cells) + 0.5) / cells - 0.5) * 0.15


def hidden_by(heights, top, x, y):
    return np.asarray(jax.jit(optics.hidden_sky)(*map(jnp.float32, (heights,)), PAD, *map(jnp.float32, (top, x, y))))


def test_hidden_sky_under_a_ball_agrees_with_traced_rays():
    x, y = np.meshgrid(centres(150), centres(150))
    square = x**2 + y**2
    heights = np.where(square < 0.02**2, 0.02 - np.sqrt(np.maximum(0.02**2 - square, 0)), np.inf)
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.02)
    ball.apply_translation((0, 0, 0.02))
    x, y = np.linspace(-0.07, 0.07, 29), np.linspace(-0.07, 0.07, 15)
    truth = rays_hidden(ball, [(a, b) for b in y for a in x]).reshape(15, 29)
    got = hidden_by(heights, 0.04, x, y)
    assert np.abs(got - truth).mean() < 0.02
    assert np.abs(got - truth).max() < 0.1


def test_hidden_sky_beside_a_straight_edge_equals_the_closed_form():
    heights = np.where(centres(150)[None, :] < 0, 0.0, np.inf) * np.ones((150, 1))
    x = np.linspace(0.01, 0.07, 25)
    got = hidden_by(heights, 0.04, x, np.zeros(1))[0]
    ends = 0.075 / np.sqrt(0.075**2 + 0.04**2)  # the pad is finite along the edge and across it
    away = x / np.sqrt(x**2 + 0.04**2)
    back = (x + 0.075) / np.sqrt((x + 0.075) ** 2 + 0.04**2)
    np.testing.assert_allclose(got, 0.5 * (back - away) * ends, atol=0.01)


def test_absent_and_distant_objects_hide_no_sky():
    x, y = np.meshgrid(centres(150), centres(150))
    for low, most in ((np.inf, 0), (-0.1, 0), (0.5, 0.01)):  # no object, below the skin, and far above it
        heights = np.where((abs(x) < 0.03) & (abs(y) < 0.03), low, np.inf)
        assert hidden_by(heights, low + 0.05, centres(30), centres(40)).max() <= most
