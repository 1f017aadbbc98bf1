"""C MuJoCo as the engine of `simulate`, compared with a plain loop over `mj_step`, and properties of both engines."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from physics_scenes import PAD, box

from sts_jax import objects, physics
from sts_jax.physics import native, roll, scene
from sts_jax.physics.scenario import STANDING, G, Start
from sts_jax.sensor import Sensor

BODIES = [objects.make(jax.random.key(i), name) for i, name in enumerate(["bottle", "fork", "watch"])]
simulate = functools.partial(physics.simulate, jax.random.key(3), sensor=Sensor(), engine="mujoco")


def plain_loop(
    model: mujoco.MjModel, points: np.ndarray, start: Start, gravity: np.ndarray, velocity: np.ndarray
) -> dict:
    """One trajectory as `roll.step` defines it."""
    (pose,), (held,) = start.pose, start.held
    data = mujoco.MjData(model)
    data.qpos[:] = pose
    back = pose[3:] * [1, -1, -1, -1]
    data.qvel[:3] = velocity[:3]
    mujoco.mju_rotVecQuat(data.qvel[3:], velocity[3:], back)
    timestep, has_wall = model.opt.timestep, mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, "wall") >= 0
    slow = touches = 0
    apart, gone = 2**20, False
    frames: dict[str, list] = {name: [] for name in ("pose", "velocity", "wrench", "contact", "wall")}
    for interval in gravity:
        impulse, loaded, wall = np.zeros(6), 0, False
        for pull in interval:
            if held or gone:
                held, impulse, loaded, wall = max(held - 1, 0), np.zeros(6), 0, False
                data.qvel[:] = 0 if gone else data.qvel
                continue
            model.opt.gravity[:] = pull
            mujoco.mj_step1(model, data)
            mujoco.mj_step2(model, data)
            # Contact forces belong to the step, because mj_step2 only moves the state.
            push = physics.wrench(model, data, "pad")
            contact, wall = bool(push.any()), has_wall and bool(physics.wrench(model, data, "wall").any())
            impulse, loaded = (impulse + push, loaded + 1) if contact else (np.zeros(6), 0)
            touches += (contact or wall) and apart * timestep >= roll.PARTED_TIME - 1e-9
            apart = 0 if contact or wall else apart + 1
            is_slow = np.linalg.norm(data.qvel[:3]) < roll.SLOW_SPEED and np.linalg.norm(data.qvel[3:]) < roll.SLOW_TURN
            slow = slow + 1 if is_slow else 0
            matrix = np.empty(9)
            mujoco.mju_quat2Mat(matrix, data.qpos[3:])
            gone = (points @ matrix[6:] + data.qpos[2]).max() < -roll.GONE_DEPTH
        turn = np.empty(3)
        mujoco.mju_rotVecQuat(turn, data.qvel[3:], data.qpos[3:])
        frames["pose"].append([*data.qpos[:3], *np.where(data.qpos[3] < 0, -1, 1) * data.qpos[3:]])
        frames["velocity"].append([*data.qvel[:3], *turn])
        frames["wrench"].append(impulse / max(loaded, 1))
        frames["contact"].append(loaded > 0)
        frames["wall"].append(wall)
    return {name: np.array(rows) for name, rows in frames.items()} | {"slow": slow, "touches": touches, "gone": gone}


CASES = {
    "lands and rests": (physics.Freefall(frames=30), [0.01, 0.0, 0.06, 0.96, 0.2, 0.1, 0.17], 32),
    "falls off": (physics.Freefall(), [0.1, 0.01, 0.06, 0.5, 0.5, 0.5, 0.5], 32),
    "is jerked in the air": (physics.Perturbed(frames=30), [0.0, 0.0, 0.2, 0.9, 0.3, 0.1, 0.3], 0),
    "is pushed and spins": (physics.Freefall(frames=14), [-0.02, 0.01, 0.06, 0.96, 0.2, 0.1, 0.17], 32),
    "slides to the wall": (physics.Inclined(friction=(0.2, 0.2), frames=20), [0.01, 0.02, 0.05, 0.7, 0.1, 0.7, 0], 48),
}
PUSHED = np.array([0.2, -0.1, 0.05, 2.0, -3.0, 4.0])  # m/s, rad/s


@pytest.mark.parametrize("name", CASES)
def test_native_roll_equals_a_plain_loop_of_steps(name):
    scenario, pose, held = CASES[name]
    body, pose = BODIES[0], np.array([*pose[:3], *(np.array(pose[3:]) / np.linalg.norm(pose[3:]))])
    condition = jnp.array([9.0, -3.0, 0.08])[: len(scenario.condition_scale)]
    before = np.arange(scenario.steps, 0, -1) * scenario.contact.timestep
    times = np.arange(scenario.frames)[:, None] / scenario.rate - before
    gravity = np.asarray(jax.vmap(jax.vmap(lambda t: scenario.gravity(t, condition)))(times), np.float64)
    hulls = np.asarray(body.hulls)
    model = native.compile_body(hulls, PAD, scenario.contact, scenario.wall)
    mass, com, inertia = (np.asarray(x, np.float64) for x in objects.rigid(body, 0.4, 1.0))
    scene.set_rigid(model, mujoco.MjData(model), float(mass), com, inertia, scenario.friction[0])
    points = np.unique(hulls.reshape(-1, 3), axis=0)
    start = Start(pose[None], np.array([held]), np.asarray(condition)[None])
    velocity = PUSHED if name == "is pushed and spins" else np.zeros(6)
    ends, record = native.roll([model], points, start, gravity[None], velocity[None], freeze=False)
    truth = plain_loop(model, points, start, gravity, velocity)
    assert truth["gone"] == (name in ("falls off", "is jerked in the air"))
    assert truth["wall"].any() == (name == "slides to the wall")
    assert truth["contact"].any() == (name != "is jerked in the air")  # that object flies past the pad
    np.testing.assert_array_equal(record.contact[0], truth["contact"])
    np.testing.assert_array_equal(record.wall[0], truth["wall"])
    np.testing.assert_allclose(record.pose[0], truth["pose"], atol=1e-6)
    np.testing.assert_allclose(record.velocity[0], truth["velocity"], atol=1e-5)
    np.testing.assert_allclose(record.wrench[0], truth["wrench"], atol=1e-5, rtol=1e-5)
    assert (ends.touches[0], ends.gone[0]) == (truth["touches"], truth["gone"])
    assert truth["gone"] or ends.slow[0] == truth["slow"]
    assert ends.finite[0]


def test_a_jerked_box_slides_by_coulombs_law():
    half, mass, friction = np.array([0.03, 0.03, 0.008]), 0.1, 0.5
    pull, lasts, frames, steps = 8.0, 0.08, 6, 160
    points, contact = box(*half), physics.Perturbed().contact
    model = native.compile_body(np.float32(points)[None], PAD, contact)
    inertia = mass / 3 * np.diag(np.sum(half**2) - half**2)
    scene.set_rigid(model, mujoco.MjData(model), mass, np.array([0.003, -0.002, 0.002]), inertia, friction)
    gravity = np.tile([0, 0, -G], (frames, steps, 1))
    gravity[1, :, :2] = -pull * np.array([np.cos(0.4), np.sin(0.4)])
    assert steps * contact.timestep == pytest.approx(lasts)
    pose = np.array([0.02, 0.01, half[2] - STANDING, 1, 0, 0, 0])
    start = Start(pose[None], np.array([0]), np.zeros((1, 0)))
    path = native.roll([model], points, start, gravity[None])[1].pose[0]
    speed = (pull - friction * G) * lasts
    distance = speed * lasts / 2 + speed**2 / (2 * friction * G)
    np.testing.assert_allclose(np.linalg.norm(path[-1, :2] - path[0, :2]), distance, rtol=0.01)


SLOW = [pytest.param(scenario, marks=pytest.mark.slow) for scenario in (physics.Inclined(), physics.Perturbed())]


@pytest.mark.parametrize("scenario", [physics.Freefall(), physics.Released(), *SLOW])
def test_freezing_a_settled_object_keeps_its_end_and_its_wrench(scenario, monkeypatch):
    bodies = BODIES[:1] if scenario.must_stand else BODIES
    num = 18 // len(bodies)
    frozen = jax.tree.map(np.asarray, simulate(bodies, scenario=scenario, num=num))
    monkeypatch.setattr(native, "roll", functools.partial(native.roll, freeze=False))
    rolled = jax.tree.map(np.asarray, simulate(bodies, scenario=scenario, num=num))
    on_pad = frozen.outcome != physics.Outcome.FELL_OFF
    stopped = on_pad & ~frozen.velocity[:, -1].any(axis=1)
    assert stopped.sum() >= 9
    for name in ("outcome", "settled", "touches", "condition"):
        np.testing.assert_array_equal(getattr(frozen, name), getattr(rolled, name))
    for name in ("pose", "velocity", "wrench", "contact", "wall", "sunk"):  # moving objects are unchanged
        np.testing.assert_array_equal(getattr(frozen, name)[~stopped], getattr(rolled, name)[~stopped])
    np.testing.assert_allclose(frozen.pose[stopped, -1, :3], rolled.pose[stopped, -1, :3], atol=1e-3)
    assert frozen.contact[stopped, -1].all()
    alone = stopped & ~frozen.wall[:, -1]  # an object that leans on the wall shifts its weight as it creeps
    assert alone.sum() >= 5
    largest = np.abs(rolled.wrench[alone, -1, :3]).max()
    np.testing.assert_allclose(frozen.wrench[alone, -1, :3], rolled.wrench[alone, -1, :3], atol=0.02 * largest)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Released", "Perturbed", "Inclined"])
def test_both_engines_move_an_object_alike_from_the_start_of_a_scenario(name):
    towards_wall = {"friction": (0.2, 0.2), "along": (0.05, 0.05), "resting": 1.0}
    scenario = getattr(physics, name)(frames=4, **towards_wall if name == "Inclined" else {})
    truth, ours = (
        jax.tree.map(np.asarray, simulate(BODIES[0], scenario=scenario, num=4, chunk=4, engine=engine))
        for engine in ("mujoco", "mjx")
    )
    weight = G * physics.rigids(BODIES, truth.body, truth.hidden).mass.min()
    moved = np.abs(truth.pose[:, -1] - truth.pose[:, 0]).max()
    assert moved > 0.002
    assert np.abs(ours.pose - truth.pose).max() < (0.005 if name == "Released" else 0.05) * moved
    np.testing.assert_allclose(ours.wrench[:, 0], truth.wrench[:, 0], atol=0.01 * weight)
    np.testing.assert_array_equal(ours.contact[:, 0], truth.contact[:, 0])
    assert ours.wall.any() == truth.wall.any() == (name == "Inclined")


def test_a_weak_pull_does_not_end_a_trajectory_before_a_strong_one(monkeypatch):
    # For a second the pull is too weak to move the bottle. Then it topples the bottle.
    class Late(physics.Perturbed):
        def gravity(self, time: jax.Array, condition: jax.Array) -> jax.Array:
            return jnp.array([0.0, 0.0, -G]) + jnp.array([6.0, 0.0, 0.0]) * (time > 1.0)

    traj = simulate(BODIES[0], scenario=Late(), num=2)
    before, after = 28, -1
    assert np.abs(traj.velocity[:, before]).max() < 1e-3
    assert np.linalg.norm(traj.pose[:, after, :3] - traj.pose[:, before, :3], axis=-1).min() > 0.01


def test_compound_bodies_land_on_their_parts():
    body = BODIES[0]
    left, right = np.asarray(body.hulls[0]), np.asarray(body.hulls[0]) + np.float32([0.05, 0, 0])
    parts = dataclasses.replace(body, hulls=jnp.asarray(np.stack([left, *[right] * 7])))
    assert parts.hulls.shape[0] in objects.PART_CLASSES
    traj = simulate(parts, scenario=physics.Perturbed(acceleration=(0.0, 0.0), frames=10), num=2)
    np.testing.assert_array_equal(traj.outcome, physics.Outcome.STANDS)
    lowest = left[:, 2].min() + np.asarray(traj.pose[:, -1, 2])
    np.testing.assert_allclose(lowest, 0, atol=5e-5)
