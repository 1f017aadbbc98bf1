"""Options of a digital twin of the sensor, and the twin that they describe."""

import dataclasses
import math
from pathlib import Path
from typing import Annotated

import jax
import tyro

import sts_jax as sts
from sts_jax.hardware import Lens, twin


@dataclasses.dataclass(frozen=True)
class Config:
    """Options of the command line: camera, object, serial port and HTTP server of the twin (a simulated sensor)."""

    resolution: tuple[int, int] = (480, 640)  # height and width of the frames (pixels)
    rate: float = 30.0  # frame rate of the camera (frames/s)
    # field of view of the fisheye lens across the image's diagonal (degrees). The paper's device has 160. None: frames
    # without lens distortion
    field_of_view: float | None = 160.0
    # deviations of the camera and the lights from ideal ones
    imperfections: twin.Imperfections = dataclasses.field(default_factory=twin.Imperfections)

    # class of the object, one of sts_jax.objects.CATEGORIES
    object_class: Annotated[str, tyro.conf.arg(name="class")] = "camera"
    sensor: Path | None = None  # file with the sensor's constants, written by Sensor.save. None: the paper's sensor
    seed: int = 0  # seed of the object, the trajectories and the noise
    # hold and release the object at random times. The value is the mean time of holding plus that of resting
    # afterwards (s). None: the object moves by command only
    release_every: float | None = None
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


def make(config: Config) -> twin.Twin:
    """Make the twin (a simulated sensor), and render the empty pad and the first pose of the object in advance.

    Raises:
        ValueError: An option is out of range.
        OSError: The sensor file cannot be read, or a file cannot be written.
    """
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
