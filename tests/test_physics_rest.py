"""Bodies at rest on the pad and in a hand, against C MuJoCo and closed forms, and what happens after the release."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from physics_scenes import PAD, corners, placed, solid_block
from scipy.spatial.transform import Rotation

import sts_jax as sts
from sts_jax import objects, physics
from sts_jax.physics import rest, scene
from sts_jax.physics.scenario import STANDING, G

FRICTION = 0.6
PLACES = {"yaw": 0.7, "position": (0.03, -0.02), "fill": 0.3}
CLASSES = {name: objects.make(jax.random.key(i), name) for i, name in enumerate(objects.CATEGORIES)}


def simulated(body: objects.Body, pose: np.ndarray, fill: float, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """The pose after some time in C MuJoCo, and the mean wrench of the pad about the sensor's origin."""
    contact = physics.Perturbed().contact
    model = scene.compile_scene(np.asarray(body.hulls), PAD, contact)
    data = mujoco.MjData(model)
    mass, com, inertia = (np.asarray(x, np.float64) for x in objects.rigid(body, fill, 1.0))
    scene.set_rigid(model, data, float(mass), com, inertia, FRICTION)
    data.qpos[:] = pose
    wrenches = []
    for _ in range(round(seconds / contact.timestep)):
        mujoco.mj_step(model, data)
        wrenches.append(physics.wrench(model, data, "pad"))
    return data.qpos.copy(), np.mean(wrenches[len(wrenches) // 2 :], axis=0)


@pytest.mark.parametrize("category", objects.CATEGORIES)
def test_c_mujoco_leaves_a_placed_body_there_and_carries_it_with_the_same_wrench(category):
    body = CLASSES[category]
    for face in range(min(2, len(physics.stable_faces(body, fill=PLACES["fill"]).up))):
        placed = physics.place(body, sts.Sensor(), face=face, **PLACES)
        pose, wrench = (np.asarray(x, np.float64) for x in placed)
        last, mean = simulated(body, pose, PLACES["fill"], 0.5)
        np.testing.assert_allclose(last[:3], pose[:3], atol=1e-4)
        assert abs(last[3:] @ pose[3:]) > np.cos(np.radians(0.25))
        force = wrench[2]
        np.testing.assert_allclose(mean[2], force, rtol=1e-3)
        np.testing.assert_allclose(mean[[0, 1, 5]], 0, atol=2e-3 * force)
        # 0.15 mm of the centre of pressure: the contacts of a polygon with sides of 10 mm and more
        np.testing.assert_allclose(mean[3:5], wrench[3:5], atol=1.5e-4 * force)


def test_the_gel_balances_every_class_and_the_default_leds_neither_clip_nor_hide_it():
    sensor = sts.Sensor(lights=sts.tactile.Leds())
    away = jnp.array([0, 0, -1.0, 1, 0, 0, 0])
    empty = np.asarray(sts.sense(sensor, CLASSES["bottle"], away).tactile)
    assert np.mean((empty <= 0) | (empty >= 1), axis=(0, 1)).max() < 1e-3
    for body in CLASSES.values():
        frame = sts.sense(sensor, body, *physics.place(body, sensor, position=(0.01, 0.02)))
        assert bool(frame.balanced)
        image = np.asarray(frame.tactile)
        assert np.mean((image <= 0) | (image >= 1), axis=(0, 1)).max() < 1e-2
        assert np.abs(image - empty).max() > 0.05


def test_placement_has_the_requested_face_yaw_and_position():
    body = CLASSES["bottle"]
    standing = physics.place(body, sts.Sensor(), face="upright", position=(0.01, -0.02), yaw=np.pi / 2)
    pose = np.asarray(standing.pose, np.float64)
    turn = Rotation.from_quat(pose[3:], scalar_first=True).as_matrix()
    np.testing.assert_allclose(turn[:, 2], [0, 0, 1], atol=1e-5)
    np.testing.assert_allclose(turn[:, 1], [-1, 0, 0], atol=1e-5)  # its -y, at the top of the image, turned by +90
    points = placed(pose, np.asarray(body.hulls, float).reshape(-1, 3))
    np.testing.assert_allclose((points.min(0) + points.max(0))[:2] / 2, [0.01, -0.02], atol=1e-6)
    np.testing.assert_allclose(points.min(0)[2], -1e-5, atol=1e-6)
    faces = physics.stable_faces(body)
    assert np.all(np.diff(faces.share) <= 0)
    np.testing.assert_allclose(faces.share.sum(), 1, rtol=1e-6)


NUM = 20
SCENARIO = physics.Released()
HALF = np.array([0.02, 0.012, 0.03])  # m, half the size of the block


def block() -> objects.Body:
    return solid_block(HALF, 0.12)


BODIES = [*(objects.make(jax.random.key(i), "camera") for i in (0, 3)), block()]
simulate = functools.partial(physics.simulate, jax.random.key(1), sensor=sts.Sensor())


@pytest.fixture(scope="module")
def let_go():
    return jax.tree.map(np.asarray, simulate(BODIES, scenario=SCENARIO, num=NUM))


@pytest.fixture(scope="module")
def rigids(let_go):
    return physics.rigids(BODIES, let_go.body, let_go.hidden)


def test_a_held_object_is_at_rest_and_carried_by_an_edge_or_a_corner(let_go, rigids):
    np.testing.assert_array_equal(let_go.velocity[:, 0], 0)
    assert let_go.contact[:, 0].all()
    assert not let_go.wall.any()
    deepest = float(sts.Sensor().gel.max_depth)
    for row in range(len(let_go.pose)):
        points = corners(BODIES, let_go, row)
        assert points[:, 2].min() == pytest.approx(-STANDING, abs=1e-7)
        touching = points[points[:, 2] < points[:, 2].min() + 1e-4, :2]
        assert np.abs(touching).max() < PAD[0] / 2
        assert np.linalg.matrix_rank(touching - touching[0], tol=1e-3) <= 1  # no face lies on the pad

        # The wrench carries a share of the weight at the contact.
        force, moment = let_go.wrench[row, 0, :3], let_go.wrench[row, 0, 3:]
        assert 0 < force[2] <= 1.001 * SCENARIO.carried[1] * G * rigids.mass[row]
        np.testing.assert_array_equal([*force[:2], moment[2]], 0)
        centre, low = np.array([-moment[1], moment[0]]) / force[2], points[points[:, 2] < 2 * deepest, :2]
        assert np.all((centre > low.min(0) - 0.02) & (centre < low.max(0) + 0.02))


def test_sense_draws_the_held_pose_without_tilting_it(let_go):
    sensor = sts.Sensor()
    for row in range(0, len(let_go.pose), 7):
        pose, wrench = jnp.asarray(let_go.pose[row, 0]), jnp.asarray(let_go.wrench[row, 0])
        frame = sts.sense(sensor, BODIES[let_go.body[row]], pose, wrench)
        assert frame.balanced
        turned = 2 * np.arccos(min(1, abs(np.dot(np.asarray(frame.pose[3:], np.float64), let_go.pose[row, 0, 3:]))))
        assert turned < np.radians(0.3)
        assert float(jnp.max(frame.pressure)) <= float(sensor.gel.stiffness * sensor.gel.max_depth)


@pytest.mark.parametrize("force", [0.05, 0.4])
def test_an_edge_pressed_into_the_gel_sinks_as_a_wedge(force):
    lean = np.radians(20)
    body, gel = block(), dataclasses.replace(sts.Sensor().gel, cells=(600, 600))
    turn = Rotation.from_rotvec([0, lean, 0])
    pose = np.array([0.004, -0.003, 0, *turn.as_quat(scalar_first=True)])
    wrench = rest.held_wrench(gel, body, pose, force)
    # A wedge of width w sinks by d: F = k w d^2 (cot a + tan a) / 2, with the centre of pressure (cot a - tan a) d / 3
    # from the edge, on the side of the flatter face.
    width, flat, steep = 2 * HALF[1], 1 / np.tan(lean), np.tan(lean)
    depth = np.sqrt(2 * force / (float(gel.stiffness) * width * (flat + steep)))
    points = placed(pose, np.asarray(body.hulls, np.float64).reshape(-1, 3))
    edge = points[points[:, 2] < points[:, 2].min() + 1e-6]
    np.testing.assert_allclose(wrench[2], force, rtol=1e-6)
    np.testing.assert_allclose(-wrench[4] / force, edge[0, 0] - (flat - steep) * depth / 3, atol=5e-5)
    np.testing.assert_allclose(wrench[3] / force, -0.003, atol=5e-5)


def test_a_corner_is_pressed_no_deeper_than_the_gel_allows():
    body, gel = block(), sts.Sensor().gel
    pose = np.array([0, 0, 0, *Rotation.from_euler("xy", [0.6, 0.6]).as_quat(scalar_first=True)])
    light, heavy = rest.held_wrench(gel, body, pose, 0.01), rest.held_wrench(gel, body, pose, 50.0)
    assert light[2] == pytest.approx(0.01, rel=1e-6)
    assert 0.01 < heavy[2] < 5
    assert sts.sense(sts.Sensor(), body, jnp.asarray(pose), jnp.asarray(heavy)).balanced
    beside = np.array([0.5, 0, 0, *pose[3:]])
    np.testing.assert_array_equal(rest.held_wrench(gel, body, beside, 1.0), 0)


def test_a_block_beyond_its_balance_topples_and_one_short_of_it_returns():
    shares = []
    for beyond in (-np.radians(6), np.radians(6)):
        scenario = dataclasses.replace(SCENARIO, beyond=(beyond, beyond), skew=0.0)
        traj = simulate(block(), scenario=scenario, num=8)
        turns = [Rotation.from_quat(traj.pose[:, frame, 3:], scalar_first=True) for frame in (0, -1)]
        turned = np.abs(np.sum(turns[0].as_matrix()[:, 2] * turns[1].as_matrix()[:, 2], axis=1))
        on_pad = np.asarray(traj.outcome != physics.Outcome.FELL_OFF)
        assert on_pad.mean() > 0.6
        shares.append(np.mean(np.asarray(traj.outcome)[on_pad] == physics.Outcome.TOPPLES))
        # On a face it has turned by the lean or by the rest of a quarter turn, which the sizes of the block determine.
        assert turned[on_pad].max() < 0.99
    assert shares[0] == 0
    assert shares[1] > 0.8


def test_the_first_frame_is_independent_of_everything_after_the_release(let_go):
    # Neither friction nor the contact's constants nor the number of frames change the first frame.
    slippery = let_go.hidden._replace(friction=np.full_like(let_go.hidden.friction, 0.1))
    other = dataclasses.replace(SCENARIO, frames=4, contact=physics.Contact(rolling=0.002))
    found = simulate(BODIES, scenario=other, num=NUM, hidden=jax.tree.map(jnp.asarray, slippery))
    for name in ("pose", "velocity", "wrench", "contact"):
        np.testing.assert_array_equal(getattr(found, name)[:, 0], getattr(let_go, name)[:, 0])
    assert np.abs(np.asarray(found.pose)[:, 3] - let_go.pose[:, 3]).max() > 1e-3


def test_objects_settle_in_every_outcome_and_the_energy_never_rises(let_go, rigids):
    share = [np.mean(let_go.outcome == outcome) for outcome in SCENARIO.outcomes]
    assert np.all(np.array(share[:2]) > [0.1, 0.2])  # topples, returns
    assert share[2] < 0.35  # fell off
    assert let_go.settled.mean() > 0.9
    for row in range(len(let_go.pose)):
        mass, com, inertia, _ = (part[row] for part in rigids)
        energy = []
        for pose, velocity in zip(let_go.pose[row].astype(float), let_go.velocity[row].astype(float), strict=True):
            turn = Rotation.from_quat(pose[3:], scalar_first=True)
            centre = turn.apply(com)
            speed = velocity[:3] + np.cross(velocity[3:], centre)
            spin = turn.apply(velocity[3:], inverse=True)
            energy.append(mass * (speed @ speed / 2 + G * (pose[2] + centre[2])) + spin @ inertia @ spin / 2)
        assert max(energy) < energy[0] + 0.02 * mass * G * 0.03  # 2 % of a fall of 30 mm
