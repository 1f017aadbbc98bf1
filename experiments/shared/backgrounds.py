"""Background images for a sensor file. Each is the mean of many visual or many tactile images of the empty pad."""

import dataclasses
import math
import time
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8

from sts_jax.hardware import PairReader

PAIRS = 20  # number of pairs whose mean is a background


@dataclasses.dataclass(frozen=True, eq=False)
class Backgrounds:
    """The mean visual image and the mean tactile image of the empty pad."""

    visual: UInt8[np.ndarray, "height width 3"]  # mean image without light, RGB
    tactile: UInt8[np.ndarray, "height width 3"]  # mean image with light, RGB
    noise: tuple[float, float]  # standard deviation of one pixel over time in the visual and the tactile stream, of 255
    rate: float  # pairs per second, measured with `time.monotonic`


class _Mean(NamedTuple):
    """The mean of the images of one stream, and the noise of a single image."""

    image: UInt8[np.ndarray, "height width 3"]
    noise: float  # standard deviation of one pixel over time, of 255


def record(sensor: PairReader) -> Backgrounds:
    """Take pairs of visual and tactile images of the empty pad, and compute the mean image of each stream.

    Args:
        sensor: Connected sensor. Its pad must be empty, and nothing may move.
    """
    sums: dict[str, np.ndarray] = {}
    squares: dict[str, np.ndarray] = {}
    taken_s = 0.0
    sensor.read()
    for _ in range(PAIRS):
        start = time.monotonic()
        pair = sensor.read()
        taken_s += time.monotonic() - start
        for shot in (pair.visual, pair.tactile):
            image = shot.image.astype(np.uint32)
            sums[shot.stream] = sums.get(shot.stream, 0) + image
            squares[shot.stream] = squares.get(shot.stream, 0) + image**2
    visual, tactile = (_mean(sums[stream], squares[stream]) for stream in ("visual", "tactile"))
    return Backgrounds(visual.image, tactile.image, (visual.noise, tactile.noise), PAIRS / taken_s)


def _mean(total: np.ndarray, squares: np.ndarray) -> _Mean:
    """The mean and the noise of `PAIRS` images, from their sum and the sum of their squares."""
    mean = total / PAIRS
    variance = (squares / PAIRS - mean**2) * PAIRS / (PAIRS - 1)
    return _Mean(np.round(mean).astype(np.uint8), math.sqrt(max(float(variance.mean()), 0.0)))
