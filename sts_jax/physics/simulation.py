"""`simulate`: trajectories with random starts and hidden properties, computed in chunks by C MuJoCo or MJX."""

import concurrent.futures
import contextlib
import functools
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray
from tqdm import tqdm

from sts_jax._checked import check_key, in_32_bits
from sts_jax._devices import cores
from sts_jax.objects.body import Body, is_traced
from sts_jax.physics.arguments import (
    check_arguments,
    check_condition,
    check_hidden,
    check_outcomes,
    check_start,
    listed,
)
from sts_jax.physics.bodies import BodyError, hulls, rigids, shapes
from sts_jax.physics.engines import Engine, Rolled, Setup, gravity_at, in_c, in_mjx, outcome_of
from sts_jax.physics.native import quiet
from sts_jax.physics.rest import held_wrench
from sts_jax.physics.roll import SLOW_TIME, Record
from sts_jax.physics.scenario import Hidden, Outcome, Scenario, Shape, Start
from sts_jax.sensor import Sensor

# m, thickness of the paper's gel. A trajectory in which the object goes deeper is drawn again. Contacts are found once
# per step, so a corner that hits the pad at 3 m/s can be 3 mm deep before a contact pushes it (at steps of 1 ms).
SUNK_LIMIT = 0.005
ATTEMPTS = 5  # draws of one trajectory before an error is raised
_FURTHER = 2**32 - 1  # `starts` folds it into the key. `simulate` folds in the indices of bodies, which are smaller
WORKERS = 2  # chunks that MJX simulates at the same time, because XLA runs each chunk on one CPU core


class Trajectory(NamedTuple):
    """n trajectories with f frames each, sorted by body."""

    time: Float[Array, "n f"]  # Time (s), 0 at frame 0.
    pose: Float[Array, "n f 7"]  # Mesh frame in the sensor frame: position (m) and quaternion with w >= 0.
    # Velocity of the mesh frame's origin (m/s) and angular velocity (rad/s), in the sensor frame.
    velocity: Float[Array, "n f 6"]
    # Force (N) and moment about the sensor's origin (N m) of the pad on the object. The wrench is the mean over the
    # unbroken contact at the end of the interval before the frame, or 0 if the last time step has no contact. Frame 0
    # of an object that a hand holds on the pad (`Start.carried`) has the wrench under the held pose.
    wrench: Float[Array, "n f 6"]
    contact: Bool[Array, "n f"]  # True if the pad pushes the object in the last time step before the frame.
    wall: Bool[Array, "n f"]  # True if the stop wall pushes the object in the last time step before the frame.
    gravity: Float[Array, "n f 3"]  # Gravity minus the acceleration of the pad, in the sensor frame (m/s^2).
    # True if the object touched pad or wall, slower than 5 mm/s and 0.1 rad/s, for the last 0.2 s, or has left the pad.
    # An object that floats, as without gravity, has not settled.
    settled: Bool[Array, "n"]
    # Number of the outcome, from the poses of the first and the last frame. It is final where `settled` is True.
    outcome: Int[Array, "n"]
    touches: Int[Array, "n"]  # Number of contacts with pad or wall, separated by at least 5 ms.
    sunk: Float[Array, "n"]  # Largest depth of the hull in pad or wall (m).
    condition: Float[Array, "n c"]  # Condition of the start (`Scenario.quantities`), in SI units.
    hidden: Hidden  # Hidden properties: arrays of shape (n,), and `up` of shape (n, 3).
    body: Int[Array, "n"]  # Index of the body in the sequence of bodies.
    resampled: Int[Array, "n"]  # Number of discarded draws, which were non-finite or in which the object sank too deep.

    @property
    def outcomes(self) -> tuple[Outcome, ...]:
        """The outcome of each trajectory. For a scenario with outcomes of its own, use `Scenario.named`."""
        numbers = np.ravel(self.outcome).tolist()
        if own := sorted({*numbers} - {*map(int, Outcome)}):
            raise ValueError(f"outcome has the number {own[0]} of a scenario of your own: use scenario.named({own[0]})")
        return tuple(map(Outcome, numbers))

    def __repr__(self) -> str:
        shown = (self.time, self.outcome, self.settled, self.body)
        if not all(isinstance(x, np.ndarray | np.generic | jax.Array) for x in shown) or is_traced(shown):
            fields = (f"{name}={getattr(leaf, 'shape', leaf)}" for name, leaf in self._asdict().items())
            return f"Trajectory({', '.join(fields)})"
        number, time = np.size(self.outcome), np.asarray(self.time)
        counts = Counter(_named(number) for number in np.ravel(self.outcome).tolist()).most_common()
        moving = number - int(np.sum(self.settled))
        return (
            f"Trajectory({number} trajector{'y' if number == 1 else 'ies'} of {len(np.unique(self.body))} "
            f"bod{'y' if len(np.unique(self.body)) == 1 else 'ies'}, {time.shape[-1] if time.ndim else 1} frames "
            f"in {time.max(initial=0):.2f} s; {', '.join(f'{count} {name}' for name, count in counts)}; "
            f"{moving} not settled at the end)"
        )


