"""`lens_warp`: computes the distortion of a fisheye lens, which a `Twin` applies to its rendered images."""

import dataclasses
import math

import cv2
import numpy as np

from sts_jax.hardware.lens import Lens, distortion
from sts_jax.hardware.twin.photometry import Warp
from sts_jax.optics import Camera

MOST_SAMPLES = 3  # largest default number of samples per raw pixel along each axis
_OUTSIDE = -2.0  # coordinate of a raw pixel that lies outside the rendered view


def lens_warp(lens: Lens, pinhole: Camera, resolution: tuple[int, int], *, samples: int | None = None) -> Warp:
    """Compute the mapping from a rendered image to the raw image of a fisheye lens.

    Raw pixels that correspond to no point of the rendered image are black.

    Args:
        lens: Fisheye camera whose raw image is wanted.
        pinhole: Camera camera of the rendered view, such as `sts_jax.Sensor().camera`.
        resolution: (height, width) of the rendered image (pixels).
        samples: Number of samples along each axis of a raw pixel, >= 1. The value of the pixel is the mean of its
            samples. None: the number that avoids aliasing, but at most 3.

    Returns:
        Mapping, for the argument `warp` of `Twin` or `Blender`.

    Raises:
        ValueError: `samples` is less than 1, or `resolution` or `pinhole` is out of range.
    """
    if samples is None:
        samples = min(max(1, math.ceil(_largest_step(distortion(lens, pinhole, resolution), resolution))), MOST_SAMPLES)
    if samples < 1:
        raise ValueError(f"samples must be >= 1 or None, got {samples}")
    fine = dataclasses.replace(
        lens,
        width=lens.width * samples,
        height=lens.height * samples,
        fx=lens.fx * samples,
        fy=lens.fy * samples,
        cx=(lens.cx + 0.5) * samples - 0.5,
        cy=(lens.cy + 0.5) * samples - 0.5,
    )
    pixels = distortion(fine, pinhole, resolution)
    limits = np.array(resolution[::-1], np.float32) + 1
    pixels = np.clip(np.nan_to_num(pixels, nan=_OUTSIDE), _OUTSIDE, limits).astype(np.float32)
    return Warp(cv2.convertMaps(pixels, None, cv2.CV_16SC2), (lens.height, lens.width))


def _largest_step(pixels: np.ndarray, resolution: tuple[int, int]) -> float:
    """The largest distance in the rendered image between the positions of two neighbouring raw pixels (pixels)."""
    inside = ((pixels > -0.5) & (pixels < np.array(resolution[::-1]) - 0.5)).all(axis=-1, keepdims=True)
    pixels = np.where(inside, pixels, np.nan)
    steps = [np.linalg.norm(np.diff(pixels, axis=axis), axis=-1) for axis in (0, 1)]
    return max((float(np.nanmax(step)) for step in steps if np.isfinite(step).any()), default=1.0)
