"""Mass properties of bodies with the contents and the shell of each draw."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from sts_jax import objects
from sts_jax.objects.body import Body
from sts_jax.physics.scenario import Hidden

AT_ONCE = 8  # draws whose mass properties are computed at once

rigid_of_draws = jax.jit(jax.vmap(objects.rigid, in_axes=(None, 0, 0, 0)))  # of one body


class Rigid(NamedTuple):
    """Mass properties and friction of draws, float64."""

    mass: Float[np.ndarray, "n"]  # kg
    com: Float[np.ndarray, "n 3"]  # m, mesh frame
    inertia: Float[np.ndarray, "n 3 3"]  # kg m^2 about `com`
    friction: Float[np.ndarray, "n"]


def rigids(bodies: Sequence[Body], which: Int[np.ndarray, "n"], hidden: Hidden) -> Rigid:
    """Compute the mass properties (`objects.rigid`) and the friction of draws.

    Args:
        bodies: the bodies.
        which: index of the body of each draw, in ascending order.
        hidden: the hidden values of each draw.

    Returns:
        n values each, in the order of the draws.
    """
    values = jax.tree.map(np.asarray, hidden)
    found = []
    for index in np.unique(which).tolist():
        mine = np.flatnonzero(which == index)
        for rows in np.split(mine, range(AT_ONCE, len(mine), AT_ONCE)):
            # Always the same number at once, because another number rounds differently and compiles anew.
            own = Hidden(*(x[np.resize(rows, AT_ONCE)] for x in values))
            rigid = rigid_of_draws(bodies[index], own.fill, own.shell_scale, own.up)
            found.append([np.asarray(x)[: len(rows)] for x in (*rigid, own.friction)])
    return Rigid(*(np.concatenate(parts).astype(np.float64) for parts in zip(*found, strict=True)))
