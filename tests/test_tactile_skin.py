"""Normals and Phong against loops in NumPy float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sts_jax import tactile

SHAPES = [(64, 64), (97, 53), (200, 200)]


@pytest.fixture(autouse=True)
def strict_ranks():
    with jax.numpy_rank_promotion("raise"):
        yield


def bumpy(shape):
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(np.linspace(-0.075, 0.075, shape[1]), np.linspace(-0.075, 0.075, shape[0]))
    z = -0.002 * np.exp(-((x - 0.01) ** 2 + y**2) / 0.015**2) + 2e-4 * np.sin(300 * x) * np.cos(200 * y)
    return np.stack([x, y, z], -1) + 1e-5 * rng.normal(size=(*shape, 3))


def normals_of(points):
    """Of a grid of points, around which it goes on as it ends."""
    planes = jnp.moveaxis(jnp.asarray(points, jnp.float32), -1, 0)
    return tactile.surface_normals(tuple(jnp.pad(plane, 1, mode="edge") for plane in planes))


def some(shape, number=200):
    rng = np.random.default_rng(1)
    inner = [(rng.integers(shape[0]), rng.integers(shape[1])) for _ in range(number)]
    return [*inner, (0, 0), (0, shape[1] - 1), (shape[0] - 1, 0), (shape[0] - 1, shape[1] - 1)]


@pytest.mark.parametrize("shape", SHAPES)
def test_normals_are_the_axis_of_least_covariance(shape):
    points = bumpy(shape)
    got = np.asarray(jax.jit(normals_of)(jnp.asarray(points, jnp.float32)))
    for i, j in some(shape):
        rows = np.clip([i - 1, i, i + 1], 0, shape[0] - 1)
        columns = np.clip([j - 1, j, j + 1], 0, shape[1] - 1)
        around = points[np.ix_(rows, columns)].reshape(-1, 3)
        normal = np.linalg.eigh(np.cov(around.T, bias=True))[1][:, 0]
        normal *= -np.sign(normal[2])
        np.testing.assert_allclose(got[i, j], normal, atol=2e-3)


@pytest.mark.parametrize("shape", SHAPES)
def test_phong_is_the_papers_equation(shape):
    rng = np.random.default_rng(2)
    normals = rng.normal(size=(*shape, 3))
    normals[..., 2] = -np.abs(normals[..., 2])
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    constants, lights = tactile.Phong(), tactile.Lights()
    got = np.asarray(jax.jit(tactile.phong)(constants, lights, jnp.asarray(normals, jnp.float32)))
    view = np.array([0.0, 0.0, -1.0])
    for i, j in some(shape):
        expected = 0.8 * np.array(constants.ambient_color)
        for direction, color in zip(np.asarray(lights.directions), np.asarray(lights.colors), strict=True):
            incidence = direction @ normals[i, j]
            reflected = 2 * incidence * normals[i, j] - direction
            expected = expected + 1.0 * max(incidence, 0) * color + 0.5 * max(reflected @ view, 0) ** 5 * color
        np.testing.assert_allclose(got[i, j], expected, atol=1e-5)


def test_flat_gel_has_the_originals_colour():
    points = bumpy((8, 8)) * [1, 1, 0]
    image = tactile.phong(tactile.Phong(), tactile.Lights(), normals_of(points))
    assert np.array_equal(np.round(np.asarray(image) * 255), np.broadcast_to([178, 178, 204], (8, 8, 3)))


def test_a_bump_is_lit_from_the_side_its_flank_faces():
    x, y = np.meshgrid(np.arange(-20, 21), np.arange(-20, 21))
    bump = np.stack([x, y, -5 * np.exp(-(x**2 + y**2) / 50)], -1)  # towards the camera
    image = np.asarray(tactile.phong(tactile.Phong(), tactile.Lights(), normals_of(bump)))
    left, right, top, bottom = image[20, 14], image[20, 26], image[14, 20], image[26, 20]
    assert left[0] > right[0] + 0.2  # red from the left edge
    assert right[1] > left[1] + 0.2  # green from the right
    assert top[2] > bottom[0]  # blue from the top, white from the bottom
    assert bottom.min() > 0.9


@pytest.mark.parametrize("flat", [True, False])
def test_gradients_are_finite_and_right(flat):
    points = bumpy((9, 11)) * [1, 1, 0]
    # Away from the clips at L.N = 0, where a difference quotient means nothing.
    points[..., 2] = 0 if flat else 0.3 * points[..., 0] + 0.2 * points[..., 1] + 10 * points[..., 0] * points[..., 1]
    points = jnp.asarray(points, jnp.float32)
    weights = jax.random.normal(jax.random.key(0), (9, 11, 3))

    def loss(z):
        normals = normals_of(jnp.concatenate([points[..., :2], z[..., None]], -1))
        return jnp.sum(weights * tactile.phong(tactile.Phong(), tactile.Lights(), normals))

    gradient = jax.jit(jax.grad(loss))(points[..., 2])
    assert jnp.all(jnp.isfinite(gradient))
    if not flat:
        direction = jax.random.normal(jax.random.key(1), (9, 11))
        step = 1e-4
        numeric = (loss(points[..., 2] + step * direction) - loss(points[..., 2] - step * direction)) / (2 * step)
        assert float(jnp.sum(gradient * direction)) == pytest.approx(float(numeric), rel=0.03)


def test_deeper_is_darker():
    depth = jnp.linspace(0, 0.005, 20)[None]
    dark = np.asarray(tactile.darken(tactile.Phong(), depth))[0]
    assert dark[0] == 1
    assert np.all(np.diff(dark) < 0)
    assert dark[-1] > 0
