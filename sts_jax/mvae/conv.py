"""Strided convolutions and their transposes, with gradients that are quick on a CPU.

XLA's CPU back end is slow wherever a convolution has `lhs_dilation`: in transposed convolutions, and in the
gradients of strided ones. Here none has one. Arrays are channels last, `(batch, height, width, channel)`;
kernels are `(size, size, in, out)` and `size` is a multiple of `stride`.
"""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_LAYOUT = ("NHWC", "HWIO", "NHWC")
_FEW = 16  # channels


@functools.partial(jax.custom_vjp, nondiff_argnums=(2, 3))
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
    return _convolve(x, kernel, stride, padding)


@functools.partial(jax.custom_vjp, nondiff_argnums=(2, 3))
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


def _convolve(x: Array, kernel: Array, stride: int, padding: int) -> Array:
    """`conv`; where channels are few, a block of `stride` x `stride` pixels is made one pixel first: quicker."""
    if stride > 1 and x.shape[3] < _FEW:
        size = kernel.shape[0]
        counts = [(n + 2 * padding - size) // stride + size // stride for n in x.shape[1:3]]
        x, kernel, stride, padding = _fold(x, stride, padding, counts), _fold_kernel(kernel, stride), 1, 0
    pads = [(padding, padding)] * 2
    return jax.lax.conv_general_dilated(x, kernel, (stride, stride), pads, dimension_numbers=_LAYOUT)


def _spread(x: Array, kernel: Array, stride: int, padding: int, height: int, width: int) -> Array:
    """`conv_transpose`, cut or filled with zeros to the size asked for."""
    size, _, _, out = kernel.shape
    batch, h, w, channels = x.shape
    taps = size // stride
    if stride == 1:  # one matrix product to all taps, shifted and added
        y = x.reshape(-1, channels) @ kernel.transpose(2, 0, 1, 3).reshape(channels, -1)
        y = y.reshape(batch, h, w, size, size, out)
        edges = [(a, size - 1 - a) for a in range(size)]
        shifted = [
            jnp.pad(y[:, :, :, a, b], ((0, 0), edges[a], edges[b], (0, 0))) for a in range(size) for b in range(size)
        ]
        y = functools.reduce(jnp.add, shifted)
    else:  # one small convolution to all phases, interleaved
        phases = _fold_kernel(kernel.swapaxes(2, 3), stride).swapaxes(2, 3)[::-1, ::-1]
        y = jax.lax.conv_general_dilated(x, phases, (1, 1), [(taps - 1, taps - 1)] * 2, dimension_numbers=_LAYOUT)
        y = y.reshape(*y.shape[:3], stride, stride, out).transpose(0, 1, 3, 2, 4, 5)
        y = y.reshape(batch, stride * (h + taps - 1), stride * (w + taps - 1), out)
    return _cut(y, padding, height, width)


def _correlate(wide: Array, narrow: Array, size: int, stride: int, padding: int) -> Array:
    """`k[a, A, B] = sum_i wide[stride i + a - padding, A] narrow[i, B]`: either gradient in the kernel."""
    batch, h, w, channels = narrow.shape
    if stride > 1 and wide.shape[3] < _FEW:
        counts = [h + size // stride - 1, w + size // stride - 1]
        folded = _correlate(_fold(wide, stride, padding, counts), narrow, size // stride, 1, 0)
        return _unfold_kernel(folded, stride)
    wide = _cut(wide, -padding, stride * (h - 1) + size, stride * (w - 1) + size)
    columns = [wide[:, :, b : b + stride * (w - 1) + 1 : stride] for b in range(size)]
    patches = jnp.concatenate(columns, axis=3)
    flat = narrow.reshape(-1, channels).T
    rows = [patches[:, a : a + stride * (h - 1) + 1 : stride] for a in range(size)]
    kernel = jnp.stack([flat @ row.reshape(batch * h * w, -1) for row in rows])
    return kernel.reshape(size, channels, size, -1).transpose(0, 2, 3, 1)


def _cut(x: Array, start: int, height: int, width: int) -> Array:
    """Rows and columns from `start` on, zero outside of the array."""
    before = max(-start, 0)
    after = [max(start + n - m, 0) for n, m in ((height, x.shape[1]), (width, x.shape[2]))]
    x = jnp.pad(x, ((0, 0), (before, after[0]), (before, after[1]), (0, 0)))
    start = max(start, 0)
    return x[:, start : start + height, start : start + width]


def _fold(x: Array, stride: int, padding: int, counts: list[int]) -> Array:
    """`counts` blocks of `stride` x `stride` pixels become pixels, their phases channels."""
    h, w = counts
    x = _cut(x, -padding, stride * h, stride * w).reshape(len(x), h, stride, w, stride, -1)
    return x.transpose(0, 1, 3, 2, 4, 5).reshape(len(x), h, w, -1)


def _fold_kernel(kernel: Array, stride: int) -> Array:
    """The kernel that does on folded pixels what `kernel` does with `stride`."""
    size, _, channels, out = kernel.shape
    taps = size // stride
    kernel = kernel.reshape(taps, stride, taps, stride, channels, out).transpose(0, 2, 1, 3, 4, 5)
    return kernel.reshape(taps, taps, -1, out)


def _unfold_kernel(kernel: Array, stride: int) -> Array:
    """The inverse of `_fold_kernel`."""
    taps, _, _, out = kernel.shape
    kernel = kernel.reshape(taps, taps, stride, stride, -1, out).transpose(0, 2, 1, 3, 4, 5)
    return kernel.reshape(taps * stride, taps * stride, -1, out)


def _conv_forward(x: Array, kernel: Array, stride: int, padding: int) -> tuple[Array, tuple[Array, Array]]:
    return _convolve(x, kernel, stride, padding), (x, kernel)


def _conv_backward(stride: int, padding: int, saved: tuple[Array, Array], g: Array) -> tuple[Array, Array]:
    x, kernel = saved
    dx = _spread(g, kernel.swapaxes(2, 3), stride, padding, *x.shape[1:3])
    return dx, _correlate(x, g, kernel.shape[0], stride, padding)


def _transpose_forward(x: Array, kernel: Array, stride: int, padding: int) -> tuple[Array, tuple[Array, Array]]:
    return conv_transpose(x, kernel, stride, padding), (x, kernel)


def _transpose_backward(stride: int, padding: int, saved: tuple[Array, Array], g: Array) -> tuple[Array, Array]:
    x, kernel = saved
    dx = _convolve(g, kernel.swapaxes(2, 3), stride, padding)
    return dx, _correlate(g, x, kernel.shape[0], stride, padding).swapaxes(2, 3)


conv.defvjp(_conv_forward, _conv_backward)
conv_transpose.defvjp(_transpose_forward, _transpose_backward)
