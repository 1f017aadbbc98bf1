"""Behaviour of `hardware.STS` when the camera or the LED controller fails while a program reads pairs of images.

    python -m benchmarks.faults                                                 # 312 faults, about a quarter of an hour
    python -m benchmarks.faults --out benchmarks/results/hardware/faults.txt    # also write the table
    python -m benchmarks.faults --number 20 --only black                        # one kind of fault

The LED controller is emulated on a pseudo-terminal, and the camera, which sees its lights, on a local network port.
Exposure time and lag are random. A fault begins at a random moment of a read, and reads continue until a pair has been
read after its end. A received image is wrong if the camera's log has a wrong or mixed light for its exposure, or no
exposure. It is old if its exposure began longer before the read than the settling time. In the last kind of fault, a
second process reads the pairs, and is killed while a light is on.
"""

import contextlib
import dataclasses
import multiprocessing
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
import unittest.mock
from collections.abc import Callable, Iterator
from pathlib import Path

import tyro
from serial.tools import list_ports_common

from benchmarks.instruments.peers import SensorPeer
from sts_jax import hardware, storage

FPS = 60.0
TIMEOUT_S = 2.0  # limit for one image
ANSWER_S = 0.6  # limit for the controller's answer to one request
HANDSHAKE_S = 1.0  # limit for the controller's first answer at a port
RECONNECT_S = 4.0  # limit for finding the controller again
CAMERA_S = 1.0  # limit for one frame
FROZEN_S = 0.4  # time after which repeated frames are an error
WATCHDOG_MS = 500
REQUEST_S = 2 * (ANSWER_S + 0.3)  # longest time of a request, after a restart of the controller (`hardware.Leds`)
GRACE_S = 0.5  # slack for threads that a busy machine delays, and for 0.2 s of `STS`
READ_S = 2 * TIMEOUT_S + REQUEST_S + GRACE_S  # longest time of a read without a reconnection
RECONNECTED_S = READ_S + RECONNECT_S + 2 * (HANDSHAKE_S + 2 * ANSWER_S)  # with a reconnection at up to two ports
DARK_S = 0.1  # slack for lights that a busy machine turns off later than the watchdog's period
PART = 40  # faults of one emulated sensor
LONG = 0.15  # share of the faults of variable length that last 5 to 7 s, longer than the time limit of an image
RETURN_S = 12.0  # longest wait for a pair after a fault: the camera's backoff after a fault of 7 s, and one read


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the command line."""

    number: int = 312  # number of faults
    seed: int = 0  # seed of the order, the times and the lengths of the faults
    jobs: int = 1  # number of emulated sensors that are read at the same time, each in a process of its own
    only: tuple[str, ...] = ()  # kinds of faults (default: all)
    out: Path | None = None  # text file for the table (default: print only)

    def __post_init__(self) -> None:
        if self.number < 1:
            raise ValueError(f"--number must be at least 1, got {self.number}")
        if unknown := set(self.only) - set(KINDS) - {KILLED}:
            raise ValueError(f"--only has unknown kinds {sorted(unknown)}: give {', '.join([*KINDS, KILLED])}")


@dataclasses.dataclass
class Count:
    """The results of all faults of one kind."""

    injected: int = 0  # number of faults
    images: int = 0
    wrong: int = 0  # images of a wrong or mixed light, or not taken by the camera
    old: int = 0  # images whose exposure began more than the settling time before the read
    errors: dict[str, int] = dataclasses.field(default_factory=dict)  # number of reads by the class of their error
    unnamed: int = 0  # reads that raised any other error than CameraError, LedError and LightError
    longest_s: float = 0.0  # longest time of a read
    limit_s: float = READ_S  # allowed time of a read
    recovered: int = 0  # number of faults after which a pair was read, or the lights went off in time
    recovery_s: float = 0.0  # longest time from the last read during a fault to the next pair
    lit_s: float = 0.0  # longest time for which a light was on after the program was killed

    def add(self, other: "Count") -> None:
        """Add the results of another `Count` to this one."""
        for name in ("injected", "images", "wrong", "old", "unnamed", "recovered"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        for name, number in other.errors.items():
            self.errors[name] = self.errors.get(name, 0) + number
        for name in ("longest_s", "recovery_s", "lit_s"):
            setattr(self, name, max(getattr(self, name), getattr(other, name)))
        self.limit_s = other.limit_s


class Bench:
    """The emulated camera and LED controller, and the `hardware.STS` that uses them."""

    def __init__(self, folder: Path, draw: random.Random):
        self.folder, self.draw = folder, draw
        self.peer = SensorPeer(
            folder / "leds", fps=FPS, lag_s=draw.uniform(0.015, 0.12), exposure_s=draw.uniform(0.004, 0.016)
        )
        self.ports = [_usb_port(self.peer.path)]

    @contextlib.contextmanager
    def connected(self) -> Iterator[hardware.STS]:
        """Connect a sensor, measure its settling times, and disconnect the sensor at the end of the `with` block."""
        with unittest.mock.patch("serial.tools.list_ports.comports", side_effect=lambda: self.ports):
            leds = hardware.Leds.connect(
                self.peer.path, timeout_s=HANDSHAKE_S, answer_s=ANSWER_S, watchdog_ms=WATCHDOG_MS
            )
            made = hardware.STS(camera=self.camera(), leds=leds, timeout_s=TIMEOUT_S, reconnect_s=RECONNECT_S)
            with made.connect(warmup_s=0.1) as sensor:
                yield sensor

    def camera(self) -> hardware.CameraConfig:
        """The configuration with which `hardware.STS` opens the emulated camera."""
        return hardware.CameraConfig(
            self.peer.url,
            *self.peer.camera.size,
            lock=False,
            timeout_s=CAMERA_S,
            frozen_after_s=FROZEN_S,
            buffer=8,
        )

    def plug_in(self, name: str) -> None:
        """Plug in the emulated controller. Its port is then the symbolic link `name` in the folder of this bench."""
        self.peer.plug_in(self.folder / name)
        self.ports[:] = [_usb_port(str(self.folder / name))]


def _usb_port(path: str) -> list_ports_common.ListPortInfo:
    port = list_ports_common.ListPortInfo(path)
    port.vid, port.pid, port.serial_number, port.description = 0x2341, 0x43, "55", "Arduino Uno"
    return port


def _length_s(bench: Bench, least_s: float, longest_s: float) -> float:
    """Draw the length of a fault: 5 to 7 s for the share LONG of the faults, else `least_s` to `longest_s`."""
    return bench.draw.uniform(5, 7) if bench.draw.random() < LONG else bench.draw.uniform(least_s, longest_s)


# A fault lasts while its function runs. The function runs in a thread of its own, and the main thread reads pairs.


def _answers(word: str) -> Callable[[Bench], None]:
    """Make a function that spoils one to four answers of the controller. `word` is a fault of `peers.Peer`."""

    def fault(bench: Bench) -> None:
        bench.peer.leds.faults = [word] * bench.draw.randint(1, 4)
        deadline = time.monotonic() + 2
        while bench.peer.leds.faults and time.monotonic() < deadline:
            time.sleep(0.01)
        bench.peer.leds.faults = []

    return fault


def _silent(bench: Bench) -> None:
    """Make the controller answer nothing for at least half the time limit of a request."""
    bench.peer.leds.faults = ["lost"] * 1000
    time.sleep(_length_s(bench, 0.5 * ANSWER_S, 2 * ANSWER_S))
    bench.peer.leds.faults = []


def _watchdog(bench: Bench) -> None:
    for _ in range(bench.draw.randint(1, 3)):
        bench.peer.leds.fire_watchdog()
        time.sleep(bench.draw.uniform(0.02, 0.4))


def _reset(bench: Bench) -> None:
    boot_s = bench.draw.uniform(0, 0.9)
    bench.peer.leds.restart(boot_s)
    time.sleep(boot_s)


def _unplugged(bench: Bench, seconds: float | None = None) -> None:
    bench.peer.unplug()
    time.sleep(_length_s(bench, 0.1, 1.5) if seconds is None else seconds)
    bench.plug_in(Path(bench.ports[0].device).name)


def _renamed(bench: Bench) -> None:
    bench.peer.unplug()
    time.sleep(_length_s(bench, 0.1, 1.5))
    bench.plug_in(f"leds-{bench.draw.randrange(10**6)}")


def _camera(mode: str, least_s: float = 0.1, longest_s: float = 1.5) -> Callable[[Bench], None]:
    """Make a function that sets a mode of `peers.MotionJpeg` for a random time (s)."""

    def fault(bench: Bench) -> None:
        bench.peer.camera.mode = mode
        time.sleep(_length_s(bench, least_s, longest_s))
        bench.peer.camera.mode = "live"

    return fault


def _gone(bench: Bench) -> None:
    bench.peer.camera.stop()
    time.sleep(_length_s(bench, 0.1, 1.5))
    bench.peer.camera.start()


def _held_reset(bench: Bench) -> None:
    """Hold the camera's frames back in the network, and restart the controller meanwhile."""
    bench.peer.camera.mode = "held"
    time.sleep(bench.draw.uniform(0.02, 0.3))
    bench.peer.leds.restart()
    time.sleep(bench.draw.uniform(0.02, 0.6))
    bench.peer.camera.mode = "live"


