"""Rate at which `hardware.STS` reads pairs of images, and the number of images taken under a wrong light.

    python -m benchmarks.device --pairs 1000                                                     # about eight minutes
    python -m benchmarks.device --pairs 1000 --out benchmarks/results/hardware/device.txt        # also write the table
    python -m benchmarks.device --pairs 1000 --twin                                              # the digital twin
    python -m benchmarks.device --pairs 10 --lags-ms 15

A separate process emulates the LED controller on a pseudo-terminal and the camera on a local network port, with lags
(from the end of an exposure to the sending of the frame) of several lengths in turn. With `--twin`, the images are
those of the twin. The light of an image is wrong or mixed if its mean in the camera's log differs from the requested
light by more than 0.1 % of full light.

A pair needs at least two frame periods and one settling time: the order of the two images alternates, so the light is
switched only once per pair. This limits the rate.
"""

import dataclasses
import multiprocessing
import multiprocessing.connection
import os
import tempfile
import time
import zlib
from pathlib import Path
from typing import NamedTuple

import tyro

from benchmarks.instruments import peers
from benchmarks.instruments.peers import Image, SensorPeer, Shown
from experiments.shared.device import TwinConfig, make_twin
from sts_jax import hardware, storage
from sts_jax.hardware import twin as twins
from sts_jax.hardware.twin import photometry

SIZE = (640, 480)
FPS = 60.0
EXPOSURE_S = 0.016
MOVE, FINISHED = "move", "finished"  # requests to the process of the emulated devices
EVERY = 10  # pairs between two movements of the twin's object
JPEG_START = b"\xff\xd8\xff"  # first bytes of a JPEG image
LEAST = 0.8  # least required rate, as a share of the camera's limit


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the command line."""

    pairs: int = 1000  # number of pairs of images, of all lags together
    lags_ms: tuple[float, ...] = (15, 30, 50, 80, 120)  # time from the end of an exposure to the sending (ms)
    twin: bool = False  # use images of the digital twin instead of images of one colour
    out: Path | None = None  # text file for the table (default: print only)

    def __post_init__(self) -> None:
        if not 0 < len(self.lags_ms) <= self.pairs:
            raise ValueError(f"--lags-ms must have 1 to --pairs values, got {len(self.lags_ms)}")


class Measured(NamedTuple):
    """Results of reading pairs of images from an emulated camera that sends its frames with a lag."""

    lag_ms: float
    settling: hardware.Settling  # as `hardware.STS` measured it
    pairs: int
    wrong: int  # images of a wrong or mixed light
    frames: int  # frames that `hardware.STS` fetched from the camera
    discarded: int  # fetched frames whose light was not proven
    lost: int  # frames that the camera took and `hardware.STS` did not fetch
    seconds: float

    @property
    def rate(self) -> float:
        """Measured number of pairs per second. A pair is a visual and a tactile image."""
        return self.pairs / self.seconds

    @property
    def limit(self) -> float:
        """Largest possible value of `rate`: `1 / (2 / FPS + mean settling time of the lights)`."""
        return 1 / (2 / FPS + (self.settling.visual_s + self.settling.tactile_s) / 2)


class TwinPeer:
    """A digital twin with a camera at the address `url` and an LED controller at a serial port."""

    def __init__(self, path: Path, *, fps: float, lag_s: float, exposure_s: float, size: tuple[int, int]) -> None:
        """Render the first images, and start the camera and the controller."""
        self._log, self._record = path.with_suffix(".jsonl"), path.with_suffix(".mjpeg")
        imperfections = twins.Imperfections(exposure_s=exposure_s, lag_s=lag_s)
        self.twin = make_twin(
            TwinConfig(size[::-1], rate=fps, imperfections=imperfections, log=self._log, record=self._record)
        )
        self._served = twins.Served(self.twin, link=path)
        self.url = self._served.camera

    def move(self) -> None:
        """Release the object if it is held. Otherwise, hold it in its next pose."""
        self.twin.command("release" if self.twin.state.phase == twins.Phase.HELD else "hold")

    def stop(self) -> None:
        """Stop the twin, its camera and its LED controller."""
        self._served.close()
        self.twin.close()

    def shown(self) -> dict[int, Shown]:
        """Read the frame numbers and the brightness of the LEDs from the twin's log."""
        _, *parts = self._record.read_bytes().split(JPEG_START)
        images = (photometry.decode(JPEG_START + part) for part in parts)
        frames = zip(images, twins.read_log(self._log), strict=True)
        return {self.key(image): Shown(frame.index, frame.light) for image, frame in frames}

    @staticmethod
    def key(image: Image) -> int:
        """Compute the checksum of an image's pixels. Frames differ in their noise, so their checksums differ too."""
        return zlib.crc32(image.tobytes())


def serve(link: multiprocessing.connection.Connection, path: Path, lag_s: float, twin: bool) -> None:
    """Run the emulated devices in a process of their own, until the process that reads the images has finished."""
    make: type[TwinPeer | SensorPeer] = TwinPeer if twin else SensorPeer
    peer = make(path, fps=FPS, lag_s=lag_s, exposure_s=EXPOSURE_S, size=SIZE)
    link.send(peer.url)
    while link.recv() == MOVE:
        if isinstance(peer, TwinPeer):
            peer.move()
    peer.stop()
    link.send(peer.shown())


def measure(lag_ms: float, pairs: int, path: Path, *, twin: bool) -> Measured:
    """Read pairs of images at one lag, and count the images that were exposed with a wrong or mixed light."""
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=serve, args=(there, path, lag_ms / 1000, twin), daemon=True)
    process.start()
    url = here.recv()
    key = TwinPeer.key if twin else peers.key
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
    """Format the results as a table with a row for each lag of the emulated camera."""
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
    """Read pairs of images from emulated cameras with the lags `args.lags_ms`, and return one result for each lag."""
    number = len(args.lags_ms)
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for index, lag_ms in enumerate(args.lags_ms):
            pairs = args.pairs * (index + 1) // number - args.pairs * index // number
            found.append(measure(lag_ms, pairs, Path(folder) / "leds", twin=args.twin))
    return found


def main(args: Args) -> str:
    """Read pairs of images from emulated cameras with different lags, and return a table of the results."""
    found = measure_all(args)
    load = os.getloadavg()[1]
    text = f"{report(found)}\n{os.cpu_count()} CPU cores, with a load of {load:.1f} processes over the last 5 minutes\n"
    if args.out is not None:
        storage.write_bytes(args.out, text.encode())
    return text


if __name__ == "__main__":
    print(main(tyro.cli(Args, description=__doc__)))
