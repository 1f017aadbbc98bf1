"""Simulation of chunks of trajectories in the two engines: MJX (`in_mjx`) and C MuJoCo (`in_c`)."""

import copy
import functools
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float, Int

from sts_jax.objects.body import Body
from sts_jax.physics import native, scene
from sts_jax.physics.bodies import BodyError, Rigid, rigids
from sts_jax.physics.contact import Hull
from sts_jax.physics.roll import Record, State, initial, roll
from sts_jax.physics.scenario import Hidden, Scenario, Start
from sts_jax.physics.scene import Contact, mjx

COMPILED = 64  # largest number of bodies whose compiled models are kept for C MuJoCo

Engine = Literal["mjx", "mujoco"]


class Setup(NamedTuple):
    """Non-random properties of n trajectories: their bodies, the scenario, the pad and the time steps."""

    bodies: list[Body]
    which: Int[np.ndarray, "n"]  # index of the body of each trajectory
    hulls: list[Hull]  # collision hull of each body
    scenario: Scenario
    pad: tuple[float, float]  # m, size along x and y
    time: Float[Array, "f s"]  # s, time at which each of the s steps of each of the f frames begins


class Rolled(NamedTuple):
    """Results of one or more trajectories."""

    ends: State | native.Ends
    record: Record


Run = Callable[[np.ndarray], Rolled]  # simulates the trajectories with given indices, at most `chunk`


class Worlds(NamedTuple):
    """Inputs of `roll_worlds` that differ between the n trajectories. All arrays have a leading axis of n."""

    fields: dict[str, Array]  # fields of MJX's model that differ between trajectories, see `scene.drawn`
    hull: Hull
    start: Start
    velocity: Float[Array, "n 6"]  # velocity on release: m/s, rad/s, sensor frame
    gravity: Float[Array, "n f s 3"]  # m/s^2, sensor frame


@functools.partial(jax.jit, static_argnames="scenario")
def gravity_at(
    condition: Float[Array | np.ndarray, "n c"], time: Float[Array, "f s"], scenario: Scenario
) -> Float[Array, "n f s 3"]:
    """`Scenario.gravity` in each time step of n trajectories."""
    return jax.vmap(lambda c: jax.vmap(jax.vmap(lambda t: scenario.gravity(t, c)))(time))(condition)


@functools.partial(jax.jit, static_argnames="scenario")
def velocity_of(condition: Float[Array | np.ndarray, "n c"], scenario: Scenario) -> Float[Array, "n 6"]:
    """`Scenario.velocity` of n trajectories."""
    return jax.vmap(scenario.velocity)(jnp.asarray(condition))


@functools.partial(jax.jit, static_argnames="scenario")
def outcome_of(
    first: Float[Array | np.ndarray, "n 7"], last: Float[Array | np.ndarray, "n 7"], scenario: Scenario
) -> Int[Array, "n"]:
    """`Scenario.outcome` of n trajectories from their first and last poses."""
    return jax.vmap(scenario.outcome)(jnp.asarray(first), jnp.asarray(last))


@jax.jit
def roll_worlds(worlds: Worlds, model: mjx.Model, data: mjx.Data) -> Rolled:
    """Simulate n trajectories in MJX with the scene of `scene.template`, whose `worlds.fields` are replaced."""

    def one(world: Worlds) -> Rolled:
        drawn = model.tree_replace(world.fields)
        state = initial(world.start.pose, world.velocity, world.start.held)
        return Rolled(*roll(drawn, data, world.hull, state, world.gravity))

    return jax.vmap(one)(worlds)


def drawn_fields(
    bodies: Sequence[Body],
    which: Int[np.ndarray, "n"],
    hidden: Hidden,
    pad: tuple[float, float],
    constants: Contact,
    wall: float,
) -> dict[str, np.ndarray]:
    """Fields of MJX's model (`scene.drawn`) of n draws, which C MuJoCo derives from their hidden properties."""
    original, like, _ = scene.template(pad, constants, wall)
    model = copy.copy(original)
    data = mujoco.MjData(model)
    rigid = rigids(bodies, which, hidden)
    fields, limited = [], [constants.limited(np.asarray(body.hulls)) for body in bodies]
    for row, body in enumerate(which.tolist()):
        model.geom_friction[model.geom_bodyid > 0, 1:] = limited[body].torsional, limited[body].rolling
        _set_rigid(model, data, body, rigid, row)
        fields.append(scene.drawn(model, like))
    return {name: np.stack([f[name] for f in fields]) for name in fields[0]}


def _set_rigid(model: mujoco.MjModel, data: mujoco.MjData, body: int, rigid: Rigid, row: int) -> None:
    """Write the values of one draw into a model by `scene.set_rigid`, and name the body in errors."""
    try:
        scene.set_rigid(model, data, *(x[row] for x in rigid))
    except ValueError as error:
        raise BodyError(body, str(error)) from error


def in_mjx(setup: Setup, starts: Start, hidden: Hidden, chunk: int) -> Run:
    """Return a function that simulates trajectories in MJX, at most `chunk` in a call, all of one size class."""
    scenario = setup.scenario
    _, model, data = scene.template(setup.pad, scenario.contact, scenario.wall)
    fields = drawn_fields(setup.bodies, setup.which, hidden, setup.pad, scenario.contact, scenario.wall)

    def run(indices: np.ndarray) -> Rolled:
        padded = np.pad(indices, (0, chunk - len(indices)), "edge")
        start = jax.tree.map(lambda x: x[padded], starts)
        worlds = Worlds(
            fields={name: x[padded] for name, x in fields.items()},
            hull=jax.tree.map(lambda *x: np.stack(x), *(setup.hulls[setup.which[i]] for i in padded)),
            start=start,
            velocity=velocity_of(start.condition, scenario=scenario),
            gravity=gravity_at(start.condition, setup.time, scenario=scenario),
        )
        return jax.tree.map(lambda x: np.asarray(x)[: len(indices)], roll_worlds(worlds, model, data))

    return run


def in_c(setup: Setup, starts: Start, hidden: Hidden, chunk: int) -> Run:
    """Return a function that simulates trajectories in C MuJoCo, at most `chunk` in a call, all of one body."""
    bodies, scenario = setup.bodies, setup.scenario
    rigid = rigids(bodies, setup.which, hidden)
    starts = jax.tree.map(np.asarray, starts)

    @functools.lru_cache(maxsize=COMPILED)
    def compiled(body: int) -> mujoco.MjModel:
        return native.compile_body(np.asarray(bodies[body].hulls), setup.pad, scenario.contact, scenario.wall)

    def run(indices: np.ndarray) -> Rolled:
        body, count = int(setup.which[indices[0]]), len(indices)
        models = []
        data = mujoco.MjData(compiled(body))
        for i in indices.tolist():
            models.append(copy.copy(compiled(body)))
            _set_rigid(models[-1], data, body, rigid, i)
        start = jax.tree.map(lambda x: x[indices], starts)
        padded = np.pad(start.condition, ((0, chunk - count), (0, 0)))  # so that gravity and velocity compile once
        gravity = np.asarray(gravity_at(padded, setup.time, scenario=scenario), np.float64)[:count]
        velocity = np.asarray(velocity_of(padded, scenario=scenario), np.float64)[:count]
        points = np.unique(np.asarray(bodies[body].hulls).reshape(-1, 3), axis=0)
        return Rolled(*native.roll(models, points, start, gravity, velocity))

    return run
