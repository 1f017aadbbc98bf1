import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sts_jax as sts
from sts_jax import geometry
from sts_jax.dataset.symmetry import turn, turn_condition, turn_wrench


@pytest.mark.parametrize(
    ("symmetry", "image", "sign"), [(1, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], 1), (4, np.diag([1, -1, 1]), -1)]
)
def test_a_turn_and_a_mirror_map_points_of_the_body_and_the_wrench(symmetry, image, sign):
    """A mirrored body is mirrored in its own frame, too, and moments are axial vectors."""
    pose = jnp.concatenate([jnp.array([0.01, 0.02, 0.03]), geometry.random_quat(jax.random.key(3))])
    point, image = np.array([0.005, -0.01, 0.02]), np.array(image)
    expected = image @ geometry.transform(pose, point)
    own = point if sign > 0 else image @ point
    np.testing.assert_allclose(geometry.transform(turn(pose, symmetry), own), expected, atol=1e-7)
    force, moment = np.array([1.0, 2, 3]), np.array([4.0, 5, 6])
    turned = turn_wrench(jnp.concatenate([force, moment]), symmetry)
    np.testing.assert_allclose(turned, [*image @ force, *sign * image @ moment], atol=1e-6)


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
