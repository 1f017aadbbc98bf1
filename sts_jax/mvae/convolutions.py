"""Convolutions and transposed convolutions with gradients that are fast on a CPU.

XLA's CPU backend is slow for convolutions with `lhs_dilation`, which JAX uses for transposed convolutions and for the
gradients of strided convolutions. The functions below use matrix products and convolutions without dilation instead.
For small images, stride 1 and kernels above 3x3, a Fourier transform also saves most of the multiplications.

Images have shape `(batch, height, width, channel)`. Kernels have shape `(size, size, in, out)`, and `size` must be a
multiple of `stride`.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

_LAYOUT = ("NHWC", "HWIO", "NHWC")
_FEW = 16  # channels. For fewer, `_convolve` is faster with folded pixels, and `_correlate` with a single convolution
_SMALL = 144  # pixels of the larger image with its padding. Up to this size, a dense Fourier transform is faster
_SUMMED = 2048  # pixels. `_correlate` sums over about as many at once: longer sums do not fit the cache


def conv(
    x: Float[Array, "batch h w in"], kernel: Float[Array, "size size in out"], stride: int, padding: int
) -> Float[Array, "batch ho wo out"]:
    """Convolve images as neural networks do, without flipping the kernel.

    `y[i] = sum_a x[stride i + a - padding] kernel[a]` along each axis, summed over the input channels. Pixels outside
    the images count as 0. The output has `(h + 2 padding - size) // stride + 1` rows, and columns likewise.

    Args:
        stride: Step of the kernel from one output pixel to the next, in input pixels.
        padding: Number of zeros before the first and after the last pixel of each axis, at most `size - 1`.
    """
    height, width = (n + 2 * padding - len(kernel) + 1 for n in x.shape[1:3])
    if stride == 1 and len(kernel) > 3 and (height + len(kernel) - 1) * (width + len(kernel) - 1) <= _SMALL:
        narrow, taps, wide = _fourier(height, width, len(kernel), padding)
        return _bilinear(x, kernel, wide, taps, narrow).reshape(len(x), height, width, -1)
    return _conv(x, kernel, stride, padding)


def conv_transpose(
    x: Float[Array, "batch h w in"], kernel: Float[Array, "size size in out"], stride: int, padding: int
) -> Float[Array, "batch ho wo out"]:
    """Apply the transpose of the linear map `conv`. A `stride` above 1 enlarges the images.

    `y[stride i + a - padding] += x[i] kernel[a]` along each axis, summed over the input channels. The output has
    `stride (h - 1) + size - 2 padding` rows, and columns likewise.

    Args:
        stride: Step of the kernel from one input pixel to the next, in output pixels.
        padding: Number of rows and columns that are cut from each side of the output.
    """
    height, width = (stride * (n - 1) + len(kernel) - 2 * padding for n in x.shape[1:3])
    if stride == 1 and len(kernel) > 3 and (height + 2 * padding) * (width + 2 * padding) <= _SMALL:
        narrow, taps, wide = _fourier(*x.shape[1:3], len(kernel), padding)
        return _bilinear(x, kernel, narrow, taps, wide).reshape(len(x), height, width, -1)
    return _conv_transpose(x, kernel, stride, padding)


@functools.cache
def _fourier(height: int, width: int, size: int, padding: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Real matrices A, B and C that turn a convolution with stride 1 into elementwise products.

    Let x be the smaller image, y the larger image and k the kernel, each as a vector of pixels. The transposed
    convolution is `y = C^T ((A x) * (B k))`, and the convolution is `x = A^T ((C y) * (B k))`. The matrices are
    discrete Fourier transforms on a grid of `height + size - 1` by `width + size - 1` points. This grid contains the
    larger image and its padding, so that no product wraps around. A complex product takes three real products (Gauss),
    and half of the frequencies suffice for real images. For 5x5 pixels and a kernel of 4x4, 94 products replace 400.
    `height` and `width` are those of the smaller image.
    """
    n, m = height + size - 1, width + size - 1
    u, v = np.divmod(np.arange(n * m), m)
    conjugate = (-u % n) * m + (-v % m)
    kept = np.arange(n * m) <= conjugate
    u, v, alone = u[kept], v[kept], (np.arange(n * m) == conjugate)[kept]

    def transform(rows: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        i, j = (index.ravel() for index in np.meshgrid(rows, columns, indexing="ij"))
        angle = 2 * np.pi * (np.outer(u, i) / n + np.outer(v, j) / m)
        return np.cos(angle), -np.sin(angle)

    real, imag = transform(np.arange(height), np.arange(width))
    narrow = np.concatenate([real + imag, real[~alone], imag[~alone]])
    real, imag = transform(np.arange(size), np.arange(size))
    taps = np.concatenate([real, (imag - real)[~alone], (real + imag)[~alone]])
    real, imag = transform(np.arange(padding, n - padding), np.arange(padding, m - padding))
    scale = np.where(alone, 1, 2)[:, None] / (n * m)
    wide = np.concatenate([scale * (real + imag), (scale * imag)[~alone], (-scale * real)[~alone]])
    return narrow, taps, wide


def _bilinear(x: Array, kernel: Array, image: np.ndarray, taps: np.ndarray, back: np.ndarray) -> Array:
    """Compute `back^T ((image x) * (taps kernel))` with the matrices of `_fourier`, as `(batch, pixel, out)`."""
    batch, h, w, channels = x.shape
    # With the rows of the transform on the first axis, all products and their derivatives multiply contiguous matrices.
    spectrum = jnp.asarray(image, x.dtype) @ x.reshape(batch, h * w, channels).swapaxes(0, 1).reshape(h * w, -1)
    weights = jnp.asarray(taps, x.dtype) @ kernel.reshape(taps.shape[1], -1)
    y = jnp.matmul(spectrum.reshape(-1, batch, channels), weights.reshape(-1, channels, kernel.shape[3]))
    y = jnp.asarray(back.T, x.dtype) @ y.reshape(len(back), -1)
    return y.reshape(-1, batch, kernel.shape[3]).swapaxes(0, 1)


@functools.partial(jax.custom_vjp, nondiff_argnums=(2, 3))
def _conv(x: Array, kernel: Array, stride: int, padding: int) -> Array:
    return _convolve(x, kernel, stride, padding)


@functools.partial(jax.custom_vjp, nondiff_argnums=(2, 3))
def _conv_transpose(x: Array, kernel: Array, stride: int, padding: int) -> Array:
    return _spread(x, kernel, stride, padding, *(stride * (n - 1) + len(kernel) - 2 * padding for n in x.shape[1:3]))


def _convolve(x: Array, kernel: Array, stride: int, padding: int) -> Array:
    """`conv` without a Fourier transform. Images with few channels are folded first, which is faster."""
    if stride > 1 and x.shape[3] < _FEW:
        size = kernel.shape[0]
        counts = [(n + 2 * padding - size) // stride + size // stride for n in x.shape[1:3]]
        x, kernel, stride, padding = _fold(x, stride, padding, counts), _fold_kernel(kernel, stride), 1, 0
    pads = [(padding, padding)] * 2
    return jax.lax.conv_general_dilated(x, kernel, (stride, stride), pads, dimension_numbers=_LAYOUT)


def _spread(x: Array, kernel: Array, stride: int, padding: int, height: int, width: int) -> Array:
    """`conv_transpose` without a Fourier transform, cropped or padded with zeros to `height` x `width` pixels."""
    size, _, _, out = kernel.shape
    if stride == 1:
        pads = [(size - 1 - padding, n - m + padding) for n, m in ((height, x.shape[1]), (width, x.shape[2]))]
        turned = kernel[::-1, ::-1]
        return jax.lax.conv_general_dilated(x, turned, (1, 1), pads, dimension_numbers=_LAYOUT)
    batch, h, w, _ = x.shape
    taps = size // stride
    # Output pixels with the same indices modulo `stride` form a phase. One small convolution computes all phases as
    # channels, which the transposition interleaves.
    phases = _fold_kernel(kernel.swapaxes(2, 3), stride).swapaxes(2, 3)[::-1, ::-1]
    y = jax.lax.conv_general_dilated(x, phases, (1, 1), [(taps - 1, taps - 1)] * 2, dimension_numbers=_LAYOUT)
    y = y.reshape(*y.shape[:3], stride, stride, out).transpose(0, 1, 3, 2, 4, 5)
    y = y.reshape(batch, stride * (h + taps - 1), stride * (w + taps - 1), out)
    return _cut(y, padding, height, width)


def _correlate(wide: Array, narrow: Array, size: int, stride: int, padding: int) -> Array:
    """Gradient by the kernel, `k[a, A, B] = sum_i wide[stride i + a - padding, A] narrow[i, B]`.

    `wide` is the larger and `narrow` the smaller image. A and B are their channels.
    """
    _, h, w, channels = narrow.shape
    if stride > 1:
        counts = [h + size // stride - 1, w + size // stride - 1]
        folded = _correlate(_fold(wide, stride, padding, counts), narrow, size // stride, 1, 0)
        return _unfold_kernel(folded, stride)
    wide = _cut(wide, -padding, h + size - 1, w + size - 1)
    if size > 2 or wide.shape[3] < _FEW:
        sums = ("CHWN", "IHWO", "HWNC")  # the batch is in the place of the channels, because the sum is over the batch
        some = -(-_SUMMED // (h * w))
        parts = [(wide[i : i + some], narrow[i : i + some]) for i in range(0, len(narrow), some)]
        products = [jax.lax.conv_general_dilated(*part, (1, 1), "VALID", dimension_numbers=sums) for part in parts]
        return functools.reduce(jnp.add, products)
    flat = narrow.reshape(-1, channels)
    taps = [wide[:, a : a + h, b : b + w].reshape(len(flat), -1) for a in range(size) for b in range(size)]
    products = [jax.lax.dot_general(flat, tap, (((0,), (0,)), ((), ()))) for tap in taps]
    return jnp.stack(products).reshape(size, size, channels, -1).swapaxes(2, 3)


def _cut(x: Array, start: int, height: int, width: int) -> Array:
    """Cut `height` x `width` pixels, beginning at row and column `start`. Pixels outside the image are 0."""
    before = max(-start, 0)
    after = [max(start + n - m, 0) for n, m in ((height, x.shape[1]), (width, x.shape[2]))]
    x = jnp.pad(x, ((0, 0), (before, after[0]), (before, after[1]), (0, 0)))
    start = max(start, 0)
    return x[:, start : start + height, start : start + width]


def _fold(x: Array, stride: int, padding: int, counts: list[int]) -> Array:
    """Turn each block of `stride` x `stride` pixels into one pixel with more channels.

    `counts` has the blocks along height and width. The first begins `padding` pixels before the image.
    """
    h, w = counts
    x = _cut(x, -padding, stride * h, stride * w).reshape(len(x), h, stride, w, stride, -1)
    return x.transpose(0, 1, 3, 2, 4, 5).reshape(len(x), h, w, -1)


def _fold_kernel(kernel: Array, stride: int) -> Array:
    """The kernel that has the same result on folded images with stride 1 as `kernel` on images with `stride`."""
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
    return _conv_transpose(x, kernel, stride, padding), (x, kernel)


def _transpose_backward(stride: int, padding: int, saved: tuple[Array, Array], g: Array) -> tuple[Array, Array]:
    x, kernel = saved
    dx = _convolve(g, kernel.swapaxes(2, 3), stride, padding)
    return dx, _correlate(g, x, kernel.shape[0], stride, padding).swapaxes(2, 3)


_conv.defvjp(_conv_forward, _conv_backward)
_conv_transpose.defvjp(_transpose_forward, _transpose_backward)
