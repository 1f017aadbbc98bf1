"""`simulate`: prepares bodies, draws and chunks on the host, and runs them in MJX or C MuJoCo."""

import concurrent.futures
import contextlib
import copy
import functools
import math
import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray
from tqdm import tqdm

from sts_jax import objects
from sts_jax._keys import check_key
from sts_jax.objects.body import Body, is_traced
from sts_jax.physics import contact, native, scene
from sts_jax.physics.contact import Hull
from sts_jax.physics.rest import UPRIGHT
from sts_jax.physics.roll import SLOW_TIME, Record, State, initial, roll
from sts_jax.physics.scenarios import Hidden, Outcome, Scenario, Shape, Start
from sts_jax.physics.scene import Contact, mjx
from sts_jax.sensor import Sensor

# m, thickness of the paper's gel. A trajectory in which the object goes deeper is drawn again. Contacts are found once
# per step, so a fast-turning object whose corner hits at 3 m/s is 3 mm deep before they push.
SUNK_LIMIT = 0.005
ATTEMPTS = 5  # draws of one trajectory before giving up
RIGIDS = 8  # draws whose mass properties are computed at once
COMPILED = 64  # bodies whose compiled model is kept for C MuJoCo
CONTENTS = 16  # draws of a body's contents by which a start may be chosen
WORKERS = 2  # chunks at once in MJX, because XLA runs these small steps on one CPU core each

Engine = Literal["mjx", "mujoco"]


class BodyError(ValueError):
    """One of several bodies cannot be simulated.

    Attributes:
        body: Its index.
    """

    def __init__(self, body: int, reason: str):
        super().__init__(f"body {body}: {reason}")
        self.body = body


class Trajectory(NamedTuple):
    """n trajectories of one or more bodies, body-major, with f frames each."""

    time: Float[Array, "n f"]  # s, 0 at frame 0
    pose: Float[Array, "n f 7"]  # mesh frame in the sensor frame, w >= 0
    velocity: Float[Array, "n f 6"]  # m/s of the mesh frame's origin, rad/s; sensor frame
    # N, N m about the sensor's origin, exerted by the pad on the object: the mean over the unbroken contact at the end
    # of the frame's interval, or 0 if the last step of the interval has no contact.
    wrench: Float[Array, "n f 6"]
    contact: Bool[Array, "n f"]  # the pad pushes in the frame's last step
    wall: Bool[Array, "n f"]  # the stop wall pushes in the frame's last step
    gravity: Float[Array, "n f 3"]  # m/s^2, sensor frame
    settled: Bool[Array, "n"]  # slower than 5 mm/s and 0.1 rad/s for the last 0.2 s, or gone from the pad
    # Outcome from the poses of the first and the last frame. It is final where `settled`
    outcome: Int[Array, "n"]
    touches: Int[Array, "n"]  # contacts with pad or wall, separated by at least 5 ms
    sunk: Float[Array, "n"]  # m, largest depth of the hull in pad or wall
    condition: Float[Array, "n c"]  # the scenario's input
    hidden: Hidden  # (n,) each, `up` (n, 3)
    body: Int[Array, "n"]  # index into the sequence of bodies
    resampled: Int[Array, "n"]  # draws discarded because non-finite or too deep

    @property
    def outcomes(self) -> tuple[Outcome, ...]:
        """The outcome of each trajectory. `Outcome.FELL_OFF` prints as "fell off"."""
        return tuple(Outcome(int(number)) for number in np.ravel(self.outcome))

    def __repr__(self) -> str:
        shown = (self.time, self.outcome, self.settled, self.body)
        if not all(isinstance(x, np.ndarray | np.generic | jax.Array) for x in shown) or is_traced(shown):
            fields = (f"{name}={getattr(leaf, 'shape', leaf)}" for name, leaf in self._asdict().items())
            return f"Trajectory({', '.join(fields)})"
        number, time = np.size(self.outcome), np.asarray(self.time)
        counts = Counter(map(str, self.outcomes)).most_common()
        moving = number - int(np.sum(self.settled))
        return (
            f"Trajectory({number} trajector{'y' if number == 1 else 'ies'} of {len(np.unique(self.body))} "
            f"bod{'y' if len(np.unique(self.body)) == 1 else 'ies'}, {time.shape[-1] if time.ndim else 1} frames "
            f"in {time.max(initial=0):.2f} s; {', '.join(f'{count} {name}' for name, count in counts)}; "
            f"{moving} not settled at the end)"
        )


