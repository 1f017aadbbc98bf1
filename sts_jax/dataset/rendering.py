"""Rendering of a dataset on all CPU cores: images as `uint8` arrays, and segmentations as bool arrays."""

import concurrent.futures
import functools
import os
from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from sts_jax import objects, physics
from sts_jax.dataset import records
from sts_jax.dataset.collection import Collection, make_bodies, symmetries_of
from sts_jax.dataset.symmetry import turn, turn_wrench
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
    """Render the images of a shard in batches, on all CPU cores.

    A shard contains frames of simulated trajectories, followed by views. A view is a visual image of an object in an
    initial pose from which no trajectory is simulated.

    Args:
        collection: The description of the dataset.
        sensor: The sensor.
        bodies: The objects of the shard.
        trajectory: The trajectories of these objects as NumPy arrays. `trajectory.body` is an index into `bodies`.
        frames: The m frames to render, int `(m, 3)`. A row contains the index of the trajectory, the index of the frame
            in the trajectory and the number of the symmetry (see `symmetries_of`). The rows are sorted by object. The
            mirrored frames of an object (symmetries 4 to 7) follow its other frames.
        views: The v views, sorted by object. The array `pose`, `(v, 7)`, has the poses of the objects: position (m) and
            quaternion (w, x, y, z). The array `body`, int `(v,)`, has indices into `bodies`.
        report: Function that is called after each batch with the number of frames and views that are finished so far.

    Yields:
        Batches of images in the order in which they are stored. A batch of frames has the visual images, the tactile
        images and the segmentations. A batch of views is a tuple with only the visual images.
    """
    size = frames_per_call()
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


def frames_per_call() -> int:
    """Number of frames that the library passes to each call of `render_uint8`.

    Calls with equal numbers of frames share one compiled program.
    """
    return CPU_RENDER_BATCH if jax.default_backend() == "cpu" else RENDER_BATCH


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
    """Render n frames of one object, as 8-bit images.

    Args:
        sensor: The sensor.
        body: The object.
        pose: Poses of the object (its mesh frame) in the sensor frame: position (m) and quaternion (w, x, y, z).
        wrench: Wrenches of the pad on the object: force (N) and moment about the sensor's origin (N m).
        resolution: Height h and width w of the images (pixels).
        crop: True to show only a window around the object. False to show the whole pad.

    Returns:
        The visual images, the tactile images, and the segmentation, bool `(n, h, w)`, which is true in pixels that show
        the object.
    """

    def one(item: tuple[Array, Array]) -> tuple[Array, Array, Array]:
        frame = sense(sensor, body, *item, resolution=resolution, crop=crop)
        visual, tactile = (jnp.round(image * 255).astype(jnp.uint8) for image in (frame.visual, frame.tactile))
        return visual, tactile, frame.segmentation

    # A CPU is twice as fast if it renders one frame after another instead of all at once.
    return jax.lax.map(one, (pose, wrench), batch_size=1 if jax.default_backend() == "cpu" else len(pose))


def empty_frame(sensor: Sensor, collection: Collection) -> records.Images:
    """Render the sensor without an object, in the resolution of a collection.

    Args:
        sensor: The sensor.
        collection: The description of the dataset.

    Returns:
        The visual and the tactile image, uint8 `(height, width, 3)`, and the segmentation, bool `(height, width)`. The
        segmentation is false everywhere.
    """
    body = make_bodies(collection, np.array([0]))[0]
    # The number of frames is that of `render`. After a collection, the program is therefore compiled already.
    gone = np.tile(np.array([0, 0, -1, 1, 0, 0, 0], np.float32), (frames_per_call(), 1))
    wrench = np.zeros((len(gone), 6), np.float32)
    images = render_uint8(sensor, body, gone, wrench, resolution=collection.resolution, crop=collection.crop)
    return records.Images(*(np.asarray(leaf)[0] for leaf in images))
