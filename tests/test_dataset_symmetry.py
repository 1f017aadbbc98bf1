import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sts_jax as sts
from sts_jax import geometry
from sts_jax.dataset.symmetry import turn, turn_condition, turn_wrench


def test_a_turn_turns_position_orientation_and_wrench():
    key = jax.random.key(3)
    pose = jnp.concatenate([jnp.array([0.01, 0.02, 0.03]), geometry.random_quat(key)])
    point = jnp.array([0.005, -0.01, 0.02])
    x, y, z = np.asarray(geometry.transform(pose, point))
    turned = turn(pose, 1)
    np.testing.assert_allclose(geometry.transform(turned, point), [-y, x, z], atol=1e-7)
    wrench = jnp.array([1.0, 2, 3, 4, 5, 6])
    np.testing.assert_allclose(turn_wrench(wrench, 1), [-2, 1, 3, -5, 4, 6], atol=1e-6)


@pytest.mark.parametrize(
    "scenario", [sts.physics.Freefall(), sts.physics.Inclined(), sts.physics.Perturbed(), sts.physics.Released()]
)
def test_a_scenarios_symmetries_are_those_that_turn_its_gravity_with_its_condition(scenario):
    condition = jnp.array([[3.0, -7.0, 0.08]])[:, : len(scenario.condition_scale)]
    kept = []
    for symmetry in range(8):
        turned = turn_condition(condition, symmetry)
        gravity, other = (scenario.gravity(jnp.float32(0.01), c[0]) for c in (condition, turned))
        image = turn_wrench(jnp.concatenate([gravity, jnp.zeros(3)]), symmetry)[:3]
        if np.allclose(other, image, atol=1e-5):
            kept.append(symmetry)
        np.testing.assert_array_equal(turned[:, 2:], condition[:, 2:])
    assert tuple(kept) == scenario.symmetries


def test_a_mirrored_pose_and_body_are_the_mirror_image_in_the_sensor_frame():
    pose = jnp.concatenate([jnp.array([0.01, 0.02, 0.03]), geometry.random_quat(jax.random.key(4))])
    point, arm, force = jnp.array([0.005, -0.01, 0.02]), jnp.array([0.3, -0.2, 0.1]), jnp.array([1.0, 2, 3])
    flip = jnp.array([1.0, -1, 1])
    np.testing.assert_allclose(
        geometry.transform(turn(pose, 4), point * flip), geometry.transform(pose, point) * flip, atol=1e-7
    )
    wrench = jnp.concatenate([force, jnp.cross(arm, force)])
    image = jnp.concatenate([force * flip, jnp.cross(arm * flip, force * flip)])
    np.testing.assert_allclose(turn_wrench(wrench, 4), image, atol=1e-6)
