"""Interpolation at each pixel between the values at the three corners of the face that is visible there."""

import functools
import operator
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sts_jax import optics


class Corners(NamedTuple):
    """Faces of an object, with the positions of their vertices in a camera image or in the gel's grid.

    The gel's grid is a regular grid of cells on the pad, in which the heights of the object above the gel are computed.
    """

    column: Float[Array, "v"]  # columns of the vertices (pixels)
    row: Float[Array, "v"]  # rows of the vertices (pixels)
    value: Float[Array, "v"]  # value to interpolate: 1 / depth (1/m) in an image, height (m) on the gel's grid
    faces: Int[Array, "f 3"]  # vertex indices


def weights(
    corners: Corners, winner: Int[Array, "h w"], column: Float[Array, "h w"], row: Float[Array, "h w"]
) -> tuple[list[Int[Array, "h w"]], tuple[Float[Array, "h w"], ...]]:
    """Vertex indices and barycentric weights of the three corners of the face that is visible at each pixel.

    Args:
        corners: Vertices and faces of the object.
        winner: Index of the visible face at each pixel. A negative index, for a pixel without a face, gives the corners
            of face 0.
        column: Column of each pixel.
        row: Row of each pixel.

    Returns:
        Vertex indices of the first, second and third corner, and the weights of these corners.
    """
    of_face = corners.faces[jnp.maximum(winner, 0)]
    indices = [of_face[..., k] for k in range(3)]
    return indices, optics.barycentrics([(corners.column[k], corners.row[k]) for k in indices], column, row)


def weighted(
    corners: Corners, winner: Int[Array, "h w"], column: Float[Array, "h w"], row: Float[Array, "h w"]
) -> list[Float[Array, "h w"]]:
    """For each pixel, multiply `corners.value` at the three corners of the visible face by barycentric weights.

    The result is a list of the three products. Their sum is the interpolated value at the pixel. The function `weights`
    describes the arguments.
    """
    indices, shares = weights(corners, winner, column, row)
    return [share * corners.value[k] for share, k in zip(shares, indices, strict=True)]


def interpolated(
    corners: Corners, images: tuple[Int[Array, "h w"], Float[Array, "h w"], Float[Array, "h w"]]
) -> Float[Array, "h w"]:
    """For each pixel, interpolate `corners.value` between the three corners of the visible face.

    Args:
        corners: Vertices and faces of the object, with the value at each vertex.
        images: Three arrays: the index of the visible face at each pixel, the column of each pixel, and the row of each
            pixel. They are the arguments `winner`, `column` and `row` of the function `weights`.

    Returns:
        Interpolated value at each pixel, meaningless at pixels without a face.
    """
    return functools.reduce(operator.add, weighted(corners, *images))
