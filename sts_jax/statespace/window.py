"""Windows around the object in an image, aligned with the principal axes of its silhouette, and magnified.

The silhouette is the set of all pixels that differ from the image of the empty sensor by more than a shadow does.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from sts_jax._sampling import bilinear_batch
from sts_jax.statespace import poses

THRESHOLD = 12 / 255  # a pixel is in the silhouette if a channel differs by more than this (shadows differ by less)
DEVIATIONS = 5  # a window's silhouette has only differences above as many standard deviations of the image's noise
LARGEST = 24 / 255  # larger differences between neighbouring pixels count as edges, and only in part as noise
MARGIN = 1.1  # side of a window, divided by the larger extent of the silhouette
SMALLEST = 0.08  # side of the smallest window, divided by the side of the image


class Window(NamedTuple):
    """A square in each of n images, aligned with the principal axes of the silhouette.

    The unit of lengths and positions is the side of the image.
    """

    centre: Float[Array, "n 2"]  # column and row of the centre, from the left and the upper border of the image
    angle: Float[Array, "n 2"]  # cosine and sine of the angle from the direction of increasing columns to the long axis
    side: Float[Array, "n"]  # side of the square


def shows(change: Float[Array, "n h w 3"], least: Float[Array, "*n"] | float = THRESHOLD) -> Float[Array, "n h w"]:
    """1 for pixels that differ from the empty sensor by more than `least` (default 12/255) in any channel, else 0."""
    return (jnp.max(jnp.abs(change), axis=-1) > jnp.asarray(least)[..., None, None]).astype(jnp.float32)


def noise(change: Float[Array, "n h w 3"]) -> Float[Array, "n"]:
    """Standard deviation of the noise in each image, from the mean difference between neighbouring pixels."""
    across = jnp.minimum(jnp.abs(jnp.diff(change, axis=2)), LARGEST)
    return jnp.mean(across, axis=(1, 2, 3)) * jnp.sqrt(jnp.pi) / 2


def locate(change: Float[Array, "n size size 3"]) -> Window:
    """Find a square window around the object in each image, aligned with the principal axes of the silhouette.

    Without a silhouette, it is the whole image. `change` is the image minus that of the empty sensor, both in [0, 1].
    """
    size = change.shape[1]
    weight = shows(change, jnp.maximum(THRESHOLD, DEVIATIONS * noise(change)))
    total = jnp.maximum(jnp.sum(weight, axis=(1, 2)), 1)
    place = (jnp.arange(size) + 0.5) / size - 0.5  # from the centre of the image
    of_columns, of_rows = jnp.sum(weight, axis=1) / total[:, None], jnp.sum(weight, axis=2) / total[:, None]
    middle = jnp.stack([of_columns @ place, of_rows @ place], axis=-1)
    x, y = place - middle[:, :1], place - middle[:, 1:]  # of each column and of each row
    mixed = jnp.sum(y * (weight @ place), axis=-1) / total
    square = jnp.sum(of_columns * x**2, axis=-1) - jnp.sum(of_rows * y**2, axis=-1)
    half = jnp.arctan2(2 * mixed, square) / 2
    angle = jnp.stack([jnp.cos(half), jnp.sin(half)], axis=-1)
    # The first and the last pixel of each row include the extreme ones along any axis.
    seen, columns = weight > 0, x[:, None]
    in_row = jnp.any(seen, axis=2)[..., None, None]
    first = jnp.min(jnp.where(seen, columns, jnp.inf), axis=2)
    last = jnp.max(jnp.where(seen, columns, -jnp.inf), axis=2)
    ends = jnp.stack([jnp.stack([first, y], axis=-1), jnp.stack([last, y], axis=-1)], axis=2)
    turned = poses.turn_back(angle[:, None, None], jnp.where(in_row, ends, 0))
    low = jnp.min(jnp.where(in_row, turned, jnp.inf), axis=(1, 2))
    high = jnp.max(jnp.where(in_row, turned, -jnp.inf), axis=(1, 2))
    side = jnp.maximum(jnp.max(high - low, axis=-1) * MARGIN + 1 / size, SMALLEST)
    centre = 0.5 + middle + poses.turn(angle, (low + high) / 2)
    visible = jnp.any(seen, axis=(1, 2))
    return Window(
        jnp.where(visible[:, None], centre, 0.5),
        jnp.where(visible[:, None], angle, jnp.array([1.0, 0.0])),
        jnp.where(visible, side, 1.0),
    )


def cut(images: Float[Array, "n size size c"], window: Window, side: int) -> Float[Array, "n side side c"]:
    """Cut the windows out of images, and resample each window to `side` x `side` pixels.

    The column index increases along the long axis of the silhouette. A pixel is the mean of four values from `sample`.
    """
    fine = 2 * side
    grid = (jnp.arange(fine) + 0.5) / fine - 0.5
    apart = jnp.stack(jnp.meshgrid(grid, grid), axis=-1).reshape(1, -1, 2) * window.side[:, None, None]
    places = window.centre[:, None] + poses.turn(window.angle[:, None], apart)
    fine_pixels = sample(images, places * images.shape[1] - 0.5)
    return jnp.mean(fine_pixels.reshape(len(images), side, 2, side, 2, -1), axis=(2, 4))


def sample(images: Float[Array, "n side side c"], places: Float[Array, "n m 2"]) -> Float[Array, "n m c"]:
    """Interpolate each image bilinearly at m places. Pixels outside the image count as 0.

    `places` are columns and rows (pixels). Whole numbers are pixel centres.
    """
    framed = jnp.pad(images, ((0, 0), (1, 1), (1, 1), (0, 0)))
    return bilinear_batch(framed, places[..., 0] + 1, places[..., 1] + 1)
