"""Convolutions and their gradients against those of XLA."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sts_jax.mvae import conv, conv_transpose

LAYOUT = ("NHWC", "HWIO", "NHWC")


def data(shape, size, out, seed=0):
    rng = np.random.default_rng(seed)
    x = jnp.asarray(rng.normal(size=shape), jnp.float32)
    kernel = jnp.asarray(rng.normal(size=(size, size, shape[-1], out)) / size / shape[-1] ** 0.5, jnp.float32)
    return x, kernel


def agree(ours, theirs, x, kernel):
    """Values and both gradients, relative to the largest entry."""
    y, pull = jax.vjp(jax.jit(ours), x, kernel)
    y_true, pull_true = jax.vjp(theirs, x, kernel)
    g = jnp.asarray(np.random.default_rng(1).normal(size=y_true.shape), jnp.float32)
    for a, b in zip((y, *pull(g)), (y_true, *pull_true(g)), strict=True):
        assert a.shape == b.shape
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-5 * max(1, float(jnp.max(jnp.abs(b)))))


@pytest.mark.parametrize(
    ("h", "w", "channels", "out", "size", "stride", "padding"),
    [
        (64, 64, 3, 32, 4, 2, 1),
        (16, 16, 32, 64, 4, 2, 1),
        (8, 8, 32, 16, 4, 1, 0),
        (13, 10, 20, 5, 4, 2, 1),
        (11, 9, 4, 3, 3, 1, 2),
        (12, 11, 2, 3, 6, 3, 0),
    ],
)
def test_conv_equals_that_of_xla(h, w, channels, out, size, stride, padding):
    def theirs(x, k):
        return jax.lax.conv_general_dilated(x, k, (stride, stride), [(padding, padding)] * 2, dimension_numbers=LAYOUT)

    x, kernel = data((2, h, w, channels), size, out)
    agree(lambda x, k: conv(x, k, stride, padding), theirs, x, kernel)


@pytest.mark.parametrize(
    ("h", "w", "channels", "out", "size", "stride", "padding"),
    [
        (5, 5, 32, 16, 4, 1, 0),
        (8, 8, 32, 20, 4, 2, 1),
        (7, 5, 18, 3, 4, 2, 1),
        (7, 5, 3, 17, 4, 2, 0),
        (6, 9, 2, 3, 3, 1, 1),
        (4, 3, 2, 3, 6, 3, 2),
    ],
)
def test_conv_transpose_equals_that_of_xla(h, w, channels, out, size, stride, padding):
    def theirs(x, k):
        pads = [(size - 1 - padding,) * 2] * 2
        return jax.lax.conv_transpose(x, k[::-1, ::-1], (stride, stride), pads, dimension_numbers=LAYOUT)

    x, kernel = data((2, h, w, channels), size, out)
    agree(lambda x, k: conv_transpose(x, k, stride, padding), theirs, x, kernel)
