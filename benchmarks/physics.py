"""Speed of the simulation: steps, falls and frames per second of MJX and of C MuJoCo, and compilation times.

    python -m benchmarks.physics                   # about 2 minutes on two CPU cores
    python -m benchmarks.physics --engines 4       # about 2 minutes
    python -m benchmarks.physics --pipeline 64     # about a minute on a CPU. On a GPU, use --pipeline 4096
    python -m benchmarks.physics --scaling         # about 10 minutes. Writes benchmarks/results/physics/
    python -m benchmarks.physics --compile         # about 8 minutes

- Without an option: steps per second of MJX (two threads) and of `mujoco.rollout` (all cores) from the same poses, for
  one hull of 32 vertices, and for one object of each of the eight classes.
- `--engines N`: falls per second of both engines of `simulate`, for N falls of each of 16 objects. MJX simulates
  `--chunk` falls at once, and needs a larger `--chunk` on a GPU.
- `--pipeline N`: drops a bottle N times, renders both streams of every frame (64x64, uint8), and fetches them.
- `--scaling`: steps per second of 1 to 4,096 worlds at once (up to 65,536 on a GPU).
- `--compile`: seconds before the first step with an empty and with a filled compilation cache, and the number of
  compilations for a hundred objects.

`--engines` and `--pipeline` include all costs except compilation.
"""

import concurrent.futures
import copy
import dataclasses
import functools
import os
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, get_args

import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np
import tyro

from benchmarks.instruments.starts import SCENARIOS, bodies, rigid_of
from benchmarks.instruments.timing import fresh, in_turn
from experiments.shared import drawing
from sts_jax import dataset, objects, physics
from sts_jax.dataset.rendering import RENDER_BATCH
from sts_jax.physics import bodies as physics_bodies
from sts_jax.physics import contact, scene
from sts_jax.physics.bodies import rigid_of_draws
from sts_jax.physics.engines import Worlds, drawn_fields, gravity_at, roll_worlds
from sts_jax.physics.scenario import G
from sts_jax.physics.scene import mjx
from sts_jax.physics.simulation import WORKERS

# `simulate` has no public way to measure its compiled functions separately. If their names change, these imports fail.
from sts_jax.physics.simulation import draw as draw_starts
from sts_jax.sensor import Sensor

