"""Frames per second of `sense` and of the ray tracer embree, and cost of a frame per pixel and per face.

    python -m benchmarks.sensor             # about 12 minutes on two CPU cores, most of it compilation
    python -m benchmarks.sensor --taxim     # about a minute: tactile images from height maps, compared with taxim
    python -m benchmarks.sensor --cost      # about 10 minutes: cost per pixel and per face, memory, a plot
    python -m benchmarks.sensor --compile   # about 2 minutes: number of compilations for a hundred objects

`sense` renders whole frames of objects at rest. embree traces only the depth of the same scenes, in three ways:

- `traced`: one call of embreex with all rays of an image, and a scene that was built beforehand
- `built`: a call that also builds the scene, because a moving object needs a new scene for each pose
- `trimesh`: the Python interface `mesh.ray` of trimesh

One call of `sense` uses little more than one core, so `dataset.collect` runs several calls at once, in threads. On a
GPU, one call renders a batch instead. Calls of `sense` and of embree alternate, and the figures are medians. The second
table has the share of each stage in the time of `sense`, and at 640x480 the speed relative to the code of the paper
(Rezaei-Shoshtari et al. 2021), whose renderer and shader took 0.40 s per frame in a single measurement on a CPU.
"""

import concurrent.futures
import dataclasses
import functools
import os
import resource
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import trimesh
import tyro
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

import sts_jax as sts
from benchmarks.instruments.starts import bodies
from benchmarks.instruments.timing import fresh, median_seconds
from benchmarks.instruments.truth import public_meshes
from experiments.shared.drawing import write_figure
from sts_jax import geometry, objects, optics, tactile
from sts_jax.rendering import drawing, equilibrium

SIZES = {(64, 64): 41, (200, 200): 15, (480, 640): 7}  # image sizes, and how often each is timed
FACES = (None, 2000, 5000)  # numbers of faces. None: the faces that the class generates
CATEGORIES = ("bottle", "scissors", "watch")
POSES = 16  # poses of each object: at rest on the pad, turned about the vertical
PAPER = 0.40  # s, time of the paper's code for a frame of 640x480
COST_SIZES = ((64, 64), (120, 160), (240, 320), (480, 640), (960, 1280), (1232, 1640))
COST_FACES = (500, 1000, 2000, 5000, 10000, 20000, 50000)
RESULTS = Path(__file__).parent / "results" / "sensor"

