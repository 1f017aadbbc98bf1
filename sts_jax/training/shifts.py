"""Further training trajectories: copies of trajectories that are shifted to other places on the pad."""

import numpy as np
from jaxtyping import Int, UInt8


def shifted(
    images: UInt8[np.ndarray, "n 2 h w 3"], empty: UInt8[np.ndarray, "h w 3"], shifts: Int[np.ndarray, "n 2"]
) -> UInt8[np.ndarray, "n 2 h w 3"]:
    """Shift the images of trajectories, as if the objects were at other places on a level pad.

    The function subtracts the image of the empty pad, shifts the difference, and adds the image of the empty pad again.
    The light on the empty pad therefore stays in place.

    The result is exact for points on the pad under distant lights, except for the vignetting of visual images. For a
    point at the height z above the pad, the shift is too large by the factor 1 + z / d, where d is the distance from
    the camera to the pad. If the border of the image cuts off a part of an object, this part is missing after the
    shift, too.

    Args:
        images: First and last image of each of n trajectories, all visual or all tactile.
        empty: Image of the empty pad, visual or tactile like `images`.
        shifts: Numbers of rows and columns by which each trajectory is shifted (pixels). Positive shifts move the
            object to larger row and column indices. The visual and the tactile images of a trajectory need the same
            shift.

    Returns:
        Shifted images, of the same shape.

    Raises:
        ValueError: The shapes do not fit together, or a shift is not smaller than the image.
    """
    size = images.shape[2:4]
    if empty.shape != images.shape[2:] or shifts.shape != (len(images), 2):
        raise ValueError(
            f"`images` has shape {images.shape}, `empty` has shape {empty.shape} and `shifts` has shape "
            f"{shifts.shape}, but `images` must have shape (n, 2, h, w, 3), `empty` must have shape (h, w, 3), and "
            "`shifts` must have shape (n, 2), with the same n, h and w"
        )
    if (np.abs(shifts) >= size).any():
        rows, columns = np.abs(shifts).max(0).tolist()
        raise ValueError(
            f"`shifts` contains shifts of up to {rows} rows and {columns} columns, but they must be below the image "
            f"size of {size[0]} rows and {size[1]} columns: give smaller shifts"
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
