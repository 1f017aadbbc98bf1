"""Contacts of hulls with the pad, compared with those of the same mesh in C MuJoCo."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from physics_scenes import PAD, box, hull, part
from scipy.spatial.transform import Rotation

from sts_jax import physics
from sts_jax.physics import contact, roll, scene

HALF = jnp.array([0.075, 0.075])
COLLIDE = jax.jit(jax.vmap(contact.collide, in_axes=(None, 0, None)))
CONTACTS = jax.jit(roll._contacts)


def points(name: str) -> np.ndarray:
    if name == "box":
        return part(box(0.03, 0.02, 0.04)).astype(np.float32)
    if name == "rod":
        turn = np.arange(16) * np.pi / 8
        rings = [np.stack([0.015 * np.cos(turn), 0.015 * np.sin(turn), 0 * turn + z], 1) for z in (0, 0.1)]
        return part(np.concatenate(rings)).astype(np.float32)
    ball = np.random.default_rng(0).normal(size=(30, 3))
    return part(ball * 0.03 / np.linalg.norm(ball, axis=1, keepdims=True)).astype(np.float32)


def in_c(model: mujoco.MjModel, data: mujoco.MjData, pose: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    data.qpos[:] = pose
    mujoco.mj_kinematics(model, data)
    mujoco.mj_collision(model, data)
    if not data.ncon:
        return 1.0, np.zeros(3), np.zeros(3)
    deepest = int(np.argmin(data.contact.dist))
    return data.contact.dist[deepest], data.contact.frame[deepest, :3].copy(), data.contact.pos[deepest].copy()


def height_at(model: mujoco.MjModel, pose: np.ndarray, depth: float, low: float, high: float) -> np.ndarray:
    """The pose, moved to the height at which the hull is `depth` in a box, by bisection of C MuJoCo's distance."""
    data, pose = mujoco.MjData(model), pose.copy()
    for _ in range(40):
        pose[2] = (low + high) / 2
        low, high = (low, pose[2]) if in_c(model, data, pose)[0] > -depth else (pose[2], high)
    return pose


@pytest.mark.parametrize("where", ["middle", "rim", "corner"])
@pytest.mark.parametrize("name", ["box", "rod", "ball"])
def test_deepest_contact_is_that_of_c_mujoco_and_there_is_none_where_it_has_none(name, where):
    shape, rng = points(name), np.random.default_rng(1)
    model = scene.compile_scene(shape, PAD, physics.Contact())
    data, poses = mujoco.MjData(model), []
    for _ in range(40):
        quat = rng.normal(size=4)
        xy = {"middle": rng.uniform(-0.01, 0.01, 2), "rim": [0.075, rng.uniform(-0.02, 0.02)], "corner": [0.075, 0.075]}
        poses.append(height_at(model, np.array([*xy[where], 0, *(quat / np.linalg.norm(quat))]), 0.0005, -0.1, 0.2))
    contacts, rows = COLLIDE(hull(shape), np.array(poses), HALF), np.arange(40)
    deepest = jnp.argmin(contacts.dist, axis=1)
    dist, pos, normal = (x[rows, deepest] for x in (contacts.dist, contacts.pos, contacts.frame[:, :, 0]))
    truth = [np.stack(x) for x in zip(*(in_c(model, data, pose) for pose in poses), strict=True)]
    share = 0.97 if where == "middle" else 0.9
    assert np.mean(np.abs(dist - truth[0]) < 2e-5) >= share
    assert np.mean(np.sum(normal * truth[1], axis=1) > 0.99) >= share
    # A flat or parallel touch has no single point, and two rims near a corner are as good as each other.
    assert np.mean(np.linalg.norm(pos - truth[2], axis=1) < 1e-3) >= share

    raised = np.add(poses, [0, 0, 0.003, 0, 0, 0, 0])
    apart = np.array([in_c(model, data, pose)[0] > 0 for pose in raised])
    assert apart.mean() > 0.5
    assert np.all(COLLIDE(hull(shape), raised, HALF).dist[apart] > 0)


def test_a_flat_base_is_supported_all_round():
    contacts = jax.jit(contact.collide)(hull(points("rod")), jnp.array([0.01, 0.0, -1e-4, 1.0, 0, 0, 0]), HALF)
    touches = np.asarray(contacts.dist) < 0
    used = np.asarray(contacts.pos)[touches] - [0.01, 0, 0]
    np.testing.assert_allclose(np.asarray(contacts.dist)[touches], -1e-4, atol=1e-7)
    angle = np.sort(np.arctan2(used[:, 1], used[:, 0]))
    assert len(used) >= 7
    assert np.max(np.diff(np.append(angle, angle[0] + 2 * np.pi))) < np.deg2rad(70)