class _Worlds(NamedTuple):
    """The arrays that one call of MJX steps, with a leading axis of trajectories."""

    fields: dict[str, Array]  # fields of the model, see `scene.drawn`
    hull: Hull
    start: Start
    gravity: Float[Array, "n f s 3"]


@functools.partial(jax.jit, static_argnames=("scenario", "pad"))
def _draw(
    key: PRNGKeyArray,
    body: Int[Array, "n"],
    draw: Int[Array, "n"],
    attempt: Int[Array, "n"],
    shapes: Shape,
    scenario: Scenario,
    pad: tuple[float, float],
) -> tuple[Start, Hidden]:
    def one(body: Int[Array, ""], draw: Int[Array, ""], attempt: Int[Array, ""]) -> tuple[Start, Hidden]:
        own = jax.random.fold_in(jax.random.fold_in(jax.random.fold_in(key, body), draw), attempt)
        start, hidden = jax.random.split(own)
        return scenario.start(start, jax.tree.map(lambda x: x[body], shapes), pad), scenario.hidden(hidden)

    return jax.vmap(one)(body, draw, attempt)


@functools.partial(jax.jit, static_argnames="scenario")
def _gravity(condition: Float[Array, "n c"], time: Float[Array, "f s"], scenario: Scenario) -> Float[Array, "n f s 3"]:
    return jax.vmap(lambda c: jax.vmap(jax.vmap(lambda t: scenario.gravity(t, c)))(time))(condition)


@jax.jit
def _roll(worlds: _Worlds, model: mjx.Model, data: mjx.Data) -> tuple[State, Record]:
    def one(world: _Worlds) -> tuple[State, Record]:
        own = model.tree_replace(world.fields)
        state = initial(world.start.pose, jnp.zeros(6), world.start.held)
        return roll(own, data, world.hull, state, world.gravity)

    return jax.vmap(one)(worlds)


_rigid = jax.jit(jax.vmap(objects.rigid, in_axes=(None, 0, 0, 0)))


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


def _check(bodies: Sequence[Any], sensor: Any, scenario: Any, num: Any, chunk: Any) -> None:
    """Raise an error for any argument that `simulate` cannot take, whatever its type."""
    for name, count in (("num", num), ("chunk", chunk)):
        whole = isinstance(count, int | np.integer) and not isinstance(count, bool)
        if not whole or count < 1:
            raise ValueError(f"{name} is {count!r}, but it must be a whole number of trajectories >= 1")
    if not bodies:
        raise ValueError("no body was given: pass one Body or a sequence of them")
    if not isinstance(sensor, Sensor):
        raise TypeError(f"sensor is {sensor!r}, but it must be a Sensor, for instance sts.Sensor()")
    if isinstance(scenario, type) or not hasattr(scenario, "check"):
        raise TypeError(f"scenario is {scenario!r}, but it must be Freefall(), Inclined() or Perturbed()")
    scenario.check()
    for i, body in enumerate(bodies):
        if not isinstance(body, Body):
            raise TypeError(
                f"body {i} is {body!r}, but it must be a Body: objects.make draws one, objects.load reads a mesh file. "
                "For several, pass a sequence of them"
            )
        known = body.hulls.ndim == 3 and body.hulls.shape[1] in objects.HULL_CLASSES
        if not known or body.hulls.shape[0] not in objects.PART_CLASSES:
            raise BodyError(
                i,
                f"hulls has shape {body.hulls.shape}, but it must be (p, n, 3) with p in {objects.PART_CLASSES} and "
                f"n in {objects.HULL_CLASSES}",
            )
        if not np.isfinite(body.hulls).all():
            raise BodyError(i, "hulls has a non-finite vertex, but all must be finite")
        if not (np.isfinite(body.shell_mass) and body.shell_mass > 0):
            raise BodyError(i, f"shell_mass is {body.shell_mass} kg, but it must be > 0 and finite: give load a mass")
        try:
            body.check()
        except ValueError as error:
            raise BodyError(i, str(error)) from error


