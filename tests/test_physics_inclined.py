"""`Inclined`: blocks hold or slide by Coulomb's law in every direction, and starts, walls and contents."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from physics_scenes import PAD, box, corners, hull, mjx_model, part, placed, rigid
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from sts_jax import objects, physics
from sts_jax.physics import roll, scene
from sts_jax.physics.scenario import STANDING, G, upright
from sts_jax.sensor import Sensor

SLOPE = np.radians(30)
AZIMUTHS = np.radians([0, 22.5, 45, 90, 200])
DOWN = np.stack([np.cos(AZIMUTHS), np.sin(AZIMUTHS)], axis=-1)
ROLL = jax.jit(jax.vmap(roll.roll, in_axes=(None, None, None, 0, 0)))
INITIAL = jax.vmap(lambda pose: roll.initial(pose, jnp.zeros(6)))
SCENARIO = physics.Inclined()
STEPS = round(0.05 / SCENARIO.contact.timestep)  # a record every 50 ms
BLOCK = part(box(0.03, 0.02, 0.01))
BODIES = [objects.make(jax.random.key(i), name) for i, name in enumerate(["bottle", "fork", "camera", "scissors"])]


def block(friction: float, wall: float = 0.0) -> tuple:
    """MJX's model and data of a block of 60 x 40 x 20 mm, and its hull."""
    inertia = 0.1 * np.diag([1.7e-4, 3.3e-4, 4.3e-4])
    return *mjx_model(SCENARIO.contact, 0.1, np.zeros(3), inertia, friction, wall), hull(BLOCK)


def slide(friction: float, slope: float) -> roll.Record:
    """The block on a pad that is tilted towards each azimuth, recorded every 50 ms."""
    start = INITIAL(jnp.asarray(np.c_[-0.03 * DOWN, np.tile([0.01, 1, 0, 0, 0], (5, 1))], jnp.float32))
    tilted = G * np.c_[np.sin(slope) * DOWN, np.full(5, -np.cos(slope))]
    flat = np.tile([0, 0, -G], (5, 2, STEPS, 1))
    gravity = np.concatenate([flat, np.tile(tilted[:, None, None], (1, 10, STEPS, 1))], axis=1)
    return jax.tree.map(np.asarray, ROLL(*block(friction), start, jnp.asarray(gravity, jnp.float32))[1])


@pytest.mark.parametrize("degrees", [0.0, 1e-3, 0.01, 0.3, 0.757, 1.0, 30.0, 89.0, 91.0, 150.0, 180.0])
@pytest.mark.parametrize("azimuth", [0.3, 2.0, 4.5])
def test_faces_near_upside_down_are_laid_flat_too(degrees, azimuth):
    lean = np.radians(degrees)
    up = np.array([np.sin(lean) * np.cos(azimuth), np.sin(lean) * np.sin(azimuth), -np.cos(lean)])
    turn = Rotation.from_quat(np.asarray(upright(jnp.asarray(up, jnp.float32))), scalar_first=True)
    np.testing.assert_allclose(turn.apply(up), [0, 0, 1], atol=2e-5)


@pytest.mark.slow
@pytest.mark.parametrize(("friction", "degrees"), [(0.2, 18), (0.4, 45)])
def test_a_block_holds_below_the_friction_angle_and_slides_above_it_by_coulombs_law(friction, degrees):
    slope = np.radians(degrees)
    pose = slide(float(np.tan(slope) / 0.97), slope).pose
    assert np.linalg.norm(pose[:, -1, :2] - pose[:, 6, :2], axis=1).max() / (5 * 0.05) < 1e-3  # m/s
    velocity = slide(friction, slope).velocity[..., :2]
    speed = np.einsum("nfi,ni->nf", velocity, DOWN)
    gained = (speed[:, 4] - speed[:, 2]) / (2 * 0.05)
    expected = G * (np.sin(slope) - friction * np.cos(slope))
    # A block that rocks is pressed less for a moment. How much depends on rounding, and so on the processor.
    np.testing.assert_allclose(gained.mean(), expected, rtol=0.02)
    np.testing.assert_allclose(gained, expected, rtol=0.04)
    across = np.abs(velocity[:, 4, 0] * DOWN[:, 1] - velocity[:, 4, 1] * DOWN[:, 0])
    assert np.all(across < 0.01 * speed[:, 4])