def _held_unplugged(bench: Bench) -> None:
    """Hold the camera's frames back in the network, and meanwhile unplug the controller and plug it in again."""
    bench.peer.camera.mode = "held"
    time.sleep(bench.draw.uniform(0.0, 0.1))
    _unplugged(bench, bench.draw.uniform(0.02, 0.1))
    time.sleep(bench.draw.uniform(0.2, 0.6))
    bench.peer.camera.mode = "live"


KINDS: dict[str, Callable[[Bench], None]] = {
    **{f"answer {word}": _answers(word) for word in ("late", "lost", "doubled", "garbled", "cut", "joined")},
    "noise on the line": _answers("noise"),
    "stale answer": _answers("stale"),
    "request lost": _answers("deaf"),
    "request damaged": _answers("damaged"),
    "controller silent": _silent,
    "watchdog fires": _watchdog,
    "controller restarts": _reset,
    "port vanishes": _unplugged,
    "port returns renamed": _renamed,
    "camera stalls": _camera("stall", 0.05, 2.0),
    "frames held back": _camera("held", 0.05, 0.8),
    "held back, restart": _held_reset,
    "held back, unplugged": _held_unplugged,
    "frames repeated": _camera("repeat", 0.05, 1.5),
    "other size": _camera("small"),
    "black": _camera("black"),
    "damaged frames": _camera("damaged"),
    "stream closed": _camera("close"),
    "camera's host gone": _gone,
}
KILLED = "program killed"
RECONNECTING = (
    "controller silent",
    "controller restarts",
    "port vanishes",
    "port returns renamed",
    "held back, restart",
    "held back, unplugged",
)


