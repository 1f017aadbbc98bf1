"""Processes that collect random pairs into a session, and print the numbers that are confirmed on disk."""

import os
import sys
import time
import warnings

import numpy as np

from sts_jax.hardware import Lit, Origin, Pair, Recorder, Session, Shot

SIZE = (48, 64)
ORIGIN = Origin("camera", "0123", SIZE[1], SIZE[0], (255, 255, 255, 255))
PERIOD_S = 0.05  # s, between two images of a recording


def pair(number, end, size=SIZE):
    """Images that follow from the number of the trajectory and the end."""
    random = np.random.default_rng([number, end == "final"])
    now = time.monotonic()

    def taken(stream, levels):
        image = random.integers(0, 256, (*size, 3)).astype(np.uint8)
        return Shot(image, stream, now, 2 * number, 1, Lit(levels, 3, 7, now - 0.2, now - 0.1), now + 0.05)

    return Pair(taken("visual", (0, 0, 0, 0)), taken("tactile", (255, 255, 255, 255)))


def shot(number, *, boot=7, epoch=0):
    """The visual (even) or tactile (odd) image of a number: noise, in which any mistake shows."""
    stream, level = ("tactile", 255) if number % 2 else ("visual", 0)
    image = np.random.default_rng(number).integers(0, 256, (*SIZE, 3)).astype(np.uint8)
    time_s = 100 + PERIOD_S * number
    lit = Lit((level,) * 4, number, boot, time_s - 0.2, time_s - 0.1)
    return Shot(image, stream, time_s, 3 * number, epoch, lit, time_s + 0.01)


def record(folder, numbers):
    """Record the images of these numbers."""
    with Recorder(folder, ORIGIN) as recorder:
        for number in numbers:
            recorder.add(shot(number))
            yield number


def write(folder):
    """Collect until killed."""
    with Session(folder, ORIGIN) as session:
        print("ready", os.getpid(), flush=True)
        while True:
            number = session.begin()
            for end in ("initial", "final"):
                session.save(number, end, pair(number, end))
            session.confirm(number)
            print(number, flush=True)


def main(folder):
    """For each line of the standard input, start a writer and wait until it is killed."""
    # JAX warns of its threads, but starts them with its first computation only.
    warnings.filterwarnings("ignore", message="os.fork")
    for _ in sys.stdin:
        writer = os.fork()  # without the imports of a new process
        if writer == 0:
            write(folder)
        os.waitpid(writer, 0)
        print("killed", flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
