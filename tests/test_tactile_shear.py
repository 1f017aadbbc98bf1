"""Shear of the skin against closed forms, a float64 solver and Masing's rule, and the dots that move with it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

from sts_jax import tactile

pytestmark = pytest.mark.usefixtures("strict_ranks")

GEL = tactile.Gel()
MARKERS = tactile.Markers()
STIFFNESS = MARKERS.stiffness * GEL.stiffness
FRICTION = MARKERS.friction
AREA = float(tactile.cell_area(GEL))
X, Y = (np.asarray(part, float) for part in tactile.cell_centres(GEL))
shear = jax.jit(tactile.shear)


def found(pressure, force=(0.0, 0.0), moment=0.0, traction=None):
    """Shear under a tangential force (N) of the object on the skin and its moment about the sensor's origin (N m)."""
    wrench = jnp.array([-force[0], -force[1], 0, 0, 0, -moment], jnp.float32)
    return shear(GEL, MARKERS, jnp.asarray(pressure, jnp.float32), wrench, traction)


def punch(pressure=1000.0, centre=(0.02, -0.03)):
    inside = (abs(X - centre[0]) < 0.015) & (abs(Y - centre[1]) < 0.01)
    return np.where(inside, pressure, 0)


def disc(radius, pressure=1000.0):
    return np.where(np.hypot(X, Y) < radius, pressure, 0)


def ball(radius=0.012, centre=(0.0, 0.0), pressure=3000.0):
    return np.maximum(0, pressure * (1 - ((X - centre[0]) ** 2 + (Y - centre[1]) ** 2) / radius**2))


def test_a_flat_punch_sticks_and_moves_the_skin_by_force_over_stiffness_and_area_until_all_of_it_slips():
    pressure = punch()
    normal, area = pressure.sum() * AREA, (pressure > 0).sum() * AREA
    for share in (0.1, 0.5, 0.99):
        force = share * FRICTION * normal * np.array([0.6, -0.8])
        out = found(pressure, force, 0.02 * force[1] + 0.03 * force[0])  # through the punch's centre
        assert out.held
        assert not out.slipping.any()
        wanted = force / (STIFFNESS * area)
        assert np.allclose(out.traction[pressure > 0], STIFFNESS * wanted, rtol=1e-4, atol=1e-2)
        assert np.allclose(out.displacement[45, 95], wanted, rtol=1e-3)  # 5 mm from the punch's edge
        assert np.allclose(jnp.sum(out.displacement, axis=(0, 1)) * AREA, wanted * area, rtol=1e-3)
        assert abs(out.displacement[:, :50]).max() < 1e-12  # 30 mm from it
    out = found(pressure, 1.02 * FRICTION * normal * np.array([0.6, -0.8]), 1.02 * FRICTION * normal * 0.002)
    assert not out.held
    assert np.array_equal(out.slipping, pressure > 0)
    assert np.allclose(out.traction[pressure > 0], FRICTION * 1000 * np.array([0.6, -0.8]), rtol=1e-3)


@pytest.mark.parametrize("stick", [0.008, 0.014, 0.019])
def test_a_twisted_disc_slips_outside_the_radius_of_the_closed_form(stick):
    radius, limit, far = 0.02, FRICTION * 1000, np.hypot(X, Y)
    inside = far < radius
    # Traction k t r within the radius c of sticking, with k t c = m p, and m p outside.
    wanted = limit * np.minimum(far / stick, 1)[..., None] * np.stack([-Y, X], axis=-1) / far[..., None]
    moment = (limit * np.minimum(far / stick, 1) * far)[inside].sum() * AREA
    assert moment == pytest.approx(2 * np.pi * limit * (stick**3 / 4 + (radius**3 - stick**3) / 3), rel=0.02)
    out = found(disc(radius), moment=moment)
    assert out.held
    assert np.array_equal(np.asarray(out.slipping), inside & (far > stick))
    assert np.allclose(out.traction[inside], wanted[inside], atol=2e-3 * limit)
    assert not found(disc(radius), moment=1.03 * 2 / 3 * np.pi * limit * radius**3).held


@pytest.mark.parametrize("stick", [0.003, 0.006, 0.01])
def test_a_ball_sticks_within_the_radius_of_the_closed_form(stick):
    radius, top = 0.012, FRICTION * 3000.0
    # Traction q within the radius c of sticking, with q = m p(c), and m p outside.
    q = top * (1 - stick**2 / radius**2)
    force = np.pi * (q * stick**2 + top * (radius**2 / 2 - stick**2 + stick**4 / radius**2 / 2))
    out = found(ball(radius), (0, force))
    assert out.held
    assert float(out.traction[75, 75, 1]) == pytest.approx(q, rel=0.01)
    far = np.hypot(X, Y)
    assert not (np.asarray(out.slipping) & (far < stick - 0.0006)).any()
    assert np.asarray(out.slipping)[(far > stick + 0.0006) & (far < radius)].all()


