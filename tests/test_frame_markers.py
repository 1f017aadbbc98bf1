"""Dots in the skin: where they are drawn, and how they move under one body and under several."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from optics_bodies import at, ball

from sts_jax import Sensor, optics, sense, tactile, touch

MARKERS = tactile.Markers(darkness=0.7)
PLAIN = Sensor(phong=tactile.Phong(darkening=0.005, diffuse=0.2, specular=0.0))  # no pixel is clipped
DOTTED = dataclasses.replace(PLAIN, markers=MARKERS)
BALL = ball()
HALF = (np.arange(150) + 0.5) / 1e3 - 0.075  # a pixel and a cell are 1 mm
X, Y = np.meshgrid(HALF, HALF)


def load(x, y, force=(0.0, 0.0), normal=0.4):
    """Wrench on a body that presses at (x, y), and on the skin with a tangential force (N)."""
    fx, fy = -force[0], -force[1]
    return jnp.array([fx, fy, normal, y * normal, -x * normal, x * fy - y * fx])


def centre(share, x, y):
    """Centre of the dot near a point (m)."""
    weight = (1 - share) * (np.hypot(X - x, Y - y) < 0.005)
    return np.array([(weight * X).sum(), (weight * Y).sum()]) / weight.sum()


@pytest.mark.slow
@pytest.mark.parametrize("force", [(0.0, 0.0), (0.25, -0.1)])
def test_dots_move_with_the_skin_under_a_ball_and_nowhere_else_in_both_streams(force):
    plain, frame = (
        sense(sensor, BALL, at(0.02, -0.03, 0.03), load(0.02, -0.03, force), resolution=(150, 150))
        for sensor in (PLAIN, DOTTED)
    )
    assert plain.shear is None
    assert frame.balanced
    assert np.array_equal(frame.depth, plain.depth)
    passed = np.asarray(frame.tactile / plain.tactile, float)
    linear = optics.to_linear(frame.visual) / optics.to_linear(plain.visual)
    assert np.allclose(passed, passed[..., :1], atol=1e-3)
    assert np.allclose(linear, passed, atol=1e-3)
    passed = passed[..., 0]
    assert passed.min() == pytest.approx(1 - MARKERS.darkness, abs=1e-3)
    area = np.pi * (MARKERS.radius**2 + 0.001**2 / 12) / MARKERS.pitch**2  # with edges one pixel wide
    assert (1 - passed).mean() == pytest.approx(MARKERS.darkness * area, rel=0.02)
    for x, y in ((0.0, 0.0), (0.05, 0.02), (-0.03, -0.03)):
        assert np.allclose(centre(passed, x, y), (x, y), atol=1e-4)
    shift = np.asarray(frame.shear[45, 95], float)
    depth = 0.1 - float(plain.depth[45, 95])
    # A dot at (x, y), raised by the depth of the imprint, is seen at (x, y) / (1 - depth / distance).
    seen = (np.array([0.02, -0.03]) + shift) / (1 - depth / 0.1)
    assert np.allclose(centre(passed, *seen), seen, atol=2e-4)
    if force == (0.0, 0.0):
        assert not frame.shear.any()
    else:
        assert 0.0005 < shift[0] < MARKERS.friction * depth / MARKERS.stiffness
        assert shift[1] == pytest.approx(-0.4 * shift[0], rel=0.02)


@pytest.mark.slow
def test_the_shear_under_several_bodies_is_the_sum_and_a_body_that_does_not_press_has_none():
    places = jnp.stack([at(x, y, 0.03) for x, y in ((0.04, 0.0), (-0.04, 0.01), (0.0, -0.05))])
    wrenches = jnp.stack(
        [load(0.04, 0.0, (0.2, 0.1)), load(-0.04, 0.01, (0.0, 0.25), 0.5), load(0.0, -0.05, (0.3, 0), 0.0)]
    )
    frame = sense(DOTTED, [BALL, BALL, BALL], places, wrenches, resolution=(16, 16))
    assert frame.balanced.all()
    alone = [
        tactile.shear(DOTTED.gel, MARKERS, jnp.where(side, frame.pressure, 0), wrench).displacement
        for side, wrench in zip((X > 0, X < 0), wrenches[:2], strict=True)
    ]
    assert all(abs(part).max() > 5e-4 for part in alone)
    assert np.allclose(frame.shear, alone[0] + alone[1], atol=1e-6)


def test_touch_draws_the_dots_at_a_given_displacement_of_the_skin():
    imprint, shear = jnp.zeros((150, 150)), jnp.full((150, 150, 2), 0.002)
    plain, still = touch(PLAIN, imprint), touch(DOTTED, imprint)
    moved = touch(DOTTED, imprint, shear=shear)
    wanted = tactile.dots(DOTTED.gel, MARKERS, shear, jnp.float32(X), jnp.float32(Y), 0.001)
    assert np.allclose(moved, plain * wanted[..., None], atol=1e-4)
    assert np.allclose(moved[2:, 2:], still[:-2, :-2], atol=1e-3)
    for sensor, shape in ((PLAIN, (150, 150, 2)), (DOTTED, (149, 150, 2))):
        with pytest.raises(ValueError, match=r"shear has the shape .* \(150, 150, 2\) of the gel's grid"):
            touch(sensor, imprint, shear=jnp.zeros(shape))


@pytest.mark.slow
def test_the_derivative_of_the_image_by_the_tangential_force_equals_finite_differences():
    weights = jnp.asarray(np.random.default_rng(0).normal(size=(32, 32, 3)), jnp.float32)

    @jax.jit
    @jax.value_and_grad
    def value(force):
        wrench = load(0.02, -0.03) + jnp.stack(
            [-force[0], -force[1], *jnp.zeros(3), -0.02 * force[1] - 0.03 * force[0]]
        )
        return jnp.sum(
            weights * sense(DOTTED, BALL, at(0.02, -0.03, 0.03), wrench, resolution=(32, 32), crop=True).tactile
        )

    force, step = jnp.array([0.2, 0.05]), jnp.array([0.002, -0.003])
    slope = value(force)[1]
    difference = value(force + step)[0] - value(force - step)[0]
    assert float(jnp.sum(slope * 2 * step)) == pytest.approx(float(difference), rel=0.05)
    assert abs(float(difference)) > 0.01