Inputs = tuple[jax.Array, jax.Array]
Works = list[Callable[[], object]]  # one call for each pose


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the command line."""

    taxim: bool = False  # measure tactile images from height maps, compared with taxim
    cost: bool = False  # measure the cost per pixel and per face, and the memory
    compile: bool = False  # count the compilations for a hundred objects

    def __post_init__(self) -> None:
        if sum((self.taxim, self.cost, self.compile)) > 1:
            raise ValueError("give at most one of --taxim, --cost and --compile")


class Case(NamedTuple):
    """An object at rest, and the size of its images."""

    name: str  # first columns of the row in the table
    body: objects.Body
    inputs: Inputs  # poses (n, 7) and wrenches (n, 6)
    shape: tuple[int, int]  # height and width (pixels)
    repeats: int  # number of measurements


class Durations(NamedTuple):
    """Median seconds per frame of `sense`, and per depth image of embree for each of the three ways."""

    frame: float  # a whole frame
    gel: float  # balance of the gel alone
    depth: float  # gel and depth
    visual: float  # gel, depth and visual stream
    tactile: float  # gel, depth and tactile stream
    at_once: float  # a whole frame in as many threads as there are cores, or in a batch
    embree: np.ndarray  # in one thread
    embree_at_once: np.ndarray  # in as many threads as there are cores


def finer(body: objects.Body, faces: int | None) -> objects.Body:
    """Subdivide and decimate a body to about `faces` faces. If `faces` is None, return the body unchanged."""
    if faces is None:
        return body
    own = np.asarray(body.faces)
    own = own[np.any(own != own[:, :1], axis=1)]
    mesh = trimesh.Trimesh(np.asarray(body.vertices, float), own)
    longest = mesh.extents.max()
    while len(mesh.faces) < faces:  # divides the longest edges first, so that faces become equal in size
        longest *= 0.8
        mesh = trimesh.Trimesh(*trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, longest, max_iter=30))
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # decimation and open meshes
        path = Path(folder) / "finer.ply"
        mesh.export(path)
        return objects.load(path, faces=faces, mass=float(objects.rigid(body, 0.5, 1.0)[0]), hollow=False)


def count(body: objects.Body) -> int:
    """Number of faces of a body, without padding."""
    return int(jnp.sum(jnp.any(body.faces != body.faces[:, :1], axis=1)))


def resting(body: objects.Body, number: int = POSES) -> Inputs:
    """Make poses of a body that stands upright on the pad, at `number` equally spaced angles about the vertical."""
    mass, com, _ = objects.rigid(body, 0.5, 1.0)
    angles = jnp.linspace(0, 2 * jnp.pi, number, endpoint=False)
    low = jnp.min(body.vertices[body.faces.ravel(), 2])
    quats = jax.vmap(lambda a: geometry.quat_from_rotvec(jnp.stack([0 * a, 0 * a, a])))(angles)
    poses = jnp.concatenate(
        [jnp.full((number, 1), 0.01), jnp.zeros((number, 1)), jnp.full((number, 1), -low), quats], 1
    )
    places = jax.vmap(geometry.transform)(poses, jnp.broadcast_to(com, (number, 3)))
    force = mass * 9.81
    zero = jnp.zeros(number)
    return poses, jnp.stack([zero, zero, zero + force, places[:, 1] * force, -places[:, 0] * force, zero], 1)


def embree(body: objects.Body, poses: jax.Array, shape: tuple[int, int]) -> dict[str, Works]:
    """Make functions that trace the depth of an object with embree."""
    camera = sts.Sensor().camera
    faces = np.asarray(body.faces)
    faces = faces[np.any(faces != faces[:, :1], axis=1)]
    posed = [np.asarray(geometry.transform(pose, body.vertices)) for pose in poses]
    slopes = np.asarray(jnp.stack(optics.rays(camera, optics.full_window(camera, shape), shape), -1)).reshape(-1, 2)
    directions = np.concatenate([slopes, np.ones((len(slopes), 1), np.float32)], -1)
    origins = np.tile(np.array([[0, 0, -camera.distance]], np.float32), (len(slopes), 1))

    def scene(vertices: np.ndarray) -> EmbreeScene:
        made = EmbreeScene()
        TriangleMesh(made, vertices[faces])
        return made

    def trace(made: EmbreeScene) -> np.ndarray:
        return made.run(origins, directions, query="DISTANCE")

    def trace_mesh(mesh: trimesh.Trimesh) -> np.ndarray:
        places, ray, _ = mesh.ray.intersects_location(origins, directions, multiple_hits=False)
        depth = np.full(len(slopes), np.inf)
        depth[ray] = places[:, 2] + camera.distance
        return depth

    scenes = [scene(vertices) for vertices in posed]
    meshes = [trimesh.Trimesh(vertices, faces, process=False) for vertices in posed]
    return {
        "traced": [functools.partial(trace, made) for made in scenes],
        "built": [functools.partial(lambda vertices: trace(scene(vertices)), vertices) for vertices in posed],
        "trimesh": [functools.partial(trace_mesh, mesh) for mesh in meshes],
    }


@functools.partial(jax.jit, static_argnames=("shape", "fields", "batched"))
def frames(
    body: objects.Body,
    inputs: Inputs,
    *,
    shape: tuple[int, int],
    fields: tuple[str, ...] = (),
    batched: bool = False,
) -> object:
    """Render frames of an object in one compiled call."""

    def draw(inputs: Inputs) -> object:
        whole = sts.sense(sts.Sensor(), body, *inputs, resolution=shape)
        return tuple(getattr(whole, name) for name in fields) if fields else whole

    return jax.vmap(draw)(inputs) if batched else jax.lax.map(draw, inputs)


def speed() -> None:
    """Print frames per second of `sense` and of the ray tracer Embree, for several objects, meshes and image sizes."""
    every = f"{os.cpu_count()} threads" if jax.default_backend() == "cpu" else "batched"
    print(f"frames /s, and embree's seconds over ours: traced, built, trimesh; {jax.devices()[0].device_kind}")
    print(f"{'object':9} {'faces':>6} {'image':>9} | {'one thread':>37} | {every:>37}")
    stages = []
    for case in cases():
        found = measure(case)
        print(rates(case, found), flush=True)
        stages.append(shares(case, found))
    print("\nshare of each stage, %: the time with it less the time without it (they need not sum to 100)")
    print(f"{'object':9} {'faces':>6} {'image':>9} | {'frame':>11} {'gel':>9} {'depth':>9} {'vision':>9} {'touch':>9}")
    print("\n".join(stages))


def cases() -> Iterator[Case]:
    """Yield a case for each combination of object, number of faces and image size."""
    for category in CATEGORIES:
        for faces in FACES:
            body = finer(objects.make(jax.random.key(0), category), faces)
            inputs = resting(body)
            for shape, repeats in SIZES.items():
                name = f"{category:9} {count(body):6} {shape[1]:4}x{shape[0]:<4}"
                yield Case(name, body, inputs, shape, repeats)


def measure(case: Case) -> Durations:
    """Measure the seconds per frame of `sense` and of the ray tracer Embree."""
    cores, on_cpu = os.cpu_count() or 1, jax.default_backend() == "cpu"
    pool = concurrent.futures.ThreadPoolExecutor(cores)

    def call(work: Callable[[], object]) -> object:
        return jax.block_until_ready(work())

    def one_by_one(works: Works) -> Callable[[], object]:
        return lambda: [call(work) for work in works]

    def in_threads(works: Works) -> Callable[[], object]:
        return lambda: list(pool.map(call, works))

    draw = functools.partial(frames, case.body, case.inputs, shape=case.shape)
    parts = [functools.partial(draw, fields=(name,)) for name in ("pressure", "depth", "visual", "tactile")]
    at_once = in_threads([draw] * cores) if on_cpu else functools.partial(draw, batched=True)
    others = list(embree(case.body, case.inputs[0], case.shape).values())
    threaded = [in_threads(works * cores) for works in others]
    with pool:
        seconds = median_seconds(draw, *parts, at_once, *map(one_by_one, others), *threaded, repeats=case.repeats)
    whole, gel, depth, visual, tactile, together = (s / POSES for s in seconds[:6])
    alone, traced = (np.array(some) / POSES for some in (seconds[6:9], seconds[9:]))
    return Durations(whole, gel, depth, visual, tactile, together / (cores if on_cpu else 1), alone, traced / cores)


def rates(case: Case, found: Durations) -> str:
    """Format a table row: frames per second of `sense` and of embree, and the ratios of their times."""
    row = [f"{case.name} |"]
    for mine, theirs in ((found.frame, found.embree), (found.at_once, found.embree_at_once)):
        row += [f"{1 / mine:8.1f}  {1 / theirs[0]:6.0f}", *(f"{t / mine:6.2f}" for t in theirs), "|"]
    return " ".join(row[:-1])


def shares(case: Case, found: Durations) -> str:
    """Format one case as a table row: the time of `sense` per frame (ms), and each stage's share of this time (%)."""
    stages = [found.gel, found.depth - found.gel, found.visual - found.depth, found.tactile - found.depth]
    line = " ".join(f"{100 * stage / found.frame:9.0f}" for stage in stages)
    paper = f"   {PAPER / found.at_once:.1f} times the paper's" if case.shape == (480, 640) else ""
    return f"{case.name} | {1e3 * found.frame:8.2f} ms {line}{paper}"


