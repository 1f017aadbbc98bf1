"""The gel's equilibrium against a float64 solver, closed forms and its own balance."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

from sts_jax import tactile

pytestmark = pytest.mark.usefixtures("strict_ranks")

GEL = tactile.Gel()
settle = jax.jit(tactile.settle)


def grid(gel=GEL):
    x, y = tactile.cell_centres(gel)
    return np.asarray(x, float), np.asarray(y, float)


def ball(x, y, radius=0.03, centre=(0.01, -0.02), gap=0.0):
    square = radius**2 - (x - centre[0]) ** 2 - (y - centre[1]) ** 2
    return np.where(square > 0, radius - np.sqrt(np.maximum(square, 0)) + gap, np.inf)


def box(x, y, size=(0.04, 0.03), centre=(0.0, 0.01), tilt=(0.0, 0.0)):
    inside = (np.abs(x - centre[0]) < size[0] / 2) & (np.abs(y - centre[1]) < size[1] / 2)
    return np.where(inside, tilt[0] * y - tilt[1] * x + 0.001, np.inf)


def push(force, x, y):
    return jnp.array([0.3, -0.2, force, y * force, -x * force, 0.01], jnp.float32)


CASES = {
    "sunken ball": (lambda x, y: ball(x, y, gap=-0.002), push(0.3, 0.01, -0.02)),
    "box pushed off its middle": (box, push(0.5, 0.004, 0.012)),
    "box on an edge": (lambda x, y: box(x, y, tilt=(0.02, 0.01)), push(1.0, 0.003, 0.01)),
    "two feet": (
        lambda x, y: np.minimum(box(x, y, (0.004, 0.004), (-0.04, 0.0)), box(x, y, (0.003, 0.01), (0.03, 0.01))),
        push(0.1, -0.01, 0.004),
    ),
    "thin bar": (lambda x, y: box(x, y, (0.1, 0.0021), (0.0, 0.0)), push(0.2, 0.01, 0.0)),
}


def true_pressure(gel, height, wrench):
    """Pressure and motion by BFGS in float64, from another start than that of the gel's Newton method."""
    x, y = grid(gel)
    area = 0.15 * 0.15 / x.size
    there = np.isfinite(height)
    x, y, h = x[there], y[there], height[there]
    fz, mx, my = (float(w) for w in wrench[2:5])
    lever = 0.02

    def energy(u):
        d, a, b = u[0] * 1e-3, u[1] * 1e-3 / lever, u[2] * 1e-3 / lever
        length = np.maximum(d - h - a * y + b * x, 0)
        pressed = gel.stiffness * area * length
        value = 0.5 * np.sum(pressed * length) - fz * d + mx * a + my * b
        slope = np.array([pressed.sum() - fz, (mx - np.sum(pressed * y)) / lever, (my + np.sum(pressed * x)) / lever])
        return value * 1e6, slope * 1e3

    start = [1e3 * h.min() + 0.1, 0, 0]
    for _ in range(5):
        start = minimize(energy, start, jac=True, method="BFGS", options={"gtol": 1e-7, "maxiter": 2000}).x
    d, a, b = start[0] * 1e-3, start[1] * 1e-3 / lever, start[2] * 1e-3 / lever
    pressure = np.zeros(height.shape)
    pressure[there] = gel.stiffness * np.maximum(d - h - a * y + b * x, 0)
    return pressure, np.array([d, a, b])


def check_balance(pressure, wrench):
    """Assert that a pressure has the force and the moments of a wrench, within the tolerance of the gel."""
    (x, y), force = grid(), float(wrench[2])
    cells = np.asarray(pressure, float) * float(tactile.cell_area(GEL))
    assert cells.sum() == pytest.approx(force, rel=0.0051)
    assert (cells * y).sum() == pytest.approx(float(wrench[3]), abs=0.0051 * force * 0.01)
    assert -(cells * x).sum() == pytest.approx(float(wrench[4]), abs=0.0051 * force * 0.01)


@pytest.mark.parametrize("name", CASES)
def test_equilibrium_equals_that_of_a_float64_solver(name):
    make, wrench = CASES[name]
    height = make(*grid())
    got = settle(GEL, jnp.asarray(height, jnp.float32), wrench)
    assert bool(got.balanced)
    pressure, (depth, a, b) = true_pressure(GEL, height, wrench)
    assert float(got.sink) == pytest.approx(depth, abs=2e-6)
    np.testing.assert_allclose(got.turn, [a, b], atol=1e-4)
    np.testing.assert_allclose(got.pressure, pressure, atol=0.01 * pressure.max())
    check_balance(got.pressure, wrench)


def check_limits(got, height):
    """Assert that a result is within the gel's limits of pressure, tilt and depth."""
    x, y = grid()
    pressure = np.asarray(got.pressure)
    assert np.all(np.isfinite(pressure))
    assert 0 <= pressure.min() <= pressure.max() <= GEL.stiffness * GEL.max_depth * 1.001
    assert np.abs(got.turn).max() <= np.tan(GEL.max_tilt) * 1.001
    moved = np.asarray(height, float) - float(got.sink) + float(got.turn[0]) * y - float(got.turn[1]) * x
    assert -np.min(moved) <= max(GEL.max_depth, -np.min(height)) * 1.001


