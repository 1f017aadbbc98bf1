"""`simulate`: trajectories with random starts and hidden properties, computed in chunks by C MuJoCo or MJX."""

import concurrent.futures
import contextlib
import os
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray
from tqdm import tqdm

from sts_jax._checked import check_key
from sts_jax.objects.body import Body
from sts_jax.physics.arguments import (
    check_arguments,
    check_condition,
    check_hidden,
    check_outcomes,
    check_start,
    listed,
)
from sts_jax.physics.bodies import BodyError, hulls, shapes
from sts_jax.physics.draws import draw
from sts_jax.physics.engines import Engine, Rolled, Setup, gravity_at, in_c, in_mjx
from sts_jax.physics.held import held_wrench
from sts_jax.physics.mass_properties import rigids
from sts_jax.physics.roll import SLOW_TIME, Record
from sts_jax.physics.scenario import Hidden, Scenario, Start
from sts_jax.physics.trajectory import Trajectory
from sts_jax.sensor import Sensor

# m, thickness of the paper's gel. A trajectory in which the object goes deeper is drawn again. Contacts are found once
# per step, so a corner that hits the pad at 3 m/s can be 3 mm deep before a contact pushes it (at steps of 1 ms).
SUNK_LIMIT = 0.005
ATTEMPTS = 5  # draws of one trajectory before an error is raised
WORKERS = 2  # chunks that MJX simulates at the same time, because XLA runs each chunk on one CPU core


class _Given(NamedTuple):
    """The starts and hidden properties that replace the random ones, or None."""

    starts: Start | None
    hidden: Hidden | None


class _Accepted(NamedTuple):
    """The accepted draw of each trajectory and its results."""

    starts: Start
    hidden: Hidden
    rolled: Rolled
    attempt: Int[np.ndarray, "n"]  # number of draws that failed before


def simulate(
    key: PRNGKeyArray,
    body: Body | Sequence[Body],
    sensor: Sensor,
    scenario: Scenario,
    num: int = 1,
    *,
    start: Start | None = None,
    hidden: Hidden | None = None,
    progress: bool | Callable[[int], object] = False,
    chunk: int = 32,
    engine: Engine = "mujoco",
) -> Trajectory:
    """Simulate `num` trajectories of each body with random starts and hidden properties.

    Trajectory j of body i depends on `key`, i, j and the body, not on the number of other trajectories. A trajectory
    fails if it has non-finite values or the object sinks more than 5 mm into the pad or the stop wall. It is then drawn
    again with another key. `Trajectory.resampled` counts the failures.

    Args:
        key: Key of the whole set, from `jax.random.key`.
        body: One body, or a sequence of bodies.
        sensor: Sensor whose `gel.size` is the size of the pad.
        scenario: `Freefall()`, `Inclined()`, `Perturbed()`, `Released()` or another `Scenario`.
        num: Number of trajectories of each body.
        start: Starts that replace the random ones, ordered body by body. If all bodies together have n trajectories,
            `pose` has the shape (n, 7) and `condition` (the c numbers of the scenario's known quantities, such as an
            acceleration of the pad) has the shape (n, c). `held` (number of time steps before the release) and
            `carried` (share of the weight that the pad carries before the release) have the shape (n,) or are one
            number for all trajectories. The simulation begins one frame interval (`scenario.steps` time steps)
            before frame 0, so `held=scenario.steps` releases an object at frame 0.
        hidden: Hidden properties (friction, mass of the shell, and contents) that replace the random ones, ordered body
            by body. If all bodies together have n trajectories, the field `up` has the shape (n, 3), and the other
            fields have the shape (n,). A trajectory has the same start with and without `hidden` if it has the same
            number of failures (`Trajectory.resampled`) in both cases.
        progress: True shows a progress bar on standard error. If `progress` is a function, it is called after each
            chunk with the number of trajectories done so far. With MJX, tens of seconds of compilation precede the
            first chunk.
        chunk: Largest number of trajectories that are simulated at once. With MJX, each new value causes a compilation
            and changes the results by rounding errors. Larger values suit a GPU. With C MuJoCo, each thread receives
            at most `chunk` trajectories at a time, and the results do not depend on `chunk`.
        engine: "mujoco" is C MuJoCo on all CPU cores. "mjx" compiles the simulation for JAX's default device. On a CPU,
            MJX is several times as slow as C MuJoCo. On a GPU, MJX is faster only with a large `chunk`, such as 4,096
            trajectories of one object. Both engines draw the same starts and hidden properties from a key.

    Returns:
        `num` trajectories of body 0, then `num` trajectories of body 1, and so on.

    Raises:
        BodyError: A body cannot start in the scenario, has bad values, or has a trajectory that fails five times.
            BodyError is a ValueError.
        ValueError: Another argument is out of range. The message names the argument.
        TypeError: An argument has the wrong type.
    """
    bodies = listed(body)
    check_key(key)
    check_arguments(bodies, sensor, scenario, num=num, chunk=chunk)
    if engine not in get_args(Engine):
        raise ValueError(f"engine is {engine!r}, but it must be {' or '.join(map(repr, get_args(Engine)))}")
    given = _Given(
        None if start is None else check_start(start, scenario, len(bodies) * num),
        None if hidden is None else check_hidden(hidden, len(bodies) * num),
    )
    frame = np.arange(scenario.frames)[:, None] / scenario.rate
    setup = Setup(
        bodies=bodies,
        which=np.repeat(np.arange(len(bodies)), num),
        hulls=hulls(bodies),
        scenario=scenario,
        pad=(float(sensor.gel.size[0]), float(sensor.gel.size[1])),
        time=jnp.asarray(frame - np.arange(scenario.steps, 0, -1) * scenario.contact.timestep),
    )
    with _reported(progress, len(setup.which), engine) as report:
        accepted = _accepted(key, setup, given, chunk, engine, report)
    return _trajectory(setup, sensor, accepted)


