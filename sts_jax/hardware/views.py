"""Conversion of the real sensor's raw images to the images that `Predictor` and the training functions need."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from sts_jax.hardware.lens import Lens, Pinhole, rectified
from sts_jax.hardware.session import RecordedImages, Recordings


class SensorView(NamedTuple):
    """A rectified visual image and a rectified tactile image: the inputs `visual` and `tactile` of a `Predictor`."""

    visual: Float[np.ndarray, "height width 3"]  # visual image, RGB, float32 in [0, 1]
    tactile: Float[np.ndarray, "height width 3"]  # tactile image, RGB, float32 in [0, 1]


def sensor_view(
    lens: Lens,
    pinhole: Pinhole,
    visual: UInt8[np.ndarray, "rows columns 3"],
    tactile: UInt8[np.ndarray, "rows columns 3"],
    resolution: tuple[int, int] = (64, 64),
) -> SensorView:
    """Rectify a raw visual image and a raw tactile image.

    The images can come from a `Pair`, or from `Device.background` (images of the empty pad).

    Args:
        lens: Lens and pose of the real camera, from `Device.lens`.
        pinhole: The simulated pinhole camera that defines the view, from `Sensor.camera`.
        visual: Raw visual image, RGB, uint8, such as `pair.visual.image` of a pair from `STS.read` or from a recording.
        tactile: Raw tactile image, RGB, uint8, such as `pair.tactile.image`.
        resolution: Height and width of the rectified images (pixels), usually `Predictor.preprocessing.resolution`.

    Returns:
        The rectified images. Each pixel is the mean of the raw image over the pixel's area.

    Raises:
        ValueError: An image is not uint8, or its size is not `lens.height` x `lens.width`. Or `resolution` or `pinhole`
            is out of range. Or the view contains rays at larger angles than `Lens.largest_angle`.
    """
    images = (rectified(lens, pinhole, image, resolution) for image in (visual, tactile))
    return SensorView(*(image.astype(np.float32) / 255 for image in images))


def relit(view: SensorView, background: SensorView, empty: SensorView) -> SensorView:
    """Adapt the brightness and colours of images to the sensor on which a model was trained.

    The result is `view * empty / background` for each pixel, clipped to [0, 1]. Values of `background` below 1/255 are
    replaced by 1/255.

    In the training images of a model, the empty pad always looks like `empty`. The model therefore regards every
    difference from `empty` as part of an object. Without this adaptation, the vignetting of another camera or a dark
    border of its images would count as an object.

    Args:
        view: Rectified images of a sensor.
        background: Rectified images of the same sensor's empty pad, from `sensor_view`.
        empty: Images of the empty pad of the sensor on which the model was trained, `SensorView(**predictor.empty)`.

    Returns:
        The images that the sensor of the model would have taken of the same scene.

    Raises:
        ValueError: The three arguments have different resolutions.
    """
    shapes = {name: own.visual.shape for name, own in (("view", view), ("background", background), ("empty", empty))}
    if len(set(shapes.values())) > 1:
        raise ValueError(
            f"the visual images of `view`, `background` and `empty` must have the same shape, got {shapes}: rectify "
            "all images with the same resolution"
        )
    return SensorView(
        *(
            np.clip(own * there / np.maximum(here, 1 / 255), 0, 1)
            for own, here, there in zip(view, background, empty, strict=True)
        )
    )


def recorded_images(
    recordings: Recordings,
    lens: Lens,
    pinhole: Pinhole,
    resolution: tuple[int, int] = (64, 64),
    *,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> RecordedImages:
    """Read and rectify the initial and final images of all recorded trajectories that the user has confirmed.

    The initial images show the held object. The final images show the object at rest.

    Args:
        recordings: Confirmed trajectories, from `load_recordings`.
        lens: Lens and pose of the real camera, from `Device.lens`.
        pinhole: The simulated pinhole camera that defines the view, from `Sensor.camera`.
        resolution: Height and width of the rectified images (pixels).
        progress: Function that is called after each trajectory, with the number of trajectories done so far and the
            number of all trajectories.

    Returns:
        The rectified images, in the order of the trajectories' numbers.

    Raises:
        ValueError: There is no confirmed trajectory, or the size of the images is not `lens.height` x `lens.width`.
            Or `resolution` or `pinhole` is out of range. Or the view contains rays at larger angles than
            `Lens.largest_angle`.
        DamagedFileError: A file is missing or damaged.
    """
    width, height = recordings.origin.width, recordings.origin.height
    if (width, height) != (lens.width, lens.height):
        raise ValueError(
            f"{recordings.folder} has images of {width}x{height} pixels, but the lens belongs to images of "
            f"{lens.width}x{lens.height} pixels: use the lens from the sensor file of the device that took the "
            "images in this folder"
        )
    return recordings.images(lambda image: rectified(lens, pinhole, image, resolution), progress)