def refusal(body: Body, scenario: Scenario) -> str | None:
    """The reason why an object cannot start in a scenario, or None if it can.

    Args:
        body: one object, whose hull spans a volume.
        scenario: scenario of the start.
    """
    return _refusal(_rests(body)[0], scenario)


def _refusal(rests: np.ndarray, scenario: Scenario) -> str | None:
    if not len(rests):
        return "it rests on no face, because its centre of mass lies outside its hull or at the edge of every face"
    if scenario.must_stand and rests[:, 2].max() < math.cos(UPRIGHT):
        return f"it does not stand upright (+z up), as {type(scenario).__name__} needs"
    return None


def _rests(body: Body) -> tuple[np.ndarray, np.ndarray]:
    points = np.asarray(body.hulls, np.float64).reshape(-1, 3)
    return objects.rest_poses(points, np.asarray(body.shell_com, np.float64))


def _hulls(bodies: Sequence[Body]) -> list[Hull]:
    found = []
    for index, body in enumerate(bodies):
        try:
            found.append(contact.hull(np.asarray(body.hulls)))
        except ValueError as error:
            raise BodyError(index, str(error)) from error
    return found


def _shapes(bodies: Sequence[Body], scenario: Scenario) -> Shape:
    """The properties that determine the starts of each body, padded to a common size."""
    found = [(np.asarray(body.hulls).reshape(-1, 3), *_rests(body)) for body in bodies]
    for index, (_, rests, _) in enumerate(found):
        reason = _refusal(rests, scenario)
        if reason is not None:
            raise BodyError(index, f"{reason}: leave it out")

    def pad(arrays: Sequence[np.ndarray], mode: Literal["edge", "constant"]) -> np.ndarray:
        size = max(map(len, arrays))
        rest = ((0, 0),) * (arrays[0].ndim - 1)
        return np.stack([np.pad(x, ((0, size - len(x)), *rest), mode) for x in arrays]).astype(np.float32)

    points, rests, shares = zip(*found, strict=True)
    coms = np.stack([np.asarray(body.shell_com)[None] for body in bodies])
    if scenario.by_contents:
        own = jax.vmap(scenario.hidden)(jax.random.split(jax.random.key(0), CONTENTS))
        coms = np.stack([np.asarray(_rigid(body, own.fill, own.shell_scale, own.up)[1]) for body in bodies])
    return Shape(pad(points, "edge"), pad(rests, "edge"), pad(shares, "constant"), coms)


def _check_hidden(hidden: Hidden, count: int) -> Hidden:
    arrays = {name: np.asarray(values, np.float32) for name, values in hidden._asdict().items()}
    for name, values in arrays.items():
        expected = (count, 3) if name == "up" else (count,)
        if values.shape != expected:
            raise ValueError(
                f"hidden.{name} has shape {values.shape}, but it must be {expected}, because bodies * num is {count}"
            )
        if not np.isfinite(values).all():
            raise ValueError(f"hidden.{name} has a value that is not finite, but all must be finite")
    fill = arrays["fill"]
    if fill.min() < 0 or fill.max() > 1:
        raise ValueError(f"hidden.fill reaches from {fill.min()} to {fill.max()}, but a share must be from 0 to 1")
    for name in ("shell_scale", "friction"):
        if arrays[name].min() <= 0:
            raise ValueError(f"hidden.{name} has the value {arrays[name].min()}, but it must be > 0")
    if not np.allclose(np.linalg.norm(arrays["up"], axis=1), 1, atol=1e-3):
        raise ValueError("hidden.up has rows that are not unit vectors: divide each row by its length")
    return Hidden(**jax.tree.map(jnp.asarray, arrays))


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
        for rows in np.split(mine, range(RIGIDS, len(mine), RIGIDS)):
            # Always the same number at once, because another number rounds differently and compiles anew.
            own = Hidden(*(x[np.resize(rows, RIGIDS)] for x in values))
            rigid = _rigid(bodies[index], own.fill, own.shell_scale, own.up)
            found.append([np.asarray(x)[: len(rows)] for x in (*rigid, own.friction)])
    return Rigid(*(np.concatenate(parts).astype(np.float64) for parts in zip(*found, strict=True)))


