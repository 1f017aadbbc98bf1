"""Checks that the raw images and the calibration of a lens cover the whole view of the sensor."""

import math
from collections.abc import Sequence

import numpy as np

from sts_jax.hardware.calibration import CalibrationError, FoundCorners
from sts_jax.hardware.lens import Lens, Pinhole, rectification, window

_RESOLUTION = 480, 640  # height and width of the view at which it is checked (pixels)
_EXTRAPOLATION = math.radians(3)  # largest angle by which the view may exceed the corners of all boards (rad)
# Share of the image's width and height that belongs to each outer part. A lens of 160 degrees shows the border of the
# view there, and a board on the pad does not reach it.
_OUTER = 0.2
_ROWS = "top", "middle", "bottom"
_COLUMNS = "left", "centre", "right"
PARTS = tuple(f"{row} {column}" for row in _ROWS for column in _COLUMNS)


def view_angle(lens: Lens, pinhole: Pinhole) -> float:
    """Return the largest angle between the optical axis of a lens and a ray of the sensor's view (rad).

    Args:
        lens: The lens and the pose of the camera.
        pinhole: The view of the sensor, such as `Sensor.camera`.
    """
    left, top, width, height = window(pinhole, _RESOLUTION)
    corners = np.array([(x, y, 0.0) for x in (left, left + width) for y in (top, top + height)])
    seen = corners @ lens.matrix.T + np.asarray(lens.translation)
    return float(np.arctan2(np.hypot(seen[:, 0], seen[:, 1]), seen[:, 2]).max())


def check_view(lens: Lens, pinhole: Pinhole, largest_angle: float | None = None) -> None:
    """Raise an error unless the raw images show the sensor's whole view and the lens is calibrated up to its corners.

    Args:
        lens: The lens and the pose of the camera.
        pinhole: The view of the sensor, such as `Sensor.camera`.
        largest_angle: Largest angle of a corner in the calibration, `Calibration.largest_angle` (rad). The view may
            exceed this angle by 3 degrees. None: the angles are not compared.

    Raises:
        CalibrationError: A part of the view lies outside of the raw image, or the view exceeds `largest_angle` by more
            than 3 degrees, or it contains rays beyond `Lens.largest_angle`.
    """
    needed = view_angle(lens, pinhole)
    if largest_angle is not None and needed > largest_angle + _EXTRAPOLATION:
        raise CalibrationError(
            f"in the calibration, the corners of the board reach {math.degrees(largest_angle):.1f} degrees from the "
            f"optical axis, but the corners of the sensor's view are at {math.degrees(needed):.1f} degrees. Take more "
            "images with the board in the corners of the image, and calibrate again."
        )
    try:
        pixels = rectification(lens, pinhole, _RESOLUTION)
    except ValueError as error:
        raise CalibrationError(str(error)) from error
    size = np.array([lens.width, lens.height])
    outside = np.any((pixels < -0.5) | (pixels > size - 0.5), axis=-1)
    if outside.any():
        blocks = [b for rows in np.array_split(outside, 3) for b in np.array_split(rows, 3, axis=1)]
        parts = ", ".join(part for part, block in zip(PARTS, blocks, strict=True) if block.any())
        raise CalibrationError(
            f"the raw image lacks {outside.mean():.1%} of the sensor's view ({parts}). Mount the camera under the "
            "middle of the pad and parallel to it, or use a lens with a larger field of view."
        )


def covered(found: Sequence[FoundCorners], size: tuple[int, int]) -> tuple[str, ...]:
    """Return the parts of the raw image in which corners of a board were found.

    The image is divided into 3 x 3 parts. The outer parts are a fifth of the image wide and high, and the middle ones
    three fifths.

    Args:
        found: Corners of the board in each image.
        size: Width and height of the raw images (pixels).

    Returns:
        Names of the parts, such as "top left" or "middle centre", in reading order.
    """
    pixels = np.concatenate([np.zeros((0, 2)), *(corners.pixels for corners in found)])
    thirds = np.digitize((pixels + 0.5) / np.asarray(size), [_OUTER, 1 - _OUTER])
    present = {f"{_ROWS[row]} {_COLUMNS[column]}" for column, row in thirds}
    return tuple(part for part in PARTS if part in present)
