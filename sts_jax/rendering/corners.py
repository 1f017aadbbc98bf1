"""Interpolation at each pixel between the values at the three corners of the face that is visible there."""

import functools
import operator
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sts_jax import optics


class Corners(NamedTuple):
    """Faces of an object, with the positions of their vertices in a camera image or in the gel's grid."""

    column: Float[Array, "v"]  # columns of the vertices (pixels)
    row: Float[Array, "v"]  # rows of the vertices (pixels)
    value: Float[Array, "v"]  # value to interpolate: 1 / depth (1/m) in an image, height (m) on the gel's grid
    faces: Int[Array, "f 3"]  # vertex indices


def weights(
    corners: Corners, winner: Int[Array, "h w"], column: Float[Array, "h w"], row: Float[Array, "h w"]
) -> tuple[list[Int[Array, "h w"]], tuple[Float[Array, "h w"], ...]]:
    """Vertex indices and barycentric weights of the corners of the face `winner` that is visible at each pixel."""
    of_face = corners.faces[jnp.maximum(winner, 0)]
    indices = [of_face[..., k] for k in range(3)]
    return indices, optics.barycentrics([(corners.column[k], corners.row[k]) for k in indices], column, row)


def weighted(
    corners: Corners, winner: Int[Array, "h w"], column: Float[Array, "h w"], row: Float[Array, "h w"]
) -> list[Float[Array, "h w"]]:
    """Products of `corners.value` and the weights at the three corners, which sum to the interpolated value."""
    indices, shares = weights(corners, winner, column, row)
    return [share * corners.value[k] for share, k in zip(shares, indices, strict=True)]


def interpolated(
    corners: Corners, images: tuple[Int[Array, "h w"], Float[Array, "h w"], Float[Array, "h w"]]
) -> Float[Array, "h w"]:
    """Interpolated `corners.value` at each pixel, meaningless at pixels without a face.

    `images` are the arguments `winner`, `column` and `row` of `weights`.
    """
    return functools.reduce(operator.add, weighted(corners, *images))