@contextlib.contextmanager
def _reported(progress: Any, count: int, engine: Engine) -> Iterator[Callable[[int], object]]:
    """Provide the function to call with the number of trajectories done: the caller's function, or that of a bar."""
    if callable(progress):
        yield progress
        return
    if not isinstance(progress, bool):
        raise TypeError(
            f"progress is {progress!r}, but it must be True, False or a function of the number of trajectories done"
        )
    first = "simulate: compiling" if engine == "mjx" else "simulate"
    with tqdm(total=count, desc=first, unit=" trajectories", disable=not progress) as bar:

        def show(done: int) -> None:
            bar.set_description("simulate", refresh=False)
            bar.update(done - bar.n)

        yield show


def _accepted(
    key: PRNGKeyArray,
    setup: Setup,
    given: _Given,
    chunk: int,
    engine: Engine,
    report: Callable[[int], object],
) -> _Accepted:
    """Draw and simulate all trajectories. Draw failed ones again until none fails.

    Args:
        key: Key of the whole set.
        setup: Properties of the trajectories that do not depend on the draws.
        given: Starts and hidden properties that replace the random ones.
        chunk: Largest number of trajectories in one call of the engine.
        engine: Engine that simulates.
        report: Function that is called with the number of trajectories done so far.

    Raises:
        BodyError: A body cannot start in the scenario, or a trajectory fails in every attempt.
    """
    count, scenario = len(setup.which), setup.scenario
    nth = np.arange(count) % (count // len(setup.bodies))
    prepare, workers = (in_mjx, WORKERS) if engine == "mjx" else (in_c, os.cpu_count() or 1)
    shape = shapes(setup.bodies, scenario)
    attempt, pending = np.zeros(count, np.int32), np.arange(count)
    rows: dict[int, Rolled] = {}
    while len(pending):
        starts, hidden = draw(key, setup.which, nth, attempt, shape, scenario=scenario, pad=setup.pad)
        check_condition(scenario, starts)
        starts = starts if given.starts is None else given.starts
        hidden = hidden if given.hidden is None else given.hidden
        chunks = _chunks(setup, pending, chunk, engine, workers)
        with concurrent.futures.ThreadPoolExecutor(workers) as pool:
            results = pool.map(prepare(setup, starts, hidden, chunk), chunks)
            for indices, result in zip(chunks, results, strict=True):
                for row, i in enumerate(indices.tolist()):
                    rows[i] = jax.tree.map(lambda x, row=row: x[row], result)
                report(len(rows))
        failed = [not (rows[i].ends.finite and rows[i].ends.sunk <= SUNK_LIMIT) for i in range(count)]
        pending = np.flatnonzero(failed)
        attempt[pending] += 1
        if attempt.max() >= ATTEMPTS:
            worst = int(attempt.argmax())
            raise BodyError(
                int(setup.which[worst]),
                f"trajectory {nth[worst]} of this body failed in each of {ATTEMPTS} attempts, because it has "
                f"non-finite values or the object sinks more than {SUNK_LIMIT} m into the pad or the stop wall: check "
                "the thickness of the body's hull and the body's mass",
            )
    rolled = jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), *(rows[i] for i in range(count)))
    return _Accepted(starts, hidden, rolled, attempt)


