"""Parts of networks: convolutions with stride 1, residual blocks, and folds of blocks of pixels into channels."""

from typing import Any

import jax
from flax import nnx
from jaxtyping import Array, Float

from sts_jax.mvae import convolutions

SMALL = nnx.initializers.variance_scaling(0.1, "fan_in", "normal")  # for last layers


def conv(x: Array, kernel: Array, *args: Any, **options: Any) -> Array:
    """The convolution of `nnx.Conv` with a 3x3 kernel. On a CPU, its gradient is faster than XLA's."""
    if jax.default_backend() != "cpu":
        return jax.lax.conv_general_dilated(x, kernel, *args, **options)
    return convolutions.conv(x, kernel, 1, 1)


class Residual(nnx.Module):
    """`x + layer(swish(norm(x)))` with a 3x3 convolution."""

    def __init__(self, channels: int, rngs: nnx.Rngs) -> None:
        self.norm = nnx.LayerNorm(channels, rngs=rngs)
        self.layer = nnx.Conv(channels, channels, (3, 3), conv_general_dilated=conv, rngs=rngs)

    def __call__(self, x: Float[Array, "n h w c"]) -> Float[Array, "n h w c"]:
        """Add the correction to each pixel."""
        return x + self.layer(jax.nn.swish(self.norm(x)))


class ResidualDense(nnx.Module):
    """A residual block of two fully connected layers."""

    def __init__(self, width: int, rngs: nnx.Rngs) -> None:
        self.norm = nnx.LayerNorm(width, rngs=rngs)
        self.first = nnx.Linear(width, width, rngs=rngs)
        self.second = nnx.Linear(width, width, kernel_init=SMALL, rngs=rngs)

    def __call__(self, x: Float[Array, "n c"]) -> Float[Array, "n c"]:
        """Add the correction to each item."""
        return x + self.second(jax.nn.swish(self.first(jax.nn.swish(self.norm(x)))))


def fold(x: Float[Array, "n h w c"]) -> Float[Array, "n h//2 w//2 4*c"]:
    """Turn each block of 2x2 pixels into one pixel with four times as many channels."""
    n, h, w, c = x.shape
    return x.reshape(n, h // 2, 2, w // 2, 2, c).transpose(0, 1, 3, 2, 4, 5).reshape(n, h // 2, w // 2, 4 * c)


def unfold(x: Float[Array, "n h w c"]) -> Float[Array, "n 2*h 2*w c//4"]:
    """The inverse of `fold`."""
    n, h, w, c = x.shape
    return x.reshape(n, h, w, 2, 2, c // 4).transpose(0, 1, 3, 2, 4, 5).reshape(n, 2 * h, 2 * w, c // 4)
