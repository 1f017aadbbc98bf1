"""Pose codes turned about the vertical, compared with quaternions and a dense covariance."""

import jax.numpy as jnp
import numpy as np
import pytest

from sts_jax import geometry, training
from sts_jax.statespace import poses


def encode(pose):
    return training.Preprocessing().encode_pose(jnp.asarray(pose, jnp.float32))


def random_poses(number, seed=0):
    rng = np.random.default_rng(seed)
    quat = rng.normal(size=(number, 4))
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    return np.concatenate([0.05 * rng.normal(size=(number, 3)), quat], axis=1).astype(np.float32)


def unit(angle):
    angle = jnp.asarray(angle, jnp.float32)
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)


def turned_by_quaternion(angle, pose):
    """Each pose after a rotation of the scene about z."""
    zero = np.zeros_like(angle)
    quat = np.stack([np.cos(angle / 2), zero, zero, np.sin(angle / 2)], axis=1)
    position = np.einsum("nij,nj->ni", np.asarray(geometry.quat_to_matrix(jnp.asarray(quat))), pose[:, :3])
    return np.concatenate([position, geometry.quat_multiply(jnp.asarray(quat), jnp.asarray(pose[:, 3:]))], axis=1)


ANGLES = np.linspace(-3, 3, 7, dtype=np.float32)


def test_turned_code_is_the_code_of_the_turned_pose():
    pose = random_poses(7)
    expected = encode(turned_by_quaternion(ANGLES, pose))
    found = poses.turn_code(unit(ANGLES), encode(pose))
    np.testing.assert_allclose(found, expected, atol=1e-5)
    np.testing.assert_allclose(poses.turn_code_back(unit(ANGLES), found), encode(pose), atol=1e-5)


def test_heading_turns_with_the_object():
    pose = random_poses(200)
    code = encode(pose)
    angle = np.random.default_rng(1).uniform(-3, 3, 200).astype(np.float32)
    expected = poses.turn(unit(angle), poses.heading(code))
    np.testing.assert_allclose(poses.heading(poses.turn_code(unit(angle), code)), expected, atol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(expected, axis=1), 1, rtol=1e-5)


@pytest.mark.parametrize(
    ("rotation", "expected"),
    [
        ((0, 0, 0.3), (np.cos(0.3), np.sin(0.3))),  # x axis level
        ((0, -np.pi / 2, 0), (-1, 0)),  # x axis upright, z axis along -x
        ((np.pi / 4, 0, 0), (1, 0)),  # y and z steep, x level
    ],
)
def test_heading_is_that_of_the_first_level_axis(rotation, expected):
    matrix = geometry.quat_to_matrix(geometry.quat_from_rotvec(jnp.array(rotation)))
    code = jnp.concatenate([jnp.zeros(3), matrix.reshape(9)])
    np.testing.assert_allclose(poses.heading(code), expected, atol=1e-6)
