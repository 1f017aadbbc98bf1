"""The view from outside."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

import sts_jax as sts
from sts_jax import evaluation

FORK = sts.objects.make(jax.random.key(0), "fork")


def test_a_slope_is_drawn_as_a_slope():
    red = dataclasses.replace(FORK, colors=FORK.colors * 0 + jnp.array([1.0, 0, 0]))
    size, slope = jnp.array([0.15, 0.15]), jnp.pi / 6
    up = jnp.array([0.0, -jnp.sin(slope), jnp.cos(slope)])
    stand = jnp.array([1.0, 0, 0, 0])

    def place(position, up):
        picture = np.asarray(evaluation.outside(red, jnp.concatenate([position, stand]), size, up)).astype(float)
        return np.argwhere(picture[..., 0] > picture[..., 1] + 0.3).mean(0)

    level = place(jnp.array([0.0, 0, 0.06]), jnp.array([0.0, 0, 9.81]))
    np.testing.assert_allclose(place(0.06 * up, 9.81 * up), level, atol=2)  # the object above the pad is drawn above it
    downhill = place(jnp.array([0.0, 0.04, 0.06]), 9.81 * up)
    assert downhill[0] > place(jnp.array([0.0, 0.04, 0.06]), None)[0] + 8