@pytest.mark.parametrize(
    ("height", "wrench"),
    [
        (lambda x, y: box(x, y) + 0.05, push(0.5, 0.0, 0.01)),  # out of reach
        (lambda x, y: np.full(x.shape, np.inf), push(0.5, 0.0, 0.01)),  # no object
        (box, push(0.5, 0.05, 0.01)),  # centre of pressure outside the footprint
        (box, push(0.5, 0.2, 0.01)),  # off the pad
        (box, push(50.0, 0.0, 0.01)),  # deeper than the limit
        (lambda x, y: box(x, y, tilt=(0.0, 0.3)), push(2.0, 0.0, 0.01)),  # a tilt beyond the limit
    ],
)
def test_without_equilibrium_the_result_is_unbalanced_and_within_the_limits(height, wrench):
    got = settle(GEL, jnp.asarray(height(*grid()), jnp.float32), wrench)
    assert not bool(got.balanced)
    check_limits(got, height(*grid()))


def test_32_bit_heights_in_64_bit_mode_have_the_same_balance():
    make, wrench = next(iter(CASES.values()))
    height = jnp.asarray(make(*grid()), jnp.float32)
    expected = settle(GEL, height, wrench)
    with jax.enable_x64(True):
        got = settle(GEL, height, wrench)
    assert bool(got.balanced)
    np.testing.assert_allclose(got.pressure, expected.pressure, atol=1e-3 * float(expected.pressure.max()))


def test_an_overloaded_tip_sinks_to_the_limit():
    x, y = grid()
    tip = np.where((abs(x) < 1e-3) & (abs(y) < 1e-3), 0.0, 0.02)
    got = settle(GEL, jnp.asarray(tip, jnp.float32), push(200.0, 0.0, 0.0))
    assert not bool(got.balanced)
    assert float(got.sink) == pytest.approx(GEL.max_depth, rel=1e-3)


@pytest.mark.parametrize("force", [0.0, -1.0])
def test_without_force_there_is_no_motion_and_no_pressure(force):
    got = settle(GEL, jnp.asarray(box(*grid()) - 0.0012, jnp.float32), push(force, 0.0, 0.0))
    assert bool(got.balanced)
    assert float(got.sink) == 0
    assert not np.any(got.turn)
    assert not np.any(got.pressure)


def odd_height(rng, x, y):
    """The underside of one to four random ellipsoids, bars, plates or wedges."""
    height = np.full(x.shape, np.inf)
    for _ in range(rng.integers(1, 5)):
        centre, size = rng.uniform(-0.05, 0.05, 2), rng.choice([[0.1, 0.002], [0.02, 0.04], [0.001, 0.001]])
        tilt = rng.normal(size=2) * rng.choice([0, 0.005, 0.03, 0.5])
        plate, round_part = box(x, y, size, centre, tilt), ball(x, y, rng.uniform(0.005, 0.05), centre)
        height = np.minimum(height, plate if rng.integers(3) else round_part)
    return height + rng.uniform(-0.003, 0.003)


def odd_push(rng, height, x, y):
    """A load of 0.02 to 50 N, with its centre among the lowest cells, at their rim or outside of them."""
    low = height < height.min() + 0.001
    share = rng.dirichlet(np.full(low.sum(), rng.choice([0.05, 1, 10])))
    shift = rng.normal(size=2) * rng.choice([0, 0, 0, 0.002, 0.03])
    return push(np.exp(rng.uniform(np.log(0.02), np.log(50))), share @ x[low] + shift[0], share @ y[low] + shift[1])


def test_random_undersides_under_random_loads_are_balanced_or_flagged():
    rng = np.random.default_rng(11)
    x, y = grid()
    balanced = 0
    for _ in range(200):
        height = odd_height(rng, x, y)
        if not np.any(np.isfinite(height)):
            continue
        wrench = odd_push(rng, height, x, y)
        got = settle(GEL, jnp.asarray(height, jnp.float32), wrench)
        check_limits(got, height)
        if got.balanced:
            balanced += 1
            check_balance(got.pressure, wrench)
    assert 60 < balanced < 250


def test_indentation_by_the_pose_alone_has_its_depth_up_to_the_limit():
    height = ball(*grid(), gap=-0.001)
    for sink in (0, 0.01):
        got = tactile.indent(GEL, jnp.asarray(height - sink, jnp.float32))
        np.testing.assert_allclose(got.pressure, 2e6 * np.clip(sink - height, 0, 0.005), atol=5)


def of_side(side):
    """A gel that is scaled in all lengths, at the same pressures, and a function of the place of a force on a ball.

    Places are those on the gel of 0.15 m. The function returns the rotation vector and whether it is balanced.
    """
    scale = side / 0.15
    gel = dataclasses.replace(
        GEL, size=(side, side), max_depth=GEL.max_depth * scale, stiffness=GEL.stiffness / scale**3
    )
    height = jnp.asarray(ball(*grid(gel), 0.02 * scale, (0.01 * scale, -0.02 * scale)), jnp.float32)

    def motion(place):
        found = settle(gel, height, push(0.05, place[0] * scale, place[1] * scale))
        return found.turn, found.balanced

    return motion


@pytest.mark.parametrize("side", [0.015, 0.005, 1.0])
def test_a_scaled_gel_has_the_same_rotations_derivatives_and_balances(side):
    plain, scaled = of_side(0.15), of_side(side)
    for place, balanced in (((0.0102, -0.0199), True), ((0.06, 0.0), False)):
        (one, first), (two, second) = plain(place), scaled(place)
        np.testing.assert_allclose(two, one, rtol=0.01, atol=1e-5)
        assert first == second == balanced
    middle = jnp.array([0.0102, -0.0199])
    expected, jacobian = (jax.jacfwd(lambda at, motion=motion: motion(at)[0])(middle) for motion in (plain, scaled))
    np.testing.assert_allclose(jacobian, expected, rtol=0.01, atol=0.01 * jnp.abs(expected).max())
