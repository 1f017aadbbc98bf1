"""Draw the random starts of trajectories, and the hidden properties of the objects, such as friction and contents."""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int, PRNGKeyArray

from sts_jax._checked import check_key
from sts_jax.objects.body import Body
from sts_jax.physics.arguments import check_arguments, listed
from sts_jax.physics.bodies import shapes
from sts_jax.physics.scenario import Hidden, Scenario, Shape, Start
from sts_jax.sensor import Sensor

_FURTHER = 2**32 - 1  # `starts` folds it into the key. `simulate` folds in the indices of bodies, which are smaller


class Starts(NamedTuple):
    """Random starts of one or more bodies. A start consists of an initial pose and the hidden properties of the body.

    Each array has the length n, which is the number of starts of all bodies together. All starts of the first body come
    first, then all starts of the second body, and so on.
    """

    pose: Float[Array, "n 7"]  # Mesh frame in the sensor frame: position (m) and quaternion with w >= 0.
    hidden: Hidden  # Hidden properties of each start: arrays of shape (n,), and `up` of shape (n, 3).
    body: Int[Array, "n"]  # Index of the body in the sequence of bodies.


@functools.partial(jax.jit, static_argnames=("scenario", "pad"))
def draw(
    key: PRNGKeyArray,
    body: Int[Array | np.ndarray, "n"],
    nth: Int[Array | np.ndarray, "n"],
    attempt: Int[Array | np.ndarray, "n"],
    shapes: Shape,
    scenario: Scenario,
    pad: tuple[float, float],
) -> tuple[Start, Hidden]:
    """Draw a `Start` and the hidden properties (friction, mass of the shell, contents) of each of n trajectories.

    The draw with index i depends on `key`, on `body[i]`, `nth[i]` and `attempt[i]`, and on the geometry of the body
    `body[i]`. The draw does not depend on the other draws. In the scenario `Inclined`, a draw can change if the
    arrays in `shapes` are padded to another number of faces.

    Args:
        key: Key of all draws.
        body: Index of the body of each draw, (n,).
        nth: Number of each draw among the draws of the same body, (n,), from 0.
        attempt: Number of times that the trajectory was drawn before and failed, (n,), from 0.
        shapes: Geometry of all bodies, with a leading axis of bodies.
        scenario: Scenario whose methods `start` and `hidden` are called.
        pad: Size of the pad along x and y (m).

    Returns:
        A `Start` and a `Hidden`, whose arrays have a leading axis of n.
    """

    def one(body: ArrayLike, nth: ArrayLike, attempt: ArrayLike) -> tuple[Start, Hidden]:
        own = jax.random.fold_in(jax.random.fold_in(jax.random.fold_in(key, body), nth), attempt)
        start, hidden = jax.random.split(own)
        return scenario.start(start, jax.tree.map(lambda x: x[body], shapes), pad), scenario.hidden(hidden)

    return jax.vmap(one)(body, nth, attempt)


def starts(
    key: PRNGKeyArray, bodies: Body | Sequence[Body], sensor: Sensor, scenario: Scenario, num: int = 1
) -> Starts:
    """Draw `num` random starts of each body, and simulate nothing.

    A start contains an initial pose and hidden properties (friction, mass of the shell, and contents).
    `simulate` draws its starts from the same distribution. The starts of the two functions are independent, even if
    both functions receive the same key. Start j of body i depends on `key`, i, j and the body, not on the number of
    other starts. In the scenario `Inclined`, a start can also depend on the other bodies in `bodies`.

    Args:
        key: Key of the whole set, from `jax.random.key`.
        bodies: One body, or a sequence of bodies.
        sensor: Sensor whose `gel.size` is the size of the pad.
        scenario: `Freefall()`, `Inclined()`, `Perturbed()`, `Released()` or another `Scenario`.
        num: Number of starts of each body.

    Returns:
        `num` starts of body 0, then `num` starts of body 1, and so on.

    Raises:
        BodyError: A body cannot start in the scenario, or has bad values. BodyError is a ValueError.
        ValueError: Another argument is out of range. The message names the argument.
        TypeError: An argument has the wrong type.
    """
    several = listed(bodies)
    check_key(key)
    check_arguments(several, sensor, scenario, num=num)
    pad = (float(sensor.gel.size[0]), float(sensor.gel.size[1]))
    which, nth = np.repeat(np.arange(len(several)), num), np.tile(np.arange(num), len(several))
    own, first = jax.random.fold_in(key, _FURTHER), np.zeros(len(which), np.int32)
    start, hidden = draw(own, which, nth, first, shapes(several, scenario), scenario=scenario, pad=pad)
    return Starts(start.pose, hidden, jnp.asarray(which, jnp.int32))
