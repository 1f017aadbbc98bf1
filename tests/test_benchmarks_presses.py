"""The geometry of the real presses, and a short fit that beats the background."""

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import presses
from sts_jax import tactile


@pytest.fixture(scope="module")
def recorded():
    return presses.read()


def test_skin_under_a_ball_has_the_points_and_normals_of_the_ball():
    row, column = np.array([50, 50, 90, 20, 60]), np.array([60, 100, 60, 50, 65])
    normals, points = presses.skin_under_ball(np.array([60.0, 50.0]), 55.0, row, column, (120, 160))
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1)
    np.testing.assert_allclose(normals[0], [0, 0, -1])
    assert normals[1][0] > 0.5  # faces right on the right of the middle
    assert normals[2][1] > 0.5  # faces down below the middle
    # All points are one radius from one centre, along their normals.
    centres = points - presses.RADIUS * normals
    np.testing.assert_allclose(centres, np.tile(centres[:1], (5, 1)), atol=1e-9)
    np.testing.assert_allclose(centres[0, :2], presses.PITCH * (np.array([60, 50]) - [79.5, 59.5]), atol=1e-9)
    # The rim of the contact lies in the gel's face. Its middle is as deep as the cap of the ball is high.
    _, rim = presses.skin_under_ball(np.array([60.0, 50.0]), 55.0, np.array([50]), np.array([115]), (120, 160))
    assert rim[0, 2] == pytest.approx(0, abs=1e-9)
    cap = presses.RADIUS - np.sqrt(presses.RADIUS**2 - (55 * presses.PITCH) ** 2)
    assert -points[0, 2] == pytest.approx(cap)


def test_normals_are_the_gradients_of_the_points():
    rows, columns = np.meshgrid(np.arange(30, 70), np.arange(40, 80), indexing="ij")
    normals, points = presses.skin_under_ball(np.array([60.3, 50.7]), 60.0, rows, columns, (120, 160))
    down, across = np.gradient(points[..., 2], presses.PITCH)
    inner = (slice(1, -1), slice(1, -1))
    np.testing.assert_allclose((-normals[..., 0] / normals[..., 2])[inner], across[inner], atol=1e-3)
    np.testing.assert_allclose((-normals[..., 1] / normals[..., 2])[inner], down[inner], atol=1e-3)


def test_a_quarter_of_the_presses_is_held_out_and_the_background_alone_has_19_5_dB(recorded):
    held = presses.held_out(len(recorded.images))
    assert held.sum() == 12
    asked = presses.pixels(recorded, np.flatnonzero(held))
    assert presses.psnr(asked.background, asked.color) == pytest.approx(19.5, abs=0.1)


@pytest.mark.parametrize("near", [True, False], ids=["near", "far"])
def test_draw_equals_the_shader_of_the_library(recorded, near):
    given = presses.pixels(recorded, np.array([5]), every=8)
    place = jnp.array([[14.0, 3, -5], [-9, 12, -8]])
    colors = jnp.array([[0.5, 0.2, 0.1], [0.0, 0.3, 0.9]])
    lights = tactile.Leds(1e-3 * place, colors) if near else tactile.Lights(place, colors)
    constants = tactile.Phong()
    pressed = tactile.phong(constants, lights, given.normals, given.points)
    face = given.points * jnp.array([[1.0, 1, 0]])
    flat = tactile.phong(constants, lights, jnp.zeros_like(face).at[:, 2].set(-1), face)
    expected = given.background * (1 + pressed - flat)
    np.testing.assert_allclose(presses.draw(constants, lights, given), expected, atol=1e-5)


@pytest.mark.parametrize("near", [True, False], ids=["near", "far"])
def test_short_fit_beats_the_background_on_held_out_presses(recorded, near):
    some, other = (presses.pixels(recorded, np.array(which), every=16) for which in ([4, 12, 20, 28, 36], [0, 21, 33]))
    before = presses.draw(*presses.shader(presses.start(some, near=near), near=near), some)
    constants, lights = presses.fit(some, near=near, steps=50)
    after = presses.draw(constants, lights, some)
    assert presses.psnr(after, some.color) > presses.psnr(before, some.color) + 0.3
    drawn = presses.draw(constants, lights, other)
    assert presses.psnr(drawn, other.color) > presses.psnr(other.background, other.color) + 5