def _set_rigid(model: mujoco.MjModel, data: mujoco.MjData, body: int, rigid: Rigid, row: int) -> None:
    try:
        scene.set_rigid(model, data, *(x[row] for x in rigid))
    except ValueError as error:
        raise BodyError(body, str(error)) from error


def _draws(
    bodies: Sequence[Body], which: np.ndarray, hidden: Hidden, pad: tuple[float, float], constants: Contact, wall: float
) -> dict[str, np.ndarray]:
    """The fields of MJX's model for each draw, which MuJoCo derives from mass properties and friction."""
    original, like, _ = scene.template(pad, constants, wall)
    model = copy.copy(original)
    data = mujoco.MjData(model)
    rigid = rigids(bodies, which, hidden)
    fields = []
    for row, body in enumerate(which.tolist()):
        _set_rigid(model, data, body, rigid, row)
        fields.append(scene.drawn(model, like))
    return {name: np.stack([f[name] for f in fields]) for name in fields[0]}


# Takes indices of trajectories, and returns their final values and records.
_Run = Callable[[np.ndarray], tuple[State | native.Ends, Record]]


class _Set(NamedTuple):
    """The properties of a set of trajectories that no draw changes."""

    bodies: list[Body]
    which: Int[np.ndarray, "n"]  # index of the body of each trajectory
    hulls: list[Hull]
    scenario: Scenario
    pad: tuple[float, float]  # m
    time: Float[Array, "f s"]  # s, time at which each step begins


def _in_mjx(trajectories: _Set, starts: Start, hidden: Hidden, chunk: int) -> _Run:
    bodies, which, hulls, scenario, pad, time = trajectories
    _, model, data = scene.template(pad, scenario.contact, scenario.wall)
    fields = _draws(bodies, which, hidden, pad, scenario.contact, scenario.wall)

    def run(indices: np.ndarray) -> tuple[State, Record]:
        padded = np.pad(indices, (0, chunk - len(indices)), "edge")
        start = jax.tree.map(lambda x: x[padded], starts)
        worlds = _Worlds(
            fields={name: x[padded] for name, x in fields.items()},
            hull=jax.tree.map(lambda *x: np.stack(x), *(hulls[which[i]] for i in padded)),
            start=start,
            gravity=_gravity(start.condition, time, scenario=scenario),
        )
        return jax.tree.map(lambda x: np.asarray(x)[: len(indices)], _roll(worlds, model, data))

    return run