def inject(bench: Bench, sensor: hardware.STS, kind: str, count: Count) -> None:
    """Inject one fault, and try to read pairs of images until the first pair arrives after the end of the fault."""
    count.injected += 1
    count.limit_s = RECONNECTED_S if kind in RECONNECTING or kind.startswith(("answer", "request")) else READ_S
    _read(bench, sensor, count)
    begin_s = bench.draw.uniform(0, 0.3)

    def run() -> None:
        time.sleep(begin_s)
        KINDS[kind](bench)

    fault = threading.Thread(target=run)
    fault.start()
    while fault.is_alive():
        _read(bench, sensor, count)
    ended_s = time.monotonic()
    while time.monotonic() < ended_s + RETURN_S:
        if _read(bench, sensor, count):
            count.recovered += 1
            count.recovery_s = max(count.recovery_s, time.monotonic() - ended_s)
            return


def _read(bench: Bench, sensor: hardware.STS, count: Count) -> bool:
    """Read a pair and count its wrong and old images. Return False if the read raised an error."""
    begun_s = time.monotonic()
    try:
        pair = sensor.read()
    except (hardware.CameraError, hardware.LedError, hardware.LightError) as error:
        name = type(error).__name__
        count.errors[name] = count.errors.get(name, 0) + 1
        time.sleep(0.1)
        return False
    except Exception as error:
        count.unnamed += 1
        print(f"a read raised another error than CameraError, LedError or LightError: {error!r}", file=sys.stderr)
        return False
    finally:
        count.longest_s = max(count.longest_s, time.monotonic() - begun_s)
    for shot, lit in ((pair.visual, False), (pair.tactile, True)):
        count.images += 1
        count.wrong += not bench.peer.judged(shot.image, lit=lit)
        taken = bench.peer.camera.exposure_of(shot.image)
        settled_s = sensor.settling.tactile_s if lit else sensor.settling.visual_s
        count.old += taken is not None and taken.start_s < begun_s - settled_s
    return True


def host(path: str, url: str, width: int, height: int) -> None:
    """Read pairs of images without end."""
    camera = hardware.CameraConfig(url, width, height, lock=False, buffer=8)
    settled = hardware.Settling(visual_s=0.15, tactile_s=0.15)
    leds = hardware.Leds.connect(path, watchdog_ms=WATCHDOG_MS)
    with hardware.STS(camera=camera, leds=leds, settling=settled) as sensor:
        while True:
            sensor.read()


