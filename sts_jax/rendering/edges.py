"""The derivative of an imprint whose edges move along with the object."""

import functools
import operator

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sts_jax.rendering.corners import Corners, weights


@jax.custom_jvp
def with_moving_edges(
    imprint: Float[Array, "h w"],
    corners: Corners,
    images: tuple[Array, Array, Array],
    depth: Float[Array, "h w"],
    on_pad: Bool[Array, "h w"],
    follows: Bool[Array, "h w"],
) -> Float[Array, "h w"]:
    """Return the imprint, with the derivative of a shape that moves along with the faces' corners.

    The derivative of interpolated depth ignores edges that move, and the imprint of a flat object with upright walls
    changes at its edges alone. With the velocity v of the visible surface (pixels) and the rate at which it sinks,

        d imprint = rate - v . grad imprint

    Each of two neighbouring pixels receives half of their difference, with the v of the one nearer to the camera: a
    micro-edge (Pidhorskyi et al. 2024, "Rasterized Edge Gradients"). It is accurate on average over a few pixels.

    Args:
        imprint: depth of the imprint (m).
        corners: with 1 / depth (1/m) as their value.
        images: the winning face, the column and the row of each pixel.
        depth: of the object from the pinhole (m), `inf` where there is none.
        on_pad: whether the ray passes through the pad.
        follows: whether the imprint follows the object's surface.

    Returns:
        The imprint, unchanged.
    """
    return imprint


@with_moving_edges.defjvp
def _with_moving_edges_jvp(primals: tuple, tangents: tuple) -> tuple[Float[Array, "h w"], Float[Array, "h w"]]:
    imprint, corners, images, depth, on_pad, follows = primals
    change_of_imprint, change_of_corners, *_ = tangents
    indices, shares = weights(corners, *images)
    across, down, nearing = (
        functools.reduce(operator.add, (share * change[k] for share, k in zip(shares, indices, strict=True)))
        for change in (change_of_corners.column, change_of_corners.row, change_of_corners.value)
    )
    change = change_of_imprint + jnp.where(follows, nearing * jnp.where(follows, depth, 1) ** 2, 0)
    for axis, speed in ((0, down), (1, across)):
        (d0, d1), (v0, v1), (i0, i1), (p0, p1) = (
            (jax.lax.slice_in_dim(image, 0, -1, axis=axis), jax.lax.slice_in_dim(image, 1, None, axis=axis))
            for image in (depth, speed, imprint, on_pad)
        )
        flow = 0.5 * jnp.where(p0 & p1, i1 - i0, 0) * jnp.where(d0 < d1, v0, v1)
        before, after = [[(0, 0), (0, 0)] for _ in range(2)]
        before[axis], after[axis] = (1, 0), (0, 1)
        change = change - jnp.pad(flow, before) - jnp.pad(flow, after)
    return imprint, change
