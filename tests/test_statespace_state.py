"""State codes, compared with rotated vertices, rotated centres of mass and a dense covariance."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from statespace_config import random_states

from sts_jax import objects
from sts_jax.statespace import harmonics, poses, state

NUMBER = 5
DIRECTIONS = objects.DIRECTIONS.astype(np.float64)
ANGLES = np.linspace(-2.5, 2.5, NUMBER)


def unit(angle):
    return jnp.stack([jnp.cos(jnp.asarray(angle, jnp.float32)), jnp.sin(jnp.asarray(angle, jnp.float32))], axis=-1)


def encoded(rotations, points, mass=0.1, com=(0.0, 0.0, 0.0), position=(0.0, 0.0, 0.0)):
    """The state codes of a hull with the vertices `points` (m) in several rotations."""
    number = len(rotations)
    code = np.concatenate([np.tile(position, (number, 1)), rotations.as_matrix().reshape(number, 9)], axis=1)
    values = np.max(points @ DIRECTIONS.T, axis=0)
    solid = np.tile(values, (number, 1)), np.full(number, mass), np.tile(com, (number, 1))
    return state.encode(*(jnp.asarray(x, jnp.float32) for x in (code, *solid)))


def fitted(points):
    """Harmonics of the support function of vertices, fitted in float64."""
    values = np.max(points @ DIRECTIONS.T, axis=0) / state.LENGTH - state.MEAN
    basis = np.asarray(harmonics.basis(jnp.asarray(DIRECTIONS, jnp.float32), state.DEGREE), np.float64)
    return np.linalg.lstsq(basis, values, rcond=None)[0]


def box(*size):
    corners = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3), axis=-1).reshape(-1, 3)
    return corners * size


def test_shown_shape_is_that_of_the_rotated_vertices():
    rng = np.random.default_rng(0)
    rotations = Rotation.random(NUMBER, random_state=2)
    points = rng.normal(size=(200, 3))
    # The hull is smooth, because a fit mixes harmonics of higher degrees into the lower ones.
    points *= np.array([0.035, 0.025, 0.02]) / np.linalg.norm(points, axis=1)[:, None]
    parts = state.split(encoded(rotations, points))
    np.testing.assert_allclose(parts.support, np.tile(fitted(points), (NUMBER, 1)), atol=1e-4)
    for i, rotation in enumerate(rotations):
        expected = fitted(rotation.apply(points))
        np.testing.assert_allclose(parts.support_in_sensor[i], expected, atol=0.02)
        assert np.abs(parts.support[i] - expected).max() > 0.1


def test_reach_is_the_depth_of_the_lowest_vertex():
    points = np.random.default_rng(0).normal(size=(2000, 3))
    points *= np.array([0.035, 0.025, 0.02]) / np.linalg.norm(points, axis=1)[:, None]
    present, since = (Rotation.random(NUMBER, random_state=seed) for seed in (5, 6))
    found = state.reach(state.split(encoded(present, points)), jnp.asarray(since.as_matrix(), jnp.float32))
    expected = [-(rotation.apply(points)[:, 2].min()) for rotation in since * present]
    np.testing.assert_allclose(found, expected, atol=2e-4)
    assert np.ptp(expected) > 1e-3


def test_turned_state_is_the_state_of_the_turned_pose():
    rotations = Rotation.random(NUMBER, random_state=4)
    rng = np.random.default_rng(0)
    points, com = 0.02 * rng.normal(size=(30, 3)), np.array([0.004, -0.002, 0.007])
    before = state.split(encoded(rotations, points, com=com, position=(0.3, -0.2, 0.5)))
    after = state.turn(unit(ANGLES), before)
    about = Rotation.from_euler("z", ANGLES[:, None])
    expected = state.split(encoded(about * rotations, points, com=com))
    expected = expected._replace(
        pose=expected.pose.at[:, :3].set(jnp.asarray(about.apply([0.3, -0.2, 0.5]), jnp.float32))
    )
    for found, wanted in zip(after, expected, strict=True):
        np.testing.assert_allclose(found, wanted, atol=2e-4)


def test_turned_variance_is_the_diagonal_of_the_turned_covariance():
    variance = np.random.default_rng(0).uniform(0.1, 2, state.CODE).astype(np.float32)
    angle = unit([0.7])
    # Turning is linear.
    turn = state.join(state.turn(jnp.tile(angle, (state.CODE, 1)), state.split(jnp.eye(state.CODE))))
    expected = np.diag(np.asarray(turn).T @ np.diag(variance) @ np.asarray(turn))
    found = state.join(state.turn_variance(angle, state.split(jnp.asarray(variance)[None])))[0]
    np.testing.assert_allclose(found, expected, rtol=1e-4)


@pytest.mark.parametrize("certainty", [0.0, 0.4])
def test_heading_of_an_uncertain_rotation_is_the_long_axis_of_the_shown_shape(certainty):
    code = encoded(Rotation.from_euler("z", ANGLES[:, None]), box(0.08, 0.02, 0.03))
    blurred = code.at[:, 3:12].multiply(certainty)
    found = state.heading(state.split(blurred))
    line = np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)
    np.testing.assert_allclose(np.abs(np.sum(found * line, axis=1)), 1, atol=1e-3)  # up to its sign
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, rtol=1e-5)


def test_heading_of_a_known_rotation_is_that_of_the_mesh():
    """The long axis of the shape differs and has no influence."""
    code = encoded(Rotation.from_euler("z", ANGLES[:, None]), box(0.02, 0.08, 0.03))
    parts = state.split(code)
    np.testing.assert_allclose(state.heading(parts), unit(ANGLES), atol=1e-5)
    wild = state.split(random_states(np.random.default_rng(0), 20))
    np.testing.assert_array_equal(state.heading(wild), poses.heading(wild.pose))


def test_unknown_state_has_a_unit_heading_and_no_gradient():
    def total(code):
        return state.heading(state.split(code)).sum()

    nothing = jnp.zeros((1, state.CODE))
    np.testing.assert_allclose(np.linalg.norm(state.heading(state.split(nothing))), 1, rtol=1e-6)
    np.testing.assert_array_equal(jax.grad(total)(nothing), 0)
