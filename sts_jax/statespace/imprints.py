"""Imprints in tactile images: networks that draw their outline and their edges, and a score of drawn images.

The decoder predicts the mean imprint of an object in a given pose. It knows the outline and the edges of the imprint
only as probabilities, because the shape is uncertain. `Outlines` draws one of the possible outlines from random
numbers. `Shading` adds the edges, which reflect the lights, and are at known places for one outline.
"""

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float, Int

from sts_jax.statespace import blocks

NOISE = 8  # random numbers from which the imprint of a sample is drawn
FEATURES = 2  # features of an imprint: the mass of the object and its area
_BLOCK = 4  # pixels, side of the blocks in which `Outlines` sees a logit
_STEEP = 6.0  # contrast of drawn outlines
_LARGEST = 4.6  # largest level of a drawn outline as a logit: probabilities from .01 to .99
_FEW = 4.0  # pixels, added to the area of an imprint before the logarithm
_EVEN = 0.01  # distance between parts of images below which the score is nearly a square


class Shading(nnx.Module):
    """Corrects the change of a tactile image by the outline of the imprint, whose edges reflect the lights.

    With `features`, it also knows as many numbers of each image: the weight on an imprint and its area say how deep it
    is.
    """

    def __init__(self, width: int, features: int, rngs: nnx.Rngs) -> None:
        self.layers = nnx.List(
            [nnx.Conv(a, width, (3, 3), conv_general_dilated=blocks.conv, rngs=rngs) for a in (4 * 4 + features, width)]
        )
        self.last = nnx.Conv(
            width, 4 * 3, (3, 3), kernel_init=blocks.SMALL, conv_general_dilated=blocks.conv, rngs=rngs
        )

    def __call__(
        self,
        pressed: Float[Array, "n size size 1"],
        touch: Float[Array, "n size size 3"],
        features: Float[Array, "n f"] | None = None,
    ) -> Float[Array, "n size size 3"]:
        """The correction of the changes `touch` of the logits. `pressed` is the weight of the imprint in each pixel."""
        x = blocks.fold(jnp.concatenate([pressed, pressed * touch], axis=-1))
        if features is not None:
            x = jnp.concatenate([x, _everywhere(features, x)], axis=-1)
        for layer in self.layers:
            x = jax.nn.swish(layer(x))
        return blocks.unfold(self.last(x))


class Outlines(nnx.Module):
    """Draws one of the possible outlines of an imprint, and how deep it is.

    A pixel is in the outline if the probability of an imprint is above a level. The level is a smooth random function
    of the place. Its random numbers are those of the whole image, because local ones would tear imprints into pieces.
    """

    def __init__(self, width: int, rngs: nnx.Rngs) -> None:
        self.first = nnx.Linear(4 * _BLOCK**2, width, rngs=rngs)
        self.change = nnx.Linear(NOISE + FEATURES, 2 * width, rngs=rngs)
        self.mixed = nnx.Linear(width, width, rngs=rngs)
        self.layers = nnx.List([blocks.Residual(width, rngs) for _ in range(2)])
        self.last = nnx.Conv(width, 1, (3, 3), kernel_init=blocks.SMALL, conv_general_dilated=blocks.conv, rngs=rngs)
        self.depth = nnx.Linear(NOISE + FEATURES, 1, kernel_init=blocks.SMALL, rngs=rngs)

    def __call__(
        self,
        logit: Float[Array, "n size size 1"],
        touch: Float[Array, "n size size 3"],
        mass: Float[Array, "n 1"],
        noise: Float[Array, "n noise"],
    ) -> tuple[Float[Array, "n size size 1"], Float[Array, "n 2"], Float[Array, "n"]]:
        """Draw an outline for each image.

        Args:
            logit: Logit of the probability that a pixel shows an imprint.
            touch: Mean change of the logits of the tactile image in an imprint.
            mass: As in a state code.
            noise: Numbers from the standard normal distribution.

        Returns:
            The weight of the imprint in each pixel, the features of each image for `Shading`, and the factor of the
            change of the tactile image.
        """
        likely = jax.nn.sigmoid(logit)
        seen = jnp.concatenate([jnp.clip(logit / 4, -2, 2), likely * touch], axis=-1)
        size = seen.shape[1]
        seen = jnp.pad(seen, ((0, 0), (0, -size % _BLOCK), (0, -size % _BLOCK), (0, 0)))
        x = self.first(blocks.fold(blocks.fold(seen)))
        scale, shift = jnp.split(self.change(jnp.concatenate([noise, mass, _log_area(likely)], axis=-1)), 2, axis=-1)
        x = self.mixed(x * (1 + scale[:, None, None]) + shift[:, None, None])
        for layer in self.layers:
            x = layer(x)
        x = self.last(jax.nn.swish(x))
        x = jax.image.resize(x, (*seen.shape[:3], 1), "linear")[:, :size, :size]
        pressed = jax.nn.sigmoid(_STEEP * (logit + _LARGEST * jnp.tanh(x)))
        features = jnp.concatenate([mass, _log_area(pressed)], axis=-1)
        return pressed, features, jnp.exp(self.depth(jnp.concatenate([noise, features], axis=-1)))[:, 0]


def energy_score(
    one: Float[Array, "n size size 3"],
    other: Float[Array, "n size size 3"],
    target: Float[Array, "n size size 3"],
    shift: Int[Array, "2"],
) -> Float[Array, "n"]:
    """Energy score of two independently drawn images of each item: their mean distance from the true image, minus half
    of their distance from each other.

    Its expected value is least if the images are drawn from the distribution of the true ones (Gneiting and Raftery
    (2007), "Strictly Proper Scoring Rules, Prediction, and Estimation"). The distance is a sum over squares of 4 and 8
    pixels and the whole image, so that the details of a small imprint count. `shift` moves the grid of the squares.
    """

    def distance(a: Array, b: Array) -> Float[Array, "n"]:
        squares = jnp.sum((a - b) ** 2, axis=-1)
        edge = (0, -squares.shape[1] % 8)
        small = _sums(jnp.roll(jnp.pad(squares, ((0, 0), edge, edge)), shift, (1, 2)), 4)
        parts = [x.reshape(len(x), -1) for x in (small, _sums(small, 2), jnp.sum(squares, axis=(1, 2)))]
        return jnp.sum(jnp.sqrt(jnp.concatenate(parts, axis=1) + _EVEN**2) - _EVEN, axis=1)

    return (distance(one, target) + distance(other, target) - distance(one, other)) / 2


def _sums(x: Float[Array, "n h w"], side: int) -> Float[Array, "n small small"]:
    """Sums over squares of `side` x `side` pixels."""
    n, h, w = x.shape
    return jnp.sum(x.reshape(n, h // side, side, w // side, side), axis=(2, 4))


def _log_area(weight: Float[Array, "n size size 1"]) -> Float[Array, "n 1"]:
    """Logarithm of the area of each imprint, which is 0 for 51 pixels."""
    return jnp.log(jnp.sum(weight, axis=(1, 2)) + _FEW) - 4


def _everywhere(features: Float[Array, "n f"], x: Float[Array, "n h w c"]) -> Float[Array, "n h w f"]:
    return jnp.broadcast_to(features[:, None, None], (*x.shape[:3], features.shape[1]))
