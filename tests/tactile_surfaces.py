"""Surfaces for the tests of normals and light."""

import jax.numpy as jnp
import numpy as np

from sts_jax import tactile

SMALL = [(64, 64), (97, 53), (200, 200)]
SHAPES = [*SMALL, (480, 640), (1232, 1640)]


def bumpy(shape):
    """A grid of points (m) on a surface with one large and many small bumps, and noise."""
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(np.linspace(-0.075, 0.075, shape[1]), np.linspace(-0.075, 0.075, shape[0]))
    z = -0.002 * np.exp(-((x - 0.01) ** 2 + y**2) / 0.015**2) + 2e-4 * np.sin(300 * x) * np.cos(200 * y)
    return np.stack([x, y, z], -1) + 1e-5 * rng.normal(size=(*shape, 3))


def normals_of(points):
    """Normals of a grid of points, with its border repeated beyond it."""
    planes = jnp.moveaxis(jnp.asarray(points), -1, 0)
    return tactile.surface_normals(tuple(jnp.pad(plane, 1, mode="edge") for plane in planes))


def some_pixels(shape, number=200):
    """Random pixels and the four corners."""
    rng = np.random.default_rng(1)
    inner = [(rng.integers(shape[0]), rng.integers(shape[1])) for _ in range(number)]
    return [*inner, (0, 0), (0, shape[1] - 1), (shape[0] - 1, 0), (shape[0] - 1, shape[1] - 1)]
