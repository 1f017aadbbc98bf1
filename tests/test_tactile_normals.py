"""Normals against eigenvectors of LAPACK, and their gradients against finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tactile_surfaces import SHAPES, bumpy, normals_of, some_pixels

from sts_jax.tactile.normals import smallest_eigenvector

pytestmark = pytest.mark.usefixtures("strict_ranks")

PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


def elements(matrix):
    return [jnp.asarray(matrix[..., i, j], jnp.float32) for i, j in PAIRS]


@pytest.mark.parametrize("gap", [1.0, 0.05])
def test_smallest_eigenvector_equals_lapacks(gap):
    rng = np.random.default_rng(0)
    turns, _ = np.linalg.qr(rng.normal(size=(500, 3, 3)))
    low = rng.uniform(-1, 1, 500)
    middle = low + rng.uniform(gap, 2 * gap, 500)
    values = np.stack([low, middle, middle + rng.uniform(0, 2, 500)], -1)
    matrix = np.einsum("nij,nj,nkj->nik", turns, values, turns)
    got = np.stack(jax.jit(smallest_eigenvector)(*elements(matrix)), -1)
    np.testing.assert_allclose(np.linalg.norm(got, axis=-1), 1, atol=1e-6)
    cosine = np.abs(np.sum(got * turns[..., 0], -1))
    assert np.degrees(np.arccos(np.minimum(cosine, 1))).max() < 0.1


@pytest.mark.parametrize(
    "diagonal", [(1.0, 1.0, 0.0), (2.0, 1.0, 0.0), (0.0, 3.0, 3.0), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)]
)
def test_repeated_eigenvalues_give_a_unit_vector_and_finite_gradients(diagonal):
    planes = elements(np.diag(diagonal))
    value = np.array(smallest_eigenvector(*planes))
    assert np.linalg.norm(value) == pytest.approx(1)
    assert np.linalg.norm(np.diag(diagonal) @ value - min(diagonal) * value) < 1e-6
    jacobian = jax.jacrev(smallest_eigenvector, argnums=tuple(range(6)))(*planes)
    assert all(np.isfinite(leaf) for leaf in jax.tree.leaves(jacobian))


@pytest.mark.parametrize("spread", [(1.0, 1.0, 0.0), (2.0, 1.0, 0.1)])
def test_gradient_of_the_eigenvector_equals_finite_differences(spread):
    rng = np.random.default_rng(1)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    matrix = turn @ np.diag(spread) @ turn.T
    change = rng.normal(size=(3, 3))
    change = change + change.T
    change -= turn @ np.diag(np.diag(turn.T @ change @ turn)) @ turn.T if spread[0] == spread[1] else 0

    def smallest(a):
        return np.linalg.eigh(a)[1][:, 0]

    step = 1e-6
    plus, minus, here = smallest(matrix + step * change), smallest(matrix - step * change), smallest(matrix)
    expected = (plus * np.sign(plus @ here) - minus * np.sign(minus @ here)) / (2 * step)
    value, got = jax.jvp(smallest_eigenvector, tuple(elements(matrix)), tuple(elements(change)))
    np.testing.assert_allclose(np.array(got) * np.sign(np.array(value) @ here), expected, atol=2e-4)


@pytest.mark.parametrize("shape", SHAPES)
def test_normals_equal_the_axis_of_least_covariance(shape):
    points = bumpy(shape)
    got = np.asarray(jax.jit(normals_of)(jnp.asarray(points, jnp.float32)))
    for i, j in some_pixels(shape):
        rows = np.clip([i - 1, i, i + 1], 0, shape[0] - 1)
        columns = np.clip([j - 1, j, j + 1], 0, shape[1] - 1)
        around = points[np.ix_(rows, columns)].reshape(-1, 3)
        normal = np.linalg.eigh(np.cov(around.T, bias=True))[1][:, 0]
        normal *= -np.sign(normal[2])
        np.testing.assert_allclose(got[i, j], normal, atol=2e-3)
