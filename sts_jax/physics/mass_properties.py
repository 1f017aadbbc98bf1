"""Mass, centre of mass, inertia and friction of bodies, computed from hidden properties, such as the contents."""

import concurrent.futures
import os
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from sts_jax import objects
from sts_jax.objects.body import Body
from sts_jax.physics.scenario import Hidden

AT_ONCE = 8  # draws whose mass properties one call computes

rigid_of_draws = jax.jit(jax.vmap(objects.rigid, in_axes=(None, 0, 0, 0)))  # one body, several draws


class Rigid(NamedTuple):
    """Mass properties and friction in n trajectories, as float64 arrays with one entry per trajectory.

    Trajectories of the same object differ in its hidden properties, such as the filled share of its interior.
    """

    mass: Float[np.ndarray, "n"]  # Mass (kg).
    com: Float[np.ndarray, "n 3"]  # Centre of mass in the mesh frame (m).
    inertia: Float[np.ndarray, "n 3 3"]  # Inertia about the centre of mass, along the mesh axes (kg m^2).
    friction: Float[np.ndarray, "n"]  # Coefficient of sliding friction against the pad.


def rigids(bodies: Sequence[Body], which: Int[np.ndarray, "n"], hidden: Hidden) -> Rigid:
    """Compute mass, centre of mass, inertia and friction of bodies with given hidden properties.

    Hidden properties are those that a camera cannot see, such as the fill level. The equations are in `objects.rigid`.

    Args:
        bodies: All bodies.
        which: Index of one body for each set of hidden properties, (n,), in ascending order.
        hidden: The n sets of hidden properties. The field `up` has the shape (n, 3), and all other fields have the
            shape (n,).

    Returns:
        Arrays with a leading axis of n, in the order of `which`.
    """
    values = jax.tree.map(np.asarray, hidden)
    groups = [np.flatnonzero(which == index) for index in np.unique(which)]
    calls = [rows for mine in groups for rows in np.split(mine, range(AT_ONCE, len(mine), AT_ONCE))]

    def computed(rows: np.ndarray) -> list[np.ndarray]:
        # Every call has the same number of draws, because another number would round differently and compile anew.
        own = Hidden(*(x[np.resize(rows, AT_ONCE)] for x in values))
        rigid = rigid_of_draws(bodies[which[rows[0]]], own.fill, own.shell_scale, own.up)
        return [np.asarray(x)[: len(rows)] for x in (*rigid, own.friction)]

    # A call uses one core of a CPU. The first call compiles.
    found = [computed(rows) for rows in calls[:1]]
    with concurrent.futures.ThreadPoolExecutor(os.cpu_count()) as pool:
        found += pool.map(computed, calls[1:])
    return Rigid(*(np.concatenate(parts).astype(np.float64) for parts in zip(*found, strict=True)))
