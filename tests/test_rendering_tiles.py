"""An image function on active tiles against the same function on the whole image."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sts_jax.rendering.tiles import TILE, where_active

SHAPES = [(8, 8), (17, 33), (64, 64), (131, 53), (5, 40), (TILE - 1, 40)]


def blur(params, images):
    """Two images, each pixel from its 3x3 neighbourhood. A row is broadcast."""
    first, second, across = images
    height, width = (n - 2 for n in first.shape[:2])
    total = sum(first[i : i + height, j : j + width] for i in range(3) for j in range(3))
    return params["gain"] * total + (first + across)[1:-1, 1:-1], total * second[1:-1, 1:-1]


def inputs(shape, key):
    keys = jax.random.split(key, 4)
    ringed = (shape[0] + 2, shape[1] + 2)
    images = (*(jax.random.normal(k, ringed) for k in keys[:2]), jnp.arange(ringed[1], dtype=jnp.float32)[None, :])
    otherwise = tuple(jax.random.normal(k, shape) for k in keys[2:])
    return {"gain": jnp.float32(0.7)}, images, otherwise


def patterns(shape):
    rng = np.random.default_rng(0)
    corner = np.zeros(shape, bool)
    corner[-1, 0] = True
    yield "none", np.zeros(shape, bool)
    yield "all", np.ones(shape, bool)
    yield "last row's first pixel", corner
    yield "some", rng.uniform(size=shape) < 0.02
    blob = np.zeros(shape, bool)
    blob[shape[0] // 3 : shape[0] // 2, : shape[1] // 2] = True
    yield "a blob at the edge", blob


def dense(active, params, images, otherwise):
    return tuple(jnp.where(active, value, other) for value, other in zip(blur(params, images), otherwise, strict=True))


@pytest.mark.parametrize("shape", SHAPES)
def test_result_equals_where_over_the_whole_image(shape):
    given = inputs(shape, jax.random.key(1))
    tiled = jax.jit(lambda active, *rest: where_active(blur, active, *rest, ring=1))
    for name, active in patterns(shape):
        for got, expected in zip(tiled(active, *given), dense(active, *given), strict=True):
            np.testing.assert_allclose(got, expected, atol=1e-5, err_msg=name)


def test_vmap_agrees_with_the_whole_images():
    shape = (40, 27)
    active = jnp.asarray(np.stack([pattern for _, pattern in patterns(shape)]))
    given = jax.vmap(lambda key: inputs(shape, key))(jax.random.split(jax.random.key(2), len(active)))
    got = jax.jit(jax.vmap(lambda active, *rest: where_active(blur, active, *rest, ring=1)))(active, *given)
    for one, other in zip(got, jax.vmap(dense)(active, *given), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-5)


def test_gradient_equals_that_of_the_whole_image():
    shape = (TILE + 3, 3 * TILE)
    given = inputs(shape, jax.random.key(3))
    active = jnp.asarray(np.random.default_rng(1).uniform(size=shape) < 0.3)

    def loss(function):
        return lambda *given: sum(jnp.sum(jnp.sin(image)) for image in function(active, *given))

    ours = jax.grad(loss(lambda *rest: where_active(blur, *rest, ring=1)), (0, 1, 2))(*given)
    theirs = jax.grad(loss(dense), (0, 1, 2))(*given)
    for got, expected in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_allclose(got, expected, atol=1e-4)
    assert jnp.any(ours[1][0] != 0)
