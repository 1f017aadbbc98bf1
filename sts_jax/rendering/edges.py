"""Derivative of an imprint with respect to the object's pose, including the motion of the imprint's edges."""

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
    """Return the imprint unchanged, but with a derivative that includes the motion of its edges.

    The depth at a pixel is interpolated on the face that is visible there. The derivative of this depth ignores edges
    that move across pixels. If a flat object with upright walls moves sideways, its imprint changes only at such edges.
    The derivative here is

        d imprint = rate - v . grad imprint

    Each pixel shows one point of the object. v is the motion of this point in the image (pixels), and `rate` is the
    change of the point's depth below the undeformed surface of the gel (m). The second term is a sum over pairs of
    neighbouring pixels. For each pair, the difference of the imprint's depths at the two pixels is multiplied by the
    component of v along the line from one pixel to the other, taken at the pixel at which the object is nearer to the
    camera. Half of this product is subtracted from the derivative at each of the two pixels. The pairs are the
    micro-edges of Pidhorskyi et al. 2024, "Rasterized Edge Gradients". The derivative is accurate on average over a few
    pixels.

    `images` are the arguments `winner`, `column` and `row` of `weights`, and `follows` is True where the object presses
    and the imprint is not clipped.
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
