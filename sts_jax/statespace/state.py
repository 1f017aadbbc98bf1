"""State codes: pose, shape and mass of an object, and its shape in the sensor's frame.

A state code has these parts, in this order:

- `pose`: the pose code, see `statespace.poses`
- `own`: the support function of the object's hull about the mesh origin, as harmonics in the object's frame
- `com`: the centre of mass in the object's frame
- `mass`: the logarithm of the mass
- `shown`: the support function in the sensor's frame, for the present rotation
- `low`: the centre of mass relative to the mesh origin, in the sensor's frame

The last two follow from the others. They are parts of the code because an image shows them directly, even if the
rotation is uncertain.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sts_jax import objects
from sts_jax.statespace import harmonics, poses

DEGREE = 6  # of the support function's harmonics
SUPPORT = harmonics.number(DEGREE)
LENGTH = 0.01  # m, unit of the support function and of the centre of mass
MEAN = 3.0  # of the support function, in this unit
MASS = 0.05  # kg, unit of the mass
SIZES = (poses.CODE, SUPPORT, 3, 1, SUPPORT, 3)
CODE = sum(SIZES)  # numbers in a state code


class State(NamedTuple):
    """The parts of a state code, or of its variance."""

    pose: Float[Array, "n 12"]
    own: Float[Array, "n k"]
    com: Float[Array, "n 3"]
    mass: Float[Array, "n 1"]
    shown: Float[Array, "n k"]
    low: Float[Array, "n 3"]


@functools.cache
def _fit() -> np.ndarray:
    """Matrix (128, k) of the least-squares fit of harmonics to values in `objects.DIRECTIONS`."""
    with jax.ensure_compile_time_eval():
        return np.linalg.pinv(np.asarray(harmonics.basis(jnp.asarray(objects.DIRECTIONS), DEGREE))).T


def split(code: Float[Array, "n code"]) -> State:
    """The parts of state codes."""
    return State(*jnp.split(code, np.cumsum(SIZES)[:-1], axis=-1))


def join(state: State) -> Float[Array, "n code"]:
    """The inverse of `split`."""
    return jnp.concatenate(state, axis=-1)


def encode(
    pose: Float[Array, "n 12"],
    support: Float[Array, "n 128"],
    mass: Float[Array, "n"],
    com: Float[Array, "n 3"],
) -> Float[Array, "n code"]:
    """State codes.

    Args:
        pose: Pose codes.
        support: Support function (m) of the hull in `objects.DIRECTIONS`, see `objects.support`.
        mass: Mass (kg).
        com: Centre of mass (m) in the mesh frame.
    """
    own = (support / LENGTH - MEAN) @ _fit()
    rotation = poses.matrix(pose)
    shown = harmonics.values(own[:, None], rotation, objects.DIRECTIONS)[:, 0] @ _fit()
    com = com / LENGTH
    low = jnp.einsum("nij,nj->ni", rotation, com)
    return join(State(pose, own, com, jnp.log(mass / MASS)[:, None], shown, low))


def turn(angle: Float[Array, "n 2"], state: State) -> State:
    """States after a rotation of the scene about the vertical through the sensor's origin."""
    return state._replace(
        pose=poses.turn_code(angle, state.pose),
        shown=harmonics.turn(angle, state.shown[:, None])[:, 0],
        low=jnp.concatenate([poses.turn(angle, state.low[:, :2]), state.low[:, 2:]], axis=-1),
    )


def turn_variance(angle: Float[Array, "n 2"], variance: State) -> State:
    """Variances of the parts of turned states, for independent numbers with the given variances."""
    cos, sin, (x, y, z) = angle[:, 0] ** 2, angle[:, 1] ** 2, variance.low.T
    return variance._replace(
        pose=poses.turn_variance(angle, variance.pose),
        shown=harmonics.turn_variance(angle, variance.shown[:, None])[:, 0],
        low=jnp.stack([cos * x + sin * y, sin * x + cos * y, z], axis=-1),
    )


def reach(state: State, rotation: Float[Array, "n 3 3"]) -> Float[Array, "n"]:
    """Distance (m) of an object's lowest point below its origin, after a rotation from the present state."""
    down = np.array([[0.0, 0.0, -1.0]], np.float32)
    return LENGTH * (MEAN + harmonics.values(state.shown[:, None], rotation, down)[:, 0, 0])


def heading(state: State) -> Float[Array, "n 2"]:
    """The direction of the object in the pad's plane, as cosine and sine of its angle from x.

    It is the direction of an axis of the mesh, see `poses.heading`. If the rotation is too uncertain, it is the long
    axis of the shown shape, with an arbitrary sign. No gradient flows through it.
    """
    state = jax.lax.stop_gradient(state)
    certain = poses.certainty(state.pose)[:, None] > 0.5
    # Order 2 of degree 2 is the second moment about the vertical.
    twice = jnp.arctan2(state.shown[:, 8], state.shown[:, 7])
    long = jnp.stack([jnp.cos(twice / 2), jnp.sin(twice / 2)], axis=-1)
    return jnp.where(certain, poses.heading(state.pose), long)
