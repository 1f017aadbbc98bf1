"""`Perturbed`, compared with a moving pad in C MuJoCo, and the acceleration at which blocks topple."""

import copy
import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from physics_scenes import PAD, hull, mjx_model, part, rigid

from benchmarks import invariance
from sts_jax import objects, physics
from sts_jax.physics import native, roll, scene
from sts_jax.physics.scenario import G, Start
from sts_jax.sensor import Sensor

NUM = 8
SCENARIO = physics.Perturbed()
BOTTLES = [objects.make(jax.random.key(i), "bottle") for i in range(2)]


@pytest.fixture(scope="module", params=[pytest.param("mjx", marks=pytest.mark.slow), "mujoco"])
def engine(request):
    return request.param


def lasting(engine: physics.Engine) -> physics.Perturbed:
    return dataclasses.replace(SCENARIO, frames={"mjx": 8, "mujoco": 60}[engine])  # 8 last longer than a jerk


@pytest.fixture(scope="module")
def shaken(engine):
    found = physics.simulate(jax.random.key(1), BOTTLES, Sensor(), lasting(engine), NUM, chunk=16, engine=engine)
    return jax.tree.map(np.asarray, found)


def test_objects_load_the_pad_in_the_first_frame(shaken):
    np.testing.assert_allclose(upright(shaken.pose[:, 0, 3:]), 1, atol=1e-4)
    assert np.all(np.linalg.norm(shaken.pose[:, 0, :2], axis=1) < SCENARIO.spread + 1e-4)
    assert np.abs(shaken.velocity[:, 0, :3]).max() < 2e-3
    assert np.abs(shaken.velocity[:, 0, 3:]).max() < 0.05
    weight = np.array([rigid(BOTTLES, shaken, row)[0] * G for row in range(2 * NUM)])
    np.testing.assert_allclose(shaken.wrench[:, 0, 2], weight, rtol=0.02)
    assert shaken.contact[:, 0].all()


def upright(quat: np.ndarray) -> np.ndarray:
    """Cosine of the lean of quaternions."""
    return 1 - 2 * (quat[..., 1] ** 2 + quat[..., 2] ** 2)


def test_the_condition_is_the_jerk_and_the_future_does_not_leak(shaken, engine):
    size = np.linalg.norm(shaken.condition[:, :2], axis=1)
    assert np.all((size >= 4) & (size <= 12) & (shaken.condition[:, 2] >= 0.06) & (shaken.condition[:, 2] <= 0.12))
    calm = dataclasses.replace(lasting(engine), acceleration=(0.0, 0.0))
    other = physics.simulate(jax.random.key(1), BOTTLES, Sensor(), calm, NUM, chunk=16, engine=engine)
    for name in ("pose", "velocity", "wrench"):
        np.testing.assert_array_equal(getattr(other, name)[:, 0], getattr(shaken, name)[:, 0])
    assert np.all(other.outcome == physics.Outcome.STANDS)
    assert np.abs(other.pose[:, -1, :2] - other.pose[:, 0, :2]).max() < 1e-3
    assert engine == "mjx" or len(np.unique(shaken.outcome)) >= 3


def test_gravity_contains_the_whole_impulse_and_returns_to_normal():
    condition = jnp.array([3.0, -4.0, 0.0754])
    scenario = dataclasses.replace(SCENARIO, contact=physics.Contact(timestep=0.001))
    time = jnp.arange(-32, 300) * 1e-3
    gravity = jax.vmap(lambda t: scenario.gravity(t, condition))(time)
    np.testing.assert_allclose(gravity[:, 2], -G, rtol=1e-6)
    np.testing.assert_array_equal(gravity[:32, :2], 0)
    np.testing.assert_allclose(gravity[32:, :2].sum(0) * 1e-3, [-3 * 0.0754, 4 * 0.0754], rtol=1e-4)
    np.testing.assert_array_equal(gravity[32 + 76 :, :2], 0)


