"""State codes, their harmonics and pose codes, compared with SciPy, rotated vertices and a dense covariance."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special
from scipy.spatial.transform import Rotation
from statespace_config import random_codes, random_states, unit

from sts_jax import objects
from sts_jax.statespace import harmonics, poses, state

NUMBER, DEGREE = 5, 6
DIRECTIONS = objects.DIRECTIONS.astype(np.float64)
ANGLES = np.linspace(-2.5, 2.5, NUMBER)
TURNED = Rotation.from_euler("z", ANGLES[:, None])
turn, heading = jax.jit(state.turn), jax.jit(state.heading)


def expected_basis(direction):
    """SciPy's harmonics in float64, as real functions with a mean square of 1."""
    x, y, z = np.moveaxis(np.asarray(direction, np.float64), -1, 0)
    polar, azimuth = np.arccos(np.clip(z, -1, 1)), np.arctan2(y, x)
    columns = []
    for n in range(DEGREE + 1):
        for m in (0, *(sign * k for k in range(1, n + 1) for sign in (1, -1))):
            value = np.sqrt(4 * np.pi) * special.sph_harm_y(n, abs(m), polar, azimuth)
            part = value.imag if m < 0 else value.real
            columns.append(part * (np.sqrt(2) * (-1) ** m if m else 1))
    return np.stack(columns, axis=-1)


def sphere(number, seed=0):
    rows = np.random.default_rng(seed).normal(size=(number, 3))
    return (rows / np.linalg.norm(rows, axis=1)[:, None]).astype(np.float32)


def ellipsoid(number):
    """Vertices of a smooth hull: a fit mixes the harmonics of higher degrees into the lower ones."""
    return sphere(number) * np.array([0.035, 0.025, 0.02])


def box(*size):
    return (np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3), axis=-1).reshape(-1, 3)) * size


def encoded(rotations, points, com=(0.0, 0.0, 0.0), position=(0.0, 0.0, 0.0)):
    """The state codes of a hull with the vertices `points` (m) in several rotations."""
    number = len(rotations)
    code = np.concatenate([np.broadcast_to(position, (number, 3)), rotations.as_matrix().reshape(number, 9)], axis=1)
    solid = np.tile(np.max(points @ DIRECTIONS.T, axis=0), (number, 1)), np.full(number, 0.1), np.tile(com, (number, 1))
    return state.encode(*(jnp.asarray(x, jnp.float32) for x in (code, *solid)))


def fitted(points):
    """Harmonics of the support function of vertices, fitted in float64."""
    values = np.max(points @ DIRECTIONS.T, axis=0) / state.LENGTH - state.MEAN
    return np.linalg.lstsq(expected_basis(DIRECTIONS), values, rcond=None)[0]


def test_harmonics_and_values_of_turned_functions_equal_scipy():
    places = np.concatenate([sphere(200), np.eye(3, dtype=np.float32), -np.eye(3, dtype=np.float32)])
    np.testing.assert_allclose(
        jax.jit(harmonics.basis, static_argnums=1)(places, DEGREE), expected_basis(places), atol=2e-5
    )
    coefficients = np.random.default_rng(0).normal(size=(4, 2, harmonics.number(DEGREE))).astype(np.float32)
    rotations = Rotation.random(4, random_state=1)
    run = jax.jit(lambda coefficients, matrix: harmonics.values(coefficients, matrix, places))
    found = run(coefficients, rotations.as_matrix().astype(np.float32))
    for i in range(4):
        expected = coefficients[i] @ expected_basis(rotations[i].inv().apply(places)).T
        np.testing.assert_allclose(found[i], expected, atol=1e-3)


def test_shown_shape_is_that_of_the_rotated_vertices():
    rotations, points = Rotation.random(NUMBER, random_state=2), ellipsoid(200)
    parts = state.split(encoded(rotations, points))
    np.testing.assert_allclose(parts.support, np.tile(fitted(points), (NUMBER, 1)), atol=1e-4)
    for i, rotation in enumerate(rotations):
        expected = fitted(rotation.apply(points))
        np.testing.assert_allclose(parts.support_in_sensor[i], expected, atol=0.02)
        assert np.abs(parts.support[i] - expected).max() > 0.1


def test_reach_is_the_depth_of_the_lowest_vertex():
    points = ellipsoid(2000)
    first, since = (Rotation.random(NUMBER, random_state=seed) for seed in (5, 6))
    found = jax.jit(state.reach)(state.split(encoded(first, points)), since.as_matrix().astype(np.float32))
    expected = [-(rotation.apply(points)[:, 2].min()) for rotation in since * first]
    np.testing.assert_allclose(found, expected, atol=2e-4)
    assert np.ptp(expected) > 1e-3


