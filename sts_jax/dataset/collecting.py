"""`collect` makes the objects of a dataset, simulates the trajectories and renders the frames.

A shard is a pure function of the `Collection`, the sensor and its index, so a missing shard can be made again.
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from sts_jax import objects, physics
from sts_jax._checked import in_32_bits
from sts_jax.dataset import records
from sts_jax.dataset.collection import Collection, as_json, class_names, make_bodies, split_objects
from sts_jax.dataset.rendering import render
from sts_jax.sensor import Sensor
from sts_jax.storage import checksums, claim, lock, read_arrays, verify, write_arrays, write_json, write_manifest


class Collected(NamedTuple):
    """The result of `collect`: how many failed trajectories were sampled again, and which objects the dataset lacks."""

    resampled: int  # number of trajectories that were discarded and sampled again
    left_out: tuple[str, ...]  # one line for each object that the dataset lacks, with the reason


class Progress(NamedTuple):
    """Progress of `collect`, which simulates the objects of a shard, then renders them, then goes to the next shard."""

    done: int  # finished trajectories of the dataset, or finished frames and views of the current shard
    total: int  # all trajectories of the dataset, or all frames and views of the current shard
    stage: str  # "trajectories" for the simulation, "frames" for the rendering


@in_32_bits
def collect(
    collection: Collection,
    sensor: Sensor,
    folder: Path,
    *,
    progress: Callable[[Progress], None] | None = None,
) -> Collected:
    """Simulate and render a dataset into a folder. A repeated call makes only the shards that the folder lacks.

    A trajectory that becomes non-finite, or whose object sinks too deep into the pad, is discarded and sampled again.
    An object that cannot be made or simulated is left out.

    Args:
        collection: The description of the dataset.
        sensor: The sensor for the simulation and the images.
        folder: The folder of the dataset. It receives the shards, `collection.json`, `sensor.json` (for
            `Sensor.load`), `split.json` and `manifest.json`.
        progress: Called when some trajectories or images are finished.

    Returns:
        Summary of the whole dataset, including the shards that earlier calls made.
    """
    sensor.check()
    collection.check()
    resampled, left_out = 0, []
    with lock(folder, finished=True):
        manifest = records.manifest_of(folder)
        claim(folder / "collection.json", as_json(collection))
        claim(folder / "sensor.json", sensor.constants())
        if not (folder / "split.json").exists():
            split = {name: [int(i) for i in part] for name, part in split_objects(collection).items()}
            write_json(folder / "split.json", split)
        if manifest is None:
            facts = {"shards": collection.num_shards}
            manifest = write_manifest(folder, checksums(folder, records.DESCRIPTIONS), facts)
        verify(folder, manifest, records.remedy(folder), records.DESCRIPTIONS)
        for index in range(collection.num_shards):
            files = records.shard_files(index, collection.num_shards)
            if not all(name in manifest.files for name in files) or not any((folder / name).exists() for name in files):
                _make_shard(collection, sensor, folder, index, progress)
                manifest = write_manifest(folder, manifest.files | checksums(folder, files), manifest.facts)
            verify(folder, manifest, records.remedy(folder), files)
            arrays = read_arrays(folder / files[1], records.remedy(folder))
            resampled += int(arrays["trajectory/resampled"].sum())
            left_out += arrays["left_out"].tolist()
    return Collected(resampled, tuple(left_out))


def _make_shard(
    collection: Collection,
    sensor: Sensor,
    folder: Path,
    index: int,
    progress: Callable[[Progress], None] | None,
) -> None:
    """Simulate, render and write one shard."""
    first = index * collection.objects_per_shard
    members = np.arange(first, min(first + collection.objects_per_shard, collection.num_objects))
    key = jax.random.fold_in(jax.random.key(collection.seed), collection.num_objects + index)
    made, left_out = _made(collection, members)
    report = _report(progress, first * collection.num_per_object, collection.num_trajectories, "trajectories")
    simulated, trajectory, failed = _simulated(collection, sensor, key, made, report)
    left_out += failed
    if trajectory is None:
        raise ValueError(
            f"{folder}: no object of shard {index} can be simulated (first object: {members[0]}, number of objects: "
            f'{len(members)}): use other objects or another scenario. One of the errors is "{left_out[-1]}"'
        )
    members, bodies = np.array(list(simulated)), list(simulated.values())
    frames = _frames_of(collection, members, trajectory)
    views = _views_of(collection, key, bodies, sensor)
    arrays = _arrays(members, bodies, trajectory, views) | {"frames": frames, "left_out": np.array(left_out, str)}
    report = _report(progress, 0, len(frames) + len(views["body"]), "frames")
    images, table = records.shard_files(index, collection.num_shards)
    records.write_images(folder / images, render(collection, sensor, bodies, trajectory, frames, views, report))
    write_arrays(folder / table, arrays)


def _simulated(
    collection: Collection,
    sensor: Sensor,
    key: PRNGKeyArray,
    bodies: dict[int, objects.Body],
    report: Callable[[int], None],
) -> tuple[dict[int, objects.Body], physics.Trajectory | None, list[str]]:
    """Simulate objects. Return those that can be simulated, their trajectories, and a line for each of the others."""
    bodies = dict(bodies)
    failed: list[str] = []
    while bodies:
        try:
            trajectory = physics.simulate(
                key,
                list(bodies.values()),
                sensor,
                collection.scenario,
                collection.num_per_object,
                progress=report,
                engine=collection.engine,
            )
            return bodies, jax.tree.map(np.asarray, trajectory), failed
        except physics.BodyError as error:  # one bad object does not stop a collection
            number = list(bodies)[error.body]
            del bodies[number]
            failed.append(f"{_named(collection, number)}: {str(error).partition(': ')[2]}")
    return bodies, None, failed


def _arrays(
    members: np.ndarray, bodies: list[objects.Body], trajectory: physics.Trajectory, views: dict[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """The arrays of a shard. Its indices of bodies become indices of objects in the collection."""
    arrays = {f"trajectory/{name}": leaf for name, leaf in trajectory._asdict().items() if name != "hidden"}
    arrays |= {f"hidden/{name}": leaf for name, leaf in trajectory.hidden._asdict().items()}
    arrays["trajectory/body"] = members[arrays["trajectory/body"]].astype(np.int32)
    solid = _solid(bodies, np.asarray(trajectory.body), trajectory.hidden)
    arrays |= {f"solid/{name}": leaf for name, leaf in solid.items()}
    arrays |= {f"view/{name}": leaf for name, leaf in views.items()}
    arrays["view/body"] = members[views["body"]].astype(np.int32)
    return arrays


def _made(collection: Collection, members: np.ndarray) -> tuple[dict[int, objects.Body], list[str]]:
    """Make objects. Return them by index, and one line for each that cannot be made (such as a deleted file)."""
    bodies, left_out = {}, []
    for number in members.tolist():
        try:
            (bodies[number],) = make_bodies(collection, np.array([number]))
        except (OSError, ValueError) as error:
            left_out.append(f"{_named(collection, number)}: {error}")
    return bodies, left_out


def _named(collection: Collection, number: int) -> str:
    """The index of an object and its class or mesh file, for messages."""
    name = class_names(collection)[number] if collection.meshes is None else collection.meshes.names[number]
    return f"object {number} ({name})"


def _frames_of(collection: Collection, members: np.ndarray, trajectory: physics.Trajectory) -> np.ndarray:
    """The frames to render, as rows (index of the trajectory in the shard, frame), int `(m, 2)`, sorted by object."""
    num, last = trajectory.pose.shape[0], trajectory.pose.shape[1] - 1
    rows: list[tuple[int, int]] = []
    for i in range(num):
        # The trajectories that are rendered in full are spread over the objects: the first one of each object, then the
        # second one of each object, and so on.
        place, repeat = divmod(i, collection.num_per_object)
        if repeat >= collection.rendered_per_object:
            continue
        rank = repeat * collection.num_objects + members[place]
        rows += [(i, t) for t in (range(last + 1) if rank < collection.num_full else (0, last))]
    return np.array(rows, np.int32)


def _solid(bodies: list[objects.Body], which: np.ndarray, hidden: physics.Hidden) -> dict[str, np.ndarray]:
    """Support function (m), mass (kg) and centre of mass (m, mesh frame) of the body of each trajectory or view."""
    rigid = physics.rigids(bodies, which, hidden)
    support = np.stack([objects.support(body) for body in bodies])
    return {"support": support[which], "mass": rigid.mass.astype(np.float32), "com": rigid.com.astype(np.float32)}


def _views_of(
    collection: Collection, key: PRNGKeyArray, bodies: list[objects.Body], sensor: Sensor
) -> dict[str, np.ndarray]:
    """Draw the views of a shard: their poses, the indices of their bodies in the shard, and the arrays of `_solid`."""
    if not collection.num_views:
        shapes = {"pose": (0, 7), "support": (0, len(objects.DIRECTIONS)), "mass": (0,), "com": (0, 3)}
        return {"body": np.zeros(0, np.int32)} | {name: np.zeros(shape, np.float32) for name, shape in shapes.items()}
    starts = physics.starts(key, bodies, sensor, collection.scenario, collection.num_views)
    starts = jax.tree.map(np.asarray, starts)
    return {"pose": starts.pose, "body": starts.body, **_solid(bodies, starts.body, starts.hidden)}


def _report(progress: Callable[[Progress], None] | None, before: int, total: int, stage: str) -> Callable[[int], None]:
    """A function that reports `before` plus its argument to `progress`, if there is one."""

    def report(done: int) -> None:
        if progress is not None:
            progress(Progress(before + done, total, stage))

    return report
