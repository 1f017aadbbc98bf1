"""Symmetries of the pad: reflections and quarter turns of poses, wrenches and conditions.

Symmetry s is a rotation about the z axis by `90 * (s % 4)` degrees. If s >= 4, a reflection (y becomes -y) precedes the
rotation. Symmetry 0 is the identity.
"""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from sts_jax import geometry


def turn(pose: Float[Array, "*n 7"], symmetry: int) -> Float[Array, "*n 7"]:
    """Rotate or mirror poses. Symmetries 4 to 7 give poses of the mirrored body, `objects.mirror(body)`."""
    if symmetry >= 4:
        pose = pose * jnp.array([1.0, -1, 1, 1, -1, 1, -1])
    spin = geometry.quat_from_rotvec(jnp.array([0.0, 0.0, symmetry % 4 * math.pi / 2]))
    position = geometry.transform(jnp.concatenate([jnp.zeros(3), spin]), pose[..., :3])
    spin = jnp.broadcast_to(spin, (*pose.shape[:-1], 4))
    return jnp.concatenate([position, geometry.quat_canonical(geometry.quat_multiply(spin, pose[..., 3:]))], -1)


def turn_wrench(wrench: Float[Array, "*n 6"], symmetry: int) -> Float[Array, "*n 6"]:
    """Rotate or mirror wrenches: force (N) and moment about the sensor's origin (N m)."""
    if symmetry >= 4:
        wrench = wrench * jnp.array([1.0, -1, 1, -1, 1, -1])
    spin = geometry.quat_from_rotvec(jnp.array([0.0, 0.0, symmetry % 4 * math.pi / 2]))
    pair = wrench.reshape(*wrench.shape[:-1], 2, 3)
    return geometry.transform(jnp.concatenate([jnp.zeros(3), spin]), pair).reshape(wrench.shape)


def turn_condition(condition: Float[Array, "*n c"], symmetry: int, vectors: int = 1) -> Float[Array, "*n c"]:
    """Rotate or mirror conditions.

    Args:
        condition: Vectors (x, y) in the plane of the pad come first. The scalars after them stay as they are.
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
