"""Duration of writing a visual and a tactile image to disk as `hardware.Session` does, and size of the files.

    python -m benchmarks.recording                  # a few seconds
    python -m benchmarks.recording --folder /mnt    # on another disk

The command writes pairs of a visual and a tactile image as `hardware.Session` does. The folder of a pair contains both
images as PNG files and their manifest, and is flushed to the disk. The images are synthetic and smooth,
without noise or with noise of standard deviation 1.5 (of 255). For two image sizes, each without and with noise, the
command prints the size of the files of a pair, the median time of encoding, the median time of writing, and the longest
time of encoding and writing together. The command deletes the files afterwards.
"""

import dataclasses
import statistics
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
import tyro

from sts_jax import storage
from sts_jax.hardware import Lit, Pair, Shot, proof, session

SIZES = ((640, 480), (1640, 1232))


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the command line."""

    folder: Path | None = None  # an existing folder on the disk to measure (default: the folder for temporary files)
    pairs: int = 20  # number of pairs of each size and noise
    seed: int = 0  # seed of the images


def pair(random: np.random.Generator, width: int, height: int, noise: float) -> Pair:
    """Make a smooth visual and a smooth tactile image, and add noise to both.

    The noise is normally distributed with the standard deviation `noise` (grey levels).
    """

    def shot(stream: proof.Stream, level: int) -> Shot:
        smooth = cv2.GaussianBlur(random.uniform(0, 1, (height, width, 3)).astype(np.float32), (0, 0), width / 50)
        smooth = (smooth - smooth.min()) / (smooth.max() - smooth.min())
        image = np.clip(level + 120 * smooth + random.normal(0, noise, smooth.shape), 0, 255).astype(np.uint8)
        now = time.monotonic()
        return Shot(image, stream, now, 0, 0, Lit((0, 0, 0, 0), 1, 1, now, now), now)

    return Pair(shot("visual", 20), shot("tactile", 100))


def main(args: Args) -> None:
    """Write image pairs of each size in SIZES, without and with noise, and print the durations and file sizes."""
    random = np.random.default_rng(args.seed)
    print("size         noise   MB a pair   ms to encode   ms to write   longest of both")
    for width, height in SIZES:
        for noise in (0.0, 1.5):
            taken = pair(random, width, height, noise)
            encoding, writing, size = [], [], 0
            with tempfile.TemporaryDirectory(dir=args.folder) as folder:
                for number in range(args.pairs):
                    start = time.perf_counter()
                    files = session.encoded_pair(taken)
                    middle = time.perf_counter()
                    storage.write_folder(Path(folder) / str(number), files)
                    encoding.append(1e3 * (middle - start))
                    writing.append(1e3 * (time.perf_counter() - middle))
                    size = sum(map(len, files.values()))
            longest = max(a + b for a, b in zip(encoding, writing, strict=True))
            print(
                f"{width:4d} x {height:4d}  {noise:5.1f}  {size / 1e6:10.1f}  {statistics.median(encoding):13.0f}"
                f"  {statistics.median(writing):12.0f}  {longest:16.0f}"
            )


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
