"""Digital twins of the sensor: from options, and in a process of their own."""

import contextlib
import dataclasses
import itertools
import json
import os
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import tyro

import sts_jax as sts
from experiments.shared import commissioning
from experiments.shared.terminal import SEEDS, SIDES, check_numbers
from sts_jax.hardware import twin

FIELD_OF_VIEW = 160.0  # field of view across the diagonal (degrees), that of the paper's device
HELD_S = 6.0  # time for which the object is held by `moving`, and for which it then moves and rests (s)
# The falls begin near the middle of the pad, so that few objects fall off
SCENARIOS: dict[str, sts.physics.Scenario] = {
    "released": sts.physics.Released(),
    "freefall": sts.physics.Freefall(spread=0.025),
}
_ENDED_S = 10.0  # time within which the process of a twin ends by itself, before it is killed (s)
_ANSWER_S = 300.0  # longest wait for an answer of the twin, which may compile programs and render images first (s)
_CAMERA = "/camera"  # path of the camera of a served twin
_STATE_S = 5.0  # longest wait for the twin's state (s)
_POLL_S = 0.1  # time between two looks at a moving object (s)


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
    # how the object moves: a hand holds it on the pad in an unstable pose and lets go, or it falls from the air
    scenario: Literal["released", "freefall"] = "released"
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
        scenario=SCENARIOS[config.scenario],
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


class TwinHand:
    """Moves the object of a served twin by commands over HTTP, one at a time, in a thread of its own."""

    def __init__(self, url: str, body: sts.objects.Body | None = None):
        """Connect to the twin at an address such as `http://127.0.0.1:45253`. `body` is its object, if it is known."""
        self._url = url
        self.body = body
        self.state: dict[str, Any] = self.ask("state", "GET")  # answer of the twin to the last request
        self.doing: str | None = None  # command that runs, or None
        self.problem: str | None = None  # error of the last command, or None
        self.held_s: float | None = None  # time since which the object is held (s), or None
        self.let_go = False  # True from the command `release` until the object is held or taken away

    @classmethod
    def of_camera(cls, camera: str | int) -> "TwinHand | None":
        """The hand of the twin that serves a camera, or None if the camera is not that of a twin."""
        if isinstance(camera, str) and camera.startswith("http://") and camera.endswith(_CAMERA):
            with contextlib.suppress(OSError, ValueError, KeyError):
                hand = cls(camera.removesuffix(_CAMERA))
                return hand if hand.state["phase"] else None
        return None

    def ask(self, path: str, method: str = "POST") -> dict[str, Any]:
        """Send a request, and return the twin's answer. A request that the twin refuses raises a ValueError."""
        try:
            request = urllib.request.Request(f"{self._url}/{path}", method=method)
            direct = urllib.request.build_opener(urllib.request.ProxyHandler({}))  # twins are on this computer
            with direct.open(request, timeout=_ANSWER_S if method == "POST" else _STATE_S) as answer:
                return json.load(answer)
        except urllib.error.HTTPError as error:
            with error:
                raise ValueError(json.load(error)["error"]) from None

    def start(self, command: str, category: str | None = None, seed: int = 0) -> bool:
        """Start a command in a thread, and return True, or return False while another one runs.

        With a `category`, the command `hold` first chooses another object. `release` ends when the object is at rest.
        """
        if self.doing is not None:
            return False
        self.doing, self.problem, self.held_s = command, None, None
        self.let_go = self.let_go or command == "release"
        threading.Thread(target=self._run, args=(command, category, seed), name="hand", daemon=True).start()
        return True

    def facts(self) -> dict[str, Any]:
        """The phase of the object, the command that runs, and the error of the last one, as JSON values."""
        return {"phase": self.state["phase"], "doing": self.doing, "problem": self.problem}

    def _run(self, command: str, category: str | None, seed: int) -> None:
        try:
            if category is not None:
                self.ask(f"choose?class={category}&seed={seed}")
                self.body = sts.objects.make(jax.random.key(seed), category)
            self.state = self.ask(command)
            while self.state["phase"] == twin.Phase.MOVING:
                time.sleep(_POLL_S)
                self.state = self.ask("state", "GET")
            if command == "hold":
                self.held_s = time.monotonic()
            self.let_go = command == "release"
        except (OSError, ValueError) as error:
            self.problem, self.let_go = str(error), self.let_go and command != "release"
        finally:
            self.doing = None


@contextlib.contextmanager
def own_twin(folder: Path, config: TwinConfig = TwinConfig()) -> Iterator[tuple[str, TwinHand]]:
    """Start a twin in another process, and commission it into an empty folder.

    Yields the port of its LED controller, and the hand that moves its object. Of `config`, the class, the seed and the
    scenario are used. The twin ends after the `with` block.
    """
    (height, width), leds = TwinConfig.resolution, str(folder / "leds")
    options = ["--class", config.object_class, "--seed", str(config.seed), "--scenario", config.scenario]
    # Ctrl-C must not reach the twin, because it has to run until this process has stopped reading its images. If this
    # process ends, the pipe is closed, and the twin stops by itself.
    command = [sys.executable, "-m", "experiments.twin", "--attached", "--port", leds, *options]
    pipe = subprocess.PIPE
    # On a GPU, one process would take the memory that the other one needs.
    environment = {"XLA_PYTHON_CLIENT_PREALLOCATE": "false", **os.environ}
    with subprocess.Popen(
        command, stdin=pipe, stdout=pipe, text=True, start_new_session=True, env=environment
    ) as process:
        try:
            assert process.stdout is not None
            printed = list(itertools.takewhile(lambda line: "Ctrl-C" not in line, process.stdout))
            camera = next((line.split()[1] for line in printed if line.startswith("camera:")), None)
            if camera is None:
                raise RuntimeError("the digital twin did not start: run `python -m experiments.twin` to see why")
            commissioning.commission(
                commissioning.Config(camera, leds, folder, width, height, ideal_lens=FIELD_OF_VIEW, every=0.0)
            )
            body = sts.objects.make(jax.random.key(config.seed), config.object_class)
            yield leds, TwinHand(camera.removesuffix(_CAMERA), body)
        finally:
            process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(_ENDED_S)
            process.kill()


@contextlib.contextmanager
def moving(hand: TwinHand) -> Iterator[None]:
    """Hold and release the object of a twin repeatedly, every `HELD_S` seconds."""
    stop = threading.Event()

    def operate() -> None:
        for command in itertools.cycle(("hold", "release")):
            with contextlib.suppress(OSError):  # the twin may have ended
                hand.ask(command)
            if stop.wait(HELD_S):
                return

    threading.Thread(target=operate, daemon=True).start()
    try:
        yield
    finally:
        stop.set()
