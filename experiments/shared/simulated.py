"""Collects trajectories of the digital twin on its virtual clock, with the same code as for a real sensor."""

import contextlib
import dataclasses
import datetime
import math
import time
from collections.abc import Iterator
from pathlib import Path

import jax

import sts_jax as sts
from experiments.shared import backgrounds
from experiments.shared.terminal import Bar, say
from sts_jax import hardware, storage
from sts_jax.hardware import EmptyPad, GuideConfig, View, twin

OBJECT = "camera"  # class of the object. The paper releases a small camera
FIELD_OF_VIEW = 160.0  # field of view across the diagonal (degrees), that of the paper's device
RATE = 15.0  # frame rate of the camera (frames/s). The guide needs few frames, and each frame costs time
WAIT_S = 0.1  # time of the computer's clock between two attempts while the session cannot be written (s)
# Rendered poses per second of a moving object. They must follow each other fast enough that the guide does not take the
# object for one at rest.
MOTION_RATE = 4.0


@dataclasses.dataclass(frozen=True)
class Simulated:
    """Options for the collection of trajectories with a digital twin of the sensor.

    Raises:
        ValueError: A field is out of range.
    """

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
    """Moves the object on a simulated sensor as `hardware.collect` instructs, and shows the collection's progress."""

    def __init__(self, device: twin.Twin, session: hardware.Session, bar: Bar, count: int):
        super().__init__(device, session)
        self._bar, self._count = bar, count
        self._problem: str | None = None

    def show(self, view: View) -> None:
        """Move the object as `hardware.collect` instructs in `view`, and show the number of confirmed trajectories.

        `view.problem` is the message of an error that prevents collecting. It is printed if the
        previous view had no problem.
        """
        super().show(view)
        self._bar("collect", view.confirmed, self._count)
        if view.problem is not None:
            if self._problem is None:
                say(view.problem)
            time.sleep(WAIT_S)
        self._problem = view.problem


def collect(config: Simulated) -> None:
    """Collect trajectories of the twin until the work directory has `config.count` of them.

    The twin (`ObjectScene`) simulates a fixed sequence of trajectories for each seed. A recorded trajectory keeps its
    number in this sequence. If a collection was interrupted, the next call continues it with the largest recorded
    number plus 1, so that no trajectory is repeated.

    Raises:
        ValueError: The work directory contains data of another sensor, or of a twin with another seed, image size or
            LED levels.
        LockedError: Another process collects into the work directory.
        SensorFileError: The sensor file in the work directory is damaged.
        OSError: A file cannot be written.
    """
    dataset = config.workdir / "dataset"
    if (dataset / storage.MANIFEST).exists() and len(hardware.load_recordings(dataset)) >= config.count:
        say(f"{dataset} has {config.count} trajectories already")
        return
    first = hardware.next_recording(dataset)
    with started(config, first) as device:
        sensor, empty = commissioned(config, device)
        with (
            hardware.Session.open(dataset, sensor.origin, settling=sensor.settling) as session,
            Bar() as bar,
        ):
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


def lens(config: Simulated, sensor: sts.Sensor) -> hardware.Lens:
    """Make the lens of the digital twin, an equidistant lens with a diagonal field of view of 160 degrees."""
    return hardware.Lens.ideal(
        *config.size, field_of_view=math.radians(FIELD_OF_VIEW), distance=float(sensor.camera.distance)
    )


@contextlib.contextmanager
def started(config: Simulated, first: int) -> Iterator[twin.Twin]:
    """Start a twin, which is a simulated sensor, and close it at the end of the `with` block.

    The trajectories of a twin are numbered from 0, and their motions depend only on the number and on the seed. This
    twin begins with the trajectory number `first`.
    """
    sensor, resolution = sts.Sensor(), config.size[::-1]
    scene = twin.ObjectScene(
        sts.objects.make(jax.random.key(config.seed), OBJECT),
        sensor=sensor,
        resolution=resolution,
        motion_rate=MOTION_RATE,
        seed=config.seed,
        first=first,
    )
    warp = twin.lens_warp(lens(config, sensor), sensor.camera, resolution)
    with twin.Twin(scene, rate=RATE, warp=warp, seed=config.seed) as device:
        yield device


def commissioned(config: Simulated, device: twin.Twin) -> tuple[twin.VirtualSensor, EmptyPad]:
    """Make a `VirtualSensor` and an `EmptyPad` for a digital twin of the sensor.

    The `VirtualSensor` reads images of the twin. The `EmptyPad` describes the images of the twin's empty pad.
    Both are made from the sensor file. If the work directory has no sensor file, `commission` writes it first. The
    `VirtualSensor` gets the settling times of the file, which are the waiting times after the LEDs are switched. The
    `EmptyPad` is computed from the background images that the file names.

    Raises:
        ValueError: The sensor file was written with another image size or with other LED levels.
        SensorFileError: The sensor file is damaged, or belongs to another device.
    """
    file = config.workdir / hardware.sensor_file.NAME
    if not file.exists():
        commission(config, device)
    there = hardware.Device.load(file)
    there.check_identity(camera=twin.CAMERA, leds=device.serial_number)
    if (there.width, there.height, there.levels) != (*config.size, config.levels):
        raise ValueError(
            f"{file} is for images of {there.width} x {there.height} pixels and the LED levels {there.levels}, but the "
            f"twin is set to {config.size[0]} x {config.size[1]} pixels and the levels {config.levels}: choose another "
            "--workdir, or run `python -m experiments.real collect --twin` with the --size and --levels of the file"
        )
    settling = hardware.Settling(there.settle_off_s, there.settle_on_s)
    sensor = twin.VirtualSensor(device, levels=config.levels, settling=settling)
    backgrounds = there.backgrounds(file)
    assert backgrounds is not None, "`commission` has recorded them"
    return sensor, hardware.known_pad(*backgrounds)


def commission(config: Simulated, device: twin.Twin) -> None:
    """Measure the LED settling times of the simulated sensor, record its empty pad, and write its sensor file."""
    simulated = sts.Sensor()
    sensor = twin.VirtualSensor(device, levels=config.levels)
    recorded = backgrounds.record(sensor)
    made = hardware.Device(
        camera=twin.CAMERA,
        fps=device.rate,
        leds=device.serial_number,
        lens=lens(config, simulated),
        settle_on_s=sensor.settling.tactile_s,
        settle_off_s=sensor.settling.visual_s,
        levels=config.levels,
        commissioned=datetime.date.today().isoformat(),
        lens_from="ideal",
    )
    config.workdir.mkdir(parents=True, exist_ok=True)
    made.save(config.workdir, simulated, (recorded.visual, recorded.tactile))
