"""Digital twins of the sensor: from options, in a process of its own, and collecting on a virtual clock."""

import contextlib
import dataclasses
import datetime
import json
import math
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import jax
import tyro

import sts_jax as sts
from experiments.shared import commissioning
from experiments.shared.terminal import Bar, say
from sts_jax import hardware, storage
from sts_jax.hardware import EmptyPad, GuideConfig, View, twin

FIELD_OF_VIEW = 160.0  # field of view across the diagonal (degrees), that of the paper's device
HELD_S = 6.0  # time for which the object of `own_twin` is held (s)
FREE_S = 6.0  # time for which this object moves and rests after its release (s)
RATE = 15.0  # frame rate of a collecting twin (frames/s). The guide needs few frames, and each frame costs time
# Rendered poses per second of a moving object of a collecting twin. They must follow each other fast enough that the
# guide does not take the object for one at rest.
MOTION_RATE = 4.0
_WAIT_S = 0.1  # time of the computer's clock between two attempts while the session cannot be written (s)
_ENDED_S = 10.0  # time within which the process of a twin ends by itself, before it is killed (s)
_ANSWER_S = 120.0  # longest wait for an answer of the twin, which may render images first (s)


@dataclasses.dataclass(frozen=True)
class TwinConfig:
    """Options of the command line: camera, object, serial port and HTTP server of the twin."""

    resolution: tuple[int, int] = (480, 640)  # height and width of the frames (pixels)
    rate: float = 30.0  # frame rate of the camera (frames/s)
    # field of view of the fisheye lens across the image's diagonal (degrees). The paper's device has 160. None: frames
    # without lens distortion
    field_of_view: float | None = FIELD_OF_VIEW
    # deviations of the camera and the lights from ideal ones
    imperfections: twin.Imperfections = dataclasses.field(default_factory=twin.Imperfections)

    # class of the object, one of sts_jax.objects.CATEGORIES
    object_class: Annotated[str, tyro.conf.arg(name="class")] = "camera"
    sensor: Path | None = None  # file with the sensor's constants, written by Sensor.save. None: the paper's sensor
    seed: int = 0  # seed of the object, the trajectories and the noise
    # rendered poses per second of a moving object. None: 10 up to 640 x 480 pixels, fewer for larger frames
    motion_rate: float | None = None

    port: Path | None = None  # make this symbolic link to the serial port, whose own name changes with each start
    host: str = "127.0.0.1"  # address on which the HTTP server listens. There is no password
    http_port: int = 0  # TCP port of the HTTP server. 0 selects a free one
    log: Path | None = None  # write the ground truth of each frame to this file, as JSON lines
    record: Path | None = None  # write all frames to this file, as motion JPEG
    # stop when the standard input ends. If another program starts the twin with a pipe as its standard input, the twin
    # then ends together with this program
    attached: bool = False


def make_twin(config: TwinConfig, *, first: int = 0, prepare: bool = True) -> twin.Twin:
    """Make a twin that begins with the trajectory number `first`, and prepare its first images."""
    if config.object_class not in sts.objects.CATEGORIES:
        classes = ", ".join(sts.objects.CATEGORIES)
        raise ValueError(f"--class is {config.object_class!r}, but it must be one of {classes}")
    if min(config.resolution) < 1:
        raise ValueError(f"--resolution is {config.resolution}, but height and width must be at least 1 pixel")
    sensor = sts.Sensor() if config.sensor is None else sts.Sensor.load(config.sensor)
    scene = twin.ObjectScene(
        sts.objects.make(jax.random.key(config.seed), config.object_class),
        sensor=sensor,
        resolution=config.resolution,
        motion_rate=config.motion_rate,
        seed=config.seed,
        first=first,
    )
    angle = config.field_of_view
    device = twin.Twin(
        scene,
        rate=config.rate,
        imperfections=config.imperfections,
        lens=None if angle is None else ideal_lens(config.resolution, angle, sensor),
        seed=config.seed,
        log=config.log,
        record=config.record,
    )
    for command in ("clear", "hold") if prepare else ():
        scene.prepare(command, device.blender)
    return device


