"""Harmonics on the sphere, compared with SciPy, quadrature, rotated directions and sampled coefficients."""

import jax.numpy as jnp
import numpy as np
from scipy import special
from scipy.spatial.transform import Rotation

from sts_jax.statespace import harmonics

DEGREE = 6
COUNT = harmonics.number(DEGREE)
ANGLES = np.array([0.0, 0.7, -2.4], np.float32)


def expected_basis(direction, degree=DEGREE):
    """SciPy's harmonics in float64, as real functions with a mean square of 1."""
    x, y, z = np.moveaxis(np.asarray(direction, np.float64), -1, 0)
    polar, azimuth = np.arccos(np.clip(z, -1, 1)), np.arctan2(y, x)
    found = []
    for n in range(degree + 1):
        for m in (0, *(sign * k for k in range(1, n + 1) for sign in (1, -1))):
            value = np.sqrt(4 * np.pi) * special.sph_harm_y(n, abs(m), polar, azimuth)
            part = value.imag if m < 0 else value.real
            found.append(part * (np.sqrt(2) * (-1) ** m if m else 1))
    return np.stack(found, axis=-1)


def directions(number, seed=0):
    rows = np.random.default_rng(seed).normal(size=(number, 3))
    return (rows / np.linalg.norm(rows, axis=1)[:, None]).astype(np.float32)


def unit(angle):
    return jnp.stack([jnp.cos(jnp.asarray(angle)), jnp.sin(jnp.asarray(angle))], axis=-1)


def test_basis_equals_scipy():
    places = np.concatenate([directions(200), np.eye(3, dtype=np.float32), -np.eye(3, dtype=np.float32)])
    np.testing.assert_allclose(harmonics.basis(jnp.asarray(places), DEGREE), expected_basis(places), atol=2e-5)


def test_values_of_turned_functions_are_those_in_directions_turned_back():
    rng = np.random.default_rng(0)
    coefficients = rng.normal(size=(4, 2, COUNT)).astype(np.float32)
    rotations = Rotation.random(4, random_state=1)
    places = directions(30)
    found = harmonics.values(jnp.asarray(coefficients), jnp.asarray(rotations.as_matrix(), jnp.float32), places)
    for i in range(4):
        expected = coefficients[i] @ expected_basis(rotations[i].inv().apply(places)).T
        np.testing.assert_allclose(found[i], expected, atol=1e-3)


def test_turned_coefficients_describe_the_turned_function():
    coefficients = np.random.default_rng(0).normal(size=(len(ANGLES), 2, COUNT)).astype(np.float32)
    places = directions(30)
    turned = np.asarray(harmonics.turn(unit(ANGLES), jnp.asarray(coefficients)))
    rotations = Rotation.from_euler("z", ANGLES[:, None])
    expected = harmonics.values(jnp.asarray(coefficients), jnp.asarray(rotations.as_matrix(), jnp.float32), places)
    for i in range(len(ANGLES)):
        np.testing.assert_allclose(turned[i] @ expected_basis(places).T, expected[i], atol=1e-3)


def test_turned_variance_equals_that_of_sampled_coefficients():
    rng = np.random.default_rng(0)
    variance = rng.uniform(0.1, 2, COUNT).astype(np.float32)
    samples = np.sqrt(variance) * rng.normal(size=(20_000, COUNT)).astype(np.float32)
    for angle in ANGLES:
        turned = harmonics.turn(unit(angle)[None], jnp.asarray(samples)[None])[0]
        found = harmonics.turn_variance(unit(angle)[None], jnp.asarray(variance)[None, None])[0, 0]
        np.testing.assert_allclose(found, np.var(turned, axis=0), rtol=0.06)  # six standard deviations
