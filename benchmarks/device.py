"""Pairs of images of a sensor's devices: images of a wrong light, and the rate against the camera's limit.

    python -m benchmarks.device --pairs 1000                                                     # about eight minutes
    python -m benchmarks.device --pairs 1000 --out benchmarks/results/hardware/device.txt        # also write the table
    python -m benchmarks.device --pairs 1000 --twin                                              # the digital twin
    python -m benchmarks.device --pairs 10 --lags-ms 15

A controller on a pseudo-terminal and a camera on loopback, in a process of their own, stand for the devices. Their
images are flat (`instruments/sensor_peer.py`), or with `--twin` those of the digital twin (`instruments/twin_peer.py`),
whose object is held or released after every ten pairs. The pairs are shared between several lags, which is the time
from the end of a frame's exposure to its sending. `hardware.STS` measures the settling times itself. The camera's log
of each frame decides which light an image shows, never the host's label. An image is of a wrong or mixed light if the
mean light of its exposure differs from the wanted one by more than 0.1 %.

The limit of the camera is one pair in two frame periods and the settling time. A pair has one switch, and the two
directions alternate, so the settling time is the mean of both.
"""

import dataclasses
import multiprocessing
import multiprocessing.connection
import os
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import tyro

from benchmarks.instruments import sensor_peer, twin_peer
from benchmarks.instruments.shown import Shown
from sts_jax import hardware

SIZE = (640, 480)
FPS = 60.0
EXPOSURE_S = 0.016
MOVE, FINISHED = "move", "finished"  # requests of the host to the process of the devices
EVERY = 10  # pairs between two of its movements of the twin's object
LEAST = 0.8  # share of the camera's limit that is required


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the command line.

    Raises:
        ValueError: There are fewer pairs than lags.
    """

    pairs: int = 1000  # of all lags together
    lags_ms: tuple[float, ...] = (15, 30, 50, 80, 120)
    twin: bool = False  # images of the digital twin instead of flat ones
    out: Path | None = None  # file of the table

    def __post_init__(self) -> None:
        if not 0 < len(self.lags_ms) <= self.pairs:
            raise ValueError(f"--pairs is {self.pairs}, but must be at least the {len(self.lags_ms)} lags")


class Measured(NamedTuple):
    """The findings at one lag."""

    lag_ms: float
    settling: hardware.Settling
    pairs: int
    wrong: int  # images of a wrong or mixed light
    frames: int  # that the host has fetched
    discarded: int  # frames that were not proven to be of the wanted light
    lost: int  # frames that the camera has taken and that the host has not fetched
    seconds: float

    @property
    def rate(self) -> float:
        """Pairs per second."""
        return self.pairs / self.seconds

    @property
    def limit(self) -> float:
        """Pairs per second that the camera allows."""
        return 1 / (2 / FPS + (self.settling.visual_s + self.settling.tactile_s) / 2)


def serve(link: multiprocessing.connection.Connection, path: Path, lag_s: float, twin: bool) -> None:
    """Run the devices until the host has finished, then hand over the camera's log."""
    make: type[twin_peer.TwinPeer | sensor_peer.SensorPeer] = twin_peer.TwinPeer if twin else sensor_peer.SensorPeer
    peer = make(path, fps=FPS, lag_s=lag_s, exposure_s=EXPOSURE_S, size=SIZE)
    link.send(peer.url)
    while link.recv() == MOVE:
        if isinstance(peer, twin_peer.TwinPeer):
            peer.move()
    peer.stop()
    link.send(peer.shown())


def measure(lag_ms: float, pairs: int, path: Path, *, twin: bool) -> Measured:
    """Read pairs at one lag and judge their images."""
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=serve, args=(there, path, lag_ms / 1000, twin), daemon=True)
    process.start()
    url = here.recv()
    key = twin_peer.key if twin else sensor_peer.key
    taken: list[tuple[int, float]] = []  # key of each image, and the share of light that it must have
    sequences: list[int] = []
    camera = hardware.CameraConfig(url, *SIZE, lock=False, buffer=8)
    with hardware.STS(camera=camera, leds=str(path)) as sensor:
        settled = sensor.settling
        sensor.read()
        before, begun_s = sensor.discarded, time.perf_counter()
        for number in range(pairs):
            if twin and number % EVERY == 0:
                here.send(MOVE)
            pair = sensor.read()
            for shot, share in ((pair.visual, 0.0), (pair.tactile, 1.0)):
                taken.append((key(shot.image), share))
                sequences.append(shot.sequence)
        seconds = time.perf_counter() - begun_s
        discarded = sensor.discarded - before
    here.send(FINISHED)
    log: dict[int, Shown] = here.recv()
    process.join()
    wrong = sum(name not in log or not log[name].is_of(share) for name, share in taken)
    frames = max(sequences) - min(sequences) + 1
    numbers = [log[name].number for name, _ in taken if name in log] or [0]
    lost = max(numbers) - min(numbers) + 1 - frames
    return Measured(lag_ms, settled, pairs, wrong, frames, discarded, lost, seconds)


def report(found: list[Measured]) -> str:
    """The table."""
    lines = ["lag (ms)  settling off, on (ms)  frames/s  pairs  wrong or mixed  pairs/s  limit  share  discarded  lost"]
    for row in found:
        settled = f"{1000 * row.settling.visual_s:.0f}, {1000 * row.settling.tactile_s:.0f}"
        lines.append(
            f"{row.lag_ms:8g}  {settled:>21s}  {row.frames / row.seconds:8.1f}  {row.pairs:5d}  {row.wrong:14d}  "
            f"{row.rate:7.2f}  {row.limit:5.2f}  {row.rate / row.limit:5.2f}  {row.discarded:9d}  {row.lost:4d}"
        )
    worst = min(row.rate / row.limit for row in found)
    lines.append(
        f"{2 * sum(row.pairs for row in found)} images, {sum(row.wrong for row in found)} of a wrong or mixed light. "
        f"The least share of the camera's limit is {worst:.2f}, and {LEAST:g} are required."
    )
    return "\n".join(lines)


def measure_all(args: Args) -> list[Measured]:
    """Measure all lags, which share the pairs."""
    number = len(args.lags_ms)
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for index, lag_ms in enumerate(args.lags_ms):
            pairs = args.pairs * (index + 1) // number - args.pairs * index // number
            found.append(measure(lag_ms, pairs, Path(folder) / "leds", twin=args.twin))
    return found


def main(args: Args) -> str:
    """Measure and return the table."""
    found = measure_all(args)
    load = os.getloadavg()[1] if hasattr(os, "getloadavg") else float("nan")
    text = (
        report(found) + f"\n{os.cpu_count()} CPU cores, with a load of {load:.1f} processes over the last 5 minutes\n"
    )
    if args.out is not None:
        args.out.parent.mkdir(parents=True, exist_ok=True)
        args.out.write_text(text)
    return text


if __name__ == "__main__":
    print(main(tyro.cli(Args, description=__doc__)))