def ideal_lens(resolution: tuple[int, int], field_of_view: float, sensor: sts.Sensor) -> hardware.Lens:
    """The equidistant lens of a twin, with a field of view across the diagonal (degrees)."""
    height, width = resolution
    distance = float(sensor.camera.distance)
    return hardware.Lens.ideal(width, height, field_of_view=math.radians(field_of_view), distance=distance)


class OwnTwin:
    """A twin that runs in another process."""

    def __init__(self, folder: Path, url: str):
        """Use `own_twin` instead."""
        self.folder, self.leds = folder, str(folder / "leds")
        self.note = ""  # remark on the state of the object
        self._url = url
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._operate, name="hand", daemon=True)

    def start(self) -> None:
        """Start a thread that holds and releases the object repeatedly."""
        self._thread.start()

    def close(self) -> None:
        """Stop this thread. The twin itself keeps running."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()

    def _operate(self) -> None:
        while not self._stop.is_set():
            for command, seconds, note in (
                ("hold", HELD_S, "a hand holds the object"),
                ("release", FREE_S, "the hand has let go"),
            ):
                with contextlib.suppress(OSError):  # the twin may have ended
                    self.command(command)
                self.note = note
                if self._stop.wait(seconds):
                    return

    def command(self, command: str) -> dict[str, object]:
        """Send `hold`, `release` or `clear` to the twin, and return its state afterwards."""
        request = urllib.request.Request(f"{self._url}/{command}", method="POST")
        with urllib.request.urlopen(request, timeout=_ANSWER_S) as answer:
            return json.load(answer)


@contextlib.contextmanager
def own_twin(folder: Path, *, seed: int = 0) -> Iterator[OwnTwin]:
    """Start a twin in another process, commission it into an empty folder, and stop it after the `with` block."""
    height, width = TwinConfig.resolution
    command = [sys.executable, "-m", "experiments.twin", "--attached", "--port", str(folder / "leds")]
    command += ["--seed", str(seed)]
    # Ctrl-C must not reach the twin, because it has to run until this process has stopped reading its images. If this
    # process ends, the pipe is closed, and the twin stops by itself.
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        try:
            own = OwnTwin(folder, _address(process))
            commissioning.commission(
                commissioning.Config(
                    camera=f"{own._url}/camera",
                    leds=own.leds,
                    out=folder,
                    width=width,
                    height=height,
                    ideal_lens=FIELD_OF_VIEW,
                    every=0.0,
                )
            )
            with contextlib.closing(own):
                yield own
        finally:
            process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(_ENDED_S)
            process.kill()


def _address(process: subprocess.Popen[str]) -> str:
    """Wait until a twin is ready, and return the URL that it prints."""
    assert process.stdout is not None
    url = ""
    for line in process.stdout:
        if line.startswith("camera:"):
            url = line.split()[1].removesuffix("/camera")
        if "Ctrl-C" in line:
            return url
    raise RuntimeError("the digital twin did not start, see above. To reproduce it, run `python -m experiments.twin`")


@dataclasses.dataclass(frozen=True)
class Simulated:
    """Options for the collection of trajectories with a twin, on its virtual clock."""

    workdir: Path  # work directory. The trajectories go to its folder `dataset`, the sensor file is `sensor.json`
    count: int = 100  # number of confirmed trajectories, earlier ones included, after which the collection ends
    size: tuple[int, int] = (640, 480)  # width and height of the images (pixels)
    # duty cycles of the four LED channels in the tactile stream, 0 (off) to 255 (always on)
    levels: tuple[int, int, int, int] = (255, 255, 255, 255)
    seed: int = 0  # seed of the object, the trajectories and the noise
    note: str = ""  # text that is stored with each trajectory
    guide: GuideConfig = dataclasses.field(default_factory=GuideConfig)  # thresholds and times of the guide

    def __post_init__(self) -> None:
        if self.count < 1:
            raise ValueError(f"count must be >= 1, got {self.count}")
        if min(self.size) < 1:
            raise ValueError(f"size is {self.size}, but width and height must be at least 1 pixel")
        hardware.sts.checked_levels(self.levels)


class Hand(twin.Hand):
    """Moves the object of a twin as `hardware.collect` instructs, and shows the collection's progress."""

    def __init__(self, device: twin.Twin, session: hardware.Session, bar: Bar, count: int):
        super().__init__(device, session)
        self._bar, self._count = bar, count
        self._problem: str | None = None

    def show(self, view: View) -> None:
        """Move the object, and show the number of confirmed trajectories, or an error that prevents collecting."""
        super().show(view)
        self._bar("collect", view.confirmed, self._count)
        if view.problem is not None:
            if self._problem is None:
                say(view.problem)
            time.sleep(_WAIT_S)
        self._problem = view.problem


