"""Pose codes of 12 numbers, and their rotation into a frame that follows the object's heading.

A pose code is the position divided by a scale, then the nine entries of the rotation matrix, row by row. A rotation of
the whole scene about the vertical changes neither gravity nor the plane of the pad. Physics and pictures are therefore
learnt in the frame of the object's heading, so that a network learns them for all headings at once.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sts_jax import geometry

CODE = 12  # numbers in a pose code
MOVE = CODE + 9  # numbers in a final pose code and in the rotation to it
LEVEL = 0.85  # least length of the horizontal part of an axis that is preferred as heading


def heading(code: Float[Array, "*n 12"]) -> Float[Array, "*n 2"]:
    """The horizontal direction of one of the object's axes, as cosine and sine of its angle from x.

    The axis is the first of the mesh's x and z axes that is almost level, or else the least steep of all three. An
    object that rests on one of its faces has a level axis, which makes the choice stable. No gradient flows through the
    heading.

    Args:
        code: Pose codes, whose nine numbers need not be an exact rotation.
    """
    columns = jax.lax.stop_gradient(code[..., 3:].reshape(*code.shape[:-1], 3, 3)[..., :2, :])
    lengths = jnp.linalg.norm(columns, axis=-2)
    least_steep = jnp.argmax(lengths, axis=-1)
    axis = jnp.where(lengths[..., 0] > LEVEL, 0, jnp.where(lengths[..., 2] > LEVEL, 2, least_steep))
    chosen = jnp.take_along_axis(columns, axis[..., None, None], axis=-1)[..., 0]
    length = jnp.linalg.norm(chosen, axis=-1, keepdims=True)
    # A belief without information about the rotation has no heading.
    return jnp.where(length > 1e-3, chosen / jnp.maximum(length, 1e-3), jnp.array([1.0, 0.0]))


def certainty(code: Float[Array, "*n 12"]) -> Float[Array, "*n"]:
    """Length of the longest horizontal part of an axis: at least 0.8 for a rotation, 0 for an unknown rotation."""
    return jnp.max(jnp.linalg.norm(matrix(code)[..., :2, :], axis=-2), axis=-1)


def matrix(code: Float[Array, "*n 12"]) -> Float[Array, "*n 3 3"]:
    """The rotations of pose codes as matrices, which need not be exact rotations."""
    return code[..., 3:].reshape(*code.shape[:-1], 3, 3)


def about_vertical(angle: Float[Array, "*n 2"]) -> Float[Array, "*n 3 3"]:
    """Rotation matrices about z. `angle` is the cosine and the sine."""
    cos, sin, zero = angle[..., 0], angle[..., 1], jnp.zeros_like(angle[..., 0])
    rows = [[cos, -sin, zero], [sin, cos, zero], [zero, zero, zero + 1]]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def nearest(turn: Float[Array, "*n 9"]) -> Float[Array, "*n 3 3"]:
    """The rotation matrices nearest to matrices that are given as nine numbers each."""
    return geometry.quat_to_matrix(geometry.quat_from_matrix(turn.reshape(*turn.shape[:-1], 3, 3)))


def rigid(code: Float[Array, "*n 12"]) -> Float[Array, "*n 12"]:
    """Pose codes whose nine numbers are replaced by the nearest rotation matrix."""
    quat = geometry.quat_from_matrix(code[..., 3:].reshape(*code.shape[:-1], 3, 3))
    return jnp.concatenate([code[..., :3], geometry.quat_to_matrix(quat).reshape(*code.shape[:-1], 9)], axis=-1)


def turn(angle: Float[Array, "*#n 2"], vector: Float[Array, "*#n 2"]) -> Float[Array, "*#n 2"]:
    """Vectors in the plane of the pad, turned by an angle. `angle` is the cosine and the sine."""
    cos, sin, x, y = angle[..., 0], angle[..., 1], vector[..., 0], vector[..., 1]
    return jnp.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def turn_back(angle: Float[Array, "*#n 2"], vector: Float[Array, "*#n 2"]) -> Float[Array, "*#n 2"]:
    """The inverse of `turn`."""
    return turn(angle * jnp.array([1.0, -1.0]), vector)


def turn_code(angle: Float[Array, "*#n 2"], code: Float[Array, "*#n 12"]) -> Float[Array, "*#n 12"]:
    """Pose codes after a rotation of the scene about the vertical through the sensor's origin."""
    position = jnp.concatenate([turn(angle, code[..., :2]), code[..., 2:3]], axis=-1)
    rows = code[..., 3:].reshape(*code.shape[:-1], 3, 3)
    level = turn(angle[..., None, :], jnp.swapaxes(rows[..., :2, :], -1, -2))
    rows = jnp.concatenate([jnp.swapaxes(level, -1, -2), rows[..., 2:, :]], axis=-2)
    return jnp.concatenate([position, rows.reshape(*code.shape[:-1], 9)], axis=-1)


def turn_code_back(angle: Float[Array, "*#n 2"], code: Float[Array, "*#n 12"]) -> Float[Array, "*#n 12"]:
    """The inverse of `turn_code`."""
    return turn_code(angle * jnp.array([1.0, -1.0]), code)


def turn_variance(angle: Float[Array, "*#n 2"], variance: Float[Array, "*#n 12"]) -> Float[Array, "*#n 12"]:
    """Variances of the components of turned pose codes, for independent components with the given variances."""
    cos, sin = angle[..., :1] ** 2, angle[..., 1:] ** 2

    def mixed(x: Float[Array, "*n k"], y: Float[Array, "*n k"]) -> list[Float[Array, "*n k"]]:
        return [cos * x + sin * y, sin * x + cos * y]

    x, y, z, first, second, third = jnp.split(variance, [1, 2, 3, 6, 9], axis=-1)
    return jnp.concatenate([*mixed(x, y), z, *mixed(first, second), third], axis=-1)