RESULTS = Path(__file__).parent / "results" / "physics"
COMPILED = ("freefall", "perturbed", "inclined")  # scenarios whose compilation is measured
OBJECTS = 100  # objects whose compilations are counted
GPU_BATCH = 4096  # frames rendered at once on a GPU
TACCEL = 915  # environment steps/s of the simulator Taccel, published for 4,096 environments on an H100


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the command line."""

    num: int = 8  # drops of each of the eight objects in the comparison with C MuJoCo
    engines: int | None = None  # measure both engines of `simulate`, with this many falls of each object
    chunk: int = 32  # falls that MJX simulates at once, for --engines. A GPU needs more than a CPU
    pipeline: int | None = None  # measure physics and rendering of this many drops
    scaling: bool = False  # measure steps per second against the number of worlds
    compile: bool = False  # measure the time of compilation, and count compiled programs

    def __post_init__(self) -> None:
        if sum(map(bool, (self.engines, self.pipeline, self.scaling, self.compile))) > 1:
            raise ValueError("give only one of --engines, --pipeline, --scaling and --compile")


class Speeds(NamedTuple):
    """Steps per second of all worlds together: MJX in one call, MJX in chunks of worlds, and C MuJoCo."""

    worlds: int  # trajectories that are simulated together
    at_once: float  # MJX, one call for all worlds
    in_chunks: float  # MJX, a call for each chunk of worlds, in threads
    in_c: float  # C MuJoCo's batch


def rod() -> objects.Body:
    """Make a solid rod of 16 sides, 30 mm thick and 100 mm long, with one hull of 32 vertices."""
    turn, mass, radius, length = np.arange(16) * np.pi / 8, 0.05, 0.015, 0.1
    ring = radius * np.stack([np.cos(turn), np.sin(turn)], 1)
    points = np.concatenate([np.c_[ring, np.full(16, z)] for z in (-length / 2, length / 2)])
    across = mass * (radius**2 / 4 + length**2 / 12)
    return dataclasses.replace(
        objects.make(jax.random.key(0), "fork"),  # a solid body, whose hull and mass properties are replaced
        hulls=jnp.asarray(points[None], jnp.float32),
        shell_mass=jnp.float32(mass),
        shell_com=jnp.zeros(3),
        shell_inertia=jnp.asarray(np.diag([across, across, mass * radius**2 / 2]), jnp.float32),
    )


def in_c(items: list[objects.Body], traj: physics.Trajectory, constants: physics.Contact) -> tuple[list, np.ndarray]:
    """Make the model and the initial state with which C MuJoCo can repeat each of the given trajectories."""
    gel, models, states = Sensor().gel.size, [], []
    pad = (float(gel[0]), float(gel[1]))
    compiled = [scene.compile_scene(np.asarray(body.hulls), pad, constants) for body in items]
    properties = [np.asarray(x, np.float64) for x in (*rigid_of(items, traj), traj.hidden.friction)]
    rows = zip(np.asarray(traj.body), np.asarray(traj.pose[:, 0]), *properties, strict=True)
    for index, pose, mass, com, inertia, friction in rows:
        model = copy.copy(compiled[index])
        data = mujoco.MjData(model)
        scene.set_rigid(model, data, mass, com, inertia, float(friction))
        data.qpos[:] = pose
        state = np.empty(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
        mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        models.append(model)
        states.append(state)
    return models, np.array(states)


def speed(num: int) -> None:
    """Print steps per second of MJX and of C MuJoCo, first for a hull of 32 vertices, then for eight objects."""
    compare_speed("one hull of 32 vertices", [rod()], 8 * num)
    compare_speed("eight objects, up to 64 vertices", bodies(objects.CATEGORIES, 8), num)


def compare_speed(name: str, items: list[objects.Body], num: int) -> None:
    """Print steps per second of MJX and of C MuJoCo, for `num` drops of each object."""
    sensor, scenario = Sensor(), physics.Freefall()
    simulate = functools.partial(physics.simulate, jax.random.key(0), items, sensor, scenario, num, engine="mjx")
    traj, steps = simulate(), scenario.frames * scenario.steps
    models, states = in_c(items, traj, scenario.contact)
    batches = [(np.array(m, object), s) for m, s in grouped(models, states)]
    data = [[mujoco.MjData(m[0]) for _ in range(os.cpu_count() or 1)] for m, _ in batches]

    def rollout() -> None:
        for (batch, state), own in zip(batches, data, strict=True):
            mujoco.rollout.rollout(list(batch), own, state, nstep=steps, persistent_pool=True)

    seconds = in_turn(simulate, rollout)
    ours, theirs = len(models) * steps / np.median(seconds, axis=0)
    ratio = float(np.median(seconds[:, 1] / seconds[:, 0]))
    print(f"{name}: {len(models)} drops of {steps} steps")
    print(f"    simulate (MJX)   {ours:10,.0f} steps/s, {WORKERS} threads, all costs but compilation")
    print(f"    C MuJoCo         {theirs:10,.0f} steps/s, rollout on {os.cpu_count()} threads")
    print(f"    ratio            {ratio:10.4f} (1/{1 / ratio:.1f}), median of pairs")


def engines(num: int, chunk: int) -> None:
    """Measure the number of falls that each engine of `simulate` computes in a second, and print the two numbers."""
    items, sensor, scenario = bodies(objects.CATEGORIES, 16), Sensor(), physics.Freefall()
    calls = [
        functools.partial(physics.simulate, jax.random.key(0), items, sensor, scenario, num, chunk=chunk, engine=engine)
        for engine in get_args(physics.Engine)
    ]
    seconds = in_turn(*calls, repeats=3)
    count = len(items) * num
    machine = f"{jax.devices()[0].device_kind}, {os.cpu_count()} cores"
    print(f"{count} falls of {scenario.frames} frames, eight classes, chunks of {chunk} in MJX: {machine}")
    for engine, median in zip(get_args(physics.Engine), np.median(seconds, axis=0), strict=True):
        print(f"    simulate, engine {engine!r:9s} {count / median:8.1f} falls/s")
    ratio = float(np.median(seconds[:, 0] / seconds[:, 1]))
    print(f"    ratio                      {ratio:8.1f}, median of pairs")


def grouped(models: list, states: np.ndarray) -> list[tuple[list, np.ndarray]]:
    """Group models and states by the number of mesh vertices, because `mujoco.rollout` needs models of one size."""
    sizes = np.array([model.nmeshvert for model in models])
    return [([m for m, n in zip(models, sizes, strict=True) if n == k], states[sizes == k]) for k in np.unique(sizes)]


def worlds(count: int, frames: int) -> tuple[Worlds, mjx.Model, mjx.Data]:
    """Make the arguments that `simulate` passes to MJX. The scene is a rod that drops from a height of 2 mm."""
    scenario, body, gel = physics.Freefall(height=0.002, frames=frames), rod(), Sensor().gel.size
    pad, some = (float(gel[0]), float(gel[1])), min(count, 256)
    index = np.zeros(some, np.int32)
    shapes = physics_bodies.shapes([body], scenario)
    nth = np.arange(some, dtype=np.int32)
    start, hidden = draw_starts(jax.random.key(0), index, nth, index, shapes, scenario=scenario, pad=pad)
    fields = drawn_fields([body], index, hidden, pad, scenario.contact, scenario.wall)
    fields, start = jax.tree.map(lambda x: np.resize(x, (count, *x.shape[1:])), (fields, start))
    hull = jax.tree.map(lambda x: np.broadcast_to(x, (count, *x.shape)), contact.hull(np.asarray(body.hulls)))
    gravity = jnp.broadcast_to(jnp.array([0, 0, -G]), (count, frames, scenario.steps, 3))
    _, model, data = scene.template(pad, scenario.contact, scenario.wall)
    return Worlds(fields, hull, start, jnp.zeros((count, 6)), gravity), model, data


def scaling(frames: int = 8, chunk: int = 32) -> None:
    """Measure steps per second against the number of worlds, and plot it."""
    rows: list[Speeds] = []
    for count in [4**k for k in range(9 if jax.default_backend() != "cpu" else 7)]:
        row = speeds(count, frames, chunk)
        rows.append(row)
        print(
            f"{count:6d} worlds: {row.at_once:12,.0f} at once {row.in_chunks:12,.0f} in chunks {row.in_c:12,.0f} C",
            flush=True,
        )
    draw_scaling(rows, jax.devices()[0].device_kind, chunk)


def speeds(count: int, frames: int, chunk: int) -> Speeds:
    """Measure the steps per second of `count` worlds."""
    scenario = physics.Freefall(height=0.002, frames=frames)
    full, model, data = worlds(count, frames)
    split = [jax.tree.map(lambda x, i=i: x[i : i + chunk], full) for i in range(0, count, chunk)]
    traj = physics.simulate(jax.random.key(0), rod(), Sensor(), scenario, min(count, 256))
    models, states = in_c([rod()], traj, scenario.contact)
    models, states = [models[i % len(models)] for i in range(count)], np.resize(states, (count, states.shape[1]))
    own = [mujoco.MjData(models[0]) for _ in range(os.cpu_count() or 1)]
    on_device, steps = jax.device_put(full), frames * scenario.steps

    def at_once() -> None:
        jax.block_until_ready(roll_worlds(on_device, model, data))

    def in_chunks() -> None:
        with concurrent.futures.ThreadPoolExecutor(WORKERS) as pool:
            list(pool.map(lambda part: jax.block_until_ready(roll_worlds(part, model, data)), split))

    def rollout() -> None:
        mujoco.rollout.rollout(models, own, states, nstep=steps, persistent_pool=True)

    seconds = np.median(in_turn(at_once, in_chunks, rollout, repeats=3), axis=0)
    return Speeds(count, *(count * steps / seconds).tolist())


def draw_scaling(rows: Sequence[Speeds], device: str, chunk: int) -> None:
    """Plot steps per second against the number of worlds in `scaling.png`."""
    from matplotlib.figure import Figure

    names = ("MJX, all at once", f"MJX, {chunk} at a time, {WORKERS} threads", f"C MuJoCo, {os.cpu_count()} threads")
    title = f"Steps per second, one hull of 32 vertices ({device}, {os.cpu_count()} cores)"
    figure = Figure(figsize=(5, 3.6), layout="constrained")
    axes = figure.subplots()
    worlds, *speeds = zip(*rows, strict=True)
    for name, column in zip(names, speeds, strict=True):
        axes.loglog(worlds, column, "o-", label=name)
    axes.set(xlabel="worlds", ylabel="steps per second", title=title)
    axes.title.set_fontsize(9)
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(0.02, 0.52))
    drawing.write_figure(RESULTS / "scaling.png", figure, dpi=150)


def draw(body: objects.Body, traj: physics.Trajectory) -> None:
    """Render the visual and tactile images of all frames of `traj`, and fetch the images to the host."""
    gpu = jax.default_backend() != "cpu"
    batch, threads = (GPU_BATCH, 1) if gpu else (RENDER_BATCH, os.cpu_count())
    pose, wrench = (np.asarray(x).reshape(-1, x.shape[-1]) for x in (traj.pose, traj.wrench))

    def one(begin: int) -> None:
        # Repeats the last frame to fill the last batch, because another batch size would compile another program.
        rows = np.minimum(np.arange(begin, begin + batch), len(pose) - 1)
        images = dataset.render_uint8(Sensor(), body, pose[rows], wrench[rows], resolution=(64, 64), crop=False)
        jax.device_get(images[:2])

    with concurrent.futures.ThreadPoolExecutor(threads) as pool:
        list(pool.map(one, range(0, len(pose), batch)))


def pipeline(count: int) -> None:
    """Print frames per second of physics, of rendering, and of both together, for `count` drops of a bottle."""
    engine: physics.Engine = "mujoco" if jax.default_backend() == "cpu" else "mjx"
    chunk = 32 if engine == "mujoco" else count
    body, scenario = objects.make(jax.random.key(0), "bottle"), physics.Freefall()
    for _ in range(2):  # the first round compiles
        begin = time.perf_counter()
        traj = physics.simulate(jax.random.key(1), body, Sensor(), scenario, count, chunk=chunk, engine=engine)
        jax.block_until_ready(traj)
        simulated = time.perf_counter()
        draw(body, traj)
        drawn = time.perf_counter()
    frames = count * scenario.frames
    print(f"{count:,} worlds of {scenario.frames} frames, both streams 64x64: {jax.devices()[0].device_kind}")
    for name, seconds in (("physics", simulated - begin), ("streams", drawn - simulated), ("together", drawn - begin)):
        print(f"    {name:9s} {seconds:8.2f} s {frames / seconds:10,.0f} frames/s")
    share = frames / (drawn - begin) / (10 * TACCEL)
    print(f"    {share:.3f} of the goal of {10 * TACCEL:,} frames/s, ten times the {TACCEL} steps/s that Taccel")
    print("    published for 4,096 environments on an H100")


def first_call(name: str, count: int) -> dict[str, Any]:
    """Measure the compilation time of `simulate` and count its compilations. Call this function in a new process."""
    scenario, sensor, items = SCENARIOS[name], Sensor(), bodies(objects.CATEGORIES, count)
    items = [body for body in items if physics.refusal(body, scenario) is None]
    begin = time.perf_counter()
    physics.simulate(jax.random.key(0), items[0], sensor, scenario, engine="mjx")
    first = time.perf_counter() - begin
    begin = time.perf_counter()
    physics.simulate(jax.random.key(0), items[0], sensor, scenario, engine="mjx")
    again = time.perf_counter() - begin
    jax.clear_caches()
    physics.simulate(jax.random.key(0), items, sensor, scenario, engine="mjx")
    compiled: dict[str, Any] = {
        "roll": roll_worlds,
        "draw": draw_starts,
        "rigid": rigid_of_draws,
        "gravity": gravity_at,
    }
    programs = {name: function._cache_size() for name, function in compiled.items()}
    return {"seconds": first - again, "objects": len(items), "programs": programs}


def compilation() -> None:
    """Print the seconds of compilation of each scenario, with an empty and with a filled compilation cache."""
    for name in COMPILED:
        with tempfile.TemporaryDirectory() as folder:
            for kind in ("empty cache", "kept cache"):
                found = fresh("benchmarks.physics.first_call", name, OBJECTS, cache=Path(folder))
                programs = ", ".join(f"{function} {number}" for function, number in found["programs"].items())
                print(f"{name:9s} {kind:11s} {found['seconds']:5.1f} s before the first step")
                print(f"{'':9s} programs for {found['objects']} objects: {programs}", flush=True)


def main(args: Args) -> None:
    """Run the chosen measurement."""
    if args.compile:
        compilation()
    elif args.scaling:
        scaling()
    elif args.engines is not None:
        engines(args.engines, args.chunk)
    elif args.pipeline is not None:
        pipeline(args.pipeline)
    else:
        speed(args.num)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
