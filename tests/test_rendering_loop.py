"""`looped` against the plain function: values, derivatives and batches."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sts_jax.rendering.loop import looped


def plain(x, n, p):
    y = jnp.sin(x) * p["a"]
    return {"y": y, "k": n + 1, "positive": y > 0, "sum": jnp.sum(y**2)}


X, N, P = jnp.linspace(0, 1, 6).reshape(2, 3), jnp.arange(2), {"a": jnp.array([2.0, 3.0])}
ONE = X[0], N[0], {"a": P["a"][0]}

WAYS = {
    "call": lambda f: f(*ONE),
    "vmap": lambda f: jax.vmap(f)(X, N, P),
    "vmap over one argument": lambda f: jax.vmap(f, in_axes=(0, None, None))(X, *ONE[1:]),
    "vmap along another axis": lambda f: jax.vmap(f, in_axes=(1, None, None))(X, *ONE[1:]),
    "gradient": lambda f: jax.grad(lambda x: f(x, *ONE[1:])["sum"])(X[0]),
    "vmap of gradient": lambda f: jax.vmap(jax.grad(lambda *a: f(*a)["sum"], argnums=(0, 2)))(X, N, P),
    "forward Jacobian": lambda f: jax.jacfwd(lambda x: f(x, *ONE[1:])["y"])(X[0]),
    "Hessian": lambda f: jax.hessian(lambda x: f(x, *ONE[1:])["sum"])(X[0]),
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
