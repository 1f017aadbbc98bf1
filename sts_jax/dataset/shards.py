"""One shard of a dataset: its objects, its trajectories and its images.

A shard is a pure function of the `Collection`, the sensor and its index, so any process can make it, and make it again.
"""

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from sts_jax import objects, physics
from sts_jax._checked import in_32_bits
from sts_jax.dataset import records
from sts_jax.dataset.collection import Collection, class_names, make_bodies
from sts_jax.dataset.remote import Remote
from sts_jax.dataset.rendering import render
from sts_jax.sensor import Sensor
from sts_jax.storage import write_arrays


class Simulated(NamedTuple):
    """The objects and trajectories of a shard, without images."""

    bodies: list[objects.Body]  # the objects that can be simulated
    trajectory: physics.Trajectory  # NumPy arrays. `body` is an index into `bodies`
    frames: np.ndarray  # int (m, 2): index of the trajectory in the shard and frame of each image, sorted by object
    views: dict[str, np.ndarray]  # arrays of the views. `body` is an index into `bodies`
    arrays: dict[str, np.ndarray]  # all arrays of the shard. Indices of bodies are those of the collection


@in_32_bits
def simulate_shard(collection: Collection, sensor: Sensor, index: int, report: Callable[[int], None]) -> Simulated:
    """Make the objects of a shard, simulate them, and choose the frames to render.

    Args:
        report: Called with the number of finished trajectories of the shard.
    """
    members = _members(collection, index)
    key = jax.random.fold_in(jax.random.key(collection.seed), collection.num_objects + index)
    made, left_out = _made(collection, members)
    simulated, trajectory, failed = _simulated(collection, sensor, key, made, report)
    left_out += failed
    if trajectory is None:
        raise ValueError(
            f"no object of shard {index} can be simulated (first object: {members[0]}, number of objects: "
            f'{len(members)}): use other objects or another scenario. One of the errors is "{left_out[-1]}"'
        )
    members, bodies = np.array(list(simulated)), list(simulated.values())
    frames = _frames_of(collection, members, trajectory)
    views = _views_of(collection, key, bodies, sensor)
    arrays = _arrays(members, bodies, trajectory, views) | {"frames": frames, "left_out": np.array(left_out, str)}
    return Simulated(bodies, trajectory, frames, views, arrays)


@in_32_bits
def write_shard(
    collection: Collection,
    sensor: Sensor,
    target: Path | Remote,
    dataset: str,
    index: int,
    simulated: Simulated,
    report: Callable[[int], None],
) -> None:
    """Render a shard and write its files, its manifest last.

    Args:
        dataset: See `records.finish_shard`.
        report: Called with the number of finished frames and views of the shard.
    """
    if isinstance(target, Remote):
        with tempfile.TemporaryDirectory() as folder:
            write_shard(collection, sensor, Path(folder), dataset, index, simulated, report)
            target.put(Path(folder), records.all_files(index, collection.num_shards))
        return
    images, table, _ = records.all_files(index, collection.num_shards)
    bodies, trajectory, frames, views, arrays = simulated
    records.write_images(target / images, render(collection, sensor, bodies, trajectory, frames, views, report))
    write_arrays(target / table, arrays)
    records.finish_shard(target, dataset, index, collection.num_shards, arrays)


def planned(collection: Collection, index: int) -> tuple[int, int]:
    """Numbers of trajectories and of frames and views of a shard, if none of its objects is left out."""
    members, length = _members(collection, index), collection.scenario.frames
    first, objects = int(members[0]), len(members)
    ranks = collection.num_full - np.arange(collection.rendered_per_object) * collection.num_objects - first
    full = int(np.clip(ranks, 0, objects).sum())
    ends = objects * collection.rendered_per_object - full
    return objects * collection.num_per_object, full * length + min(2, length) * ends + objects * collection.num_views


def _members(collection: Collection, index: int) -> np.ndarray:
    """Indices of the objects of a shard in the collection."""
    first = index * collection.objects_per_shard
    return np.arange(first, min(first + collection.objects_per_shard, collection.num_objects))


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
        rows += [(i, t) for t in (range(last + 1) if rank < collection.num_full else sorted({0, last}))]
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
