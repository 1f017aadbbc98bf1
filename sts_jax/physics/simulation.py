"""`simulate`: draws starts and hidden values on the host, and rolls chunks of trajectories in MJX or C MuJoCo."""

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

from sts_jax._keys import check_key
from sts_jax.objects.body import Body
from sts_jax.physics.arguments import check_arguments, check_condition, check_hidden, check_outcomes, listed
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
# per step, so a fast-turning object whose corner hits at 3 m/s is 3 mm deep before they push.
SUNK_LIMIT = 0.005
ATTEMPTS = 5  # draws of one trajectory before giving up
WORKERS = 2  # chunks at once in MJX, because XLA runs these small steps on one CPU core each


class _Accepted(NamedTuple):
    """The accepted draw of each trajectory and its results."""

    starts: Start
    hidden: Hidden
    rolled: Rolled
    attempt: Int[np.ndarray, "n"]  # draws discarded before


def simulate(
    key: PRNGKeyArray,
    body: Body | Sequence[Body],
    sensor: Sensor,
    scenario: Scenario,
    num: int = 1,
    *,
    hidden: Hidden | None = None,
    progress: bool | Callable[[int], object] = False,
    chunk: int = 32,
    engine: Engine | None = None,
) -> Trajectory:
    """Simulate `num` trajectories of each body with random starts and hidden values.

    Trajectory j of body i depends on `key`, i, j and the body, not on the number of other trajectories. Trajectories
    that are non-finite or sink deeper into the pad than SUNK_LIMIT are drawn again with a fresh key (`resampled`).

    Args:
        key: for the whole set.
        body: one body, or a sequence of different ones.
        sensor: `sensor.gel.size` is the pad's size.
        scenario: `Freefall()`, `Inclined()`, `Perturbed()`, `Released()` or another `Scenario`.
        num: trajectories of each body.
        hidden: (bodies * num,) each, `up` (bodies * num, 3), body-major. Replaces the drawn values. The starts remain
            those of `key`, except where `resampled` is not 0.
        progress: True shows a bar on standard error or in a notebook. MJX compiles for tens of seconds before the first
            chunk is done. A function is called after each chunk with the number of trajectories done so far.
        chunk: trajectories that MJX steps at once. Another number compiles anew and rounds differently. Larger ones
            suit a GPU. C MuJoCo takes at most this many, of one body, in one thread. Its results do not depend on it.
        engine: "mujoco" is C MuJoCo on all CPU cores, where it is several times as fast and compiles nothing. "mjx"
            runs on the device of JAX. None takes the faster one, "mujoco" if `jax.default_backend()` is "cpu". Both
            have the same starts and hidden values for a key.

    Returns:
        bodies * num trajectories, body-major.

    Raises:
        BodyError: (a ValueError) a body cannot start in the scenario, has bad values, or has a trajectory that fails in
            every attempt.
        ValueError: another argument, which the message names, is out of range.
        TypeError: an argument is of another type.
    """
    bodies = listed(body)
    check_key(key)
    check_arguments(bodies, sensor, scenario, num=num, chunk=chunk)
    if engine not in (None, *get_args(Engine)):
        raise ValueError(f"engine is {engine!r}, but it must be {', '.join(map(repr, get_args(Engine)))} or None")
    given = None if hidden is None else check_hidden(hidden, len(bodies) * num)
    frame = np.arange(scenario.frames)[:, None] / scenario.rate
    setup = Setup(
        bodies=bodies,
        which=np.repeat(np.arange(len(bodies)), num),
        hulls=hulls(bodies),
        scenario=scenario,
        pad=(float(sensor.gel.size[0]), float(sensor.gel.size[1])),
        time=jnp.asarray(frame - np.arange(scenario.steps, 0, -1) * scenario.contact.timestep),
    )
    if engine is None:
        engine = "mujoco" if jax.default_backend() == "cpu" else "mjx"
    with _reported(progress, len(setup.which), engine) as report:
        accepted = _accepted(key, setup, given, chunk, engine, report)
    return _trajectory(setup, sensor, accepted)


@contextlib.contextmanager
def _reported(progress: Any, count: int, engine: Engine) -> Iterator[Callable[[int], object]]:
    """The function to call with the number of trajectories done: the caller's, a bar's, or one without effect."""
    if callable(progress):
        yield progress
        return
    if not isinstance(progress, bool):
        raise TypeError(f"progress is {progress!r}, but it must be True, False or a function of the number done")
    first = "simulate: compiling" if engine == "mjx" else "simulate"
    with tqdm(total=count, desc=first, unit=" trajectories", disable=not progress) as bar:

        def show(done: int) -> None:
            bar.set_description("simulate", refresh=False)
            bar.update(done - bar.n)

        yield show


def _accepted(
    key: PRNGKeyArray,
    setup: Setup,
    given: Hidden | None,
    chunk: int,
    engine: Engine,
    report: Callable[[int], object],
) -> _Accepted:
    """Draw and roll all trajectories, and those that fail again, until none fails.

    Args:
        key: for the whole set.
        setup: the properties of the trajectories.
        given: hidden values that replace the drawn ones.
        chunk: trajectories that one call rolls at most.
        engine: the engine.
        report: called with the number of trajectories done so far.

    Raises:
        BodyError: a trajectory fails in every attempt.
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
        hidden = hidden if given is None else given
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
                f"trajectory {nth[worst]} is non-finite or sinks deeper than {SUNK_LIMIT} m in {ATTEMPTS} draws: "
                "check the thickness of the hull and the mass",
            )
    rolled = jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), *(rows[i] for i in range(count)))
    return _Accepted(starts, hidden, rolled, attempt)


def _chunks(setup: Setup, pending: np.ndarray, chunk: int, engine: Engine, workers: int) -> list[np.ndarray]:
    """Pending trajectories in groups that one call rolls: of hulls of one size in MJX, of one body in C MuJoCo."""
    sizes = np.array([body.hulls.size for body in setup.bodies])
    kind = (sizes[setup.which] if engine == "mjx" else setup.which)[pending]
    size = chunk if engine == "mjx" else min(chunk, -(-len(pending) // workers))
    parts = [pending[kind == one] for one in np.unique(kind)]
    return [group for part in parts for group in np.split(part, range(size, len(part), size))]


def _with_held(setup: Setup, sensor: Sensor, accepted: _Accepted, down: Float[np.ndarray, "n"]) -> Record:
    """The records, with the wrench of the pad on objects that a hand holds against it in frame 0.

    Args:
        setup: the properties of the trajectories.
        sensor: the sensor, whose gel determines the centre of pressure.
        accepted: the accepted draws and their results.
        down: m/s^2, gravity towards the pad in frame 0.
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
    """The results under the names of `Trajectory`."""
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
