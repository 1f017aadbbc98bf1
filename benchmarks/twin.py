"""Frame rates of the digital twin at 640x480 and at 1640x1232.

    python -m benchmarks.twin

For each size, the command prints the time to render one pose, to make a noisy frame with the light on for half of the
exposure, and to encode it as JPEG, then the rates at which the twin makes frames and at which a second process receives
them through OpenCV, with the light off. All values are medians, and all processes run on one CPU core.
"""

import dataclasses
import os
import subprocess
import sys
from collections.abc import Callable

import numpy as np
import tyro

import sts_jax as sts
from benchmarks.instruments.timing import median_seconds
from experiments.shared.device import TwinConfig, make_twin
from sts_jax.hardware import twin
from sts_jax.hardware.twin import photometry

SIZES = ((480, 640), (1232, 1640))  # height and width, pixels
RATE = 200.0  # requested frames/s of the camera, more than the machine can make
WINDOW = 10  # number of frames over which a rate is measured

# Prints the seconds between the frames that OpenCV reads.
CLIENT = """
import sys, time, cv2
capture, last = cv2.VideoCapture(sys.argv[1], cv2.CAP_FFMPEG), None
for _ in range(int(sys.argv[2])):
    good, image = capture.read()
    assert good
    now = time.monotonic()
    if last is not None:
        print(now - last)
    last = now
"""


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the command line."""

    frames: int = 200  # number of frames in each measurement


def timed(call: Callable[[], object], number: int) -> float:
    """Median time of `number` calls (ms)."""
    return 1e3 * median_seconds(call, repeats=number)[0]


def held(size: tuple[int, int]) -> twin.Twin:
    """Make a twin, whose pad is empty until it receives the command `hold`."""
    imperfections = twin.Imperfections(exposure_s=1 / RATE)
    return make_twin(TwinConfig(resolution=size, rate=RATE, imperfections=imperfections), prepare=False)


def served(size: tuple[int, int], number: int) -> float:
    """Rate at which a second process receives frames of the digital twin over HTTP (frames/s)."""
    device = held(size)
    device.scene.prepare("hold", device.blender)
    with device, twin.Served(device) as server:
        device.command("hold")
        done = subprocess.run(
            [sys.executable, "-c", CLIENT, server.camera, str(number)], check=True, capture_output=True, text=True
        )
    gaps = np.array([float(line) for line in done.stdout.split()])
    windows = gaps[: len(gaps) // WINDOW * WINDOW].reshape(-1, WINDOW)
    return float(np.median(WINDOW / windows.sum(axis=1)))


def main(args: Args) -> None:
    """Measure the digital twin on one CPU core, and print one line for each image size in SIZES."""
    core = min(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {core})
    for size in SIZES:
        device = held(size)
        with device:
            scene = device.scene
            device.command("hold")
            blender, seen = device.blender, scene.at(device.now_s)
            frame = blender.frame(scene.ends(seen, blender), 0.5)
            poses = iter([dataclasses.replace(seen, frame=i) for i in range(1, 8)])
            render = timed(lambda: scene.ends(next(poses), blender), 5)  # noqa: B023
            blend = timed(lambda: blender.frame(scene.ends(seen, blender), 0.5), args.frames)  # noqa: B023
            jpeg = timed(lambda: photometry.encode(frame, 92), args.frames)  # noqa: B023
            device.ping()
            virtual = timed(device.capture, args.frames)
        rate = served(size, args.frames)
        print(
            f"{size[1]}x{size[0]}: rendering of a pose {render:.0f} ms, frame with noise {blend:.1f} ms, JPEG "
            f"{jpeg:.1f} ms, virtual clock {1e3 / virtual:.1f} frames/s, served {rate:.1f} frames/s",
            flush=True,
        )
    print(f"one core, load average of the machine {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")


if __name__ == "__main__":
    sts.enable_compilation_cache()
    main(tyro.cli(Args, description=__doc__))
