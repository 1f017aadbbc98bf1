"""Codes of poses: encoding, decoding, and the short codes of an uncertain network."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sts_jax import geometry, training
from sts_jax.evaluation.metrics import geodesic_angle


def poses(count):
    key, turn = jax.random.split(jax.random.key(0))
    quats = jax.vmap(geometry.random_quat)(jax.random.split(turn, count))
    return jnp.concatenate([0.05 * jax.random.normal(key, (count, 3)), quats], axis=-1)


@pytest.mark.parametrize(("rotation", "size"), [("matrix", 12), ("quaternion", 7)])
def test_decoding_inverts_encoding(rotation, size):
    preprocessing, pose = training.Preprocessing(rotation=rotation), poses(200)
    code = preprocessing.encode_pose(pose)
    assert code.shape == (200, size) == (200, preprocessing.pose_size)
    again = preprocessing.decode_pose(code)
    np.testing.assert_allclose(again[:, :3], pose[:, :3], atol=1e-7)
    assert geodesic_angle(np.asarray(again), np.asarray(pose)).max() < 2e-3
    flipped = jnp.concatenate([pose[:, :3], -pose[:, 3:]], axis=-1)
    np.testing.assert_allclose(preprocessing.encode_pose(flipped), code, atol=1e-6)


def test_a_matrix_code_is_continuous_where_the_quaternion_changes_its_sign():
    around = jnp.array([0.0, 0.0, 1.0])
    turns = [geometry.quat_from_rotvec(angle * around) for angle in (jnp.pi - 1e-3, jnp.pi + 1e-3)]
    codes = {
        rotation: [training.Preprocessing(rotation=rotation).encode_pose(jnp.r_[jnp.zeros(3), q]) for q in turns]
        for rotation in ("matrix", "quaternion")
    }
    gaps = {rotation: float(jnp.linalg.norm(a - b)) for rotation, (a, b) in codes.items()}
    assert gaps["matrix"] < 0.01
    assert gaps["quaternion"] > 1.9


@pytest.mark.parametrize("rotation", ["matrix", "quaternion"])
def test_an_uncertain_code_is_decoded_to_a_valid_pose(rotation):
    preprocessing = training.Preprocessing(rotation=rotation)
    pose = poses(50)
    code = preprocessing.encode_pose(pose)
    faint = preprocessing.decode_pose(code.at[:, 3:].multiply(0.05))  # a mean over many orientations is short
    assert geodesic_angle(np.asarray(faint), np.asarray(pose)).max() < 2e-3
    nothing = preprocessing.decode_pose(jnp.zeros(preprocessing.pose_size))
    np.testing.assert_array_equal(nothing[3:], [1, 0, 0, 0])
