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
    """The parts of state codes, as in the docstring of the module, or the variances of these parts."""

    pose: Float[Array, "n 12"]
    own: Float[Array, "n k"]
    com: Float[Array, "n 3"]
    mass: Float[Array, "n 1"]
    shown: Float[Array, "n k"]
    low: Float[Array, "n 3"]


@functools.cache
def _fit() -> np.ndarray:
    """Matrix (128, k) that maps values at `objects.DIRECTIONS` to coefficients, as a least-squares fit."""
    with jax.ensure_compile_time_eval():
        return np.linalg.pinv(np.asarray(harmonics.basis(jnp.asarray(objects.DIRECTIONS), DEGREE))).T


def split(code: Float[Array, "n code"]) -> State:
    """Split state codes into their parts."""
    return State(*jnp.split(code, np.cumsum(SIZES)[:-1], axis=-1))


def join(state: State) -> Float[Array, "n code"]:
    """Join parts to state codes. This is the inverse of `split`."""
    return jnp.concatenate(state, axis=-1)


def encode(
    pose: Float[Array, "n 12"],
    support: Float[Array, "n 128"],
    mass: Float[Array, "n"],
    com: Float[Array, "n 3"],
) -> Float[Array, "n code"]:
    """Encode the true states of objects.

    Args:
        pose: Pose codes, from `training.Preprocessing.encode_pose`.
        support: Support functions at `objects.DIRECTIONS`, from `objects.support` (m).
        mass: Masses (kg).
        com: Centres of mass in the mesh frame (m).

    Returns:
        State codes with the parts that the docstring of the module lists.
    """
    own = (support / LENGTH - MEAN) @ _fit()
    rotation = poses.matrix(pose)
    shown = harmonics.values(own[:, None], rotation, objects.DIRECTIONS)[:, 0] @ _fit()
    com = com / LENGTH
    low = jnp.einsum("nij,nj->ni", rotation, com)
    return join(State(pose, own, com, jnp.log(mass / MASS)[:, None], shown, low))


def turn(angle: Float[Array, "n 2"], state: State) -> State:
    """Rotate the scene about the z axis of the sensor frame.

    Args:
        angle: Cosine and sine of the rotation angle.
        state: Parts of state codes.

    Returns:
        Parts of the state codes after the rotation.
    """
    return state._replace(
        pose=poses.turn_code(angle, state.pose),
        shown=harmonics.turn(angle, state.shown[:, None])[:, 0],
        low=jnp.concatenate([poses.turn(angle, state.low[:, :2]), state.low[:, 2:]], axis=-1),
    )


def turn_variance(angle: Float[Array, "n 2"], variance: State) -> State:
    """Variances of state codes after a rotation about the z axis of the sensor frame.

    Args:
        angle: Cosine and sine of the rotation angle.
        variance: Variances of the numbers of the state codes, which are assumed to be independent.

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
    """Height of the mesh origin above the lowest point of an object, after a further rotation.

    Args:
        state: Parts of state codes.
        rotation: Rotation matrices from the orientation in `state` to the new one.

    Returns:
        Heights along the z axis of the sensor frame (m).
    """
    down = np.array([[0.0, 0.0, -1.0]], np.float32)
    return LENGTH * (MEAN + harmonics.values(state.shown[:, None], rotation, down)[:, 0, 0])


def heading(state: State) -> Float[Array, "n 2"]:
    """The heading of each object: a direction in the plane of the pad that turns with the object.

    It is the direction of one of the mesh axes, see `poses.heading`. If the rotation is too uncertain, it is the long
    axis of `shown` in the plane of the pad, with an arbitrary sign. No gradient flows through the heading.

    Args:
        state: Parts of state codes, or their means under a belief.

    Returns:
        Cosine and sine of the angle from the x axis to the heading.
    """
    state = jax.lax.stop_gradient(state)
    certain = poses.certainty(state.pose)[:, None] > 0.5  # 0 for an unknown rotation, at least 0.8 for a known one
    # The harmonics of degree 2 and orders 2 and -2 give twice the angle of the long axis.
    twice = jnp.arctan2(state.shown[:, 8], state.shown[:, 7])
    long = jnp.stack([jnp.cos(twice / 2), jnp.sin(twice / 2)], axis=-1)
    return jnp.where(certain, poses.heading(state.pose), long)
