"""The mean of many pairs of images without an object, which is the background of a sensor file."""

import dataclasses
import math
import time
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8

from sts_jax.hardware import PairReader

PAIRS = 20  # of a background


@dataclasses.dataclass(frozen=True, eq=False)
class Backgrounds:
    """The mean images of both streams with nothing on the pad."""

    visual: UInt8[np.ndarray, "height width 3"]
    tactile: UInt8[np.ndarray, "height width 3"]
    noise: tuple[float, float]  # standard deviation of one pixel over time in each stream, of 255
    rate: float  # pairs per second of the computer's clock


class _Mean(NamedTuple):
    """The mean of some images, and their noise."""

    image: UInt8[np.ndarray, "height width 3"]
    noise: float


def record(sensor: PairReader) -> Backgrounds:
    """Take pairs of images of the empty pad at rest."""
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
    mean = total / PAIRS
    variance = (squares / PAIRS - mean**2) * PAIRS / (PAIRS - 1)
    return _Mean(np.round(mean).astype(np.uint8), math.sqrt(max(float(variance.mean()), 0.0)))