def test_a_ball_rolls_with_five_sevenths_of_the_pull():
    radius, mass = 0.02, 0.1
    constants = dataclasses.replace(SCENARIO.contact, rolling=0.0)
    model = mujoco.MjModel.from_xml_string(scene._xml(PAD, 0.0, constants, [f'type="sphere" size="{radius}"'], "", ""))
    data = mujoco.MjData(model)
    scene.set_rigid(model, data, mass, np.zeros(3), 0.4 * mass * radius**2 * np.diag([1.01, 1, 0.99]), 0.8)
    model.opt.gravity[:] = G * np.array([0, np.sin(SLOPE), -np.cos(SLOPE)])
    data.qpos[:] = [0, -0.05, radius, 1, 0, 0, 0]
    mujoco.mj_step(model, data, nstep=2 * STEPS)
    before = data.qvel[1]
    mujoco.mj_step(model, data, nstep=2 * STEPS)
    np.testing.assert_allclose((data.qvel[1] - before) / 0.1, 5 / 7 * G * np.sin(SLOPE), rtol=0.005)


@pytest.fixture(scope="module")
def slid():
    varied = dataclasses.replace(SCENARIO, friction=(0.35, 0.75), resting=0.8, tries=1)  # so that many objects slide
    found = physics.simulate(jax.random.key(1), BODIES, Sensor(), varied, 8)
    return jax.tree.map(np.asarray, found)


def test_starts_are_on_a_face_or_just_above_the_pad_and_outside_the_wall(slid):
    resting = 0
    for row in range(len(slid.pose)):
        points = corners(BODIES, slid, row)
        lowest = points[:, 2].min()
        assert points[:, 1].max() < PAD[1] / 2
        if slid.contact[row, 0]:
            resting += 1
            face = points[points[:, 2] < lowest + 1e-3]
            assert np.linalg.matrix_rank(face - face[0], tol=2e-3) >= 2  # on a face, not on a corner
            assert abs(lowest + STANDING) < 3e-4
            assert np.linalg.norm(slid.velocity[row, 0, :3]) < G / SCENARIO.rate
        else:
            assert 0.001 - 1e-6 <= lowest <= 0.01 + 1e-6
            np.testing.assert_array_equal(slid.velocity[row, 0], 0)
    assert 0.6 <= resting / len(slid.pose) <= 0.95


def test_the_wrench_excludes_the_wall(slid):
    on_pad = slid.settled & (slid.outcome != physics.Outcome.FELL_OFF)
    leaning, alone = np.flatnonzero(on_pad & slid.wall[:, -1]), np.flatnonzero(on_pad & ~slid.wall[:, -1])
    assert len(leaning) >= 5
    assert len(alone) >= 3
    for row in alone:  # the pad carries all of the weight, and its moment
        mass, com, _ = rigid(BODIES, slid, row)
        pull = mass * G * np.array([0, np.sin(SLOPE), -np.cos(SLOPE)])
        moment = np.cross(placed(slid.pose[row, -1], com), pull)
        np.testing.assert_allclose(slid.wrench[row, -1, :3], -pull, atol=0.02 * mass * G)
        np.testing.assert_allclose(slid.wrench[row, -1, 3:], -moment, atol=0.02 * mass * G * 0.075)
    for row in leaning:  # friction on the pad is at most that of Coulomb's law
        force = slid.wrench[row, -1, :3]
        assert np.linalg.norm(force[:2]) <= slid.hidden.friction[row] * force[2] * 1.02 + 1e-3
    carried = np.array([-slid.wrench[r, -1, 1] / (rigid(BODIES, slid, r)[0] * G * np.sin(SLOPE)) for r in leaning])
    assert np.mean(carried < 0.95) > 0.5  # the wall carries the rest


