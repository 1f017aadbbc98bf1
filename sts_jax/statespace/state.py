"""State codes: numbers that describe the pose, the shape and the mass of an object in the first frame of a trajectory.

The shape is described by the support function of the object's convex hull: `h(d)` is the maximum of `x . d` over all
points x of the hull, that is, how far the hull reaches from the mesh origin in the direction d. `support_in_sensor`
and `com_in_sensor` follow from the other parts of a code. They are included because an image determines them directly,
even if the rotation of the mesh frame is uncertain.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sts_jax import objects
from sts_jax._checked import in_32_bits
from sts_jax.physics.roll import GONE_DEPTH
from sts_jax.statespace import harmonics, poses

DEGREE = 6  # largest degree of the spherical harmonics of a support function
SUPPORT = harmonics.number(DEGREE)  # number of coefficients of a support function
LENGTH = 0.01  # m, unit of support functions and of centres of mass
MEAN = 3.0  # subtracted from support functions, in units of LENGTH
MASS = 0.05  # kg, unit of the mass
SIZES = (poses.CODE, SUPPORT, 3, 1, SUPPORT, 3)  # numbers of each part
CODE = sum(SIZES)  # numbers in a state code


class State(NamedTuple):
    """The parts of n state codes in their order, or the variances of the parts."""

    pose: Float[Array, "n 12"]  # pose code
    support: Float[Array, "n k"]  # coefficients of the support function, for directions in the mesh frame
    com: Float[Array, "n 3"]  # centre of mass in the mesh frame, in units of 0.01 m
    mass: Float[Array, "n 1"]  # natural logarithm of the mass in units of 0.05 kg
    support_in_sensor: Float[Array, "n k"]  # coefficients of the support function, for directions in the sensor frame
    com_in_sensor: Float[Array, "n 3"]  # from mesh origin to centre of mass in the sensor frame, in units of 0.01 m


@functools.cache
def _fit() -> np.ndarray:
    """Matrix (128, k) that maps values at `objects.DIRECTIONS` to coefficients, as a least-squares fit."""
    with jax.ensure_compile_time_eval():
        return np.linalg.pinv(np.asarray(harmonics.basis(jnp.asarray(objects.DIRECTIONS), DEGREE))).T


def split(code: Float[Array, "n code"]) -> State:
    """Split state codes into their parts."""
    return State(*jnp.split(code, np.cumsum(SIZES)[:-1], axis=-1))


def join(state: State) -> Float[Array, "n code"]:
    """Join the parts of state codes."""
    return jnp.concatenate(state, axis=-1)


@in_32_bits
@jax.jit
def encode(
    pose: Float[Array, "n 12"],
    support: Float[Array, "n 128"],
    mass: Float[Array, "n"],
    com: Float[Array, "n 3"],
) -> Float[Array, "n code"]:
    """Encode the true states of n objects.

    Args:
        pose: Pose codes, from `training.Preprocessing.encode_pose`.
        support: Support functions of the convex hulls at `objects.DIRECTIONS` (m), from `objects.support`.
        mass: Masses (kg).
        com: Centres of mass in the mesh frame (m).
    """
    coefficients = (support / LENGTH - MEAN) @ _fit()
    rotation = poses.matrix(pose)
    in_sensor = harmonics.values(coefficients[:, None], rotation, objects.DIRECTIONS)[:, 0] @ _fit()
    com = com / LENGTH
    com_in_sensor = jnp.einsum("nij,nj->ni", rotation, com)
    return join(State(pose, coefficients, com, jnp.log(mass / MASS)[:, None], in_sensor, com_in_sensor))


def turn(angle: Float[Array, "n 2"], state: State) -> State:
    """State codes after a rotation of the whole scene about the z axis of the sensor frame."""
    return state._replace(
        pose=poses.turn_code(angle, state.pose),
        support_in_sensor=harmonics.turn(angle, state.support_in_sensor[:, None])[:, 0],
        com_in_sensor=jnp.concatenate(
            [poses.turn(angle, state.com_in_sensor[:, :2]), state.com_in_sensor[:, 2:]], axis=-1
        ),
    )


def reflection(code: Float[Array, "n code"]) -> Float[Array, "n code"]:
    """Factors of the numbers of state codes under the reflection x -> -x of the whole scene.

    In its mesh frame, each object is reflected across the coordinate plane that changes its shape the least, so that a
    reflected fork has its handle on the same side as other forks.
    """
    forms, sides = harmonics.reflected(SUPPORT), 1 - 2 * np.eye(3)
    across = sides[0]
    options = [
        np.concatenate([across, np.outer(across, own).ravel(), form, own, [1], forms[0], across])
        for own, form in zip(sides, forms, strict=True)
    ]
    change = jnp.einsum("nk,ak->na", split(code).support ** 2, (1 - forms) / 2)
    return jnp.asarray(np.stack(options), code.dtype)[jnp.argmin(change, axis=-1)]


def turn_variance(angle: Float[Array, "n 2"], variance: State) -> State:
    """Variances of state codes after `turn`, if their numbers are independent before."""
    cos, sin, (x, y, z) = angle[:, 0] ** 2, angle[:, 1] ** 2, variance.com_in_sensor.T
    return variance._replace(
        pose=poses.turn_variance(angle, variance.pose),
        support_in_sensor=harmonics.turn_variance(angle, variance.support_in_sensor[:, None])[:, 0],
        com_in_sensor=jnp.stack([cos * x + sin * y, sin * x + cos * y, z], axis=-1),
    )


def moved(state: State, position: Float[Array, "n 3"], rotation: Float[Array, "n 3 3"]) -> State:
    """State codes after a rotation in the sensor frame, with other position codes. All parts may be uncertain."""
    turned = harmonics.values(state.support_in_sensor[:, None], rotation, objects.DIRECTIONS)[:, 0] @ _fit()
    matrix = (rotation @ poses.matrix(state.pose)).reshape(len(position), 9)
    return state._replace(
        pose=jnp.concatenate([position, matrix], axis=-1),
        support_in_sensor=turned,
        com_in_sensor=jnp.einsum("nij,nj->ni", rotation, state.com_in_sensor),
    )


def moved_variance(variance: State, position: float, rotation: Float[Array, "n 3 3"]) -> State:
    """Variances of state codes after `moved`, if their numbers are independent before. `position` is a new variance.

    The variances of the parts in the sensor frame stay the same.
    """
    matrix = (rotation**2 @ poses.matrix(variance.pose)).reshape(len(rotation), 9)
    pose = jnp.concatenate([jnp.full_like(variance.pose[:, :3], position), matrix], axis=-1)
    return variance._replace(pose=pose)


def reach(state: State, rotation: Float[Array, "n 3 3"], *, up: bool = False) -> Float[Array, "n"]:
    """How far each object reaches below (or above) its mesh origin (m), after a rotation in the sensor frame."""
    direction = np.array([[0.0, 0.0, 1.0 if up else -1.0]], np.float32)
    return LENGTH * (MEAN + harmonics.values(state.support_in_sensor[:, None], rotation, direction)[:, 0, 0])


def gone(state: State, height: Float[Array, "n"], rotation: Float[Array, "n 3 3"]) -> Bool[Array, "n"]:
    """Whether each object has left the pad and no longer moves, from the height of its origin (m) and its rotation."""
    return height + reach(state, rotation, up=True) < -GONE_DEPTH


def heading(state: State) -> Float[Array, "n 2"]:
    """The heading of each object, from mean state codes.

    If the rotation is known, it is `poses.heading`. Otherwise, it is the long axis of the object's shape in the plane
    of the pad, with an arbitrary sign. No gradient flows through the heading.
    """
    state = jax.lax.stop_gradient(state)
    # The longest projection of a mesh axis onto the pad is at least 0.8 for a known rotation. An uncertain rotation is
    # a mean of several matrices, whose columns are shorter.
    projections = jnp.linalg.norm(poses.matrix(state.pose)[..., :2, :], axis=-2)
    certain = jnp.max(projections, axis=-1)[:, None] > 0.5
    # The harmonics of degree 2 and orders 2 and -2 give twice the angle of the long axis.
    twice = jnp.arctan2(state.support_in_sensor[:, 8], state.support_in_sensor[:, 7])
    long = jnp.stack([jnp.cos(twice / 2), jnp.sin(twice / 2)], axis=-1)
    return jnp.where(certain, poses.heading(state.pose), long)
