"""Collect a dataset: objects, trajectories and frames. Each shard is a pure function of the collection and sensor."""

import concurrent.futures
import dataclasses
import functools
import hashlib
import math
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, UInt8
from scipy import spatial

from sts_jax import geometry, objects, physics
from sts_jax._files import claim, digest, lock, read_json
from sts_jax.dataset import records
from sts_jax.frame import sense
from sts_jax.sensor import Sensor

# Frames rendered by one compiled call. The last call of an object is padded. A CPU renders frames one after another.
RENDER_BATCH = 32
CPU_RENDER_BATCH = 8
SAME = 1e-5  # m, largest difference between files of one mesh in several formats
PARTS = ("train", "validation", "test")  # of the split of the objects


@dataclasses.dataclass(frozen=True)
class Meshes:
    """Objects from files, see `survey_meshes`."""

    folder: str
    names: tuple[str, ...]  # names of items of `objects.library`
    labels: tuple[str, ...]  # class of each
    digest: str  # SHA-256 of the names and files
    cache: str | None = None  # folder, see `objects.library`
    scale: float | None = None  # m, length of one unit of the files
    up: Literal["x", "y", "z"] | None = None


@dataclasses.dataclass(frozen=True)
class Collection:
    """Description of a dataset. Together with a `Sensor` it determines every byte of it."""

    scenario: physics.Scenario = dataclasses.field(default_factory=physics.Freefall)
    categories: tuple[str, ...] = objects.CATEGORIES  # classes of the procedural objects, used in turn
    meshes: Meshes | None = None  # objects from files instead (num_objects is their number)
    parts: bool = False  # convex parts for objects whose hull fits badly (package coacd, ten seconds per object)
    num_objects: int = 160
    num_per_object: int = 4  # trajectories per object, each with new hidden values
    num_full: int = 20  # trajectories with every frame rendered (other rendered ones: first and last frame)
    num_rendered: int | None = None  # trajectories per object that have images, the first ones (None: all)
    num_views: int = 0  # pictures per object at further starts, which are not simulated
    symmetries: bool = True  # render first and last frames in all `scenario.symmetries`, or only as simulated
    resolution: tuple[int, int] = (64, 64)  # height, width (pixels)
    crop: bool = False  # the square around the object (the paper's view) instead of the whole pad
    shares: tuple[float, float, float] = (0.7, 0.1, 0.2)  # of the objects for training, validation and test
    objects_per_shard: int = 40
    seed: int = 0
    engine: physics.Engine = "mujoco"  # see `physics.simulate` (trajectories differ between engines)

    @property
    def num_trajectories(self) -> int:
        """Number of trajectories in the whole dataset."""
        return self.num_objects * self.num_per_object

    @property
    def rendered_per_object(self) -> int:
        """Number of trajectories per object that have images."""
        return self.num_per_object if self.num_rendered is None else self.num_rendered

    @property
    def num_shards(self) -> int:
        """Number of shards. A shard is written as a whole or not at all."""
        return math.ceil(self.num_objects / self.objects_per_shard)


class Collected(NamedTuple):
    """Summary of a whole dataset, as `collect` returns it."""

    resampled: int  # number of discarded draws of trajectories
    left_out: tuple[str, ...]  # one line for each object that was left out


class Progress(NamedTuple):
    """Progress of `collect`."""

    done: int  # finished trajectories or frames
    total: int
    stage: str  # "trajectories" or "frames"