def _in_c(trajectories: _Set, starts: Start, hidden: Hidden, chunk: int) -> _Run:
    """As `_in_mjx`, but all trajectories of one call have the same body."""
    bodies, which, _, scenario, pad, time = trajectories
    rigid = rigids(bodies, which, hidden)
    starts = jax.tree.map(np.asarray, starts)

    @functools.lru_cache(maxsize=COMPILED)
    def compiled(body: int) -> mujoco.MjModel:
        return native.compile_body(np.asarray(bodies[body].hulls), pad, scenario.contact, scenario.wall)

    def run(indices: np.ndarray) -> tuple[native.Ends, Record]:
        body = int(which[indices[0]])
        models = []
        data = mujoco.MjData(compiled(body))
        for i in indices.tolist():
            models.append(copy.copy(compiled(body)))
            _set_rigid(models[-1], data, body, rigid, i)
        start = jax.tree.map(lambda x: x[indices], starts)
        padded = np.pad(start.condition, ((0, chunk - len(indices)), (0, 0)))  # so that `_gravity` compiles once
        gravity = np.asarray(_gravity(padded, time, scenario=scenario), np.float64)[: len(indices)]
        return native.roll(models, np.unique(np.asarray(bodies[body].hulls).reshape(-1, 3), axis=0), start, gravity)

    return run


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
        scenario: `Freefall()`, `Inclined()` or `Perturbed()`.
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
    bodies = list(body) if isinstance(body, Sequence) and not isinstance(body, str) else [body]
    check_key(key)
    _check(bodies, sensor, scenario, num, chunk)
    if engine not in (None, *get_args(Engine)):
        raise ValueError(f"engine is {engine!r}, but it must be {', '.join(map(repr, get_args(Engine)))} or None")
    count = len(bodies) * num
    given = None if hidden is None else _check_hidden(hidden, count)
    pad = (float(sensor.gel.size[0]), float(sensor.gel.size[1]))
    hulls = _hulls(bodies)
    shapes = _shapes(bodies, scenario)
    which, nth = np.repeat(np.arange(len(bodies)), num), np.tile(np.arange(num), len(bodies))
    frame = np.arange(scenario.frames)[:, None] / scenario.rate
    time = jnp.asarray(frame - np.arange(scenario.steps, 0, -1) * scenario.contact.timestep)  # begin of each step
    trajectories = _Set(bodies, which, hulls, scenario, pad, time)
    if engine is None:
        engine = "mujoco" if jax.default_backend() == "cpu" else "mjx"
    prepare, workers = (_in_mjx, WORKERS) if engine == "mjx" else (_in_c, os.cpu_count() or 1)
    # The trajectories of one call have hulls of one size in MJX, and one body in C MuJoCo.
    alike = np.array([b.hulls.size for b in bodies])[which] if engine == "mjx" else which

    attempt = np.zeros(count, np.int32)
    pending = np.arange(count)
    rows: dict[int, tuple[State | native.Ends, Record]] = {}
    with _reported(progress, count, engine) as report:
        while len(pending):
            starts, drawn = _draw(key, which, nth, attempt, shapes, scenario=scenario, pad=pad)
            drawn = drawn if given is None else given
            parts = [pending[alike[pending] == kind] for kind in np.unique(alike[pending])]
            size = chunk if engine == "mjx" else min(chunk, -(-len(pending) // workers))
            chunks = [c for part in parts for c in np.split(part, range(size, len(part), size))]
            with concurrent.futures.ThreadPoolExecutor(workers) as pool:
                results = pool.map(prepare(trajectories, starts, drawn, chunk), chunks)
                for indices, result in zip(chunks, results, strict=True):
                    for row, i in enumerate(indices.tolist()):
                        rows[i] = jax.tree.map(lambda x, row=row: x[row], result)
                    report(len(rows))
            states = [rows[i][0] for i in range(count)]
            ok = np.array([bool(state.finite and state.sunk <= SUNK_LIMIT) for state in states])
            pending = np.flatnonzero(~ok)
            attempt[pending] += 1
            if attempt.max() >= ATTEMPTS:
                worst = int(attempt.argmax())
                raise BodyError(
                    int(which[worst]),
                    f"trajectory {nth[worst]} is non-finite or sinks deeper than {SUNK_LIMIT} m in {ATTEMPTS} draws: "
                    "check the thickness of the hull and the mass",
                )

    last, records = jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), *(rows[i] for i in range(count)))
    frozen_or_slow = last.gone | (last.slow * scenario.contact.timestep >= SLOW_TIME)
    return Trajectory(
        time=jnp.tile(jnp.arange(scenario.frames) / scenario.rate, (count, 1)),
        pose=records.pose,
        velocity=records.velocity,
        wrench=records.wrench,
        contact=records.contact,
        wall=records.wall,
        gravity=_gravity(starts.condition, time[:, -1:], scenario=scenario)[:, :, 0],
        settled=frozen_or_slow,
        outcome=jax.vmap(scenario.outcome)(records.pose[:, 0], records.pose[:, -1]),
        touches=last.touches,
        sunk=last.sunk,
        condition=starts.condition,
        hidden=drawn,
        body=jnp.asarray(which, jnp.int32),
        resampled=jnp.asarray(attempt),
    )