@pytest.mark.slow
def test_convex_parts_leave_the_space_between_them_free():
    # An arch of two posts and a beam straddles the stop wall. Its beam lies 5 mm above the wall.
    post, beam = box(0.015, 0.005, 0.025), np.add(box(0.015, 0.025, 0.005), [0, 0, 0.025])
    parts = np.concatenate([part(x) for x in (post - [0, 0.02, 0], np.add(post, [0, 0.02, 0]), beam)])
    _, model, _ = scene.template(PAD, physics.Contact(), 0.02)
    pose = jnp.array([0, 0.08, 0.0249, 1, 0, 0, 0])
    contacts = CONTACTS(model, hull(parts), pose)
    assert np.all(contacts.dist[8:] > 0)
    assert np.sum(contacts.dist[:8] < 0) == 4  # of the post on the pad. The other post is beyond the pad
    np.testing.assert_allclose(contacts.dist[:8].min(), -1e-4, atol=1e-6)
    assert np.all(contacts.pos[:8][np.asarray(contacts.dist[:8] < 0), 1] < 0.066)
    assert np.min(CONTACTS(model, hull(parts.reshape(1, -1, 3)), pose).dist[8:]) < -0.004


@pytest.mark.slow
@pytest.mark.parametrize("lean", [0.0, 0.4, -0.4])
def test_the_wall_holds_an_object_that_lies_across_it_as_in_c_mujoco(lean):
    rod = part(box(0.01, 0.05, 0.004))
    model = scene.compile_scene(rod, PAD, physics.Contact(), 0.02)
    pose = np.array([0.01, 0.082, 0, np.cos(lean / 2), np.sin(lean / 2), 0, 0])
    pose = height_at(model, pose, 0.0002, 0.02, 0.06)
    dist, normal, pos = in_c(model, mujoco.MjData(model), pose)
    _, ours, _ = scene.template(PAD, physics.Contact(), 0.02)
    contacts = CONTACTS(ours, hull(rod), jnp.asarray(pose, jnp.float32))
    deepest = int(jnp.argmin(contacts.dist))
    np.testing.assert_allclose(contacts.dist[deepest], dist, atol=2e-6)
    np.testing.assert_allclose(abs(contacts.frame[deepest, 0] @ normal), 1, atol=1e-3)
    assert abs(contacts.pos[deepest, 1] - pos[1]) < (0.011 if lean == 0 else 1e-3)
    assert 8 <= deepest < 12


@pytest.mark.parametrize("yaw", [0.0, 1e-7, 1e-3])
def test_edges_nearly_parallel_to_a_rim_keep_all_contacts(yaw):
    pose = jnp.array([0.03, -0.01, 0.02 - 3e-5, np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)])
    contacts = contact.collide(hull(points("box")[:, :, [0, 2, 1]]), pose, HALF)  # it lies on its side, 60 x 80 mm
    touching = np.asarray(contacts.pos)[np.asarray(contacts.dist) < 0]
    np.testing.assert_allclose(np.unique(touching[:, 0].round(3)), [0.0, 0.06])
    np.testing.assert_allclose(np.unique(touching[:, 1].round(3)), [-0.05, 0.03])
    assert len(touching) == 4


@pytest.mark.parametrize("lean", [0.0, 0.02, 0.1])
def test_both_rims_hold_an_edge_across_a_corner_whose_ends_are_lower(lean):
    """A rod on one of its long edges, whose ends lie beyond two sides of the pad. It leans along its length."""
    rod = part(box(0.06, 0.005, 0.005)).astype(np.float32)
    quat = Rotation.from_euler("ZYX", [-np.pi / 4, lean, np.pi / 4]).as_quat(scalar_first=True)
    away = 0.007  # m, from the middle of the lowest edge to either side. It crosses the rims 14 mm from the corner
    deep = 0.0002  # m, depth of the lower crossing. One end or both are lower
    reach, thick = away * np.sqrt(2), 0.005 * np.sqrt(2)
    low = np.array([0.075 - away, 0.075 - away, np.tan(lean) * reach - deep])
    middle = low + thick * np.array([np.sin(lean) / np.sqrt(2), -np.sin(lean) / np.sqrt(2), np.cos(lean)])
    pose = np.concatenate([middle, quat])
    model = scene.compile_scene(rod, PAD, physics.Contact())
    dist, _, _ = in_c(model, mujoco.MjData(model), pose)
    contacts = contact.collide(hull(rod), jnp.asarray(pose, jnp.float32), HALF)
    assert dist < -0.5 * deep
    np.testing.assert_allclose(contacts.dist.min(), dist, atol=5e-6)
    touching = np.asarray(contacts.pos)[np.asarray(contacts.dist) < -0.5 * deep]
    expected = [[0.061, 0.075], [0.075, 0.061]] if lean == 0 else [[0.075, 0.061]]
    np.testing.assert_allclose(np.unique(touching[:, :2].round(3), axis=0), expected, atol=1.1e-3)
    beneath = contact.collide(hull(rod), jnp.asarray(pose - [0, 0, 0.05, 0, 0, 0, 0], jnp.float32), HALF)
    assert beneath.dist.min() > -deep  # far below the top, no contact lifts the object over it