def survey_meshes(
    folder: str | os.PathLike[str],
    scenario: physics.Scenario,
    *,
    classes: tuple[str, ...] = (),
    scale: float | None = None,
    up: Literal["x", "y", "z"] | None = None,
    parts: bool = False,
    cache: str | os.PathLike[str] | None = None,
    progress: Callable[[str], None] | None = None,
) -> tuple[Meshes, str]:
    """List the objects of a folder of meshes, or of ShapeNetSem, that a scenario can use.

    Args:
        folder: See `objects.library`.
        scenario: The scenario that the objects are for.
        classes: The classes to use, see `mesh_classes`. Empty means all.
        scale: Length of one unit of the files (m). None takes ShapeNetSem's table, or 1 m for other files.
        up: The files' axis that becomes +z. None takes ShapeNetSem's table, or y for glTF and z for other files.
        parts: Whether objects whose hull fits badly collide as convex parts.
        cache: Folder that keeps the processed objects.
        progress: Called with a line for each object.

    Returns:
        The usable objects, and a listing of them and of the objects that were left out, with the reasons. Files with
        the same mesh, under any names and in any formats, count as one object. Otherwise a mesh could be in two parts
        of the split.

    Raises:
        FileNotFoundError: The folder does not exist.
        ValueError: The folder holds no mesh, no usable mesh, or no mesh of one of the classes.
    """
    library = objects.library(folder, cache=cache, scale=scale, up=up, parts=parts)
    unknown = sorted(set(classes) - set(library.classes))
    if unknown:
        raise ValueError(f"{folder} holds no {', '.join(unknown)}: choose among {', '.join(library.classes)}")
    items = tuple(item for item in library.items if not classes or item.label in classes)
    library, listing = objects.survey(dataclasses.replace(library, items=items), progress=progress)
    usable, digest = [], hashlib.sha256()
    seen: dict[int, list[tuple[str, np.ndarray]]] = {}  # name and `_triangles`, by the number of triangles
    for index, item in enumerate(library.items):
        body = objects.read(library, index).body
        reason = physics.refusal(body, scenario)
        if reason is not None:
            listing += f"{item.name}: left out of {type(scenario).__name__}: {reason}\n"
            continue
        triangles = _triangles(body)
        alike = seen.setdefault(len(triangles), [])
        twin = next((name for name, other in alike if _same(triangles, other)), None)
        if twin is not None:
            listing += f"{item.name}: the same mesh as {twin}, left out\n"
            continue
        alike.append((item.name, triangles))
        usable.append(item)
        digest.update(item.name.encode() + hashlib.sha256(item.path.read_bytes()).digest())
    if not usable:
        raise ValueError(f"{folder} holds no object that can be used:\n{listing}")
    names, labels = tuple(item.name for item in usable), tuple(item.label for item in usable)
    kept = None if cache is None else str(cache)
    return Meshes(str(folder), names, labels, digest.hexdigest(), kept, scale, up), listing


def _triangles(body: objects.Body) -> np.ndarray:
    """The centres of a body's triangles (n, 3), without the padding."""
    corners = np.asarray(body.vertices)[np.asarray(body.faces)]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1)
    return corners[area > 0].mean(1)