class Starts(NamedTuple):
    """n random starts of one or more bodies, sorted by body."""

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
    """Draw a start and the hidden properties of each of n trajectories. A draw does not depend on the other draws.

    In `Inclined`, a draw can change if the arrays in `shapes` are padded to another number of faces.

    Args:
        key: Key of all draws.
        body: Index of the body of each draw, among those of `shapes`.
        nth: Number of each draw among those of the same body, from 0.
        attempt: Number of earlier draws of the trajectory that failed.
    """

    def one(body: ArrayLike, nth: ArrayLike, attempt: ArrayLike) -> tuple[Start, Hidden]:
        draw_key = jax.random.fold_in(jax.random.fold_in(jax.random.fold_in(key, body), nth), attempt)
        start, hidden = jax.random.split(draw_key)
        return scenario.start(start, jax.tree.map(lambda x: x[body], shapes), pad), scenario.hidden(hidden)

    return jax.vmap(one)(body, nth, attempt)


class _Given(NamedTuple):
    """What replaces the random draws, or None."""

    starts: Start | None
    hidden: Hidden | None


class _Accepted(NamedTuple):
    """The accepted draw of each trajectory and its results."""

    starts: Start
    hidden: Hidden
    rolled: Rolled
    attempt: Int[np.ndarray, "n"]  # number of draws that failed before


@in_32_bits
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

    Trajectory j of body i depends on `key`, i, j and the body, not on the number of other trajectories. In `Inclined`,
    its start also depends on the largest number of stable faces of one of the bodies. A trajectory that has non-finite
    values, or whose object sinks more than 5 mm into the pad or the stop wall, is drawn again with another key
    (`Trajectory.resampled`).

    Args:
        key: Key of the whole set, from `jax.random.key`.
        body: One body, or a sequence of bodies.
        sensor: Sensor whose `gel.size` is the size of the pad.
        scenario: `Freefall()`, `Inclined()`, `Perturbed()`, `Released()` or another `Scenario`.
        num: Number of trajectories of each body.
        start: Starts of all n trajectories that replace the random ones. `held` and `carried` may be one number for
            all. The simulation begins one frame interval before frame 0, so `held=scenario.steps` releases an object at
            frame 0.
        hidden: Hidden properties of all n trajectories that replace the random ones. A trajectory has the same start
            with and without `hidden` if it fails equally often.
        progress: True shows a progress bar on standard error. A function is called after each chunk with the number of
            finished trajectories. With MJX, tens of seconds of compilation precede the first chunk.
        chunk: Largest number of trajectories that are simulated at once. With MJX, each new value causes a compilation
            and changes the results by rounding errors. Larger values suit a GPU.
        engine: "mujoco" is C MuJoCo on all CPU cores. "mjx" runs on JAX's default device: several times as slow on a
            CPU, and faster on a GPU only with a large `chunk`, such as 4,096 trajectories of one object. Both engines
            draw the same starts and hidden properties from a key.

    Raises:
        BodyError: A body cannot start in the scenario, has bad values, or has a trajectory that fails five times.
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
        time=jax.device_put(frame - np.arange(scenario.steps, 0, -1) * scenario.contact.timestep),
    )
    with quiet(), _reported(progress, len(setup.which), engine) as report:
        accepted = _accepted(key, setup, given, chunk, engine, report)
    return _trajectory(setup, sensor, accepted)


