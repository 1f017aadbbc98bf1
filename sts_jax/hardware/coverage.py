"""Whether a lens and its calibration cover the sensor's view."""

import math
from collections.abc import Sequence

import numpy as np

from sts_jax.hardware.calibration import CalibrationError, FoundCorners
from sts_jax.hardware.lens import Lens, Pinhole, rectification, window

_RESOLUTION = 480, 640  # pixels of the view at which it is checked
_EXTRAPOLATION = math.radians(3)  # by which the view may exceed the corners of all boards
# Share of the image's width and height, from each border. Where a lens of 160 degrees sees the view's border. The board
# on the pad ends before it.
_OUTER = 0.2
_ROWS = "top", "middle", "bottom"
_COLUMNS = "left", "centre", "right"
PARTS = tuple(f"{row} {column}" for row in _ROWS for column in _COLUMNS)


def view_angle(lens: Lens, pinhole: Pinhole) -> float:
    """The largest angle between the optical axis of a lens and a ray of the sensor's view (rad)."""
    left, top, width, height = window(pinhole, _RESOLUTION)
    corners = np.array([(x, y, 0.0) for x in (left, left + width) for y in (top, top + height)])
    seen = corners @ lens.matrix.T + np.asarray(lens.translation)
    return float(np.arctan2(np.hypot(seen[:, 0], seen[:, 1]), seen[:, 2]).max())


def check_view(lens: Lens, pinhole: Pinhole, largest_angle: float | None = None) -> None:
    """Raise an error unless the raw image shows the whole view, and the boards of the calibration reached its corners.

    Args:
        lens: the camera.
        pinhole: the sensor's view.
        largest_angle: `Calibration.largest_angle` (rad). The view may exceed it by 3 degrees. None: not compared.

    Raises:
        CalibrationError: a part of the view is outside of the raw image, or beyond the corners of all boards.
    """
    needed = view_angle(lens, pinhole)
    if largest_angle is not None and needed > largest_angle + _EXTRAPOLATION:
        raise CalibrationError(
            f"the corners of the board reach {math.degrees(largest_angle):.1f} degrees from the optical axis, but the "
            f"corners of the sensor's view are at {math.degrees(needed):.1f} degrees. Take more pictures with the "
            "board in the corners of the image."
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
    """The parts of the raw image that contain corners of a board: the middle, and the outer fifths at the borders.

    Args:
        found: the corners of each image.
        size: width and height of the raw images (pixels).

    Returns:
        Names such as "top left", in the order of `coverage.PARTS`.
    """
    pixels = np.concatenate([np.zeros((0, 2)), *(corners.pixels for corners in found)])
    thirds = np.digitize((pixels + 0.5) / np.asarray(size), [_OUTER, 1 - _OUTER])
    present = {f"{_ROWS[row]} {_COLUMNS[column]}" for column, row in thirds}
    return tuple(part for part in PARTS if part in present)
