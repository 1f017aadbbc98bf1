"""Interpolation between the corners of the face that is nearest at each pixel."""

import functools
import operator
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sts_jax import optics


class Corners(NamedTuple):
    """The vertices of an object on the screen, and its faces."""

    column: Float[Array, "v"]  # pixels
    row: Float[Array, "v"]  # pixels
    value: Float[Array, "v"]  # 1 / depth (1/m) in the camera's view, height (m) on the gel's grid
    faces: Int[Array, "f 3"]  # vertex indices


def weights(
    corners: Corners, winner: Int[Array, "h w"], column: Float[Array, "h w"], row: Float[Array, "h w"]
) -> tuple[list[Int[Array, "h w"]], tuple[Float[Array, "h w"], ...]]:
    """Vertex indices and weights of the three corners of the face that wins each pixel.

    Pixels in which no face wins get those of face 0.
    """
    of_face = corners.faces[jnp.maximum(winner, 0)]
    indices = [of_face[..., k] for k in range(3)]
    return indices, optics.barycentrics([(corners.column[k], corners.row[k]) for k in indices], column, row)


def weighted(
    corners: Corners, winner: Int[Array, "h w"], column: Float[Array, "h w"], row: Float[Array, "h w"]
) -> list[Float[Array, "h w"]]:
    """Value of each corner of the winning face, times its weight. Their sum is the interpolated value."""
    indices, shares = weights(corners, winner, column, row)
    return [share * corners.value[k] for share, k in zip(shares, indices, strict=True)]


def interpolated(
    corners: Corners, images: tuple[Int[Array, "h w"], Float[Array, "h w"], Float[Array, "h w"]]
) -> Float[Array, "h w"]:
    """Interpolated value of the winning faces, from the images `(winner, column, row)`."""
    return functools.reduce(operator.add, weighted(corners, *images))
