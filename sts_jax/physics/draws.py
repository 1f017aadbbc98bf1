"""Random starts and hidden values: of the trajectories of `simulate`, and of further starts without trajectories."""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int, PRNGKeyArray

from sts_jax._keys import check_key
from sts_jax.objects.body import Body
from sts_jax.physics.arguments import check_arguments, listed
from sts_jax.physics.bodies import shapes
from sts_jax.physics.scenario import Hidden, Scenario, Shape, Start
from sts_jax.sensor import Sensor

_FURTHER = 2**32 - 1  # folded into the key. `simulate` folds in the indices of bodies, which are lower


class Starts(NamedTuple):
    """n starts of one or more bodies, body-major."""

    pose: Float[Array, "n 7"]  # mesh frame in the sensor frame, w >= 0
    hidden: Hidden  # (n,) each, `up` (n, 3)
    body: Int[Array, "n"]  # index into the sequence of bodies


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
    """Draw starts and hidden values. Each depends on its own body, number and attempt only.

    Args:
        key: for the whole set.
        body: index of the body of each draw.
        nth: number of each draw among those of its body.
        attempt: how often each was drawn before.
        shapes: of all bodies.
        scenario: scenario of the starts.
        pad: m, size of the pad along x and y.
    """

    def one(body: ArrayLike, nth: ArrayLike, attempt: ArrayLike) -> tuple[Start, Hidden]:
        own = jax.random.fold_in(jax.random.fold_in(jax.random.fold_in(key, body), nth), attempt)
        start, hidden = jax.random.split(own)
        return scenario.start(start, jax.tree.map(lambda x: x[body], shapes), pad), scenario.hidden(hidden)

    return jax.vmap(one)(body, nth, attempt)


def starts(
    key: PRNGKeyArray, bodies: Body | Sequence[Body], sensor: Sensor, scenario: Scenario, num: int = 1
) -> Starts:
    """Draw `num` further starts of each body and their hidden values, without simulating them.

    They have the distribution of the starts of `simulate` and are independent of its draws with the same key. Start j
    of body i depends on `key`, i, j and the body, not on the number of other starts.

    Args:
        key: for the whole set. The key of `simulate` may be used again.
        bodies: one body, or a sequence of different ones.
        sensor: `sensor.gel.size` is the pad's size.
        scenario: `Freefall()`, `Inclined()`, `Perturbed()`, `Released()` or another `Scenario`.
        num: starts of each body.

    Returns:
        bodies * num starts, body-major.

    Raises:
        BodyError: (a ValueError) a body cannot start in the scenario, or has bad values.
        ValueError: another argument, which the message names, is out of range.
        TypeError: an argument is of another type.
    """
    several = listed(bodies)
    check_key(key)
    check_arguments(several, sensor, scenario, num=num)
    pad = (float(sensor.gel.size[0]), float(sensor.gel.size[1]))
    which, nth = np.repeat(np.arange(len(several)), num), np.tile(np.arange(num), len(several))
    own, first = jax.random.fold_in(key, _FURTHER), np.zeros(len(which), np.int32)
    start, hidden = draw(own, which, nth, first, shapes(several, scenario), scenario=scenario, pad=pad)
    return Starts(start.pose, hidden, jnp.asarray(which, jnp.int32))
