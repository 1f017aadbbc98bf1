"""Bilinear interpolation of images. Places are columns and rows in pixels, whole numbers at pixel centres.

Each function serves one pattern of access: `bilinear` any places of one image, `bilinear_batch` many places of several
small images with channels, and `shifted` the same offset from every pixel. A place beyond the image has the value of
the nearest place in it. To get zero there, pad the image with a ring of zeros.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int


def bilinear(
    image: Float[Array, "h w *c"], column: Float[Array, "*n"], row: Float[Array, "*n"], *, wrap: bool = False
) -> Float[Array, "..."]:
    """Values of an image at any places.

    Args:
        image: values of any kind, with any number of axes for channels. At least 2x2 pixels without `wrap`.
        column: of the places, pixels.
        row: of the places, pixels.
        wrap: whether the image repeats beyond its border.

    Returns:
        Values at the places, (*n, *c).
    """
    height, width = image.shape[:2]
    if wrap:
        (left, x), (top, y) = _split(column, width), _split(row, height)
        right, bottom = (left + 1) % width, (top + 1) % height
    else:
        (left, x), (top, y) = _split_within(column, width), _split_within(row, height)
        right, bottom = left + 1, top + 1
    x, y = (part.reshape(part.shape + (1,) * (image.ndim - 2)) for part in (x, y))
    upper = image[top, left] * (1 - x) + image[top, right] * x
    lower = image[bottom, left] * (1 - x) + image[bottom, right] * x
    return upper * (1 - y) + lower * y


def bilinear_batch(
    images: Float[Array, "n h w c"], column: Float[Array, "n m"], row: Float[Array, "n m"]
) -> Float[Array, "n m c"]:
    """Values of several images at many places each, with a fast derivative by the images.

    Args:
        images: at least 2x2 pixels each.
        column: of the places, pixels.
        row: of the places, pixels.

    Returns:
        Values at the places.
    """
    count, height, width, channels = images.shape
    # The four neighbours of a place lie side by side in a table, and one look-up finds them.
    corners = [images[:, i : height - 1 + i, j : width - 1 + j] for i in (0, 1) for j in (0, 1)]
    table = jnp.concatenate(corners, axis=-1).reshape(count, (height - 1) * (width - 1), 4 * channels)
    (left, x), (top, y) = _split_within(column, width), _split_within(row, height)
    index = top * (width - 1) + left
    found = jnp.take_along_axis(table, index[..., None], axis=1).reshape(*index.shape, 4, channels)
    weights = jnp.stack([(1 - y) * (1 - x), (1 - y) * x, y * (1 - x), y * x], axis=-1)
    return jnp.sum(weights[..., None] * found, axis=-2)


def shifted(
    around: Float[Array, "a b"], columns: Float[Array, ""], rows: Float[Array, ""], shape: tuple[int, int]
) -> Float[Array, "h w"]:
    """Values at the same offset from every pixel of an image.

    Args:
        around: the image, with `h + 1` rows above and below it and `w + 1` columns on each side.
        columns: of the offset, pixels.
        rows: of the offset, pixels.
        shape: (height, width) of the image, pixels.

    Returns:
        Values of the moved image.
    """
    height, width = shape
    columns, rows = jnp.clip(columns, -width, width), jnp.clip(rows, -height, height)
    left, top = jnp.floor(columns), jnp.floor(rows)
    start = (top.astype(jnp.int32) + height + 1, left.astype(jnp.int32) + width + 1)
    part = jax.lax.dynamic_slice(around, start, (height + 1, width + 1))
    x, y = columns - left, rows - top
    part = part[:, :-1] * (1 - x) + part[:, 1:] * x
    return part[:-1] * (1 - y) + part[1:] * y


def _split(place: Float[Array, "*n"], size: int) -> tuple[Int[Array, "*n"], Float[Array, "*n"]]:
    """Index of the pixel before each place of a repeating line of pixels, and the distance from it."""
    before = jnp.floor(place)
    return before.astype(jnp.int32) % size, place - before


def _split_within(place: Float[Array, "*n"], size: int) -> tuple[Int[Array, "*n"], Float[Array, "*n"]]:
    """Index of the pixel before each place of a line of pixels, and the distance from it. A pixel follows."""
    place = jnp.clip(place, 0, size - 1)
    before = jnp.minimum(jnp.floor(place), size - 2)
    return before.astype(jnp.int32), place - before