@pytest.mark.slow
def test_a_jerk_in_gravity_equals_a_moving_pad(shaken, engine):
    # C MuJoCo with a contact at every vertex moves the object on a driven pad. Compare until the end of the jerk or the
    # first loss of contact, after which rounding decides. test_benchmarks_invariance compares outcomes.
    apart = []
    for row in range(0, 2 * NUM, 2):
        model = invariance.c_model(BOTTLES[shaken.body[row]], SCENARIO.contact, every_vertex=True, driven=True)
        data = mujoco.MjData(model)
        scene.set_rigid(model, data, *rigid(BOTTLES, shaken, row), float(shaken.hidden.friction[row]))
        model.stat.meaninertia = model.dof_M0[-6:].mean()
        model.opt.iterations, model.opt.tolerance = 100, 1e-12  # masses this far apart converge slowly
        data.qpos[-7:] = shaken.pose[row, 0]
        condition = jnp.asarray(shaken.condition[row])
        times = jnp.arange(int(condition[2] / SCENARIO.contact.timestep)) * SCENARIO.contact.timestep
        gravity = np.asarray(jax.vmap(lambda t, c=condition: SCENARIO.gravity(t, c))(times), np.float64)
        for step, own in enumerate(gravity, start=1):
            data.qfrc_applied[:2] = -invariance.CARRIAGE * own[:2]
            mujoco.mj_step(model, data)
            if not data.ncon:
                break
            if step % SCENARIO.steps == 0:
                place = data.qpos[2:5] - [*data.qpos[:2], 0]
                apart.append(np.linalg.norm(place - shaken.pose[row, step // SCENARIO.steps, :3]))
    assert len(apart) >= 2 * NUM
    # In C MuJoCo the mesh pushes too, from 0.1 mm on, and in the truth from 1 mm on.
    assert np.quantile(apart, 0.9) < (1e-4 if engine == "mjx" else 2e-4)
    assert np.max(apart) < 3e-4  # while it moves by centimetres


def prism(base: np.ndarray, height: float) -> np.ndarray:
    """Vertices of an upright prism about its centre, padded to a hull class."""
    return part(np.concatenate([np.c_[base, np.full(len(base), z)] for z in (-height / 2, height / 2)]), 64)


ROLL = jax.jit(jax.vmap(roll.roll, in_axes=(None, None, None, None, 0)))


def ends_in_mjx(parts: np.ndarray, pose: np.ndarray, rigid: tuple, gravity: np.ndarray) -> np.ndarray:
    """The last poses of one object under several gravities (n, f, s, 3)."""
    start = roll.initial(jnp.asarray(pose), jnp.zeros(6))
    model = mjx_model(SCENARIO.contact, *rigid)
    return np.asarray(ROLL(*model, hull(parts), start, jnp.asarray(gravity, jnp.float32))[0].qpos)


def ends_in_c(parts: np.ndarray, pose: np.ndarray, rigid: tuple, gravity: np.ndarray) -> np.ndarray:
    """As `ends_in_mjx`. A level frame follows, so that every pull is a force."""
    model = native.compile_body(np.float32(parts), PAD, SCENARIO.contact)
    scene.set_rigid(model, mujoco.MjData(model), *rigid)
    start = Start(np.tile(pose, (8, 1)), np.zeros(8, int), np.zeros((8, 0)))
    level = np.broadcast_to([0, 0, -G], gravity[:, :1].shape)
    models = [copy.copy(model) for _ in range(8)]
    return native.roll(models, parts[0], start, np.concatenate([gravity, level], axis=1))[1].pose[:, -2]


ANGLES = np.linspace(0, 2 * np.pi, 8, endpoint=False)


@pytest.mark.parametrize(
    ("ends", "low", "angles"),  # a prism and its bases are point-symmetric, so half of the directions are all
    [pytest.param(ends_in_mjx, 0.0, ANGLES[:4], marks=pytest.mark.slow), (ends_in_c, 0.01, ANGLES)],
    ids=["mjx", "mujoco"],
)
@pytest.mark.parametrize(("sides", "radius"), [(4, 0.015 * np.sqrt(2)), (20, 0.015)])  # a box and a bottle
def test_a_tall_prism_topples_at_g_b_over_h(sides, radius, ends, low, angles):
    height, half, mass = 0.1, 0.015, 0.1  # m, kg. The centre of mass is `low` below the middle
    around = (np.arange(sides) + 0.5) * 2 * np.pi / sides
    base = radius * np.c_[np.cos(around), np.sin(around)]
    # It tips over the edge that resists least: half width over the share of the pull across the edge.
    across = np.cos(angles[:, None] - around - np.pi / sides)
    reach = radius * np.cos(np.pi / sides) / np.max(across, axis=1)
    inertia = mass / 12 * np.diag([4 * half**2 + height**2, 4 * half**2 + height**2, 8 * half**2])
    rigid = (mass, np.array([0, 0, -low]), inertia, 0.8)
    pose = np.array([0, 0, height / 2, 1, 0, 0, 0])
    for factor, falls in ((0.97, False), (1.03, True)):
        size = factor * G * reach / (height / 2 - low)
        gravity = np.stack([size * np.cos(angles), size * np.sin(angles), np.full(len(angles), -G)], axis=-1)
        steps = round(0.05 / SCENARIO.contact.timestep)
        still = np.tile([0, 0, -G], (len(angles), 1, steps, 1))
        pulled = np.tile(gravity[:, None, None], (1, 20, steps, 1))
        pulled[:, :8, :, :2] *= np.linspace(0, 1, 8 * steps).reshape(8, steps, 1)  # sustained, not a blow
        last = ends(prism(base, height), pose, rigid, np.concatenate([still, pulled], axis=1))
        lean = np.degrees(np.arccos(upright(last[:, 3:])))
        assert np.all((lean > 20) == falls), (factor, lean)
