"""The raw view of a fisheye lens, for the two ends of the light."""

import dataclasses
import math

import cv2
import numpy as np

from sts_jax.hardware.lens import Lens, Pinhole, distortion
from sts_jax.hardware.twin.photometry import Warp

MOST_SAMPLES = 3  # per raw pixel and direction
_OUTSIDE = -2.0  # coordinate of a pixel outside of the rendered view


def lens_warp(lens: Lens, pinhole: Pinhole, resolution: tuple[int, int], *, samples: int | None = None) -> Warp:
    """The way from the rendered view to the raw view of a lens.

    Raw pixels that show more than the rendered view are dark.

    Args:
        lens: The camera.
        pinhole: The rendered view, `Sensor.camera`.
        resolution: (height, width) of the rendered view, pixels.
        samples: Samples of a raw pixel in each direction, which are averaged. Default: as many as the image needs to
            show no aliasing, at most `MOST_SAMPLES`.
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
    """The largest distance in the rendered view between neighbours of the raw view (pixels)."""
    inside = ((pixels > -0.5) & (pixels < np.array(resolution[::-1]) - 0.5)).all(axis=-1, keepdims=True)
    pixels = np.where(inside, pixels, np.nan)
    steps = [np.linalg.norm(np.diff(pixels, axis=axis), axis=-1) for axis in (0, 1)]
    return max((float(np.nanmax(step)) for step in steps if np.isfinite(step).any()), default=1.0)
