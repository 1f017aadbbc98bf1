"""Convolutions and their gradients against those of XLA."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sts_jax.mvae import conv, conv_transpose

LAYOUT = ("NHWC", "HWIO", "NHWC")


def xla_conv(x, kernel, stride, padding):
    return jax.lax.conv_general_dilated(x, kernel, (stride, stride), [(padding, padding)] * 2, dimension_numbers=LAYOUT)


def xla_conv_transpose(x, kernel, stride, padding):
    pads = [(len(kernel) - 1 - padding,) * 2] * 2
    return jax.lax.conv_transpose(x, kernel[::-1, ::-1], (stride, stride), pads, dimension_numbers=LAYOUT)


@pytest.mark.parametrize(
    ("ours", "theirs", "shape", "out", "size", "stride", "padding"),
    [
        (conv, xla_conv, (64, 64, 3), 32, 4, 2, 1),
        (conv, xla_conv, (16, 16, 32), 64, 4, 2, 1),
        (conv, xla_conv, (8, 8, 32), 16, 4, 1, 0),
        (conv, xla_conv, (13, 10, 20), 5, 4, 2, 1),
        (conv, xla_conv, (11, 9, 4), 3, 3, 1, 2),
        (conv, xla_conv, (12, 11, 2), 3, 6, 3, 0),
        (conv, xla_conv, (50, 45, 20), 8, 3, 1, 1),  # the gradient by the kernel is a sum of several parts
        (conv_transpose, xla_conv_transpose, (5, 5, 32), 16, 4, 1, 0),
        (conv_transpose, xla_conv_transpose, (8, 8, 32), 20, 4, 2, 1),
        (conv_transpose, xla_conv_transpose, (7, 5, 18), 3, 4, 2, 1),
        (conv_transpose, xla_conv_transpose, (7, 5, 3), 17, 4, 2, 0),
        (conv_transpose, xla_conv_transpose, (6, 9, 2), 3, 3, 1, 1),
        (conv_transpose, xla_conv_transpose, (4, 3, 2), 3, 6, 3, 2),
    ],
)
def test_values_and_gradients_equal_those_of_xla(ours, theirs, shape, out, size, stride, padding):
    rng = np.random.default_rng(0)
    x = jnp.asarray(rng.normal(size=(2, *shape)), jnp.float32)
    kernel = jnp.asarray(rng.normal(size=(size, size, shape[-1], out)) / size / shape[-1] ** 0.5, jnp.float32)

    def run(function):
        y, pull = jax.vjp(lambda x, kernel: function(x, kernel, stride, padding), x, kernel)
        return y, *pull(jnp.asarray(np.random.default_rng(1).normal(size=y.shape), jnp.float32))

    for a, b in zip(*(jax.jit(run, static_argnums=0)(function) for function in (ours, theirs)), strict=True):
        # relative to the largest entry
        assert a.shape == b.shape
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-5 * max(1, float(jnp.max(jnp.abs(b)))))
