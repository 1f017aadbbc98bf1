"""Pose codes of 12 numbers, and their rotation into a coordinate frame that follows the object's heading.

A pose code is the position divided by `training.Preprocessing.position_scale`, then the nine entries of the rotation
matrix, row by row.

On a level pad, a rotation of the whole scene about the z axis changes neither gravity nor the plane of the pad. The
transition and the decoder therefore work in a frame whose x axis is the heading, a horizontal direction that turns with
the object. They learn motions and images for all headings at once. An angle is given by its cosine and its sine.

A motion from one pose to another has 6 numbers: the difference of the position codes, then the vector of the rotation
(rad), in the sensor frame. The motion over one step of a one-step model is its velocity.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sts_jax import geometry

CODE = 12  # numbers in a pose code
MOVE = CODE + 9  # numbers in a final pose code and in the matrix of the rotation from the first to the final pose
MOTION = 6  # numbers in a motion
LEVEL = 0.85  # an axis is level if the length of its projection onto the pad is above this


def heading(code: Float[Array, "*n 12"]) -> Float[Array, "*n 2"]:
    """The heading of each object: the direction of one of its mesh axes, projected onto the plane of the pad.

    A mesh axis counts as level if the projection of its unit vector is longer than 0.85. The chosen axis is x if x is
    level, else z if z is level, else the axis with the longest projection. A level axis stays level after a small
    rotation. If the projection of the chosen axis is almost 0, the heading is the x axis of the sensor frame. No
    gradient flows through the heading. The matrix of `code` may be a mean of several rotation matrices.
    """
    columns = jax.lax.stop_gradient(matrix(code)[..., :2, :])
    lengths = jnp.linalg.norm(columns, axis=-2)
    least_steep = jnp.argmax(lengths, axis=-1)
    axis = jnp.where(lengths[..., 0] > LEVEL, 0, jnp.where(lengths[..., 2] > LEVEL, 2, least_steep))
    chosen = jnp.take_along_axis(columns, axis[..., None, None], axis=-1)[..., 0]
    length = jnp.linalg.norm(chosen, axis=-1, keepdims=True)
    # If nothing is known about the rotation, its mean is near zero and has no direction. The x axis replaces it.
    return jnp.where(length > 1e-3, chosen / jnp.maximum(length, 1e-3), jnp.array([1.0, 0.0]))


def matrix(code: Float[Array, "*n 12"]) -> Float[Array, "*n 3 3"]:
    """The 3x3 matrix in each pose code. For a mean of several codes, it is in general not a rotation matrix."""
    return code[..., 3:].reshape(*code.shape[:-1], 3, 3)


def about_vertical(angle: Float[Array, "*n 2"]) -> Float[Array, "*n 3 3"]:
    """Matrices of rotations about the z axis."""
    cos, sin, zero = angle[..., 0], angle[..., 1], jnp.zeros_like(angle[..., 0])
    rows = [[cos, -sin, zero], [sin, cos, zero], [zero, zero, zero + 1]]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def nearest(turn: Float[Array, "*n 9"]) -> Float[Array, "*n 3 3"]:
    """The rotation matrix nearest to each matrix of nine entries."""
    return geometry.quat_to_matrix(geometry.quat_from_matrix(turn.reshape(*turn.shape[:-1], 3, 3)))


def rigid(code: Float[Array, "*n 12"]) -> Float[Array, "*n 12"]:
    """Replace the matrix in each pose code by the nearest rotation matrix."""
    return jnp.concatenate([code[..., :3], nearest(code[..., 3:]).reshape(*code.shape[:-1], 9)], axis=-1)


def turn(angle: Float[Array, "*#n 2"], vector: Float[Array, "*#n 2"]) -> Float[Array, "*#n 2"]:
    """Rotate vectors in the plane of the pad by an angle."""
    cos, sin, x, y = angle[..., 0], angle[..., 1], vector[..., 0], vector[..., 1]
    return jnp.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def turn_back(angle: Float[Array, "*#n 2"], vector: Float[Array, "*#n 2"]) -> Float[Array, "*#n 2"]:
    """Rotate vectors in the plane of the pad by minus an angle, the inverse of `turn`."""
    return turn(angle * jnp.array([1.0, -1.0]), vector)


def turn_code(angle: Float[Array, "*#n 2"], code: Float[Array, "*#n 12"]) -> Float[Array, "*#n 12"]:
    """Pose codes after a rotation of the whole scene about the z axis of the sensor frame."""
    position = jnp.concatenate([turn(angle, code[..., :2]), code[..., 2:3]], axis=-1)
    rows = matrix(code)
    level = turn(angle[..., None, :], jnp.swapaxes(rows[..., :2, :], -1, -2))
    rows = jnp.concatenate([jnp.swapaxes(level, -1, -2), rows[..., 2:, :]], axis=-2)
    return jnp.concatenate([position, rows.reshape(*code.shape[:-1], 9)], axis=-1)


def turn_code_back(angle: Float[Array, "*#n 2"], code: Float[Array, "*#n 12"]) -> Float[Array, "*#n 12"]:
    """The inverse of `turn_code`."""
    return turn_code(angle * jnp.array([1.0, -1.0]), code)


def turn_variance(angle: Float[Array, "*#n 2"], variance: Float[Array, "*#n 12"]) -> Float[Array, "*#n 12"]:
    """Variances of pose codes after `turn_code`, if their numbers are independent before."""
    cos, sin = angle[..., :1] ** 2, angle[..., 1:] ** 2

    def mixed(x: Float[Array, "*n k"], y: Float[Array, "*n k"]) -> list[Float[Array, "*n k"]]:
        return [cos * x + sin * y, sin * x + cos * y]

    x, y, z, first, second, third = jnp.split(variance, [1, 2, 3, 6, 9], axis=-1)
    return jnp.concatenate([*mixed(x, y), z, *mixed(first, second), third], axis=-1)


def motion(before: Float[Array, "*n 12"], after: Float[Array, "*n 12"]) -> Float[Array, "*n 6"]:
    """The motion from one pose to another."""
    turned = matrix(after) @ jnp.swapaxes(matrix(before), -1, -2)
    vector = geometry.quat_to_rotvec(geometry.quat_from_matrix(turned))
    return jnp.concatenate([after[..., :3] - before[..., :3], vector], axis=-1)


def advanced(code: Float[Array, "*n 12"], move: Float[Array, "*n 6"]) -> Float[Array, "*n 12"]:
    """Pose codes after a motion, the inverse of `motion`."""
    turned = geometry.quat_to_matrix(geometry.quat_from_rotvec(move[..., 3:])) @ matrix(code)
    return jnp.concatenate([code[..., :3] + move[..., :3], turned.reshape(*code.shape[:-1], 9)], axis=-1)


def turn_motion(angle: Float[Array, "*#n 2"], move: Float[Array, "*#n 6"]) -> Float[Array, "*n 6"]:
    """Motions after a rotation of the whole scene about the z axis of the sensor frame."""
    along, about = turn(angle, move[..., :2]), turn(angle, move[..., 3:5])
    return jnp.concatenate([along, move[..., 2:3], about, move[..., 5:]], axis=-1)


def turn_motion_back(angle: Float[Array, "*#n 2"], move: Float[Array, "*#n 6"]) -> Float[Array, "*n 6"]:
    """The inverse of `turn_motion`."""
    return turn_motion(angle * jnp.array([1.0, -1.0]), move)