def test_turned_state_is_the_state_of_the_turned_pose():
    rotations, place = Rotation.random(NUMBER, random_state=4), [0.3, -0.2, 0.5]
    points, com = 0.02 * np.random.default_rng(0).normal(size=(30, 3)), np.array([0.004, -0.002, 0.007])
    before = state.split(encoded(rotations, points, com, place))
    after = turn(unit(ANGLES), before)
    expected = state.split(encoded(TURNED * rotations, points, com, TURNED.apply(place)))
    for found, wanted in zip(after, expected, strict=True):
        np.testing.assert_allclose(found, wanted, atol=2e-4)
    np.testing.assert_allclose(jax.jit(poses.turn_code_back)(unit(ANGLES), after.pose), before.pose, atol=1e-5)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_reflected_state_is_the_state_of_the_reflected_object(axis):
    rotations, place = Rotation.random(NUMBER, random_state=4), np.array([0.3, -0.2, 0.5])
    points, com = 0.02 * np.random.default_rng(0).normal(size=(30, 3)), np.array([0.004, -0.002, 0.007])
    own = np.where(np.arange(3) == axis, -1.0, 1.0)
    points = np.concatenate([points, points * own + [0.002, 0.001, 0]])  # almost symmetric across this plane alone
    across = np.array([-1.0, 1, 1])
    other = Rotation.from_matrix(across[:, None] * rotations.as_matrix() * own)
    expected = encoded(other, points * own, com * own, place * across)
    code = encoded(rotations, points, com, place)
    found = code * jax.jit(state.reflection)(code)
    np.testing.assert_allclose(found, expected, atol=0.03)  # the directions of a fit are not symmetric
    assert np.abs(found - code).max() > 0.3


def test_turned_variance_is_the_diagonal_of_the_turned_covariance():
    variance = np.random.default_rng(0).uniform(0.1, 2, state.CODE).astype(np.float32)
    angle = unit([0.7])
    # Turning is linear.
    turned = np.concatenate(turn(jnp.tile(angle, (state.CODE, 1)), state.split(jnp.eye(state.CODE))), axis=1)
    expected = np.diag(turned.T @ np.diag(variance) @ turned)
    found = np.concatenate(jax.jit(state.turn_variance)(angle, state.split(jnp.asarray(variance)[None])), axis=1)[0]
    np.testing.assert_allclose(found, expected, rtol=1e-4)


def test_rigid_finds_the_nearest_rotation():
    code = random_codes(np.random.default_rng(0), 5)
    noisy = code.at[:, 3:].multiply(1.7) + 1e-3
    u, _, vt = np.linalg.svd(np.asarray(noisy[:, 3:]).reshape(-1, 3, 3).astype(np.float64))
    found = np.asarray(jax.jit(poses.rigid)(noisy))
    np.testing.assert_allclose(found[:, 3:].reshape(-1, 3, 3), u @ vt, atol=1e-5)
    np.testing.assert_array_equal(found[:, :3], noisy[:, :3])


def test_heading_turns_with_the_object():
    rng = np.random.default_rng(1)
    code, angle = random_codes(rng, 200), unit(rng.uniform(-3, 3, 200))
    found = jax.jit(lambda angle, code: poses.heading(poses.turn_code(angle, code)))(angle, code)
    expected = jax.jit(lambda angle, code: poses.turn(angle, poses.heading(code)))(angle, code)
    np.testing.assert_allclose(found, expected, atol=1e-4)
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
    code = np.concatenate([np.zeros(3), Rotation.from_rotvec(rotation).as_matrix().ravel()])
    np.testing.assert_allclose(jax.jit(poses.heading)(jnp.asarray(code, jnp.float32)), expected, atol=1e-6)


@pytest.mark.parametrize("certainty", [0.0, 0.4])
def test_heading_of_an_uncertain_rotation_is_the_long_axis_of_the_shown_shape(certainty):
    code = encoded(TURNED, box(0.08, 0.02, 0.03)).at[:, 3:12].multiply(certainty)
    found = heading(state.split(code))
    np.testing.assert_allclose(np.abs(np.sum(found * unit(ANGLES), axis=1)), 1, atol=1e-3)  # up to its sign
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, rtol=1e-5)


def test_heading_of_a_known_rotation_is_that_of_the_mesh():
    """The long axis of the shape differs and has no influence."""
    np.testing.assert_allclose(heading(state.split(encoded(TURNED, box(0.02, 0.08, 0.03)))), unit(ANGLES), atol=1e-5)
    wild = state.split(random_states(np.random.default_rng(0), 20))
    np.testing.assert_array_equal(heading(wild), jax.jit(poses.heading)(wild.pose))


def test_unknown_state_has_a_unit_heading_and_no_gradient():
    @jax.jit
    def headings(code):
        return state.heading(state.split(code))

    nothing = jnp.zeros((1, state.CODE))
    np.testing.assert_allclose(np.linalg.norm(headings(nothing)), 1, rtol=1e-6)
    np.testing.assert_array_equal(jax.grad(lambda code: headings(code).sum())(nothing), 0)
