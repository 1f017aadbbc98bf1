"""Pose codes of 12 numbers, and their rotation into a coordinate frame that follows the object's heading.

A pose code is the position divided by `training.Preprocessing.position_scale`, then the nine entries of the rotation
matrix, row by row. The rotation matrix maps the mesh frame to the sensor frame.

The heading of an object is a horizontal direction that turns with the object. On a level pad, a rotation of the whole
scene about the z axis changes neither gravity nor the plane of the pad. The transition and the decoder therefore work
in a coordinate frame whose x axis is the heading. They learn motions and images for all headings at once.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sts_jax import geometry

CODE = 12  # numbers in a pose code
MOVE = CODE + 9  # numbers in a final pose code and in the matrix of the rotation from the first to the final pose
LEVEL = 0.85  # an axis is level if the length of its projection onto the pad is above this


def heading(code: Float[Array, "*n 12"]) -> Float[Array, "*n 2"]:
    """The heading of each object: the direction of one of its mesh axes, projected onto the plane of the pad.

    A mesh axis counts as level if the projection of its unit vector is longer than 0.85. The chosen axis is x if x is
    level, else z if z is level, else the axis with the longest projection. The projection of an axis that is parallel
    to the pad has a length of 1, so this axis still counts as level after a small rotation. If the projection of the
    chosen axis is almost 0, the heading is the x axis of the sensor frame. No gradient flows through the heading.

    Args:
        code: Pose codes (position and rotation matrix). The matrix may be inexact, for example the mean of several
            rotation matrices.

    Returns:
        Cosine and sine of the angle from the x axis of the sensor frame to the heading.
    """
    columns = jax.lax.stop_gradient(code[..., 3:].reshape(*code.shape[:-1], 3, 3)[..., :2, :])
    lengths = jnp.linalg.norm(columns, axis=-2)
    least_steep = jnp.argmax(lengths, axis=-1)
    axis = jnp.where(lengths[..., 0] > LEVEL, 0, jnp.where(lengths[..., 2] > LEVEL, 2, least_steep))
    chosen = jnp.take_along_axis(columns, axis[..., None, None], axis=-1)[..., 0]
    length = jnp.linalg.norm(chosen, axis=-1, keepdims=True)
    # If nothing is known about the rotation, its mean is near zero and has no direction. The x axis replaces it.
    return jnp.where(length > 1e-3, chosen / jnp.maximum(length, 1e-3), jnp.array([1.0, 0.0]))


def certainty(code: Float[Array, "*n 12"]) -> Float[Array, "*n"]:
    """The certainty of each object's rotation. It is 0 for an unknown rotation, and at least 0.8 for a known rotation.

    The columns of a rotation matrix are the mesh axes, which have a length of 1. If the rotation is uncertain, the
    mean of its possible matrices has shorter columns. The certainty is the length of the longest projection of a column
    onto the plane of the pad.

    Args:
        code: Mean pose code (position and rotation matrix) of each object. The mean is over all poses that the object
            can have, weighted with their probability density.

    Returns:
        The certainty of each rotation.
    """
    return jnp.max(jnp.linalg.norm(matrix(code)[..., :2, :], axis=-2), axis=-1)


def matrix(code: Float[Array, "*n 12"]) -> Float[Array, "*n 3 3"]:
    """Return the 3x3 matrix in each pose code (position and rotation matrix).

    If a code is the mean of several pose codes, the returned matrix is the mean of several rotation matrices. Such a
    mean is in general not a rotation matrix.
    """
    return code[..., 3:].reshape(*code.shape[:-1], 3, 3)


def about_vertical(angle: Float[Array, "*n 2"]) -> Float[Array, "*n 3 3"]:
    """Matrices of rotations about the z axis. `angle[..., 0]` is the cosine of an angle, `angle[..., 1]` its sine."""
    cos, sin, zero = angle[..., 0], angle[..., 1], jnp.zeros_like(angle[..., 0])
    rows = [[cos, -sin, zero], [sin, cos, zero], [zero, zero, zero + 1]]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def nearest(turn: Float[Array, "*n 9"]) -> Float[Array, "*n 3 3"]:
    """The rotation matrix nearest to each given matrix. The last axis of `turn` lists the nine entries row by row."""
    return geometry.quat_to_matrix(geometry.quat_from_matrix(turn.reshape(*turn.shape[:-1], 3, 3)))


def rigid(code: Float[Array, "*n 12"]) -> Float[Array, "*n 12"]:
    """Replace the 3x3 matrix in each pose code (a position and a matrix) by the nearest rotation matrix."""
    quat = geometry.quat_from_matrix(code[..., 3:].reshape(*code.shape[:-1], 3, 3))
    return jnp.concatenate([code[..., :3], geometry.quat_to_matrix(quat).reshape(*code.shape[:-1], 9)], axis=-1)


def turn(angle: Float[Array, "*#n 2"], vector: Float[Array, "*#n 2"]) -> Float[Array, "*#n 2"]:
    """Rotate vectors (x, y) in the plane of the pad. `angle` has the cosine and the sine of each rotation angle."""
    cos, sin, x, y = angle[..., 0], angle[..., 1], vector[..., 0], vector[..., 1]
    return jnp.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def turn_back(angle: Float[Array, "*#n 2"], vector: Float[Array, "*#n 2"]) -> Float[Array, "*#n 2"]:
    """Rotate vectors (x, y) in the plane of the pad by minus an angle. `turn_back(angle, turn(angle, v))` equals `v`.

    `angle` has the cosine and the sine of each rotation angle.
    """
    return turn(angle * jnp.array([1.0, -1.0]), vector)


def turn_code(angle: Float[Array, "*#n 2"], code: Float[Array, "*#n 12"]) -> Float[Array, "*#n 12"]:
    """Compute the pose codes of objects after a rotation of the whole scene about the z axis of the sensor frame.

    Args:
        angle: Cosine and sine of the rotation angle.
        code: Pose codes (position and rotation matrix) before the rotation.

    Returns:
        Pose codes after the rotation.
    """
    position = jnp.concatenate([turn(angle, code[..., :2]), code[..., 2:3]], axis=-1)
    rows = code[..., 3:].reshape(*code.shape[:-1], 3, 3)
    level = turn(angle[..., None, :], jnp.swapaxes(rows[..., :2, :], -1, -2))
    rows = jnp.concatenate([jnp.swapaxes(level, -1, -2), rows[..., 2:, :]], axis=-2)
    return jnp.concatenate([position, rows.reshape(*code.shape[:-1], 9)], axis=-1)


def turn_code_back(angle: Float[Array, "*#n 2"], code: Float[Array, "*#n 12"]) -> Float[Array, "*#n 12"]:
    """Rotate pose codes about the z axis by the negative `angle`. This is the inverse of `turn_code`."""
    return turn_code(angle * jnp.array([1.0, -1.0]), code)


def turn_variance(angle: Float[Array, "*#n 2"], variance: Float[Array, "*#n 12"]) -> Float[Array, "*#n 12"]:
    """Compute the variances of pose codes after a rotation of the scene about the z axis of the sensor frame.

    Args:
        angle: Cosine and sine of the rotation angle.
        variance: Variances of the 12 numbers in the pose codes (position and rotation matrix). The numbers are assumed
            to be independent.

    Returns:
        Variances of the numbers after the rotation.
    """
    cos, sin = angle[..., :1] ** 2, angle[..., 1:] ** 2

    def mixed(x: Float[Array, "*n k"], y: Float[Array, "*n k"]) -> list[Float[Array, "*n k"]]:
        return [cos * x + sin * y, sin * x + cos * y]

    x, y, z, first, second, third = jnp.split(variance, [1, 2, 3, 6, 9], axis=-1)
    return jnp.concatenate([*mixed(x, y), z, *mixed(first, second), third], axis=-1)