def _chunks(setup: Setup, pending: np.ndarray, chunk: int, engine: Engine, workers: int) -> list[np.ndarray]:
    """Group pending trajectories for calls of the engine: by the size of the hulls in MJX, by body in C MuJoCo."""
    sizes = np.array([body.hulls.size for body in setup.bodies])
    kind = (sizes[setup.which] if engine == "mjx" else setup.which)[pending]
    size = chunk if engine == "mjx" else min(chunk, -(-len(pending) // workers))
    parts = [pending[kind == one] for one in np.unique(kind)]
    return [group for part in parts for group in np.split(part, range(size, len(part), size))]


def _with_held(setup: Setup, sensor: Sensor, accepted: _Accepted, down: Float[np.ndarray, "n"]) -> Record:
    """Return the records, with the wrench of the pad on objects that a hand holds on the pad in frame 0.

    Args:
        setup: Properties of the trajectories that do not depend on the draws.
        sensor: Sensor whose gel determines the centre of pressure.
        accepted: Accepted draws and their results.
        down: Gravity towards the pad in frame 0 (m/s^2).
    """
    record, starts = accepted.rolled.record, jax.tree.map(np.asarray, accepted.starts)
    held = np.flatnonzero((starts.carried > 0) & (starts.held >= setup.scenario.steps))
    if not len(held):
        return record
    wrench, contact = np.array(record.wrench), np.array(record.contact)
    mass = rigids(setup.bodies, setup.which, accepted.hidden).mass
    for i in held.tolist():
        force = float(starts.carried[i] * mass[i] * down[i])
        wrench[i, 0] = held_wrench(sensor.gel, setup.bodies[setup.which[i]], starts.pose[i], force)
        contact[i, 0] = True
    return record._replace(wrench=jnp.asarray(wrench), contact=jnp.asarray(contact))


def _trajectory(setup: Setup, sensor: Sensor, accepted: _Accepted) -> Trajectory:
    """Collect the results in a `Trajectory`."""
    scenario, ends = setup.scenario, jax.tree.map(jnp.asarray, accepted.rolled.ends)
    gravity = gravity_at(accepted.starts.condition, setup.time[:, -1:], scenario=scenario)[:, :, 0]
    record = jax.tree.map(jnp.asarray, _with_held(setup, sensor, accepted, -np.asarray(gravity[:, 0, 2])))
    outcome = jax.vmap(scenario.outcome)(record.pose[:, 0], record.pose[:, -1])
    check_outcomes(scenario, np.asarray(outcome))
    starts = accepted.starts
    return Trajectory(
        time=jnp.tile(jnp.arange(scenario.frames) / scenario.rate, (len(setup.which), 1)),
        pose=record.pose,
        velocity=record.velocity,
        wrench=record.wrench,
        contact=record.contact,
        wall=record.wall,
        gravity=gravity,
        settled=ends.gone | (ends.slow * scenario.contact.timestep >= SLOW_TIME),
        outcome=outcome,
        touches=ends.touches,
        sunk=ends.sunk,
        condition=starts.condition,
        hidden=accepted.hidden,
        body=jnp.asarray(setup.which, jnp.int32),
        resampled=jnp.asarray(accepted.attempt),
    )
