"""Contacts of hulls with the pad, compared with those of the same mesh in C MuJoCo."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from sts_jax import geometry, physics
from sts_jax.physics import contact, roll, scene

PAD = (0.15, 0.15)
HALF = jnp.array([0.075, 0.075])
COLLIDE = jax.jit(jax.vmap(contact.collide, in_axes=(None, 0, None)))
CONTACTS = jax.jit(roll._contacts)


def points(name: str) -> np.ndarray:
    rng = np.random.default_rng(0)
    if name == "box":
        grid = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), -1).reshape(-1, 3) * [0.03, 0.02, 0.04]
    elif name == "rod":
        turn = np.arange(16) * np.pi / 8
        grid = np.concatenate(
            [np.stack([0.015 * np.cos(turn), 0.015 * np.sin(turn), 0 * turn + z], 1) for z in (0, 0.1)]
        )
    else:
        grid = rng.normal(size=(30, 3))
        grid *= 0.03 / np.linalg.norm(grid, axis=1, keepdims=True)
    return np.concatenate([grid, np.repeat(grid[-1:], 32 - len(grid), axis=0)]).astype(np.float32)[None]


def in_c(model: mujoco.MjModel, data: mujoco.MjData, pose: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    data.qpos[:] = pose
    mujoco.mj_kinematics(model, data)
    mujoco.mj_collision(model, data)
    if not data.ncon:
        return 1.0, np.zeros(3), np.zeros(3)
    deepest = int(np.argmin(data.contact.dist))
    return data.contact.dist[deepest], data.contact.frame[deepest, :3], data.contact.pos[deepest]


def deepest_in_ours(hull: contact.Hull, poses: np.ndarray) -> tuple[np.ndarray, ...]:
    found = COLLIDE(hull, poses, HALF)
    index = jnp.argmin(found.dist, axis=1)
    rows = jnp.arange(len(poses))
    return tuple(np.asarray(x) for x in (found.dist[rows, index], found.frame[rows, index, 0], found.pos[rows, index]))


def touching(shape: np.ndarray, where: str, depth: float, count: int = 40) -> np.ndarray:
    """Poses in which the hull is pushed `depth` into the pad, found by bisection of C MuJoCo's distance."""
    model = scene.compile_scene(shape, PAD, physics.Contact())
    data = mujoco.MjData(model)
    rng = np.random.default_rng(1)
    poses = []
    for _ in range(count):
        quat = rng.normal(size=4)
        quat /= np.linalg.norm(quat)
        xy = {"middle": rng.uniform(-0.01, 0.01, 2), "rim": [0.075, rng.uniform(-0.02, 0.02)], "corner": [0.075, 0.075]}
        low, high = -0.1, 0.2
        for _ in range(30):
            middle = (low + high) / 2
            pose = np.array([*xy[where], middle, *quat])
            low, high = (low, middle) if in_c(model, data, pose)[0] > -depth else (middle, high)
        poses.append(pose)
    return np.array(poses)


@pytest.mark.parametrize("where", ["middle", "rim", "corner"])
@pytest.mark.parametrize("name", ["box", "rod", "ball"])
def test_deepest_contact_is_that_of_c_mujoco(name, where):
    shape = points(name)
    model = scene.compile_scene(shape, PAD, physics.Contact())
    poses = touching(shape, where, 0.0005)
    dist, normal, pos = deepest_in_ours(contact.hull(shape), poses)
    truth = [in_c(model, mujoco.MjData(model), pose) for pose in poses]
    near = np.abs(dist - [t[0] for t in truth]) < 2e-5
    along = np.sum(normal * [t[1] for t in truth], axis=1) > 0.99
    # A flat or parallel touch has no single point, and two rims near a corner are as good as each other.
    close = np.linalg.norm(pos - [t[2] for t in truth], axis=1) < 1e-3
    share = 0.97 if where == "middle" else 0.9
    assert np.mean(near) >= share
    assert np.mean(along) >= share
    assert np.mean(close) >= share