@contextlib.contextmanager
def _reported(progress: Any, count: int, engine: Engine) -> Iterator[Callable[[int], object]]:
    """Provide the function to call with the number of trajectories done: the caller's function, or that of a bar."""
    if callable(progress):
        yield progress
        return
    if not isinstance(progress, bool):
        raise TypeError(f"progress is {progress!r}, but it must be True, False or a function of a number")
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
    """Draw and simulate all trajectories, and draw failed ones again until none fails."""
    count, scenario = len(setup.which), setup.scenario
    nth = np.arange(count) % (count // len(setup.bodies))
    prepare, workers = (in_mjx, WORKERS) if engine == "mjx" else (in_c, cores())
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
            results = pool.map(in_32_bits(prepare(setup, starts, hidden, chunk)), chunks)
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
                f"trajectory {nth[worst]} of this body failed in each of {ATTEMPTS} attempts (non-finite values, or "
                f"deeper than {SUNK_LIMIT} m in the pad or the stop wall): check the body's hull and mass, and "
                "scenario.contact",
            )
    rolled = jax.tree.map(lambda *x: jax.device_put(np.stack(x)), *(rows[i] for i in range(count)))
    return _Accepted(starts, hidden, rolled, attempt)


def _chunks(setup: Setup, pending: np.ndarray, chunk: int, engine: Engine, workers: int) -> list[np.ndarray]:
    """Group pending trajectories for calls of the engine: by the size of the hulls in MJX, by body in C MuJoCo."""
    sizes = np.array([body.hulls.size for body in setup.bodies])
    kind = (sizes[setup.which] if engine == "mjx" else setup.which)[pending]
    size = chunk if engine == "mjx" else min(chunk, -(-len(pending) // workers))
    parts = [pending[kind == one] for one in np.unique(kind)]
    return [group for part in parts for group in np.split(part, range(size, len(part), size))]


def _with_held(setup: Setup, sensor: Sensor, accepted: _Accepted, down: Float[np.ndarray, "n"]) -> Record:
    """The records, with the wrench on objects that a hand holds in frame 0, under gravity `down` (m/s^2)."""
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
    gravity = np.asarray(gravity_at(accepted.starts.condition, setup.time[:, -1:], scenario=scenario))[:, :, 0]
    record = jax.tree.map(jnp.asarray, _with_held(setup, sensor, accepted, -gravity[:, 0, 2]))
    outcome = outcome_of(record.pose[:, 0], record.pose[:, -1], scenario=scenario)
    check_outcomes(scenario, np.asarray(outcome))
    starts, time = accepted.starts, jnp.arange(scenario.frames) / scenario.rate
    slow_s = np.asarray(ends.slow, np.float32) * np.float32(scenario.contact.timestep)
    return Trajectory(
        time=jnp.asarray(np.tile(time, (len(setup.which), 1))),
        **record._asdict(),
        gravity=jnp.asarray(gravity),
        settled=jnp.asarray(np.asarray(ends.gone) | (slow_s >= np.float32(SLOW_TIME))),
        outcome=outcome,
        touches=ends.touches,
        sunk=ends.sunk,
        condition=starts.condition,
        hidden=accepted.hidden,
        body=jnp.asarray(setup.which.astype(np.int32)),
        resampled=jnp.asarray(accepted.attempt),
    )


@in_32_bits
def starts(
    key: PRNGKeyArray, bodies: Body | Sequence[Body], sensor: Sensor, scenario: Scenario, num: int = 1
) -> Starts:
    """Draw `num` random starts of each body as `simulate` does, and simulate nothing.

    The starts are independent of those that `simulate` draws from the same key. Start j of body i depends on `key`, i,
    j and the body, and in `Inclined` it can depend on the other bodies.
    """
    several = listed(bodies)
    check_key(key)
    check_arguments(several, sensor, scenario, num=num)
    pad = (float(sensor.gel.size[0]), float(sensor.gel.size[1]))
    which, nth = np.repeat(np.arange(len(several)), num), np.tile(np.arange(num), len(several))
    further, first = jax.random.fold_in(key, _FURTHER), np.zeros(len(which), np.int32)
    start, hidden = draw(further, which, nth, first, shapes(several, scenario), scenario=scenario, pad=pad)
    return Starts(start.pose, hidden, jnp.asarray(which, jnp.int32))


def _named(number: int) -> str:
    return str(Outcome(number)) if number in set(Outcome) else f"outcome {number}"
