"""Evaluation of an image function on those tiles of an image that have active pixels.

In most images of a sensor, few pixels are active, such as those that show the object. `where_active` cuts the image
into square tiles and evaluates the tiles with an active pixel, batch by batch. The function is instead called once with
the whole image if more than 40 % of the tiles are active (`CROWDED`), if the image is smaller than a tile, or under
`vmap`. The gradient is always computed on the whole image.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sts_jax import _cpu_reductions

TILE = 4  # pixels, side of a tile
BATCH = 64  # number of tiles that are evaluated at a time
CROWDED = 0.4  # share of active tiles above which the whole image is evaluated at once, on all CPU cores

Images = Any  # tree of images (height, width)
Function = Callable[[Any, Images], Images]


def where_active(
    function: Function, active: Bool[Array, "h w"], params: Any, images: Images, otherwise: Images, *, ring: int = 0
) -> Images:
    """`jnp.where(active, function(params, images), otherwise)`, with the function evaluated only on active tiles.

    Args:
        function: Function `(params, images) -> result` from images (a + 2 * ring, b + 2 * ring) to images (a, b), for
            any a and b. A pixel of the result must depend only on pixels at most `ring` rows and columns away. Images
            may have a third axis, of tiles. It must not close over traced values: pass them in `params`.
        active: Mask of the pixels at which the result is needed.
        params: First argument of `function`.
        images: Pytree of images (h + 2 * ring, w + 2 * ring). An image with a single row or column is broadcast.
        otherwise: Pytree of images (h, w), of the structure that `function` returns.
        ring: Number of neighbouring pixels in each direction that `function` needs.
    """
    if min(active.shape) < TILE:
        return _dense(function, active, params, images, otherwise)
    return _where_active(function, ring, active, params, images, otherwise)


def lines(images: tuple[Float[Array, "a b"], Float[Array, "a b"]]) -> tuple[Float[Array, "1 b"], Float[Array, "a 1"]]:
    """First row of an image of x values whose rows are equal, and first column of an image of y values likewise."""
    return images[0][:1], images[1][:, :1]


def planes(image: Float[Array, "h w *n 3"]) -> list[Float[Array, "h w *n"]]:
    """Split an image into its three channels."""
    return [image[..., k] for k in range(3)]


def _dense(function: Function, active: Bool[Array, "h w"], params: Any, images: Images, otherwise: Images) -> Images:
    shape = jnp.broadcast_shapes(*(image.shape for image in jax.tree.leaves(images)))
    values = function(params, jax.tree.map(lambda image: jnp.broadcast_to(image, shape), images))
    return jax.tree.map(lambda value, other: jnp.where(active, value, other), values, otherwise)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _where_active(
    function: Function, ring: int, active: Bool[Array, "h w"], params: Any, images: Images, otherwise: Images
) -> Images:
    leaves, structure = jax.tree.flatten((active, params, images, otherwise))

    @jax.custom_batching.custom_vmap
    def chosen(*leaves: Array) -> Images:
        return _sparse(function, ring, *jax.tree.unflatten(structure, leaves))

    @chosen.def_vmap
    def batched(_size: int, in_batched: list[bool], *leaves: Array) -> tuple[Images, Images]:
        # A batched loop over tiles would run until the last image is done, and copy all images in every iteration.
        def whole(*leaves: Array) -> Images:
            return _dense(function, *jax.tree.unflatten(structure, leaves))

        result = jax.vmap(whole, in_axes=[0 if one else None for one in in_batched])(*leaves)
        return result, jax.tree.map(lambda _: True, result)

    return chosen(*leaves)


class _Progress(NamedTuple):
    """State of the loop over batches of tiles."""

    next_tile: Int[Array, ""]  # first tile of the next batch
    result: Images  # images with the values of the tiles so far


def _sparse(
    function: Function, ring: int, active: Bool[Array, "h w"], params: Any, images: Images, otherwise: Images
) -> Images:
    """Evaluate the function on the active tiles, or on the whole image if there are many of them."""
    height, width = active.shape
    rows, columns = -(-height // TILE), -(-width // TILE)
    number = rows * columns
    flags = jnp.pad(active, [(0, rows * TILE - height), (0, columns * TILE - width)])
    used = jnp.any(flags.reshape(rows, TILE, columns, TILE), axis=(1, 3)).reshape(number)
    end = jnp.sum(used)
    order = jnp.pad(_cpu_reductions.flatnonzero(used), (0, -number % BATCH), constant_values=number)
    # The tiles of the last row and column overlap their neighbours, so that every tile lies in the image. The last
    # batch is filled up with repetitions of one tile.
    first_row = jnp.minimum(order // columns * TILE, height - TILE)
    first_column = jnp.minimum(order % columns * TILE, width - TILE)

    def evaluate_batch(progress: _Progress) -> _Progress:
        # The last axis is that of the tiles, because a CPU vectorises along it.
        row, column = (
            jax.lax.dynamic_slice(first, (progress.next_tile,), (BATCH,)) for first in (first_row, first_column)
        )
        inside = jnp.arange(TILE, dtype=jnp.int32)[:, None]
        target = (row[None, :] + inside)[:, None] * width + (column[None, :] + inside)[None, :]

        def take(image: Array) -> Array:
            side = jnp.arange(TILE + 2 * ring, dtype=jnp.int32)[:, None]
            down = (row[None, :] + side)[:, None] * (image.shape[1] if image.shape[0] > 1 else 0)
            across = (column[None, :] + side)[None, :] * (1 if image.shape[1] > 1 else 0)
            # If no neighbours are needed, a batch is a single row of pixels.
            place = down + across if ring else (down + across).reshape(1, -1)
            return image.reshape(-1).at[place].get(mode="promise_in_bounds")

        parts = jax.tree.map(take, images)
        values = function(params, parts)
        wanted = active.reshape(-1).at[target].get(mode="promise_in_bounds")
        target = jnp.where(wanted, target, height * width).reshape(-1)

        def put(image: Array, value: Array) -> Array:
            return image.reshape(-1).at[target].set(value.reshape(-1), mode="drop").reshape(height, width)

        return _Progress(progress.next_tile + BATCH, jax.tree.map(put, progress.result, values))

    def tile_by_tile() -> Images:
        start = _Progress(jnp.int32(0), otherwise)
        return jax.lax.while_loop(lambda progress: progress.next_tile < end, evaluate_batch, start).result

    return jax.lax.cond(
        end > CROWDED * number, lambda: _dense(function, active, params, images, otherwise), tile_by_tile
    )


@_where_active.defjvp
def _where_active_jvp(function: Function, ring: int, primals: tuple, tangents: tuple) -> tuple[Images, Images]:
    return jax.jvp(functools.partial(_dense, function, primals[0]), primals[1:], tangents[1:])
