"""Digital twins of the sensor: from options, and in a process of their own."""

import contextlib
import dataclasses
import itertools
import subprocess
import sys
import threading
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import jax
import tyro

import sts_jax as sts
from experiments.shared import commissioning
from experiments.shared.terminal import SEEDS, SIDES, check_numbers
from sts_jax.hardware import twin

FIELD_OF_VIEW = 160.0  # field of view across the diagonal (degrees), that of the paper's device
HELD_S = 6.0  # time for which the object of `own_twin` is held, and for which it then moves and rests (s)
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
    check_numbers(
        config, resolution=SIDES, rate=(0.1, 1000), field_of_view=(1, 359), motion_rate=(0.01, 1000), seed=SEEDS
    )
    sensor = sts.Sensor()
    scene = twin.ObjectScene(
        sts.objects.make(jax.random.key(config.seed), config.object_class),
        sensor=sensor,
        resolution=config.resolution,
        motion_rate=config.motion_rate,
        seed=config.seed,
        first=first,
    )
    (height, width), angle = config.resolution, config.field_of_view
    device = twin.Twin(
        scene,
        rate=config.rate,
        imperfections=config.imperfections,
        lens=None if angle is None else commissioning.ideal_lens((width, height), angle, sensor),
        seed=config.seed,
        log=config.log,
        record=config.record,
    )
    for command in ("clear", "hold") if prepare else ():
        scene.prepare(command, device.blender)
    return device


@contextlib.contextmanager
def own_twin(folder: Path) -> Iterator[str]:
    """Start a twin in another process, commission it into an empty folder, and hold and release its object repeatedly.

    Yields the port of its LED controller. The twin ends after the `with` block.
    """
    (height, width), leds, stop = TwinConfig.resolution, str(folder / "leds"), threading.Event()

    def operate(url: str) -> None:
        for command in itertools.cycle(("hold", "release")):
            request = urllib.request.Request(f"{url}/{command}", method="POST")
            with contextlib.suppress(OSError):  # the twin may have ended
                urllib.request.urlopen(request, timeout=_ANSWER_S).close()
            if stop.wait(HELD_S):
                return

    # Ctrl-C must not reach the twin, because it has to run until this process has stopped reading its images. If this
    # process ends, the pipe is closed, and the twin stops by itself.
    command = [sys.executable, "-m", "experiments.twin", "--attached", "--port", leds]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, start_new_session=True) as process:
        try:
            assert process.stdout is not None
            printed = list(itertools.takewhile(lambda line: "Ctrl-C" not in line, process.stdout))
            camera = next((line.split()[1] for line in printed if line.startswith("camera:")), None)
            if camera is None:
                raise RuntimeError("the digital twin did not start: run `python -m experiments.twin` to see why")
            commissioning.commission(
                commissioning.Config(camera, leds, folder, width, height, ideal_lens=FIELD_OF_VIEW, every=0.0)
            )
            threading.Thread(target=operate, args=(camera.removesuffix("/camera"),), daemon=True).start()
            yield leds
        finally:
            stop.set()
            process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(_ENDED_S)
            process.kill()