@pytest.mark.parametrize("where", ["middle", "rim", "corner"])
def test_no_contact_where_c_mujoco_has_none(where):
    shape = points("box")
    poses = touching(shape, where, 0.0005)
    poses[:, 2] += 0.003
    model = scene.compile_scene(shape, PAD, physics.Contact())
    apart = np.array([in_c(model, mujoco.MjData(model), pose)[0] > 0 for pose in poses])
    assert apart.mean() > 0.5
    assert np.all(deepest_in_ours(contact.hull(shape), poses)[0][apart] > 0)


def test_a_flat_base_is_supported_all_round():
    hull = contact.hull(points("rod"))
    found = contact.collide(hull, jnp.array([0.01, 0.0, -1e-4, 1.0, 0, 0, 0]), HALF)
    used = np.asarray(found.pos)[np.asarray(found.dist) < 0] - [0.01, 0, 0]
    np.testing.assert_allclose(np.asarray(found.dist)[np.asarray(found.dist) < 0], -1e-4, atol=1e-7)
    angle = np.sort(np.arctan2(used[:, 1], used[:, 0]))
    assert len(used) >= 7
    assert np.max(np.diff(np.append(angle, angle[0] + 2 * np.pi))) < np.deg2rad(70)


def test_padding_changes_nothing():
    shape = points("box")
    more = np.concatenate([shape, np.repeat(shape[-1:], 32, axis=0)])
    pose = jnp.array([0.05, 0.01, 0.0398, *geometry.random_quat(jax.random.key(0)) * 0 + jnp.array([1.0, 0, 0, 0])])
    a, b = (contact.collide(contact.hull(s), pose, HALF) for s in (shape, more))
    np.testing.assert_array_equal(np.sort(a.dist), np.sort(b.dist))


@pytest.mark.slow
def test_convex_parts_leave_the_space_between_them_free():
    # An arch of two posts and a beam straddles the stop wall. Its beam lies 5 mm above the wall.
    def box(centre: list[float], size: list[float]) -> np.ndarray:
        grid = np.stack(np.meshgrid([-0.5, 0.5], [-0.5, 0.5], [-0.5, 0.5]), -1).reshape(-1, 3) * size + centre
        return np.concatenate([grid, np.repeat(grid[-1:], 24, axis=0)])

    parts = np.stack(
        [box([0, y, 0], [0.03, 0.01, 0.05]) for y in (-0.02, 0.02)] + [box([0, 0, 0.025], [0.03, 0.05, 0.01])]
    )
    _, model, _ = scene.template(PAD, physics.Contact(), 0.02)
    pose = jnp.array([0, 0.08, 0.0249, 1, 0, 0, 0])
    arch, filled = (jax.tree.map(jnp.asarray, contact.hull(x)) for x in (parts, parts.reshape(1, -1, 3)))
    found = CONTACTS(model, arch, pose)
    assert np.all(found.dist[8:] > 0)
    assert np.sum(found.dist[:8] < 0) == 4  # of the post on the pad. The other post is beyond the pad
    np.testing.assert_allclose(found.dist[:8].min(), -1e-4, atol=1e-6)
    assert np.all(found.pos[:8][np.asarray(found.dist[:8] < 0), 1] < 0.066)
    assert np.min(CONTACTS(model, filled, pose).dist[8:]) < -0.004


@pytest.mark.slow
@pytest.mark.parametrize("lean", [0.0, 0.4, -0.4])
def test_the_wall_holds_an_object_that_lies_across_it_as_in_c_mujoco(lean):
    grid = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), -1).reshape(-1, 3) * [0.01, 0.05, 0.004]
    rod = np.concatenate([grid, np.repeat(grid[-1:], 24, axis=0)])[None]
    model = scene.compile_scene(rod, PAD, physics.Contact(), 0.02)
    data = mujoco.MjData(model)
    quat = np.array([np.cos(lean / 2), np.sin(lean / 2), 0, 0])
    low, high = 0.02, 0.06  # the height at which it is pushed 0.2 mm into the wall
    for _ in range(40):
        middle = (low + high) / 2
        deep = in_c(model, data, np.array([0.01, 0.082, middle, *quat]))[0] < -2e-4
        low, high = (middle, high) if deep else (low, middle)
    pose = np.array([0.01, 0.082, low, *quat])
    dist, normal, pos = in_c(model, data, pose)
    _, ours, _ = scene.template(PAD, physics.Contact(), 0.02)
    found = CONTACTS(ours, jax.tree.map(jnp.asarray, contact.hull(rod)), jnp.asarray(pose, jnp.float32))
    deepest = int(jnp.argmin(found.dist))
    np.testing.assert_allclose(found.dist[deepest], dist, atol=2e-6)
    np.testing.assert_allclose(abs(found.frame[deepest, 0] @ normal), 1, atol=1e-3)
    assert abs(found.pos[deepest, 1] - pos[1]) < (0.011 if lean == 0 else 1e-3)
    assert 8 <= deepest < 12


