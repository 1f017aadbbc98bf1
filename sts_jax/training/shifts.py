"""More training trajectories from few: the same motion at another place of the pad."""

import numpy as np
from jaxtyping import Int, UInt8


def shifted(
    images: UInt8[np.ndarray, "n 2 h w 3"], empty: UInt8[np.ndarray, "h w 3"], shifts: Int[np.ndarray, "n 2"]
) -> UInt8[np.ndarray, "n 2 h w 3"]:
    """Move trajectories over the pad, which is the same everywhere and lies flat.

    The difference from the image of the empty pad moves, and the light of the empty pad, which is not the same
    everywhere, stays. This is exact for points on the pad under far lights. A point at the height h above the pad
    should move by the share d / (d + h) of the shift only, where d is the distance of the camera. An object that the
    edge of the view cuts off remains cut off where it moves inwards.

    Args:
        images: First and last images of one stream.
        empty: The image of the empty pad of the same stream.
        shifts: Rows and columns by which each trajectory moves (pixels), the same for both streams.

    Returns:
        Images of the same shape.

    Raises:
        ValueError: The shapes do not fit, or a shift is as large as the image.
    """
    size = images.shape[2:4]
    if empty.shape != images.shape[2:] or shifts.shape != (len(images), 2):
        raise ValueError(
            f"images have shape {images.shape}, empty has {empty.shape} and shifts have {shifts.shape}, but they must "
            "have (n, 2, h, w, 3), (h, w, 3) and (n, 2)"
        )
    if (np.abs(shifts) >= size).any():
        raise ValueError(f"shifts go up to {np.abs(shifts).max()} pixels, but they must be below the size {size}")
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
