"""Start a digital twin of the sensor: an LED controller on a serial port, and a camera over HTTP.

    python -m experiments.twin                                          # a small camera, held and released by command
    python -m experiments.twin --release-every 6 --port twin-leds       # released at random, port with a fixed name
    python -m experiments.twin --resolution 1232 1640 --rate 5          # size of the paper's camera

Prints how to connect and runs until Ctrl-C. The first start compiles for about two minutes, later ones take about 20 s.
"""

import dataclasses
import math
import signal
import sys
import threading
from pathlib import Path
from typing import Annotated

import jax
import tyro

import sts_jax as sts
from experiments.shared import errors
from sts_jax.hardware import Lens, twin


@dataclasses.dataclass(frozen=True)
class Config:
    """Camera, object and connections."""

    resolution: tuple[int, int] = (480, 640)  # height and width of the frames, pixels
    rate: float = 30.0  # frames per second
    # degrees across the diagonal of the fisheye lens (the paper's device: 160), or None for the rectified view
    field_of_view: float | None = 160.0
    imperfections: twin.Imperfections = dataclasses.field(default_factory=twin.Imperfections)

    object_class: Annotated[str, tyro.conf.arg(name="class")] = "camera"  # one of sts_jax.objects.CATEGORIES
    sensor: Path | None = None  # a file written by Sensor.save (default: the paper's sensor)
    seed: int = 0  # of the object, the trajectories, and the noise
    release_every: float | None = None  # s, mean time of holding and resting. Default: by command only
    motion_rate: float | None = None  # drawn poses per second of a moving object (default: by the resolution)

    port: Path | None = None  # name of a symbolic link to the serial port (default: its changing name is printed)
    host: str = "127.0.0.1"  # interface on which HTTP listens. There is no password
    http_port: int = 0  # 0: a free one
    log: Path | None = None  # file for the truth about each frame, as JSON lines
    record: Path | None = None  # file for all frames, as motion JPEG
    attached: bool = False  # end with the standard input, and so with a program that holds its other end


def make(config: Config) -> twin.Twin:
    """Make the twin, and render its first images.

    Raises:
        ValueError: An option is out of range.
    """
    if config.object_class not in sts.objects.CATEGORIES:
        raise ValueError(f"class is {config.object_class!r}, but it must be one of {', '.join(sts.objects.CATEGORIES)}")
    if min(config.resolution) < 1:
        raise ValueError(f"resolution is {config.resolution}, but height and width must be at least 1 pixel")
    sensor = sts.Sensor() if config.sensor is None else sts.Sensor.load(config.sensor)
    scene = twin.ObjectScene(
        sts.objects.make(jax.random.key(config.seed), config.object_class),
        sensor=sensor,
        resolution=config.resolution,
        motion_rate=config.motion_rate,
        seed=config.seed,
    )
    warp = None
    if config.field_of_view is not None:
        height, width = config.resolution
        lens = Lens.ideal(
            width, height, field_of_view=math.radians(config.field_of_view), distance=float(sensor.camera.distance)
        )
        warp = twin.lens_warp(lens, sensor.camera, config.resolution)
    device = twin.Twin(
        scene,
        rate=config.rate,
        imperfections=config.imperfections,
        warp=warp,
        seed=config.seed,
        release_every=config.release_every,
        log=config.log,
        record=config.record,
    )
    for command in ("clear", "hold"):
        scene.prepare(command, device.blender)
    return device


def main(config: Config) -> None:
    """Serve the twin until Ctrl-C or SIGTERM."""
    stop = threading.Event()
    print("preparing the first images ...", flush=True)
    with make(config) as device:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: stop.set())
        with twin.Served(device, link=config.port, host=config.host, http_port=config.http_port) as served:
            print(f"{served.description}\nCtrl-C ends it.", flush=True)
            if config.attached:
                threading.Thread(target=_until_end_of_input, args=(stop,), daemon=True).start()
            stop.wait()


def _until_end_of_input(stop: threading.Event) -> None:
    sys.stdin.read()
    stop.set()


if __name__ == "__main__":
    sts.enable_compilation_cache()
    with errors.on_one_line():
        main(tyro.cli(Config, description=__doc__))
