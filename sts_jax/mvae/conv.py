"""Strided convolutions and their transposes, with gradients that are quick on a CPU.

XLA's CPU back end is slow wherever a convolution has `lhs_dilation`: in transposed convolutions, and in the
gradients of strided ones. Here none has one. Arrays are channels last, `(batch, height, width, channel)`;
kernels are `(size, size, in, out)` and `size` is a multiple of `stride`.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_LAYOUT = ("NHWC", "HWIO", "NHWC")


@partial(jax.custom_vjp, nondiff_argnums=(2, 3))
def conv(
    x: Float[Array, "batch h w in"], kernel: Float[Array, "size size in out"], stride: int, padding: int
) -> Float[Array, "batch ho wo out"]:
    """Convolution as networks have it (correlation), `y[i] = sum_a x[stride i + a - padding] kernel[a]`.

    Args:
        x: the input; outside of it is zero.
        kernel: `size` a multiple of `stride`.
        stride: pixels between two outputs.
        padding: zeros added on each side; at most `size - 1`.

    Returns:
        `ho = (h + 2 padding - size) // stride + 1` rows, columns likewise.
    """
    return jax.lax.conv_general_dilated(
        x, kernel, (stride, stride), [(padding, padding)] * 2, dimension_numbers=_LAYOUT
    )


@partial(jax.custom_vjp, nondiff_argnums=(2, 3))
def conv_transpose(
    x: Float[Array, "batch h w in"], kernel: Float[Array, "size size in out"], stride: int, padding: int
) -> Float[Array, "batch ho wo out"]:
    """The transpose of `conv`: `y[stride i + a - padding] += x[i] kernel[a]`.

    Args:
        x: the input.
        kernel: `size` a multiple of `stride`; `in` is the number of channels of `x`.
        stride: pixels of the output per pixel of the input.
        padding: what is cut from each side of the output.

    Returns:
        `ho = stride (h - 1) + size - 2 padding` rows, columns likewise.
    """
    return _spread(
        x, kernel, stride, padding, *(stride * (n - 1) + kernel.shape[0] - 2 * padding for n in x.shape[1:3])
    )


def _spread(x: Array, kernel: Array, stride: int, padding: int, height: int, width: int) -> Array:
    """`conv_transpose`, cut or filled with zeros to the size asked for."""
    size, _, _, out = kernel.shape
    taps = size // stride
    # kernel[stride q + r] is tap q of phase r: all phases of the output are the channels of one small convolution.
    kernel = kernel.reshape(taps, stride, taps, stride, -1, out).transpose(0, 2, 4, 1, 3, 5)
    batch, h, w, _ = x.shape
    if stride == 1:
        flat = kernel.transpose(2, 0, 1, 3, 4, 5).reshape(x.shape[3], -1)
        y = (x.reshape(-1, x.shape[3]) @ flat).reshape(batch, h, w, taps, taps, out)
        edges = [(a, taps - 1 - a) for a in range(taps)]
        y = sum(
            jnp.pad(y[:, :, :, a, b], ((0, 0), edges[a], edges[b], (0, 0))) for a in range(taps) for b in range(taps)
        )
    else:
        flat = kernel[::-1, ::-1].reshape(taps, taps, x.shape[3], -1)
        y = jax.lax.conv_general_dilated(x, flat, (1, 1), [(taps - 1, taps - 1)] * 2, dimension_numbers=_LAYOUT)
        y = y.reshape(batch, h + taps - 1, w + taps - 1, stride, stride, out).transpose(0, 1, 3, 2, 4, 5)
        y = y.reshape(batch, stride * (h + taps - 1), stride * (w + taps - 1), out)
    return _cut(y, padding, height, width)


def _cut(x: Array, before: int, height: int, width: int) -> Array:
    """Rows and columns `before .. before + size`, zero where the array has ended (or not begun)."""
    x = jnp.pad(
        x,
        (
            (0, 0),
            (max(-before, 0), max(before + height - x.shape[1], 0)),
            (max(-before, 0), max(before + width - x.shape[2], 0)),
            (0, 0),
        ),
    )
    before = max(before, 0)
    return x[:, before : before + height, before : before + width]


def _correlate(wide: Array, narrow: Array, size: int, stride: int, padding: int) -> Array:
    """`k[a, A, B] = sum_i wide[stride i + a - padding, A] narrow[i, B]`: either gradient in the kernel."""
    taps = size // stride
    batch, h, w, channels = narrow.shape
    wide = _cut(wide, -padding, stride * (h + taps - 1), stride * (w + taps - 1))
    wide = wide.reshape(batch, h + taps - 1, stride, w + taps - 1, stride, -1).transpose(0, 1, 3, 2, 4, 5)
    wide = wide.reshape(batch, h + taps - 1, w + taps - 1, -1)
    flat = narrow.reshape(-1, channels)
    rows = [
        jnp.stack([flat.T @ wide[:, a : a + h, b : b + w].reshape(len(flat), -1) for b in range(taps)])
        for a in range(taps)
    ]
    kernel = jnp.stack(rows).reshape(taps, taps, channels, stride, stride, -1)
    return kernel.transpose(0, 3, 1, 4, 5, 2).reshape(size, size, -1, channels)


def _conv_forward(x: Array, kernel: Array, stride: int, padding: int) -> tuple[Array, tuple[Array, Array]]:
    return conv(x, kernel, stride, padding), (x, kernel)


def _conv_backward(stride: int, padding: int, saved: tuple[Array, Array], g: Array) -> tuple[Array, Array]:
    x, kernel = saved
    dx = _spread(g, kernel.swapaxes(2, 3), stride, padding, *x.shape[1:3])
    return dx, _correlate(x, g, kernel.shape[0], stride, padding)


def _transpose_forward(x: Array, kernel: Array, stride: int, padding: int) -> tuple[Array, tuple[Array, Array]]:
    return conv_transpose(x, kernel, stride, padding), (x, kernel)


def _transpose_backward(stride: int, padding: int, saved: tuple[Array, Array], g: Array) -> tuple[Array, Array]:
    x, kernel = saved
    dx = conv(g, kernel.swapaxes(2, 3), stride, padding)
    return dx, _correlate(g, x, kernel.shape[0], stride, padding).swapaxes(2, 3)


conv.defvjp(_conv_forward, _conv_backward)
conv_transpose.defvjp(_transpose_forward, _transpose_backward)