def ball(shape: tuple[int, int], pitch: float, *, radius: float = 4e-3, depth: float = 1e-3) -> np.ndarray:
    """Imprint of a ball in the middle of an image."""
    y, x = ((np.arange(n) - (n - 1) / 2) * pitch for n in shape)
    square = radius**2 - x[None, :] ** 2 - y[:, None] ** 2
    return np.maximum(np.sqrt(np.maximum(square, 0)) - radius + depth, 0).astype(np.float32)


def waves(shape: tuple[int, int], pitch: float, *, depth: float = 1e-3) -> np.ndarray:
    """Imprint of waves over a whole image."""
    y, x = ((np.arange(n) - (n - 1) / 2) * pitch for n in shape)
    return (depth * (0.6 + 0.2 * np.sin(2e3 * x)[None, :] + 0.2 * np.sin(1.4e3 * y)[:, None])).astype(np.float32)


def compare_taxim(shape: tuple[int, int] = (480, 640), pitch: float = 0.0295e-3) -> None:
    """Print the time that `sts_jax.touch` and the simulator Taxim need for a tactile image of an imprint."""
    from taxim import Taxim  # an optional dependency that only this measurement needs

    theirs = Taxim(backend="jax")
    window = pitch * jnp.array([-shape[1] / 2, -shape[0] / 2, shape[1], shape[0]])
    skin, shadowed = tactile.Skin(coupling=0.0002), tactile.Skin(coupling=0.0002, shadow_steps=16)
    sensors = {
        "sharp": sts.Sensor(),
        "far": sts.Sensor(skin=skin),
        "LEDs": sts.Sensor(lights=tactile.Leds(), skin=skin),
        "shadows": sts.Sensor(lights=tactile.Leds(), skin=shadowed),
    }
    print(f"touch at {shape[1]}x{shape[0]} from a height map, ms: {jax.devices()[0].device_kind}")
    names = (*sensors, "taxim", "shadows")
    print(f"{'':6} " + " ".join(f"{name:>8}" for name in names) + " | taxim's over ours: far, LEDs, shadows")
    for name, make in (("ball", ball), ("waves", waves)):
        imprint = jnp.asarray(make(shape, pitch))
        height = -1e3 * imprint + jnp.where(imprint > 0, 0, 1.0)  # mm, as taxim expects
        ours = [
            functools.partial(jax.jit(functools.partial(sts.touch, sensor)), imprint, window)
            for sensor in sensors.values()
        ]
        others = [
            functools.partial(theirs.render_direct, height, with_shadow=shadow, press_depth=1.0)
            for shadow in (False, True)
        ]
        times = [1e3 * seconds for seconds in median_seconds(*ours, *others, repeats=15)]
        _, far, leds, shadows, taxim, taxim_shadows = times
        row = " ".join(f"{value:8.1f}" for value in times)
        print(f"{name:6} {row} | {taxim / far:8.2f} {taxim / leds:8.2f} {taxim_shadows / shadows:8.2f}", flush=True)