def true_traction(pressure, force, moment, start):
    """Traction by minimising the energy of springs with friction by BFGS in float64."""
    there = pressure > 0
    x, y, limit = X[there], Y[there], FRICTION * pressure[there] / STIFFNESS * 1e3  # mm
    s0 = start[there] / STIFFNESS * 1e3
    lever = 0.01
    load = np.array([*force, moment / lever]) / (STIFFNESS * AREA) * 1e3

    def stretches(w):
        v = np.stack([s0[:, 0] + w[0] - w[2] * y / lever, s0[:, 1] + w[1] + w[2] * x / lever])
        size = np.hypot(*v)
        return v * np.where(size > limit, limit / np.maximum(size, 1e-300), 1), size

    def energy(w):
        q, size = stretches(w)
        value = np.where(size > limit, limit * size - limit**2 / 2, size**2 / 2).sum() - load @ w
        return value, np.array([q[0].sum(), q[1].sum(), (x * q[1] - y * q[0]).sum() / lever]) - load

    w = np.zeros(3)
    for _ in range(5):
        w = minimize(energy, w, jac=True, method="BFGS", options={"gtol": 1e-10, "maxiter": 5000}).x
    assert abs(energy(w)[1]).max() < 1e-5 * abs(load).max()  # the given load is below the limit
    traction = np.zeros((*pressure.shape, 2))
    traction[there] = stretches(w)[0].T * STIFFNESS / 1e3
    return traction


CONTACTS = {
    "ball": ball(centre=(0.03, -0.02)),
    "edge": np.maximum(0, punch() * (1 + 60 * (X - 0.03) + 30 * (Y + 0.03))),
    "two feet": ball(0.004, (-0.04, 0.01)) + punch(500.0, (0.03, 0.01)),
    "noise": np.where(np.random.default_rng(0).uniform(size=X.shape) < 0.02, 2000 * abs(np.sin(90 * X + 40 * Y)), 0),
}


@pytest.mark.parametrize("share", [0.3, 0.6])
@pytest.mark.parametrize("name", CONTACTS)
def test_the_traction_agrees_with_a_float64_solver_also_with_a_history(name, share):
    pressure = CONTACTS[name]
    normal = pressure.sum() * AREA
    x, y = (pressure * X).sum() / pressure.sum(), (pressure * Y).sum() / pressure.sum()
    spin = (pressure * np.hypot(X - x, Y - y)).sum() * AREA
    force = share * FRICTION * normal * np.array([0.9, -0.5])
    moment = x * force[1] - y * force[0] + 0.8 * share * FRICTION * spin
    first = found(pressure, force, moment)
    # Afterwards, the object is lifted a little, and the load turns.
    lifted, next_force = 0.8 * pressure, 0.5 * force[::-1]
    next_moment = x * next_force[1] - y * next_force[0]
    second = found(lifted, next_force, next_moment, first.traction)
    start = np.zeros((*X.shape, 2))
    for out, load, about, p in ((first, force, moment, pressure), (second, next_force, next_moment, lifted)):
        truth = true_traction(p, load, about, start)
        assert out.held
        assert np.allclose(out.traction, truth, atol=2e-4 * FRICTION * p.max())
        assert np.allclose(jnp.sum(out.traction, axis=(0, 1)) * AREA, load, atol=1e-3 * normal)
        start = np.asarray(out.traction, float)
    assert first.slipping.any()


def test_unloading_follows_masings_rule():
    pressure = ball()
    most = 0.9 * FRICTION * pressure.sum() * AREA

    def motion(force, traction=None):
        out = found(pressure, (force, 0), traction=traction)
        return float(out.traction[75, 75, 0]) / STIFFNESS, out  # the centre sticks

    loaded, out = motion(most)
    for force in (0.5 * most, 0.0, -0.6 * most):
        unloaded, back = motion(force, out.traction)
        assert unloaded == pytest.approx(loaded - 2 * motion((most - force) / 2)[0], abs=1e-3 * loaded)
        if force == 0:
            assert unloaded > 0.2 * loaded  # the skin does not return
    assert back.slipping.any()