def _same(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether two meshes with the same number of triangles have them at the same places, in any order."""
    box = [np.stack([x.min(0), x.max(0)]) for x in (one, other)]
    if np.abs(box[0] - box[1]).max() > SAME:
        return False
    pairs = ((one, other), (other, one))
    return all(spatial.cKDTree(x).query(y)[0].max() <= SAME for x, y in pairs)


def mesh_classes(folder: str | os.PathLike[str]) -> tuple[str, ...]:
    """The classes of the objects of a folder (see `objects.library`). No mesh is opened."""
    return objects.library(folder).classes


@functools.lru_cache
def _library(meshes: Meshes, parts: bool) -> tuple[objects.Library, dict[str, int]]:
    library = objects.library(meshes.folder, cache=meshes.cache, scale=meshes.scale, up=meshes.up, parts=parts)
    return library, {item.name: index for index, item in enumerate(library.items)}


def class_names(collection: Collection) -> tuple[str, ...]:
    """The class of each object of a collection, `num_objects` names."""
    if collection.meshes is not None:
        return collection.meshes.labels
    return tuple(collection.categories[i % len(collection.categories)] for i in range(collection.num_objects))


def make_bodies(collection: Collection, indices: np.ndarray) -> list[objects.Body]:
    """Make objects of a collection, given their indices (n,).

    A procedural object has a key of its own, so that object i does not depend on the other objects that are made.

    Raises:
        FileNotFoundError: A mesh file no longer exists.
        ValueError: No body can be made from an object.
    """
    if collection.meshes is not None:
        library, where = _library(collection.meshes, collection.parts)
        chosen = [collection.meshes.names[i] for i in indices]
        gone = [name for name in chosen if name not in where]
        if gone:
            raise FileNotFoundError(f"{library.folder} no longer has the mesh files {', '.join(gone)}: put them back")
        return [objects.read(library, where[name]).body for name in chosen]
    key, names = jax.random.key(collection.seed), class_names(collection)
    bodies = [objects.make(jax.random.fold_in(key, int(i)), names[i]) for i in indices]
    if not collection.parts:
        return bodies
    return [objects.decompose(body) if objects.gaps(body)[1] > objects.HOLLOW else body for body in bodies]


def head(collection: Collection, count: int) -> Collection:
    """The collection of the first `count` objects only."""
    meshes = collection.meshes
    if meshes is None:
        return dataclasses.replace(collection, num_objects=count)
    few = dataclasses.replace(meshes, names=meshes.names[:count], labels=meshes.labels[:count])
    return dataclasses.replace(collection, meshes=few, num_objects=len(few.names))


def split_objects(collection: Collection) -> dict[str, np.ndarray]:
    """Indices of the objects for training, validation and test, shuffled by the seed, with classes spread evenly."""
    rng = np.random.default_rng([collection.seed, 1])
    # Each block has one object of every class that has one left, so that a cut spreads the classes evenly.
    names = np.array(class_names(collection))
    members = [rng.permutation(np.flatnonzero(names == name)) for name in dict.fromkeys(names.tolist())]
    blocks = [rng.permutation([m[i] for m in members if i < len(m)]) for i in range(max(map(len, members)))]
    cuts = np.round(np.cumsum(collection.shares)[:-1] * collection.num_objects).astype(int)
    parts = np.split(np.concatenate(blocks), cuts)
    return {name: np.sort(part).astype(np.int64) for name, part in zip(PARTS, parts, strict=True)}


def turn(pose: Float[Array, "*n 7"], symmetry: int) -> Float[Array, "*n 7"]:
    """A pose under a symmetry of the pad. A mirrored pose belongs to the mirrored body, see `objects.mirror`.

    Symmetry s first mirrors (y becomes -y) if s >= 4, and then turns by s % 4 quarter turns about z.
    """
    if symmetry >= 4:
        pose = pose * jnp.array([1.0, -1, 1, 1, -1, 1, -1])
    spin = geometry.quat_from_rotvec(jnp.array([0.0, 0.0, symmetry % 4 * math.pi / 2]))
    position = geometry.transform(jnp.concatenate([jnp.zeros(3), spin]), pose[..., :3])
    spin = jnp.broadcast_to(spin, (*pose.shape[:-1], 4))
    return jnp.concatenate([position, geometry.quat_canonical(geometry.quat_multiply(spin, pose[..., 3:]))], -1)


def turn_wrench(wrench: Float[Array, "*n 6"], symmetry: int) -> Float[Array, "*n 6"]:
    """A wrench about the sensor's origin under a symmetry of the pad."""
    if symmetry >= 4:
        wrench = wrench * jnp.array([1.0, -1, 1, -1, 1, -1])
    spin = geometry.quat_from_rotvec(jnp.array([0.0, 0.0, symmetry % 4 * math.pi / 2]))
    pair = wrench.reshape(*wrench.shape[:-1], 2, 3)
    return geometry.transform(jnp.concatenate([jnp.zeros(3), spin]), pair).reshape(wrench.shape)


def turn_condition(condition: Float[Array, "*n c"], symmetry: int, vectors: int = 1) -> Float[Array, "*n c"]:
    """A condition under a symmetry of the pad. It begins with so many vectors (x, y), and the other numbers stay."""
    if condition.shape[-1] == 0:
        return condition
    parts = [condition[..., 2 * vectors :]]
    for place in reversed(range(0, 2 * vectors, 2)):
        vector = jnp.concatenate([condition[..., place : place + 2], jnp.zeros((*condition.shape[:-1], 4))], -1)
        parts.insert(0, turn_wrench(vector, symmetry)[..., :2])
    return jnp.concatenate(parts, -1)


def collect(
    collection: Collection,
    sensor: Sensor,
    folder: Path,
    *,
    progress: Callable[[Progress], None] | None = None,
) -> Collected:
    """Make every shard of a dataset that does not exist yet.

    Args:
        collection: The description of the dataset.
        sensor: The sensor that renders the frames.
        folder: The folder for the shards, `collection.json`, `sensor.json` (for `Sensor.load`) and `split.json`.
        progress: Called as trajectories and frames are finished.

    Returns:
        For the whole dataset, the number of draws that were discarded because the trajectory became non-finite or the
        object sank too deep, and the objects that were left out because all their draws failed or because they
        could not be made.

    Raises:
        ValueError: A constant of the sensor or a field of the collection is out of range, the folder holds another
            collection (the message names the field) or one of an older format, the pad does not have the scenario's
            symmetries, or no object of a shard can be simulated.
        LockedError: Another process collects into the folder.
        TornFileError: A file in the folder is damaged, or belongs to another dataset or shard. The message names it.
        OSError: The disk is full, or the folder cannot be written to.
    """
    sensor.check()
    sides = [float(side) for side in sensor.gel.size]
    quarter_turns = any(symmetry % 2 for symmetry in symmetries_of(collection))
    if quarter_turns and sides[0] != sides[1]:
        raise ValueError(f"symmetries=True needs a square pad, got gel.size={sides}: give one, or symmetries=False")
    if min(collection.shares) < 0 or not math.isclose(sum(collection.shares), 1):
        raise ValueError(f"shares is {collection.shares}, but the shares of the objects must be >= 0 and have sum 1")
    if collection.meshes is not None and collection.num_objects != len(collection.meshes.names):
        raise ValueError(f"num_objects={collection.num_objects}, but meshes has {len(collection.meshes.names)} objects")
    _check_counts(collection)
    with lock(folder):
        return _collect(collection, sensor, folder, progress)


def _check_counts(collection: Collection) -> None:
    rendered, views, most = collection.num_rendered, collection.num_views, collection.num_per_object
    if rendered is not None and not (type(rendered) is int and 1 <= rendered <= most):
        raise ValueError(
            f"num_rendered must be a whole number from 1 to num_per_object={most}, or None for all, got {rendered!r}"
        )
    if not (type(views) is int and views >= 0):
        raise ValueError(f"num_views must be a whole number of at least 0, got {views!r}")


def _collect(
    collection: Collection, sensor: Sensor, folder: Path, progress: Callable[[Progress], None] | None
) -> Collected:
    description, constants, path = _as_json(collection), sensor.constants(), folder / "collection.json"
    if path.exists():
        records.check_format(read_json(path, f"delete {folder} and collect again"), folder)
    claim(path, description)
    claim(folder / "sensor.json", constants)
    claim(
        folder / "split.json",
        {name: [int(i) for i in part] for name, part in split_objects(collection).items()},
    )
    made = Collected(0, ())
    for index in range(collection.num_shards):
        identity = records.Identity(digest(description), digest(constants), index)
        path = shard_path(folder, collection.num_shards, index)
        if not path.with_suffix(".npz").exists():
            _make_shard(collection, sensor, folder, identity, progress)
        shard = records.read_shard(path, identity)
        resampled = made.resampled + int(shard["trajectory/resampled"].sum())
        made = Collected(resampled, made.left_out + tuple(shard["left_out"].tolist()))
    return made


def symmetries_of(collection: Collection) -> tuple[int, ...]:
    """Symmetries of the pad in which the first and last frames of a trajectory are rendered. 0 is the identity."""
    return collection.scenario.symmetries if collection.symmetries else (0,)


def shard_path(folder: Path, count: int, index: int) -> Path:
    """The record file of shard `index` of `count`."""
    return folder / f"shard-{index:05d}-of-{count:05d}.array_record"


def _make_shard(
    collection: Collection,
    sensor: Sensor,
    folder: Path,
    identity: records.Identity,
    progress: Callable[[Progress], None] | None,
) -> None:
    index = identity.shard
    first = index * collection.objects_per_shard
    members = np.arange(first, min(first + collection.objects_per_shard, collection.num_objects))
    before = first * collection.num_per_object
    key = jax.random.fold_in(jax.random.key(collection.seed), collection.num_objects + index)
    bodies, left_out = _made(collection, members)
    while True:
        if not bodies:
            raise ValueError(f"{folder}: no object of shard {index} can be simulated: {left_out[-1]}")
        members = np.array(list(bodies))
        try:
            trajectory = physics.simulate(
                key,
                list(bodies.values()),
                sensor,
                collection.scenario,
                collection.num_per_object,
                progress=_report(progress, before, collection.num_trajectories, "trajectories"),
                engine=collection.engine,
            )
            break
        except physics.BodyError as error:  # one bad object does not stop a collection
            number = int(members[error.body])
            del bodies[number]
            left_out.append(f"{_named(collection, number)}: {str(error).partition(': ')[2]}")
    trajectory = jax.tree.map(np.asarray, trajectory)
    frames = _frames_of(collection, members, trajectory)
    views = _views_of(collection, key, list(bodies.values()), sensor)
    report = _report(progress, 0, len(frames) + len(views["body"]), "frames")
    arrays = {f"trajectory/{name}": leaf for name, leaf in trajectory._asdict().items() if name != "hidden"}
    arrays |= {f"hidden/{name}": leaf for name, leaf in trajectory.hidden._asdict().items()}
    arrays["trajectory/body"] = members[arrays["trajectory/body"]].astype(np.int32)
    solid = _solid(list(bodies.values()), trajectory.body, trajectory.hidden)
    mirrored = np.stack([objects.support(objects.mirror(body)) for body in bodies.values()])
    arrays |= {f"solid/{name}": leaf for name, leaf in solid.items()} | {"solid/mirrored": mirrored[trajectory.body]}
    arrays |= {f"view/{name}": leaf for name, leaf in views.items()}
    arrays["view/body"] = members[views["body"]].astype(np.int32)
    arrays |= {"frames": frames, "left_out": np.array(left_out, str)}
    images = _render(collection, sensor, list(bodies.values()), trajectory, frames, views, report)
    records.write_shard(shard_path(folder, collection.num_shards, index), images, arrays, identity)


def _made(collection: Collection, members: np.ndarray) -> tuple[dict[int, objects.Body], list[str]]:
    """Objects by index, and a line for each that cannot be made, such as one whose file was deleted meanwhile."""
    bodies, left_out = {}, []
    for number in members.tolist():
        try:
            (bodies[number],) = make_bodies(collection, np.array([number]))
        except (OSError, ValueError) as error:
            left_out.append(f"{_named(collection, number)}: {error}")
    return bodies, left_out


def _named(collection: Collection, number: int) -> str:
    name = class_names(collection)[number] if collection.meshes is None else collection.meshes.names[number]
    return f"object {number} ({name})"


def _frames_of(collection: Collection, members: np.ndarray, trajectory: physics.Trajectory) -> np.ndarray:
    """The frames to render, as rows of (trajectory, frame, symmetry). Trajectories are counted within the shard."""
    num, last = trajectory.pose.shape[0], trajectory.pose.shape[1] - 1
    rows: list[tuple[int, int, int]] = []
    for i in range(num):
        # Full trajectories are spread over the objects: the first one of each, then the second one of each, ...
        place, repeat = divmod(i, collection.num_per_object)
        if repeat >= collection.rendered_per_object:
            continue
        rank = repeat * collection.num_objects + members[place]
        full = rank < collection.num_full
        rows += [(i, t, 0) for t in (range(last + 1) if full else (0, last))]
        rows += [(i, t, symmetry) for symmetry in symmetries_of(collection) if symmetry for t in (0, last)]
    frames = np.array(rows, np.int32)
    # Sorted by object and then by mirror image, because a call renders one body.
    return frames[np.lexsort((frames[:, 2] >= 4, frames[:, 0] // collection.num_per_object))]


def _solid(bodies: list[objects.Body], which: np.ndarray, hidden: physics.Hidden) -> dict[str, np.ndarray]:
    """The true shape, mass (kg) and centre of mass (m, mesh frame) of each draw, float32."""
    rigid = physics.rigids(bodies, which, hidden)
    support = np.stack([objects.support(body) for body in bodies])
    return {"support": support[which], "mass": rigid.mass.astype(np.float32), "com": rigid.com.astype(np.float32)}


def _views_of(
    collection: Collection, key: PRNGKeyArray, bodies: list[objects.Body], sensor: Sensor
) -> dict[str, np.ndarray]:
    """The further starts to render: pose, index of the body in the shard, and `_solid`."""
    if not collection.num_views:
        shapes = {"pose": (0, 7), "support": (0, len(objects.DIRECTIONS)), "mass": (0,), "com": (0, 3)}
        return {"body": np.zeros(0, np.int32)} | {name: np.zeros(shape, np.float32) for name, shape in shapes.items()}
    starts = physics.starts(key, bodies, sensor, collection.scenario, collection.num_views)
    starts = jax.tree.map(np.asarray, starts)
    return {"pose": starts.pose, "body": starts.body, **_solid(bodies, starts.body, starts.hidden)}


class _Job(NamedTuple):
    """Frames of one body that one compiled call renders."""

    body: objects.Body
    pose: np.ndarray  # (n, 7)
    wrench: np.ndarray  # (n, 6)
    is_view: bool  # whether only the visual image is kept


def _render(
    collection: Collection,
    sensor: Sensor,
    bodies: list[objects.Body],
    trajectory: physics.Trajectory,
    frames: np.ndarray,
    views: dict[str, np.ndarray],
    report: Callable[[int], None],
) -> Iterator[tuple[np.ndarray, ...]]:
    """Render `frames`, then `views`, in order, a fixed number per call.

    There is one thread per core, because a call keeps only one core busy.
    """
    size = CPU_RENDER_BATCH if jax.default_backend() == "cpu" else RENDER_BATCH
    turned = {
        q: [np.asarray(f(jnp.asarray(x), q)) for f, x in ((turn, trajectory.pose), (turn_wrench, trajectory.wrench))]
        for q in symmetries_of(collection)
    }
    mirrored = [objects.mirror(body) for body in bodies] if max(turned) >= 4 else bodies

    def jobs() -> Iterator[_Job]:
        owner = np.stack([trajectory.body[frames[:, 0]], frames[:, 2] >= 4], 1)
        for body_index, flip in np.unique(owner, axis=0):
            rows = frames[(owner == [body_index, flip]).all(1)]
            for part in np.split(rows, range(size, len(rows), size)):
                pose = np.stack([turned[q][0][i, t] for i, t, q in part])
                wrench = np.stack([turned[q][1][i, t] for i, t, q in part])
                yield _Job((mirrored if flip else bodies)[body_index], pose, wrench, False)
        for body_index in np.unique(views["body"]):
            poses = views["pose"][views["body"] == body_index]
            for pose in np.split(poses, range(size, len(poses), size)):
                yield _Job(bodies[body_index], pose, np.zeros((len(pose), 6), np.float32), True)

    def work(job: _Job) -> tuple[np.ndarray, ...]:
        pose, wrench = (np.pad(x, ((0, size - len(x)), (0, 0)), "edge") for x in (job.pose, job.wrench))
        images = render_uint8(sensor, job.body, pose, wrench, resolution=collection.resolution, crop=collection.crop)
        kept = images[:1] if job.is_view else images
        return tuple(np.asarray(leaf)[: len(job.pose)] for leaf in kept)

    done = 0
    with concurrent.futures.ThreadPoolExecutor(os.cpu_count()) as pool:
        for images in pool.map(work, jobs()):
            done += len(images[0])
            report(done)
            yield images


@functools.partial(jax.jit, static_argnames=("resolution", "crop"))
def render_uint8(
    sensor: Sensor,
    body: objects.Body,
    pose: Float[Array, "n 7"],
    wrench: Float[Array, "n 6"],
    *,
    resolution: tuple[int, int],
    crop: bool,
) -> tuple[UInt8[Array, "n h w 3"], UInt8[Array, "n h w 3"], Array]:
    """Render frames of one object as they are stored: visual and tactile in `uint8`, segmentation in bool."""

    def one(item: tuple[Array, Array]) -> tuple[Array, Array, Array]:
        frame = sense(sensor, body, *item, resolution=resolution, crop=crop)
        visual, tactile = (jnp.round(image * 255).astype(jnp.uint8) for image in (frame.visual, frame.tactile))
        return visual, tactile, frame.segmentation

    # A CPU is twice as fast if it renders one frame after another instead of all at once.
    return jax.lax.map(one, (pose, wrench), batch_size=1 if jax.default_backend() == "cpu" else len(pose))


def empty_frame(sensor: Sensor, collection: Collection) -> records.Images:
    """Both streams (`uint8`) and the segmentation (bool) of the untouched sensor, as the collection renders them."""
    body = make_bodies(collection, np.array([0]))[0]
    gone = jnp.array([[0.0, 0, -1, 1, 0, 0, 0]])
    images = render_uint8(sensor, body, gone, jnp.zeros((1, 6)), resolution=collection.resolution, crop=collection.crop)
    return records.Images(*(np.asarray(leaf)[0] for leaf in images))


def _report(progress: Callable[[Progress], None] | None, before: int, total: int, stage: str) -> Callable[[int], None]:
    def report(done: int) -> None:
        if progress is not None:
            progress(Progress(before + done, total, stage))

    return report


def _as_json(collection: Collection) -> dict:
    content = dataclasses.asdict(collection)
    scenario = collection.scenario
    content["scenario"] = {"name": type(scenario).__name__, **content["scenario"]}
    # Left out where it is 1, so that the descriptions of older datasets, whose conditions have one vector, stay valid.
    if scenario.quantities and scenario.vectors != 1:
        content["scenario"]["vectors"] = scenario.vectors
    return {"format": records.FORMAT, **content}
