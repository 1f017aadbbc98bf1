"""Further starts of bodies, without their trajectories."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from sts_jax._keys import check_key
from sts_jax.objects.body import Body
from sts_jax.physics.scenarios import Hidden, Scenario
from sts_jax.physics.simulate import _check, _draw, _shapes
from sts_jax.sensor import Sensor

_FURTHER = 2**32 - 1  # folded into the key. `simulate` folds in the indices of bodies, which are lower


class Starts(NamedTuple):
    """n starts of one or more bodies, body-major."""

    pose: Float[Array, "n 7"]  # mesh frame in the sensor frame, w >= 0
    hidden: Hidden  # (n,) each, `up` (n, 3)
    body: Int[Array, "n"]  # index into the sequence of bodies


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
        scenario: `Freefall()`, `Inclined()` or `Perturbed()`.
        num: starts of each body.

    Returns:
        bodies * num starts, body-major.

    Raises:
        BodyError: (a ValueError) a body cannot start in the scenario, or has bad values.
        ValueError: another argument, which the message names, is out of range.
        TypeError: an argument is of another type.
    """
    bodies = list(bodies) if isinstance(bodies, Sequence) and not isinstance(bodies, str) else [bodies]
    check_key(key)
    _check(bodies, sensor, scenario, num, 1)
    pad = (float(sensor.gel.size[0]), float(sensor.gel.size[1]))
    which, nth = np.repeat(np.arange(len(bodies)), num), np.tile(np.arange(num), len(bodies))
    own, first = jax.random.fold_in(key, _FURTHER), np.zeros(len(which), np.int32)
    start, hidden = _draw(own, which, nth, first, _shapes(bodies, scenario), scenario=scenario, pad=pad)
    return Starts(start.pose, hidden, jnp.asarray(which, jnp.int32))
