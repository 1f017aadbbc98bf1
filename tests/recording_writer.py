"""A process that records images which follow from their numbers, and prints each number when it is recorded."""

import itertools
import sys

import numpy as np
from session_writer import ORIGIN, SIZE

from sts_jax.hardware import Lit, Recorder, Settling, Shot

PERIOD_S = 0.05  # s, between two images


def shot(number, *, boot=7, epoch=0):
    """The visual (even) or tactile (odd) image of a number: noise, in which any mistake shows."""
    stream, level = ("tactile", 255) if number % 2 else ("visual", 0)
    image = np.random.default_rng(number).integers(0, 256, (*SIZE, 3)).astype(np.uint8)
    time_s = 100 + PERIOD_S * number
    lit = Lit((level,) * 4, number, boot, time_s - 0.2, time_s - 0.1)
    return Shot(image, stream, time_s, 3 * number, epoch, lit, time_s + 0.01)


def write(folder, numbers, **options):
    """Record the images of these numbers."""
    with Recorder(folder, ORIGIN, settling=Settling(0.1, 0.2), **options) as recorder:
        for number in numbers:
            recorder.add(shot(number))
            yield number


if __name__ == "__main__":
    for written in write(sys.argv[1], itertools.count()):
        print(written, flush=True)