@pytest.mark.slow
def test_the_contents_decide_whether_an_object_at_rest_tips():
    keys = jax.random.split(jax.random.key(5), 300)
    body = BODIES[0]
    points, com = np.asarray(body.hulls, np.float64).reshape(-1, 3), np.asarray(body.shell_com, np.float64)
    coms = com + 0.01 * np.random.default_rng(0).normal(size=(16, 3))
    shape = physics.Shape(*map(jnp.asarray, (points, *objects.rest_poses(points, com), coms)))

    def undecided(pose):
        turn = Rotation.from_quat(pose[3:], scalar_first=True)
        laid, centres = turn.apply(points), turn.apply(coms)
        low = laid[:, 2].min()
        face = ConvexHull(laid[laid[:, 2] < low + 1e-3, :2]).equations
        meets = centres[:, :2] + (centres[:, 2:] - low) * np.array([0, np.tan(SLOPE)])
        margin = -(meets @ face[:, :2].T + face[:, 2]).max(1)
        return min(np.maximum(margin, 0).mean(), np.maximum(-margin, 0).mean())

    def poses(tries):
        scenario = dataclasses.replace(SCENARIO, resting=1.0, tries=tries)
        return np.asarray(jax.jit(jax.vmap(lambda key: scenario.start(key, shape, PAD).pose))(keys), float)

    one, widest = (np.array([*map(undecided, poses(tries))]) for tries in (1, 16))
    for share in (0.75, 0.9):  # all of sixteen draws are below it with a chance of share^16
        assert np.mean(widest > np.quantile(one, share)) == pytest.approx(1 - share**16, abs=0.1)


@pytest.mark.slow
def test_objects_that_fall_beside_the_pad_gain_no_energy_at_the_wall():
    turn = np.random.default_rng(0).normal(size=(12, 4))
    pose = np.tile([0.0, 0.03, 0.03, 1, 0, 0, 0], (12, 1))
    pose[:, 0] = np.linspace(0.08, 0.16, 12)  # over the pad's side, and past it
    pose[:, 3:] = turn / np.linalg.norm(turn, axis=1, keepdims=True)
    gravity = G * np.array([0, np.sin(SLOPE), -np.cos(SLOPE)])
    steps = jnp.broadcast_to(jnp.asarray(gravity, jnp.float32), (12, 40, 20, 3))
    _, record = jax.tree.map(np.asarray, ROLL(*block(0.3, 0.02), INITIAL(jnp.asarray(pose, jnp.float32)), steps))
    lost = (record.pose[..., :3] - pose[:, None, :3]) @ gravity
    assert record.wall.any(1).mean() > 0.5
    assert np.all(0.5 * np.sum(record.velocity[..., :3] ** 2, axis=-1) <= lost + 0.02)


def test_contents_lie_in_all_directions_except_in_variants():
    keys = jax.random.split(jax.random.key(0), 2000)
    up = np.asarray(jax.vmap(SCENARIO.hidden)(keys).up)
    np.testing.assert_allclose(np.linalg.norm(up, axis=1), 1, atol=1e-5)
    np.testing.assert_allclose(up.mean(0), 0, atol=0.05)
    np.testing.assert_allclose(up.T @ up / len(up), np.eye(3) / 3, atol=0.03)
    off = jax.vmap(physics.variant(SCENARIO, "off").hidden)(keys)
    np.testing.assert_allclose(off.up, np.tile([0.0, 0, 1], (2000, 1)), atol=1e-6)
    np.testing.assert_allclose(off.friction, np.mean(SCENARIO.friction), rtol=1e-6)
    with pytest.raises(ValueError, match="the name of the variant is 'none', but it must be one of default"):
        physics.variant(SCENARIO, "none")
