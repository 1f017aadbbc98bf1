"""Rendering of a dataset on all CPU cores: images as `uint8` arrays, and segmentations as bool arrays."""

import collections
import concurrent.futures
import functools
import itertools
from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from sts_jax import geometry, objects, physics
from sts_jax._checked import in_32_bits
from sts_jax._devices import cores
from sts_jax.dataset import records
from sts_jax.dataset.collection import Collection, make_bodies
from sts_jax.frame import sense
from sts_jax.sensor import Sensor

RENDER_BATCH = 32  # value of `frames_per_call` on a GPU
CPU_RENDER_BATCH = 8  # value on a CPU: fewer, because a CPU renders the frames one after another


class _Job(NamedTuple):
    """Frames of one body that one compiled call renders."""

    body: objects.Body
    pose: np.ndarray  # (n, 7)
    wrench: np.ndarray  # (n, 6)
    is_view: bool  # true for views, of which only the visual image is stored


def render(
    collection: Collection,
    sensor: Sensor,
    bodies: list[objects.Body],
    trajectory: physics.Trajectory,
    frames: np.ndarray,
    views: dict[str, np.ndarray],
    report: Callable[[int], None],
) -> Iterator[tuple[np.ndarray, ...]]:
    """Render the images of a shard in batches, on all CPU cores: frames of trajectories, then views.

    Args:
        trajectory: Trajectories as NumPy arrays. `trajectory.body` is an index into `bodies`.
        frames: Trajectory and frame of each image, int `(m, 2)`, sorted by object.
        views: `pose` `(v, 7)` and `body`, int `(v,)`, an index into `bodies`, sorted by object.
        report: Called after each batch with the number of finished frames and views.

    Yields:
        Batches in the order of storage: visual images, tactile images and segmentations, or visual images of views.
    """
    size = frames_per_call()
    quat, wrench = geometry.quat_canonical(trajectory.pose[..., 3:]), np.asarray(trajectory.wrench)
    pose = np.concatenate([trajectory.pose[..., :3], quat], -1)

    def jobs() -> Iterator[_Job]:
        owner = trajectory.body[frames[:, 0]]
        for body_index in np.unique(owner):
            rows = frames[owner == body_index]
            for part in np.split(rows, range(size, len(rows), size)):
                yield _Job(bodies[body_index], pose[part[:, 0], part[:, 1]], wrench[part[:, 0], part[:, 1]], False)
        for body_index in np.unique(views["body"]):
            poses = views["pose"][views["body"] == body_index]
            for some in np.split(poses, range(size, len(poses), size)):
                yield _Job(bodies[body_index], some, np.zeros((len(some), 6), np.float32), True)

    def work(job: _Job) -> tuple[np.ndarray, ...]:
        pose, wrench = (np.pad(x, ((0, size - len(x)), (0, 0)), "edge") for x in (job.pose, job.wrench))
        images = render_uint8(sensor, job.body, pose, wrench, resolution=collection.resolution, crop=collection.crop)
        kept = images[:1] if job.is_view else images
        return tuple(np.asarray(leaf)[: len(job.pose)] for leaf in kept)

    done, todo, workers = 0, jobs(), cores()
    with concurrent.futures.ThreadPoolExecutor(workers) as pool:
        # A few jobs ahead: large images would fill the memory if the disk is slower than the rendering.
        pending = collections.deque(pool.submit(work, job) for job in itertools.islice(todo, 2 * workers))
        while pending:
            images = pending.popleft().result()
            pending.extend(pool.submit(work, job) for job in itertools.islice(todo, 1))
            done += len(images[0])
            report(done)
            yield images


def frames_per_call() -> int:
    """Number of frames in each of the library's calls of `render_uint8`, which share one compiled program."""
    return CPU_RENDER_BATCH if jax.default_backend() == "cpu" else RENDER_BATCH


@in_32_bits
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
    """Render n frames as `sense` does: 8-bit visual and tactile images, and the segmentation, bool `(n, h, w)`."""

    def one(item: tuple[Array, Array]) -> tuple[Array, Array, Array]:
        frame = sense(sensor, body, *item, resolution=resolution, crop=crop)
        visual, tactile = (jnp.round(image * 255).astype(jnp.uint8) for image in (frame.visual, frame.tactile))
        return visual, tactile, frame.segmentation

    # A CPU is twice as fast if it renders one frame after another instead of all at once.
    return jax.lax.map(one, (pose, wrench), batch_size=1 if jax.default_backend() == "cpu" else len(pose))


@in_32_bits
def empty_frame(sensor: Sensor, collection: Collection) -> records.Images:
    """Render the sensor without an object in the resolution of a collection, without a leading axis."""
    body = make_bodies(collection, np.array([0]))[0]
    # The number of frames is that of `render`. After a collection, the program is therefore compiled already.
    gone = np.tile(np.array([0, 0, -1, 1, 0, 0, 0], np.float32), (frames_per_call(), 1))
    wrench = np.zeros((len(gone), 6), np.float32)
    images = render_uint8(sensor, body, gone, wrench, resolution=collection.resolution, crop=collection.crop)
    return records.Images(*(np.asarray(leaf)[0] for leaf in images))