def kill(bench: Bench, count: Count) -> None:
    """Start a program that reads pairs of images, and kill the program at a random moment while a light is on."""
    count.injected += 1
    count.limit_s = WATCHDOG_MS / 1000 + DARK_S
    size = bench.peer.camera.size
    port = bench.ports[0].device
    program = f"from benchmarks import faults; faults.host({port!r}, {bench.peer.url!r}, {size[0]}, {size[1]})"
    lights = bench.peer.lights
    process = subprocess.Popen([sys.executable, "-c", program])
    try:
        _until(lambda: lights.off_after(0.0) is None or process.poll() is not None, 60)
        wait_s = time.monotonic() + bench.draw.uniform(0, 3)
        _until(lambda: time.monotonic() > wait_s and lights.off_after(0.0) is None, 60)
        if process.poll() is not None or lights.off_after(0.0) is not None:
            raise RuntimeError(f"no light was on within 60 s, exit status of the program: {process.poll()}")
        process.send_signal(signal.SIGKILL)
        process.wait()
        killed_s = time.monotonic()
    finally:
        process.kill()
        process.wait()
    _until(lambda: lights.off_after(killed_s) is not None, 10)
    time.sleep(0.3)
    off_s = lights.off_after(killed_s)
    lit_s = float("inf") if off_s is None else off_s - killed_s
    count.lit_s = max(count.lit_s, lit_s)
    count.recovered += lit_s <= count.limit_s


def _until(condition: Callable[[], bool], limit_s: float) -> None:
    deadline = time.monotonic() + limit_s
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.002)


def measure(args: Args) -> dict[str, Count]:
    """Inject the faults in random order, all kinds equally often, and return the results by kind."""
    kinds = list(args.only) or [*KINDS, KILLED]
    order = [kinds[i % len(kinds)] for i in range(args.number)]
    random.Random(args.seed).shuffle(order)
    parts = [order[i : i + PART] for i in range(0, args.number, PART)]
    tasks = [(part, args.seed + number) for number, part in enumerate(parts)]
    if args.jobs == 1:
        found = [measure_part(*task) for task in tasks]
    else:
        with multiprocessing.get_context("spawn").Pool(args.jobs) as pool:
            found = pool.starmap(measure_part, tasks, chunksize=1)
    counts = {kind: Count() for kind in kinds}
    for part in found:
        for kind, count in part.items():
            counts[kind].add(count)
    return counts


def measure_part(order: list[str], seed: int) -> dict[str, Count]:
    """Inject faults into one emulated sensor, whose camera has a random exposure time and a random lag."""
    counts = {kind: Count() for kind in order}
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(Path(folder), random.Random(seed))
        try:
            with bench.connected() as sensor:
                for kind in order:
                    if kind != KILLED:
                        inject(bench, sensor, kind, counts[kind])
            for _ in range(order.count(KILLED)):
                kill(bench, counts[KILLED])
        finally:
            bench.peer.stop()
    return counts


def report(counts: dict[str, Count]) -> str:
    """Format the results as text: a table of the faults of camera and controller, and a sentence on killed programs."""
    lines = [
        "fault                 injected  images  wrong  old  longest read (s)  limit (s)  recovered  after (s)  "
        "reads with errors"
    ]
    for kind, count in counts.items():
        if kind == KILLED:
            continue
        errors = ", ".join(f"{name} {number}" for name, number in sorted(count.errors.items()))
        if count.unnamed:
            errors += f" OTHER ERRORS {count.unnamed}"
        lines.append(
            f"{kind:20s}  {count.injected:8d}  {count.images:6d}  {count.wrong:5d}  {count.old:3d}  "
            f"{count.longest_s:16.2f}  {count.limit_s:9.2f}  {count.recovered:9d}  "
            f"{count.recovery_s:9.2f}  {errors or '-'}"
        )
    read = [count for kind, count in counts.items() if kind != KILLED]
    lines.append(
        f"{'all':20s}  {sum(c.injected for c in read):8d}  {sum(c.images for c in read):6d}  "
        f"{sum(c.wrong for c in read):5d}  {sum(c.old for c in read):3d}  {'':16s}  {'':9s}  "
        f"{sum(c.recovered for c in read):9d}  {'':9s}  {sum(sum(c.errors.values()) for c in read)}"
    )
    if KILLED in counts:
        count = counts[KILLED]
        lines.append(
            f"{KILLED} while a light was on: {count.injected} times. The lights went off after at most "
            f"{count.lit_s:.3f} s, with a watchdog of {WATCHDOG_MS / 1000:g} s."
        )
    return "\n".join(lines)


def main(args: Args) -> str:
    """Inject the faults, write the table of the results to `--out` if given, and return the table."""
    begun_s = time.monotonic()
    counts = measure(args)
    text = report(counts)
    load = os.getloadavg()[2] if hasattr(os, "getloadavg") else float("nan")
    text += (
        f"\nseed {args.seed}, {time.monotonic() - begun_s:.0f} s, {args.jobs} sensor(s) at a time, {os.cpu_count()} "
        f"CPU cores with a load of {load:.1f} processes on average over the last 15 minutes\n"
    )
    if args.out is not None:
        storage.write_bytes(args.out, text.encode())
    return text


if __name__ == "__main__":
    print(main(tyro.cli(Args, description=__doc__)))