def simulate(config: Simulated) -> None:
    """Collect trajectories of a twin until the work directory has `config.count` of them.

    A twin has a fixed sequence of trajectories for each seed, which an interrupted collection continues.
    """
    dataset = config.workdir / "dataset"
    if (dataset / storage.MANIFEST).exists() and len(hardware.load_recordings(dataset)) >= config.count:
        say(f"{dataset} has {config.count} trajectories already")
        return
    with started(config, hardware.next_recording(dataset)) as device:
        sensor, empty = commissioned(config, device)
        with hardware.Session(dataset, sensor.origin) as session, Bar() as bar:
            say(f"{dataset} has {session.confirmed} confirmed trajectories. New ones are added")
            begun_s = time.monotonic()
            number = hardware.collect(
                sensor,
                session,
                Hand(device, session, bar, config.count),
                config=config.guide,
                empty=empty,
                trusted=True,
                count=config.count,
                note=config.note,
            )
            bar("collect", config.count, config.count)
        seconds = time.monotonic() - begun_s
        say(f"{number} trajectories in {seconds:.1f} s, {seconds / number:.2f} s each")


@contextlib.contextmanager
def started(config: Simulated, first: int) -> Iterator[twin.Twin]:
    """Start a twin that begins with the trajectory number `first`."""
    options = TwinConfig(resolution=config.size[::-1], rate=RATE, motion_rate=MOTION_RATE, seed=config.seed)
    with make_twin(options, first=first, prepare=False) as device:
        yield device


def commissioned(config: Simulated, device: twin.Twin) -> tuple[twin.VirtualSensor, EmptyPad]:
    """Connect to a twin with the sensor file of the work directory, which is written first if it is missing."""
    file = config.workdir / hardware.sensor_file.NAME
    if not file.exists():
        _commission(config, device)
    there = hardware.Device.load(file)
    there.check_identity(camera=twin.CAMERA, leds=device.serial_number)
    if (there.width, there.height, there.levels) != (*config.size, config.levels):
        raise ValueError(
            f"{file} is for images of {there.width} x {there.height} pixels and LED levels {there.levels}, but --size "
            f"is {config.size} and --levels is {config.levels}: change them, or choose another --workdir"
        )
    settling = hardware.Settling(there.settle_off_s, there.settle_on_s)
    sensor = twin.VirtualSensor(device, levels=config.levels, settling=settling)
    backgrounds = there.backgrounds(file)
    assert backgrounds is not None, "`_commission` has recorded them"
    return sensor, hardware.known_pad(*backgrounds)


def _commission(config: Simulated, device: twin.Twin) -> None:
    """Measure the settling times of a twin, record its empty pad, and write its sensor file."""
    simulated = sts.Sensor()
    sensor = twin.VirtualSensor(device, levels=config.levels)
    empty = commissioning.record_empty(sensor)
    file = hardware.Device(
        camera=twin.CAMERA,
        fps=device.rate,
        leds=device.serial_number,
        lens=ideal_lens(config.size[::-1], FIELD_OF_VIEW, simulated),
        settle_on_s=sensor.settling.tactile_s,
        settle_off_s=sensor.settling.visual_s,
        levels=config.levels,
        commissioned=datetime.date.today().isoformat(),
        lens_from="ideal",
    )
    config.workdir.mkdir(parents=True, exist_ok=True)
    file.save(config.workdir, simulated, (empty.visual, empty.tactile))
