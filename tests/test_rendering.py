"""Parts of the renderer against plain functions: height maps, loops over a batch, and tiles of an image."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from optics_bodies import from_trimesh

import sts_jax as sts
from sts_jax import geometry, objects, tactile
from sts_jax.rendering.equilibrium import underside
from sts_jax.rendering.loop import looped
from sts_jax.rendering.tiles import TILE, where_active

SENSOR = sts.Sensor()
TURN = geometry.quat_from_rotvec(jnp.array([0.6, 0.5, 0.3]))


def test_the_gels_height_map_has_faces_within_reach_and_the_skys_has_all():
    # A foot 2 cm wide under a roof 10 cm wide, 4 cm above the skin.
    foot, roof = trimesh.creation.box((0.02, 0.02, 0.04)), trimesh.creation.box((0.1, 0.1, 0.01))
    body = from_trimesh(trimesh.util.concatenate([foot, roof.apply_translation((0, 0, 0.025))]))
    near, whole = jax.jit(underside)(
        SENSOR.gel, body.faces, body.two_sided, body.vertices + jnp.array([[0, 0, 0.02]]), jnp.bool_(True)
    )
    middle = np.abs(np.arange(150) - 74.5)
    apart = np.maximum(middle[:, None], middle[None, :])
    np.testing.assert_allclose(near, np.where(apart < 10, 0, np.inf), atol=1e-6)
    np.testing.assert_allclose(whole, np.where(apart < 10, 0, np.where(apart < 50, 0.04, np.inf)), atol=1e-6)


def test_faces_beyond_reach_do_not_change_the_equilibrium():
    settle = jax.jit(tactile.settle)
    for category in ("camera", "webcam", "bottle"):
        body = objects.make(jax.random.key(0), category)
        points = geometry.transform(jnp.concatenate([jnp.zeros(3), TURN]), body.vertices)
        points -= jnp.array([0, 0, 1.0]) * jnp.min(points[:, 2])
        near, whole = jax.jit(underside)(SENSOR.gel, body.faces, body.two_sided, points, jnp.bool_(True))
        assert np.any(np.asarray(near) != np.asarray(whole))
        for wrench in ([0, 0, 5, 0, 0, 0], [0, 0, 60, 1.0, -2.0, 0], [0, 0, 400, 9.0, 9.0, 0]):
            wrench = jnp.asarray(wrench, jnp.float32)
            got, truth = settle(SENSOR.gel, near, wrench), settle(SENSOR.gel, whole, wrench)
            assert float(jnp.max(truth.pressure)) > 0
            for one, other in zip(jax.tree.leaves(got), jax.tree.leaves(truth), strict=True):
                np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-7)


def plain(x, n, p):
    y = jnp.sin(x) * p["a"]
    return {"y": y, "k": n + 1, "positive": y > 0, "sum": jnp.sum(y**2)}


X, N, P = jnp.linspace(0, 1, 6).reshape(2, 3), jnp.arange(2), {"a": jnp.array([2.0, 3.0])}
ONE = X[0], N[0], {"a": P["a"][0]}

WAYS = {
    "vmap": lambda f: jax.vmap(f)(X, N, P),
    "vmap along another axis": lambda f: jax.vmap(f, in_axes=(1, None, None))(X, *ONE[1:]),
    "gradient": lambda f: jax.grad(lambda x: f(x, *ONE[1:])["sum"])(X[0]),
    "vmap of gradient": lambda f: jax.vmap(jax.grad(lambda *a: f(*a)["sum"], argnums=(0, 2)))(X, N, P),
    "forward Jacobian": lambda f: jax.jacfwd(lambda x: f(x, *ONE[1:])["y"])(X[0]),
    "vmap of Hessian": lambda f: jax.vmap(jax.hessian(lambda *a: f(*a)["sum"]))(X, N, P),
    "gradient through scan": lambda f: jax.grad(
        lambda q: jax.lax.scan(lambda c, a: (c + f(a[0] * q, *a[1:])["sum"], 0.0), 0.0, (X, N, P))[0]
    )(2.0),
    "gradient through checkpoint": lambda f: jax.grad(jax.checkpoint(lambda x: f(x, *ONE[1:])["sum"]))(X[0]),
}


@pytest.mark.parametrize("way", WAYS)
def test_every_transformation_equals_that_of_the_plain_function(way):
    ours, theirs = WAYS[way](looped(plain)), WAYS[way](plain)
    assert jax.tree.structure(ours) == jax.tree.structure(theirs)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), ours, theirs)


@pytest.mark.parametrize("way", [jax.vmap, lambda f: jax.vmap(jax.grad(f)), lambda f: jax.vmap(jax.jit(jax.grad(f)))])
def test_a_batch_on_a_cpu_is_a_loop_over_single_items(way):
    def function(x):
        return jnp.sum(jnp.sin(x))

    def works_on_the_whole_batch(f):
        program = str(jax.make_jaxpr(way(f))(jnp.ones((5, 3))))
        return "f32[5,3] = sin" in program or "f32[5,3] = cos" in program

    assert works_on_the_whole_batch(function)
    assert not works_on_the_whole_batch(looped(function))


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
    several = jnp.asarray(np.stack([active for _, active in patterns(shape)]))
    got = jax.vmap(tiled, (0, None, None, None))(several, *given)
    jax.tree.map(np.testing.assert_array_equal, [x[-1] for x in got], list(tiled(several[-1], *given)))


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
