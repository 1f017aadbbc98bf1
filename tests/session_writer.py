"""Processes that collect random pairs into a session and print the numbers that are confirmed on disk."""

import os
import sys
import time
import warnings

import numpy as np

from sts_jax.hardware.leds import Lit
from sts_jax.hardware.proof import Pair, Shot
from sts_jax.hardware.session import Origin, Session

SIZE = (48, 64)
ORIGIN = Origin("camera", "0123", SIZE[1], SIZE[0], (255, 255, 255, 255))


def pair(number, end, size=SIZE):
    """Images that follow from the number of the trajectory and the end."""
    random = np.random.default_rng([number, end == "final"])
    now = time.monotonic()

    def shot(stream, levels):
        image = random.integers(0, 256, (*size, 3)).astype(np.uint8)
        return Shot(image, stream, now, 2 * number, 1, Lit(levels, 3, 7, now - 0.2, now - 0.1), now + 0.05)

    return Pair(shot("visual", (0, 0, 0, 0)), shot("tactile", (255, 255, 255, 255)))


def write(folder):
    """Collect until killed."""
    with Session(folder, ORIGIN) as session:
        print("ready", os.getpid(), flush=True)
        while True:
            number = session.begin()
            before = session.confirmed
            for end in ("initial", "final"):
                session.save(number, end, pair(number, end))
            session.confirm(number, note=f"note {number}")
            assert session.confirmed == before + 1
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
