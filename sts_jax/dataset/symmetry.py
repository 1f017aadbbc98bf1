"""Symmetries of the pad: mirror images and quarter turns of poses, wrenches and conditions.

Symmetry s first mirrors (y becomes -y) if s >= 4, and then turns by s % 4 quarter turns about z. 0 is the identity.
"""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from sts_jax import geometry


def turn(pose: Float[Array, "*n 7"], symmetry: int) -> Float[Array, "*n 7"]:
    """Transform a pose by a symmetry of the pad.

    A mirrored pose is the pose of the mirrored body, see `objects.mirror`.

    Args:
        pose: Pose of the mesh frame in the sensor frame, position (m) and quaternion.
        symmetry: Number of the symmetry, 0 to 7.
    """
    if symmetry >= 4:
        pose = pose * jnp.array([1.0, -1, 1, 1, -1, 1, -1])
    spin = geometry.quat_from_rotvec(jnp.array([0.0, 0.0, symmetry % 4 * math.pi / 2]))
    position = geometry.transform(jnp.concatenate([jnp.zeros(3), spin]), pose[..., :3])
    spin = jnp.broadcast_to(spin, (*pose.shape[:-1], 4))
    return jnp.concatenate([position, geometry.quat_canonical(geometry.quat_multiply(spin, pose[..., 3:]))], -1)


def turn_wrench(wrench: Float[Array, "*n 6"], symmetry: int) -> Float[Array, "*n 6"]:
    """Transform a wrench by a symmetry of the pad.

    Args:
        wrench: Force (N) and moment about the sensor's origin (N m).
        symmetry: Number of the symmetry, 0 to 7.
    """
    if symmetry >= 4:
        wrench = wrench * jnp.array([1.0, -1, 1, -1, 1, -1])
    spin = geometry.quat_from_rotvec(jnp.array([0.0, 0.0, symmetry % 4 * math.pi / 2]))
    pair = wrench.reshape(*wrench.shape[:-1], 2, 3)
    return geometry.transform(jnp.concatenate([jnp.zeros(3), spin]), pair).reshape(wrench.shape)


def turn_condition(condition: Float[Array, "*n c"], symmetry: int, vectors: int = 1) -> Float[Array, "*n c"]:
    """Transform the condition of a scenario by a symmetry of the pad.

    Args:
        condition: Vectors (x, y) in the plane of the pad, followed by scalars, which do not change.
        symmetry: Number of the symmetry, 0 to 7.
        vectors: Number of vectors at the beginning of the condition.
    """
    if condition.shape[-1] == 0:
        return condition
    parts = [condition[..., 2 * vectors :]]
    for place in reversed(range(0, 2 * vectors, 2)):
        vector = jnp.concatenate([condition[..., place : place + 2], jnp.zeros((*condition.shape[:-1], 4))], -1)
        parts.insert(0, turn_wrench(vector, symmetry)[..., :2])
    return jnp.concatenate(parts, -1)
