"""Windows around the changed part of an image, aligned with its principal axes and magnified."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from sts_jax._sampling import bilinear_batch
from sts_jax.statespace import poses

THRESHOLD = 12 / 255  # a pixel shows the object if a channel differs by more than this (shadows differ by less)
MARGIN = 1.1  # side of the window, divided by the larger extent of the silhouette
SMALLEST = 0.08  # side of the smallest window, divided by the side of the image


class Window(NamedTuple):
    """A square in each image, along the principal axes of the silhouette. Lengths are shares of the image's side."""

    centre: Float[Array, "n 2"]  # column, row
    angle: Float[Array, "n 2"]  # cosine and sine of the angle from the columns to the long axis
    side: Float[Array, "n"]


def shows(change: Float[Array, "n h w 3"]) -> Float[Array, "n h w"]:
    """1 for pixels that differ from the empty sensor, else 0.

    Args:
        change: Images less that of the empty sensor.
    """
    return (jnp.max(jnp.abs(change), axis=-1) > THRESHOLD).astype(jnp.float32)


def locate(change: Float[Array, "n size size 3"]) -> Window:
    """The window around all pixels that differ from the empty sensor, or the whole image if there are none.

    Args:
        change: Square images less that of the empty sensor.
    """
    size = change.shape[1]
    weight = shows(change)
    seen = weight > 0
    total = jnp.maximum(jnp.sum(weight, axis=(1, 2)), 1)
    place = (jnp.arange(size) + 0.5) / size

    def mean(x: Float[Array, "n size size"]) -> Float[Array, "n"]:
        return jnp.sum(weight * x, axis=(1, 2)) / total

    column, row = jnp.broadcast_to(place, weight.shape), jnp.broadcast_to(place[:, None], weight.shape)
    middle = jnp.stack([mean(column), mean(row)], axis=-1)
    x, y = column - middle[:, :1, None], row - middle[:, 1:, None]
    twice = jnp.stack([mean(x * x) - mean(y * y), 2 * mean(x * y)], axis=-1)
    half = jnp.arctan2(twice[:, 1], twice[:, 0]) / 2
    angle = jnp.stack([jnp.cos(half), jnp.sin(half)], axis=-1)
    turned = poses.turn_back(angle[:, None, None], jnp.stack([x, y], axis=-1))
    low = jnp.min(jnp.where(seen[..., None], turned, jnp.inf), axis=(1, 2))
    high = jnp.max(jnp.where(seen[..., None], turned, -jnp.inf), axis=(1, 2))
    side = jnp.maximum(jnp.max(high - low, axis=-1) * MARGIN + 1 / size, SMALLEST)
    centre = middle + poses.turn(angle, (low + high) / 2)
    there = jnp.any(seen, axis=(1, 2))
    return Window(
        jnp.where(there[:, None], centre, 0.5),
        jnp.where(there[:, None], angle, jnp.array([1.0, 0.0])),
        jnp.where(there, side, 1.0),
    )


def cut(images: Float[Array, "n size size c"], window: Window, side: int) -> Float[Array, "n side side c"]:
    """The windows at another resolution. A pixel is the mean of four interpolated values, 0 outside of the image.

    Args:
        images: Square images.
        window: The window of each image.
        side: Side of the result in pixels.
    """
    fine = 2 * side
    grid = (jnp.arange(fine) + 0.5) / fine - 0.5
    apart = jnp.stack(jnp.meshgrid(grid, grid), axis=-1).reshape(1, -1, 2) * window.side[:, None, None]
    places = window.centre[:, None] + poses.turn(window.angle[:, None], apart)
    found = sample(images, places * images.shape[1] - 0.5)
    return jnp.mean(found.reshape(len(images), side, 2, side, 2, -1), axis=(2, 4))


def sample(images: Float[Array, "n side side c"], places: Float[Array, "n m 2"]) -> Float[Array, "n m c"]:
    """Bilinear interpolation at columns and rows, where whole numbers are pixel centres. Zero outside of the image."""
    framed = jnp.pad(images, ((0, 0), (1, 1), (1, 1), (0, 0)))
    return bilinear_batch(framed, places[..., 0] + 1, places[..., 1] + 1)
