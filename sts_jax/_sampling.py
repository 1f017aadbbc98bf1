"""Bilinear interpolation of images at points given by column and row (pixels), whole numbers at pixel centres.

One function for each pattern of access. In `bilinear` and `bilinear_batch`, a point outside the image gets the value of
the nearest point inside. To get zero there, pad the image with a ring of zeros.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int


def bilinear(
    image: Float[Array, "h w *c"], column: Float[Array, "*n"], row: Float[Array, "*n"], *, wrap: bool = False
) -> Float[Array, "..."]:
    """Interpolate an image of at least 2x2 pixels at any points.

    With `wrap`, the image repeats beyond its border, and may have any size.
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
    """Interpolate each of n images at m points. The derivative by the images is fast to compute."""
    count, height, width, channels = images.shape
    # The four neighbours of a point lie side by side in a table, so that one look-up finds them.
    corners = [images[:, i : height - 1 + i, j : width - 1 + j] for i in (0, 1) for j in (0, 1)]
    table = jnp.concatenate(corners, axis=-1).reshape(count, (height - 1) * (width - 1), 4 * channels)
    (left, x), (top, y) = _split_within(column, width), _split_within(row, height)
    index = top * (width - 1) + left
    neighbours = jnp.take_along_axis(table, index[..., None], axis=1).reshape(*index.shape, 4, channels)
    weights = jnp.stack([(1 - y) * (1 - x), (1 - y) * x, y * (1 - x), y * x], axis=-1)
    return jnp.sum(weights[..., None] * neighbours, axis=-2)


def shifted(
    around: Float[Array, "a b"], columns: Float[Array, ""], rows: Float[Array, ""], shape: tuple[int, int]
) -> Float[Array, "h w"]:
    """Shift an image (h, w) by an offset (pixels): pixel (i, j) gets the value at row i + rows, column j + columns.

    Args:
        around: The image with a border of h + 1 rows above and below, and w + 1 columns on the left and on the right.
            The border has the values that the shift moves into the image.
        columns: Horizontal part of the offset, clipped to [-w, w].
        rows: Vertical part of the offset, clipped to [-h, h].
        shape: (h, w).
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
    """Index of the pixel before each position on a periodic line of pixels, and the distance from it."""
    before = jnp.floor(place)
    return before.astype(jnp.int32) % size, place - before


def _split_within(place: Float[Array, "*n"], size: int) -> tuple[Int[Array, "*n"], Float[Array, "*n"]]:
    """As `_split`, with positions clipped to the line. The index is at most `size - 2`."""
    place = jnp.clip(place, 0, size - 1)
    before = jnp.minimum(jnp.floor(place), size - 2)
    return before.astype(jnp.int32), place - before
