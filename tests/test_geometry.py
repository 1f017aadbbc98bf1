"""Rotations and poses against SciPy and 4x4 matrices, gradients against finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sts_jax import geometry

pytestmark = pytest.mark.usefixtures("strict_ranks")


def rotations(num, seed=0):
    """Random rotations, among them the identity and half turns, and their quaternions in this library's order."""
    special = Rotation.from_rotvec(np.pi * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]))
    turns = Rotation.concatenate([special, Rotation.random(num, random_state=seed)])
    return turns, jnp.asarray(turns.as_quat(canonical=True, scalar_first=True), jnp.float32)


def poses(num, seed=0):
    """Random poses and their 4x4 matrices in float64."""
    turns, quats = rotations(num, seed)
    places = np.random.default_rng(seed).normal(size=(len(turns), 3))
    matrices = np.tile(np.eye(4), (len(turns), 1, 1))
    matrices[:, :3, :3], matrices[:, :3, 3] = turns.as_matrix(), places
    return jnp.concatenate([jnp.asarray(places, jnp.float32), quats], -1), matrices


def test_quaternions_agree_with_scipy():
    turns, quats = rotations(200)
    others, more = rotations(200, seed=1)
    np.testing.assert_allclose(geometry.quat_to_matrix(quats), turns.as_matrix(), atol=1e-6)
    np.testing.assert_allclose(
        geometry.quat_to_matrix(geometry.quat_multiply(quats, more)), (turns * others).as_matrix(), atol=2e-6
    )
    np.testing.assert_allclose(
        geometry.quat_to_matrix(geometry.quat_inverse(quats)), turns.inv().as_matrix(), atol=1e-6
    )
    np.testing.assert_allclose(geometry.quat_canonical(-quats)[4:], quats[4:], atol=1e-6)


def test_rotation_vectors_survive_a_round_trip():
    turns, quats = rotations(200)
    vectors = np.concatenate([turns.as_rotvec()[4:], 1e-5 * turns.as_rotvec()[4:]]).astype(np.float32)
    expected = Rotation.from_rotvec(vectors)
    got = geometry.quat_from_rotvec(jnp.asarray(vectors))
    np.testing.assert_allclose(geometry.quat_to_matrix(got), expected.as_matrix(), atol=2e-6)
    np.testing.assert_allclose(geometry.quat_to_rotvec(got), vectors, atol=3e-6)
    np.testing.assert_allclose(geometry.norm(geometry.quat_to_rotvec(quats)), turns.magnitude(), atol=1e-6)


def test_poses_survive_a_round_trip():
    pose, matrix = poses(200)
    np.testing.assert_allclose(geometry.pose_to_matrix(pose), matrix, atol=1e-6)
    again = geometry.pose_from_matrix(jnp.asarray(matrix, jnp.float32))
    assert np.all(again[:, 3] >= 0)
    np.testing.assert_allclose(geometry.pose_to_matrix(again), matrix, atol=2e-5)


def test_poses_compose_as_matrices_do():
    left, a = poses(200)
    right, b = poses(200, seed=1)
    np.testing.assert_allclose(geometry.pose_to_matrix(geometry.pose_multiply(left, right)), a @ b, atol=5e-6)
    np.testing.assert_allclose(geometry.pose_to_matrix(geometry.pose_inverse(left)), np.linalg.inv(a), atol=5e-6)
    points = np.random.default_rng(2).normal(size=(7, 3))
    got = jax.vmap(geometry.transform, (0, None))(left, jnp.asarray(points))
    np.testing.assert_allclose(got, points @ a[:, :3, :3].mT + a[:, None, :3, 3], atol=5e-6)


def test_quaternion_of_any_matrix_is_the_nearest_rotation():
    rng = np.random.default_rng(2)
    matrix = rng.normal(size=(500, 3, 3))
    left, _, right = np.linalg.svd(matrix)
    left[:, :, 2] *= np.linalg.det(left @ right)[:, None]
    quat = jax.jit(geometry.quat_from_matrix)(matrix.astype(np.float32))
    assert np.all(quat[:, 0] >= 0)
    values = np.linalg.svd(matrix, compute_uv=False)
    clear = values[:, 1] - values[:, 2] > 0.05  # otherwise two rotations may be equally near
    np.testing.assert_allclose(geometry.quat_to_matrix(quat)[clear], (left @ right)[clear], atol=2e-5)


@pytest.mark.parametrize("vector", [(0.0, 0.0, 0.0), (1e-4, 0.0, -2e-4), (0.3, -1.2, 2.5)])
def test_the_gradient_of_a_round_trip_through_a_matrix_is_the_identity(vector):
    def round_trip(v):
        quat = geometry.quat_from_matrix(geometry.quat_to_matrix(geometry.quat_from_rotvec(v)))
        return geometry.quat_to_rotvec(quat)

    got = jax.jit(jax.jacrev(round_trip))(jnp.array(vector))  # the round trip is the identity
    np.testing.assert_allclose(got, np.eye(3), atol=2e-3)


def test_a_matrix_that_mirrors_has_no_pose():
    mirrored = np.eye(4)
    mirrored[1, 1] = -1
    with pytest.raises(ValueError, match=r"the matrix mirrors \(its 3x3 part has the determinant -1\)"):
        geometry.pose_from_matrix(mirrored)
    with pytest.raises(ValueError, match="mirrors"):
        geometry.pose_from_matrix(np.stack([np.eye(4), mirrored]))
    assert np.isfinite(jax.jit(geometry.pose_from_matrix)(mirrored)).all()
