"""Symmetries of the pad: reflections and quarter turns of poses, wrenches and conditions.

Symmetry s is a rotation about the z axis by `90 * (s % 4)` degrees. If s >= 4, a reflection (y becomes -y) precedes the
rotation. Symmetry 0 is the identity.

A condition is the input that a scenario applies to a trajectory, such as an acceleration of the pad.
"""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from sts_jax import geometry


def turn(pose: Float[Array, "*n 7"], symmetry: int) -> Float[Array, "*n 7"]:
    """Rotate or mirror poses by a symmetry of the pad.

    Symmetries 4 to 7 mirror the object. The results of these symmetries are poses of the mirrored body,
    `objects.mirror(body)`.

    Args:
        pose: Pose of the object (its mesh frame) in the sensor frame: position (m) and quaternion (w, x, y, z).
        symmetry: Number of the symmetry, 0 to 7. Symmetry s is a rotation about the z axis by `90 * (s % 4)` degrees.
            If s >= 4, a reflection (y becomes -y) precedes the rotation. Symmetry 0 is the identity.
    """
    if symmetry >= 4:
        pose = pose * jnp.array([1.0, -1, 1, 1, -1, 1, -1])
    spin = geometry.quat_from_rotvec(jnp.array([0.0, 0.0, symmetry % 4 * math.pi / 2]))
    position = geometry.transform(jnp.concatenate([jnp.zeros(3), spin]), pose[..., :3])
    spin = jnp.broadcast_to(spin, (*pose.shape[:-1], 4))
    return jnp.concatenate([position, geometry.quat_canonical(geometry.quat_multiply(spin, pose[..., 3:]))], -1)


def turn_wrench(wrench: Float[Array, "*n 6"], symmetry: int) -> Float[Array, "*n 6"]:
    """Rotate or mirror wrenches by a symmetry of the pad.

    Args:
        wrench: Force (N) and moment about the sensor's origin (N m).
        symmetry: Number of the symmetry, 0 to 7. Symmetry s is a rotation about the z axis by `90 * (s % 4)` degrees.
            If s >= 4, a reflection (y becomes -y) precedes the rotation. Symmetry 0 is the identity.
    """
    if symmetry >= 4:
        wrench = wrench * jnp.array([1.0, -1, 1, -1, 1, -1])
    spin = geometry.quat_from_rotvec(jnp.array([0.0, 0.0, symmetry % 4 * math.pi / 2]))
    pair = wrench.reshape(*wrench.shape[:-1], 2, 3)
    return geometry.transform(jnp.concatenate([jnp.zeros(3), spin]), pair).reshape(wrench.shape)


def turn_condition(condition: Float[Array, "*n c"], symmetry: int, vectors: int = 1) -> Float[Array, "*n c"]:
    """Rotate or mirror conditions by a symmetry of the pad.

    A condition is the input that a scenario applies to a trajectory, such as an acceleration of the pad.

    Args:
        condition: The c components of each condition. Vectors (x, y) in the plane of the pad come first, and scalars
            follow. The symmetries do not change the scalars.
        symmetry: Number of the symmetry, 0 to 7. Symmetry s is a rotation about the z axis by `90 * (s % 4)` degrees.
            If s >= 4, a reflection (y becomes -y) precedes the rotation. Symmetry 0 is the identity.
        vectors: Number of vectors at the beginning of the condition.
    """
    if condition.shape[-1] == 0:
        return condition
    parts = [condition[..., 2 * vectors :]]
    for place in reversed(range(0, 2 * vectors, 2)):
        vector = jnp.concatenate([condition[..., place : place + 2], jnp.zeros((*condition.shape[:-1], 4))], -1)
        parts.insert(0, turn_wrench(vector, symmetry)[..., :2])
    return jnp.concatenate(parts, -1)