def cost_of(faces: int, height: int, width: int) -> dict[str, float]:
    """Measure the time and the peak memory to render a frame of a bottle."""
    body, shape = finer(objects.make(jax.random.key(0), "bottle"), faces), (height, width)
    poses, wrenches = resting(body, 1 if shape == COST_SIZES[-1] else 4)  # four frames of this size are 0.2 GiB
    (seconds,) = median_seconds(lambda: frames(body, (poses, wrenches), shape=shape))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return {"faces": count(body), "seconds": seconds / len(poses), "bytes": peak}


def cost() -> None:
    """Measure the time and the peak memory of rendering a frame, for several image sizes and numbers of faces."""

    def measured(faces: int, shape: tuple[int, int]) -> dict[str, float]:
        found = fresh("benchmarks.sensor.cost_of", faces, *shape)
        seconds, memory = found["seconds"], f"{found['bytes'] / 2**30:6.2f} GiB held at most"
        image, per_pixel = f"{shape[1]:5}x{shape[0]:<5}", 1e9 * seconds / shape[0] / shape[1]
        print(f"{found['faces']:6} faces {image} {1e3 * seconds:8.2f} ms {per_pixel:8.1f} ns a pixel {memory}")
        return found

    by_size = [(shape, measured(2000, shape)) for shape in COST_SIZES]
    by_faces = {shape: [measured(faces, shape) for faces in COST_FACES] for shape in ((64, 64), (480, 640))}
    measured(20000, COST_SIZES[-1])
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6), constrained_layout=True)
    pixels = [shape[0] * shape[1] for shape, _ in by_size]
    left.loglog(pixels, [1e9 * found["seconds"] / n for (_, found), n in zip(by_size, pixels, strict=True)], "o-")
    left.set(xlabel="pixels", ylabel="ns a pixel", title="2,000 faces, 64x64 to 1640x1232")
    for shape, found in by_faces.items():
        right.loglog(
            [f["faces"] for f in found], [1e3 * f["seconds"] for f in found], "o-", label=f"{shape[1]}x{shape[0]}"
        )
    right.set(xlabel="faces", ylabel="ms a frame", title="a bottle at rest")
    right.legend()
    write_figure(RESULTS / "cost.png", figure, dpi=110)


def compilations(number: int = 100) -> None:
    """Print how often `sense` compiles for `number` different objects: the public meshes and procedural objects."""
    files = sorted(public_meshes().glob("*.obj"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # open meshes and missing materials
        loaded = [objects.load(path, longest_side=0.08, up="y", faces=4096) for path in files]
    items = [*loaded, *bodies(objects.CATEGORIES, number - len(loaded))]
    for body in items:
        poses, wrenches = resting(body, 1)
        sts.sense(sts.Sensor(), body, poses[0], wrenches[0])
    programs: tuple[Any, Any] = (equilibrium.balance, drawing.draw)
    balance, draw = (program._cache_size() for program in programs)
    print(f"{len(items)} objects, {len(files)} of them loaded: the balance compiled {balance} times, drawing {draw}")


def main(args: Args) -> None:
    """Run the measurement of the option `--taxim`, `--cost` or `--compile`, or else measure the speed of `sense`."""
    if args.taxim:
        compare_taxim()
    elif args.cost:
        cost()
    elif args.compile:
        compilations()
    else:
        speed()


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
