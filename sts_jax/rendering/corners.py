"""Interpolation between the corners of the nearest face at each pixel."""

import functools
import operator
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sts_jax import optics


class Corners(NamedTuple):
    """Vertices of an object on a screen, which is an image of the camera or the gel's grid, and its faces."""

    column: Float[Array, "v"]  # columns of the vertices (pixels)
    row: Float[Array, "v"]  # rows of the vertices (pixels)
    value: Float[Array, "v"]  # value to interpolate: 1 / depth (1/m) in an image, height (m) on the gel's grid
    faces: Int[Array, "f 3"]  # vertex indices


def weights(
    corners: Corners, winner: Int[Array, "h w"], column: Float[Array, "h w"], row: Float[Array, "h w"]
) -> tuple[list[Int[Array, "h w"]], tuple[Float[Array, "h w"], ...]]:
    """Vertex indices and barycentric weights of the three corners of the nearest face at each pixel.

    Args:
        corners: Vertices and faces of the object.
        winner: Index of the nearest face at each pixel. Negative indices, where there is no face, give face 0.
        column: Columns of the pixels.
        row: Rows of the pixels.
    """
    of_face = corners.faces[jnp.maximum(winner, 0)]
    indices = [of_face[..., k] for k in range(3)]
    return indices, optics.barycentrics([(corners.column[k], corners.row[k]) for k in indices], column, row)


def weighted(
    corners: Corners, winner: Int[Array, "h w"], column: Float[Array, "h w"], row: Float[Array, "h w"]
) -> list[Float[Array, "h w"]]:
    """Values of the nearest face's corners, times their weights. The sum of the three is the interpolated value."""
    indices, shares = weights(corners, winner, column, row)
    return [share * corners.value[k] for share, k in zip(shares, indices, strict=True)]


def interpolated(
    corners: Corners, images: tuple[Int[Array, "h w"], Float[Array, "h w"], Float[Array, "h w"]]
) -> Float[Array, "h w"]:
    """Interpolate the value on the nearest face at each pixel, given the images `(winner, column, row)`."""
    return functools.reduce(operator.add, weighted(corners, *images))
