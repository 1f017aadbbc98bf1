"""Raw images of the real sensor as the views that a `Predictor` and a training take."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8

from sts_jax.hardware.lens import Lens, Pinhole, rectified
from sts_jax.hardware.recordings import Recordings

Progress = Callable[[int, int], None]  # takes the trajectories that were read, and their number


class SensorView(NamedTuple):
    """Both streams of one moment in the view of the sensor's pinhole, as `Predictor` takes them."""

    visual: Float[np.ndarray, "height width 3"]  # RGB, float32 in [0, 1]
    tactile: Float[np.ndarray, "height width 3"]  # RGB, float32 in [0, 1]


class Moments(NamedTuple):
    """First and last moments of recorded trajectories in the view of the sensor's pinhole."""

    visual: UInt8[np.ndarray, "n 2 height width 3"]  # RGB: initial, final
    tactile: UInt8[np.ndarray, "n 2 height width 3"]  # RGB: initial, final
    number: Int[np.ndarray, "n"]  # of the trajectory in its session


def sensor_view(
    lens: Lens,
    pinhole: Pinhole,
    visual: UInt8[np.ndarray, "rows columns 3"],
    tactile: UInt8[np.ndarray, "rows columns 3"],
    resolution: tuple[int, int] = (64, 64),
) -> SensorView:
    """Rectify the two raw images of a pair, or the two backgrounds of a sensor file.

    Args:
        lens: the lens of the camera, `Device.lens`.
        pinhole: the view of the sensor, `Sensor.camera`.
        visual: raw image, `pair.visual.image` of `STS.read` or of a recording.
        tactile: raw image.
        resolution: (height, width) of the view, `Predictor.preprocessing.resolution`. Each pixel is the mean of the raw
            image over its area.

    Raises:
        ValueError: an image has another size than the lens, see `rectified`.
    """
    images = (rectified(lens, pinhole, image, resolution) for image in (visual, tactile))
    return SensorView(*(image.astype(np.float32) / 255 for image in images))


def relit(view: SensorView, background: SensorView, empty: SensorView) -> SensorView:
    """A view in the light of another empty pad: each pixel times `empty / background`, at most 1.

    A model that was trained on simulated images, or on another sensor, takes every difference from its empty pad for an
    object. The vignetting of a camera and its edge of the view are such differences.

    Args:
        view: the view of a sensor.
        background: the view of the empty pad of this sensor.
        empty: the empty pad of the model, `SensorView(**predictor.empty)`.

    Raises:
        ValueError: the three have not the same resolution.
    """
    shapes = {name: own.visual.shape for name, own in (("view", view), ("background", background), ("empty", empty))}
    if len(set(shapes.values())) > 1:
        raise ValueError(f"the images have the shapes {shapes}, but they must be equal: give the same resolution")
    return SensorView(
        *(
            np.clip(own * there / np.maximum(here, 1 / 255), 0, 1)
            for own, here, there in zip(view, background, empty, strict=True)
        )
    )


def moments(
    recordings: Recordings,
    lens: Lens,
    pinhole: Pinhole,
    resolution: tuple[int, int] = (64, 64),
    *,
    progress: Progress | None = None,
) -> Moments:
    """Read and rectify all confirmed trajectories, one at a time.

    Args:
        recordings: the trajectories, from `load_recordings`.
        lens: the lens of the camera, `Device.lens`.
        pinhole: the view of the sensor, `Sensor.camera`.
        resolution: (height, width) of the views (pixels).
        progress: called after each trajectory.

    Raises:
        ValueError: there is no confirmed trajectory, or the images have another size than the lens.
        TornFileError: a file is missing or damaged.
    """
    width, height = recordings.session["width"], recordings.session["height"]
    if (width, height) != (lens.width, lens.height):
        raise ValueError(
            f"{recordings.folder} has images of {width}x{height} pixels, but the lens belongs to images of "
            f"{lens.width}x{lens.height}: give the sensor file of the device that collected them"
        )
    if not len(recordings):
        raise ValueError(
            f"{recordings.folder} has no confirmed trajectory: collect some, or confirm them in the review"
        )
    visual, tactile = [], []
    for done, trajectory in enumerate(recordings, 1):
        ends = trajectory.initial, trajectory.final
        visual.append([rectified(lens, pinhole, pair.visual.image, resolution) for pair in ends])
        tactile.append([rectified(lens, pinhole, pair.tactile.image, resolution) for pair in ends])
        if progress is not None:
            progress(done, len(recordings))
    return Moments(np.array(visual), np.array(tactile), np.array(recordings.numbers))
