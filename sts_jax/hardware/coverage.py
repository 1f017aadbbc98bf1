"""Checks that the raw images and the calibration of a lens cover the whole view of the sensor."""

import math
from collections.abc import Sequence

import numpy as np

from sts_jax.hardware.board import FoundCorners
from sts_jax.hardware.calibration import CalibrationError
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
    """Return the largest angle from the optical axis of the real camera to a point of the sensor's view (rad).

    The view is the part of the gel's outer face that rectified images show. The point with the largest angle is a
    corner of the view.

    Args:
        lens: The lens and the pose of the real camera.
        pinhole: The simulated pinhole camera that defines the view, such as `Sensor.camera`.
    """
    left, top, width, height = window(pinhole, _RESOLUTION)
    corners = np.array([(x, y, 0.0) for x in (left, left + width) for y in (top, top + height)])
    seen = corners @ lens.matrix.T + np.asarray(lens.translation)
    return float(np.arctan2(np.hypot(seen[:, 0], seen[:, 1]), seen[:, 2]).max())


def check_view(lens: Lens, pinhole: Pinhole, largest_angle: float | None = None) -> None:
    """Check that the camera sees the whole view and that the calibration images cover the corners of the view.

    The view is the part of the gel's outer face that rectified images show.

    Args:
        lens: The lens and the pose of the real camera.
        pinhole: The simulated pinhole camera that defines the view, such as `Sensor.camera`.
        largest_angle: `Calibration.largest_angle`, the largest angle from the optical axis at which the calibration
            images show a corner of the board (rad). The angles of the corners of the view may be up to 3 degrees
            larger. None: this angle is not checked.

    Raises:
        CalibrationError: A part of the view lies outside of the camera's image. Or a corner of the view is more than
            3 degrees beyond `largest_angle`. Or the lens model is not valid for the whole view.
    """
    needed = view_angle(lens, pinhole)
    if largest_angle is not None and needed > largest_angle + _EXTRAPOLATION:
        raise CalibrationError(
            f"the corners of the sensor's view are up to {math.degrees(needed):.1f} degrees from the optical axis, but "
            f"the calibration images show the board only up to {math.degrees(largest_angle):.1f} degrees. The "
            f"difference must be at most {math.degrees(_EXTRAPOLATION):.0f} degrees. Take more images with the board "
            "in the corners of the image, and calibrate again."
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
            f"{outside.mean():.2%} of the sensor's view ({parts}) lies outside of the raw image, but the raw image "
            "must show the whole view. Mount the camera under the centre of the pad and parallel to the pad, or use a "
            "lens with a larger field of view."
        )


def covered(found: Sequence[FoundCorners], size: tuple[int, int]) -> tuple[str, ...]:
    """Return the parts of the raw image in which a corner of the board was found at least once.

    A corner in any of the calibration images counts. The image is divided into 3 rows and 3 columns. The top and bottom
    rows each have 20 % of the image's height, and the left and right columns each have 20 % of the image's width.

    Args:
        found: Corners of the board in each image, from `find_board`.
        size: Width and height of the raw images (pixels).

    Returns:
        Names of the parts, such as "top left" or "middle centre", in reading order.
    """
    pixels = np.concatenate([np.zeros((0, 2)), *(corners.pixels for corners in found)])
    thirds = np.digitize((pixels + 0.5) / np.asarray(size), [_OUTER, 1 - _OUTER])
    present = {f"{_ROWS[row]} {_COLUMNS[column]}" for column, row in thirds}
    return tuple(part for part in PARTS if part in present)