def test_the_displacement_grows_with_the_load_to_the_limit_of_friction():
    pressure = ball(centre=(-0.02, 0.03)) + punch(800.0)
    most = FRICTION * pressure.sum() * AREA
    forces = jnp.array([0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 1.1, 5.0]) * most
    wrenches = jnp.zeros((8, 6)).at[:, 1].set(-forces)
    out = jax.vmap(shear, in_axes=(None, None, None, 0))(GEL, MARKERS, jnp.asarray(pressure, jnp.float32), wrenches)
    assert not out.displacement[0].any()
    largest = np.asarray(jnp.max(jnp.linalg.norm(out.displacement, axis=-1), axis=(1, 2)))
    assert (np.diff(largest[:7]) > 0).all()
    bound = FRICTION * pressure.max() / STIFFNESS
    assert (largest <= bound).all()
    assert out.held[:4].all()
    assert not out.held[-1]
    for k in (3, 6):
        alone = shear(GEL, MARKERS, jnp.asarray(pressure, jnp.float32), wrenches[k])
        assert np.allclose(alone.displacement, out.displacement[k], atol=1e-7)


@pytest.mark.parametrize("share", [0.3, 0.85])
def test_derivatives_equal_finite_differences(share):
    with jax.enable_x64(True):
        pressure = jnp.asarray(ball(centre=(0.01, 0.02)) + 0.3 * punch())
        most = FRICTION * float(pressure.sum()) * AREA
        wrench = most * share * jnp.array([0.7, 0.4, 0, 0, 0, 0])
        weights = jnp.asarray(np.random.default_rng(1).normal(size=(*X.shape, 2)))

        def value(wrench, scale, friction):
            markers = dataclasses.replace(MARKERS, friction=friction)
            out = tactile.shear(GEL, markers, pressure * (1 + scale * jnp.asarray(X)), wrench)
            return jnp.sum(weights * out.displacement), out

        value, given = jax.jit(value), (wrench, jnp.asarray(0.0), jnp.asarray(FRICTION))
        slopes, out = jax.grad(value, (0, 1, 2), has_aux=True)(*given)
        assert out.held
        assert out.slipping.any()
        way = (most * jnp.array([0.5, -0.3, 0.9, 0.2, 0.1, 0.02]), 20.0, 0.3)
        step = 1e-6
        ahead, behind = (value(*(a + sign * step * b for a, b in zip(given, way, strict=True)))[0] for sign in (1, -1))
        along = sum(jnp.sum(a * b) for a, b in zip(slopes, way, strict=True))
        assert float(along) == pytest.approx(float(ahead - behind) / (2 * step), rel=1e-3)
        assert float(along) != 0


@pytest.mark.parametrize(
    ("pressure", "friction", "force"), [(0 * X, 0.8, 1.0), (punch(), 0.0, 1.0), (0 * X, 0.8, 0.0), (punch(), 0.8, 0.0)]
)
def test_without_contact_friction_or_load_the_skin_stays_and_derivatives_are_finite(pressure, friction, force):
    def total(pressure, wrench, friction):
        out = tactile.shear(GEL, dataclasses.replace(MARKERS, friction=friction), pressure, wrench)
        return jnp.sum(out.displacement), out

    given = jnp.asarray(pressure, jnp.float32), jnp.array([force, 0, 0, 0, 0, 0.01 * force]), jnp.float32(friction)
    slopes, out = jax.jit(jax.grad(total, (0, 1, 2), has_aux=True))(*given)
    assert not out.displacement.any()
    assert bool(out.held) == (force == 0)
    assert all(np.isfinite(slope).all() for slope in slopes)


def test_dots_lie_on_the_grid_have_their_size_and_move_with_the_skin():
    x = (np.arange(320) + 0.5) / 320 * 0.08 - 0.04  # 8 pitches
    x, y = map(jnp.float32, np.meshgrid(x, x + 0.02))
    still = tactile.dots(GEL, MARKERS, jnp.zeros((150, 150, 2)), x, y, 0.00025)
    dark = np.asarray(1 - still) / MARKERS.darkness
    assert dark.mean() == pytest.approx(np.pi * MARKERS.radius**2 / MARKERS.pitch**2, rel=0.01)
    assert dark[79:81, 159:161].min() == 1  # around the pad's centre
    assert dark[100, 180] == 0
    shift = jnp.broadcast_to(jnp.array([0.002, -0.001]), (150, 150, 2))
    moved = tactile.dots(GEL, MARKERS, shift, x, y, 0.00025)
    assert np.allclose(moved[:-4, 8:], still[4:, :-8], atol=1e-3)
    beyond = tactile.dots(GEL, MARKERS, shift, x + 0.1, y, 0.00025)
    assert (np.asarray(beyond)[np.asarray(x) + 0.1 > 0.0751] == 1).all()
    assert np.asarray(beyond).min() < 0.5