@pytest.mark.parametrize("yaw", [0.0, 1e-7, 1e-5, 1e-3])
def test_edges_nearly_parallel_to_a_rim_keep_all_contacts(yaw):
    pose = jnp.array([0.03, -0.01, 0.02 - 3e-5, np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)])
    box = points("box")[:, :, [0, 2, 1]]  # lies on its side, 60 x 80 mm
    found = contact.collide(jax.tree.map(jnp.asarray, contact.hull(box)), pose, HALF)
    there = np.asarray(found.pos)[np.asarray(found.dist) < 0]
    np.testing.assert_allclose(np.unique(there[:, 0].round(3)), [0.0, 0.06])
    np.testing.assert_allclose(np.unique(there[:, 1].round(3)), [-0.05, 0.03])
    assert len(there) == 4


@pytest.mark.parametrize("lean", [0.0, 0.02, 0.1])
def test_both_rims_hold_an_edge_across_a_corner_whose_ends_are_lower(lean):
    """A rod on one of its long edges, whose ends lie beyond two sides of the pad. It leans along its length."""
    grid = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), -1).reshape(-1, 3) * [0.06, 0.005, 0.005]
    rod = np.concatenate([grid, np.repeat(grid[-1:], 24, axis=0)]).astype(np.float32)[None]
    turn = jnp.array([jnp.array([0, 0, -np.pi / 4]), jnp.array([0, lean, 0]), jnp.array([np.pi / 4, 0, 0])])
    yaw, pitch, edge_on = geometry.quat_from_rotvec(turn.astype(jnp.float32))
    quat = np.asarray(geometry.quat_multiply(yaw, geometry.quat_multiply(pitch, edge_on)))
    away = 0.007  # m, from the middle of the lowest edge to either side. It crosses the rims 14 mm from the corner
    deep = 0.0002  # m, depth of the lower crossing. One end or both are lower
    reach, thick = away * np.sqrt(2), 0.005 * np.sqrt(2)
    low = np.array([0.075 - away, 0.075 - away, np.tan(lean) * reach - deep])
    middle = low + thick * np.array([np.sin(lean) / np.sqrt(2), -np.sin(lean) / np.sqrt(2), np.cos(lean)])
    pose = np.concatenate([middle, quat])
    model = scene.compile_scene(rod, PAD, physics.Contact())
    dist, _, _ = in_c(model, mujoco.MjData(model), pose)
    hull = jax.tree.map(jnp.asarray, contact.hull(rod))
    found = contact.collide(hull, jnp.asarray(pose, jnp.float32), HALF)
    assert dist < -0.5 * deep
    np.testing.assert_allclose(found.dist.min(), dist, atol=5e-6)
    there = np.asarray(found.pos)[np.asarray(found.dist) < -0.5 * deep]
    expected = [[0.061, 0.075], [0.075, 0.061]] if lean == 0 else [[0.075, 0.061]]
    np.testing.assert_allclose(np.unique(there[:, :2].round(3), axis=0), expected, atol=1.1e-3)
    beneath = contact.collide(hull, jnp.asarray(pose - [0, 0, 0.05, 0, 0, 0, 0], jnp.float32), HALF)
    assert beneath.dist.min() > -deep  # far below the top, no contact lifts the object over it
