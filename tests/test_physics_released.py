"""`Released`: held poses touch the pad, the balance decides on which side objects fall, and no future in the wrench."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from physics_scenes import PAD, box, corners, part, placed
from scipy.spatial.transform import Rotation

import sts_jax as sts
from sts_jax import objects, physics
from sts_jax.physics import rest
from sts_jax.physics.scenario import STANDING, G

NUM = 20
SCENARIO = physics.Released()
HALF = np.array([0.02, 0.012, 0.03])  # m, half the size of the block


def block() -> objects.Body:
    """A solid block, 40 x 24 x 60 mm, without contents. The visible mesh is the block too."""
    body = objects.make(jax.random.key(0), "fork")
    mesh = trimesh.creation.box(2 * HALF)
    x, y, z = (2 * HALF) ** 2
    mass = 0.12
    return dataclasses.replace(
        body,
        vertices=jnp.asarray(np.resize(mesh.vertices, body.vertices.shape), jnp.float32),
        faces=jnp.asarray(np.resize(mesh.faces, body.faces.shape), body.faces.dtype),
        hulls=jnp.asarray(part(box(*HALF)), jnp.float32),
        shell_mass=jnp.float32(mass),
        shell_com=jnp.zeros(3),
        shell_inertia=jnp.asarray(mass / 12 * np.diag([y + z, x + z, x + y]), jnp.float32),
    )


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

        # The wrench carries a share of the weight within the contact.
        force, moment = let_go.wrench[row, 0, :3], let_go.wrench[row, 0, 3:]
        assert 0 < force[2] <= 1.001 * SCENARIO.carried[1] * G * rigids.mass[row]
        np.testing.assert_array_equal([*force[:2], moment[2]], 0)
        centre = np.array([-moment[1], moment[0]]) / force[2]
        low = points[points[:, 2] < 2 * deepest]
        reach = 2 * deepest / np.tan(np.radians(3))  # of the part that is pressed into the gel beside the contact
        assert np.linalg.norm(low[:, :2] - centre, axis=1).min() < max(reach, np.ptp(low[:, :2], axis=0).max())
        lowest, highest = low[:, :2].min(0) - 0.02, low[:, :2].max(0) + 0.02
        assert np.all((centre > lowest) & (centre < highest))


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


def test_the_balance_of_the_centre_of_mass_decides_on_which_side_an_object_falls(let_go, rigids):
    agree, judged = [], 0
    for row in range(len(let_go.pose)):
        first = np.asarray(let_go.pose[row, 0], np.float64)
        points, centre = corners(BODIES, let_go, row), placed(first, rigids.com[row])
        edge = points[points[:, 2] < points[:, 2].min() + 5e-3, :2].mean(0)  # both ends of a skewed edge
        ahead = centre[:2] - edge
        if np.linalg.norm(ahead) < 4e-3:  # nearly balanced
            continue
        judged += 1
        early = placed(np.asarray(let_go.pose[row, 4], np.float64), rigids.com[row])  # after 0.13 s
        agree.append((early[:2] - centre[:2]) @ ahead > 0)
    assert judged >= len(let_go.pose) / 4
    assert np.mean(agree) > 0.85


@pytest.mark.slow
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
