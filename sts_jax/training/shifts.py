"""Further training trajectories: copies of trajectories that are shifted to other places on the pad."""

import numpy as np
from jaxtyping import Int, UInt8


def shifted(
    images: UInt8[np.ndarray, "n 2 h w 3"], empty: UInt8[np.ndarray, "h w 3"], shifts: Int[np.ndarray, "n 2"]
) -> UInt8[np.ndarray, "n 2 h w 3"]:
    """Shift the images of trajectories to other places on a level pad.

    The difference from the image of the empty pad is shifted and added to this image, so that the light of the empty
    pad stays at its place. The result is exact for points on the pad under distant lights. A point at the height h
    above the pad should move by the share d / (d + h) of the shift only, where d is the distance from the camera to the
    pad. If the border of the image cuts off a part of an object, this part is missing after the shift, too.

    Args:
        images: First and last image of each trajectory, all visual or all tactile.
        empty: Image of the empty pad, visual or tactile as the others.
        shifts: Rows and columns by which each trajectory is shifted (pixels). The visual and the tactile images of a
            trajectory need the same shift.

    Returns:
        Shifted images, of the same shape.

    Raises:
        ValueError: The shapes do not fit together, or a shift is not smaller than the image.
    """
    size = images.shape[2:4]
    if empty.shape != images.shape[2:] or shifts.shape != (len(images), 2):
        raise ValueError(
            f"images has shape {images.shape}, empty has shape {empty.shape} and shifts has shape {shifts.shape}, but "
            "they must have shapes (n, 2, h, w, 3), (h, w, 3) and (n, 2)"
        )
    if (np.abs(shifts) >= size).any():
        raise ValueError(
            f"shifts has values up to {np.abs(shifts).max()} pixels, but they must be below the size {size} of the "
            "images"
        )
    moved = np.empty_like(images)
    for out, pair, shift in zip(moved, images, shifts, strict=True):
        change = np.zeros(pair.shape, np.int16)
        (to_rows, to_columns), (from_rows, from_columns) = (
            tuple(slice(max(sign * s, 0), n + min(sign * s, 0)) for s, n in zip(shift, size, strict=True))
            for sign in (1, -1)
        )
        change[:, to_rows, to_columns] = (pair.astype(np.int16) - empty)[:, from_rows, from_columns]
        out[:] = np.clip(empty + change, 0, 255)
    return moved
