"""State codes: numbers that describe the pose, the shape and the mass of an object in the first frame of a trajectory.

The shape is described by the support function of the object's convex hull: `h(d)` is the maximum of `x . d` over all
points x of the hull, that is, how far the hull reaches from the mesh origin in the direction d. A state code has these
parts, in this order:

- `pose`: the pose code, see `statespace.poses`
- `own`: the support function as coefficients of spherical harmonics, for directions in the mesh frame
- `com`: the centre of mass in the mesh frame
- `mass`: the logarithm of the mass
- `shown`: the support function for directions in the sensor frame, which depends on the object's rotation
- `low`: the vector from the mesh origin to the centre of mass, in the axes of the sensor frame

`shown` and `low` follow from the other parts. The code includes them because an image determines them directly, even
if the rotation of the mesh frame is uncertain.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sts_jax import objects
from sts_jax.statespace import harmonics, poses

DEGREE = 6  # largest degree of the spherical harmonics of a support function
SUPPORT = harmonics.number(DEGREE)  # number of coefficients of a support function
LENGTH = 0.01  # m, unit of support functions and of centres of mass
MEAN = 3.0  # subtracted from support functions, in units of LENGTH
MASS = 0.05  # kg, unit of the mass
SIZES = (poses.CODE, SUPPORT, 3, 1, SUPPORT, 3)  # numbers of each part
CODE = sum(SIZES)  # numbers in a state code


class State(NamedTuple):
    """State codes of n objects, split into the parts that describe the pose, the shape and the mass.

    The shape is given by the support function `h(d)` of the convex hull: the maximum of `x . d` over the points x of
    the hull, for a unit vector d. A `State` holds either the parts of the state codes or the variances of
    the parts.
    """

    pose: Float[Array, "n 12"]  # pose code
    own: Float[Array, "n k"]  # coefficients of the support function, for directions in the mesh frame
    com: Float[Array, "n 3"]  # centre of mass in the mesh frame, in units of 0.01 m
    mass: Float[Array, "n 1"]  # natural logarithm of the mass in units of 0.05 kg
    shown: Float[Array, "n k"]  # coefficients of the support function, for directions in the sensor frame
    low: Float[Array, "n 3"]  # vector from mesh origin to centre of mass in the sensor frame, in units of 0.01 m


@functools.cache
def _fit() -> np.ndarray:
    """Matrix (128, k) that maps values at `objects.DIRECTIONS` to coefficients, as a least-squares fit."""
    with jax.ensure_compile_time_eval():
        return np.linalg.pinv(np.asarray(harmonics.basis(jnp.asarray(objects.DIRECTIONS), DEGREE))).T


def split(code: Float[Array, "n code"]) -> State:
    """Split state codes into their parts: pose, shape and mass, see `State`."""
    return State(*jnp.split(code, np.cumsum(SIZES)[:-1], axis=-1))


def join(state: State) -> Float[Array, "n code"]:
    """Join the parts of n state codes (pose, shape and mass, see `State`) into n vectors.

    This function is the inverse of `split`.
    """
    return jnp.concatenate(state, axis=-1)


def encode(
    pose: Float[Array, "n 12"],
    support: Float[Array, "n 128"],
    mass: Float[Array, "n"],
    com: Float[Array, "n 3"],
) -> Float[Array, "n code"]:
    """Encode the true pose, shape and mass of each of n objects as a state code, which is one vector.

    Args:
        pose: Pose codes (position and rotation matrix), from `training.Preprocessing.encode_pose`.
        support: Support functions of the convex hulls (m), from `objects.support`. For each of the 128 unit vectors d
            in `objects.DIRECTIONS`, the value is the maximum of `x . d` over the points x of the hull.
        mass: Masses (kg).
        com: Centres of mass in the mesh frame (m).

    Returns:
        State codes. A code consists of the fields of `State`, concatenated in their order.
    """
    own = (support / LENGTH - MEAN) @ _fit()
    rotation = poses.matrix(pose)
    shown = harmonics.values(own[:, None], rotation, objects.DIRECTIONS)[:, 0] @ _fit()
    com = com / LENGTH
    low = jnp.einsum("nij,nj->ni", rotation, com)
    return join(State(pose, own, com, jnp.log(mass / MASS)[:, None], shown, low))


def turn(angle: Float[Array, "n 2"], state: State) -> State:
    """Compute the state codes of objects after a rotation of the whole scene about the z axis of the sensor frame.

    A state code describes the pose, the shape and the mass of an object.

    Args:
        angle: Cosine and sine of the rotation angle of each object.
        state: State codes before the rotation, split into their parts.

    Returns:
        State codes after the rotation, split into their parts.
    """
    return state._replace(
        pose=poses.turn_code(angle, state.pose),
        shown=harmonics.turn(angle, state.shown[:, None])[:, 0],
        low=jnp.concatenate([poses.turn(angle, state.low[:, :2]), state.low[:, 2:]], axis=-1),
    )


def turn_variance(angle: Float[Array, "n 2"], variance: State) -> State:
    """Compute the variances of state codes after a rotation of the scene about the z axis of the sensor frame.

    A state code consists of numbers that describe the pose, the shape and the mass of an object.

    Args:
        angle: Cosine and sine of the rotation angle for each of the n state codes.
        variance: Variances of the numbers in the state codes. The numbers are assumed to be independent.

    Returns:
        Variances of the numbers after the rotation.
    """
    cos, sin, (x, y, z) = angle[:, 0] ** 2, angle[:, 1] ** 2, variance.low.T
    return variance._replace(
        pose=poses.turn_variance(angle, variance.pose),
        shown=harmonics.turn_variance(angle, variance.shown[:, None])[:, 0],
        low=jnp.stack([cos * x + sin * y, sin * x + cos * y, z], axis=-1),
    )


def reach(state: State, rotation: Float[Array, "n 3 3"]) -> Float[Array, "n"]:
    """Compute the height of the mesh origin above the lowest point of each object, after a rotation of the object.

    Args:
        state: State codes (pose, shape and mass) before the rotation, split into their parts.
        rotation: Matrices of the rotation in the sensor frame.

    Returns:
        Heights along the z axis of the sensor frame (m).
    """
    down = np.array([[0.0, 0.0, -1.0]], np.float32)
    return LENGTH * (MEAN + harmonics.values(state.shown[:, None], rotation, down)[:, 0, 0])


def heading(state: State) -> Float[Array, "n 2"]:
    """Compute the heading of each object: a direction that lies in the plane of the pad and turns with the object.

    If `poses.certainty` is above 0.5, the rotation is known well enough, and the heading is the direction of one of the
    mesh axes, see `poses.heading`. Otherwise, the heading is the long axis of the object's shape in the plane of the
    pad, with an arbitrary sign. The long axis is computed from `State.shown`, the support function in the sensor frame.
    An image determines the support function even if the rotation of the mesh is uncertain. No gradient flows through
    the heading.

    Args:
        state: State codes (pose, shape and mass), split into their parts. If the state codes are uncertain, pass their
            means.

    Returns:
        Cosine and sine of the angle from the x axis of the sensor frame to the heading.
    """
    state = jax.lax.stop_gradient(state)
    certain = poses.certainty(state.pose)[:, None] > 0.5  # 0 for an unknown rotation, at least 0.8 for a known one
    # The harmonics of degree 2 and orders 2 and -2 give twice the angle of the long axis.
    twice = jnp.arctan2(state.shown[:, 8], state.shown[:, 7])
    long = jnp.stack([jnp.cos(twice / 2), jnp.sin(twice / 2)], axis=-1)
    return jnp.where(certain, poses.heading(state.pose), long)
