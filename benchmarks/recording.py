"""Duration of writing images to disk as `hardware.Session` and `hardware.Recorder` do, and size of the files.

    python -m benchmarks.recording                  # half a minute
    python -m benchmarks.recording --folder /mnt    # on another disk

The images are synthetic and smooth, without noise or with noise of standard deviation 1.5 (of 255). The command prints
the median and the longest time of writing a pair as a session does (PNG files, flushed to the disk), and of adding an
image to a recording in each encoding. It deletes the files afterwards.
"""

import dataclasses
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
import tyro

from sts_jax import storage
from sts_jax.hardware import Lit, Origin, Pair, Recorder, Shot, recording, session, sts

SIZES = ((640, 480), (1640, 1232))


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the command line."""

    folder: Path | None = None  # an existing folder on the disk to measure (default: the folder for temporary files)
    pairs: int = 10  # number of pairs of each size and noise
    seed: int = 0  # seed of the images


def pair(random: np.random.Generator, width: int, height: int, noise: float) -> Pair:
    """Make a smooth visual and a smooth tactile image with noise of a standard deviation (grey levels)."""

    def shot(stream: sts.Stream, level: int) -> Shot:
        smooth = cv2.GaussianBlur(random.uniform(0, 1, (height, width, 3)).astype(np.float32), (0, 0), width / 50)
        smooth = (smooth - smooth.min()) / (smooth.max() - smooth.min())
        image = np.clip(level + 120 * smooth + random.normal(0, noise, smooth.shape), 0, 255).astype(np.uint8)
        now = time.monotonic()
        return Shot(image, stream, now, 0, 0, Lit((0, 0, 0, 0), 1, 1, now, now), now)

    return Pair(shot("visual", 20), shot("tactile", 100))


def measure(name: str, folder: Path, count: int, write: Callable[[int], object]) -> None:
    """Call `write` with the numbers below `count`, and print its durations and the size of the folder."""
    times = []
    for number in range(count):
        start = time.perf_counter()
        write(number)
        times.append(1e3 * (time.perf_counter() - start))
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / count
    print(f"  {name:28s}  {size / 1e6:5.2f} MB  {statistics.median(times):5.0f} ms, at most {max(times):5.0f} ms")


def measure_disk(folder: Path, taken: Pair, count: int) -> None:
    """Measure the writing of a pair, and of an image in each encoding."""

    def write_pair(number: int) -> None:
        storage.write_folder(folder / "session" / str(number), session.encoded_pair(taken), {})

    measure("pair of a session", folder / "session", count, write_pair)
    height, width = taken.visual.image.shape[:2]
    for encoding in get_args(recording.Encoding):
        origin = Origin("camera", "leds", width, height, (255,) * 4)
        with Recorder(folder / encoding, origin, encoding=encoding) as recorder:

            def add(number: int, recorder: Recorder = recorder) -> None:
                recorder.add(dataclasses.replace(taken.visual, time_s=0.05 * number))

            measure(f"image of a recording, {encoding}", folder / encoding, count, add)


def main(args: Args) -> None:
    """Measure each size in SIZES, without and with noise."""
    random = np.random.default_rng(args.seed)
    for width, height in SIZES:
        for noise in (0.0, 1.5):
            print(f"{width} x {height}, noise {noise}")
            with tempfile.TemporaryDirectory(dir=args.folder) as temporary:
                measure_disk(Path(temporary), pair(random, width, height, noise), args.pairs)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
