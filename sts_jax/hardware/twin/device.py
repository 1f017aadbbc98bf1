"""`Twin`, a simulated sensor whose LED controller and camera share one clock, its log, and `VirtualSensor`."""

import contextlib
import dataclasses
import itertools
import json
import math
import os
import random
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8

from sts_jax import storage
from sts_jax.hardware import protocol
from sts_jax.hardware.camera import Captured
from sts_jax.hardware.leds import Leds, Lit
from sts_jax.hardware.lens import Lens
from sts_jax.hardware.session import Origin
from sts_jax.hardware.sts import STS, Settling
from sts_jax.hardware.twin import photometry
from sts_jax.hardware.twin.scene import Scene, Seen

CAMERA = "twin"  # name of the camera in sessions and sensor files
_ANSWER_S = 0.004  # duration of a request on the virtual clock (s). Its levels apply after half of this time
_TICK_S = 0.005  # period with which the watchdog is checked on the virtual clock (s)


@dataclasses.dataclass(frozen=True)
class Exposure(Seen):
    """The ground truth of one frame, with the scene in the middle of the exposure.

    Times are on the twin's clock, `time.monotonic` if the twin is served.
    """

    index: int  # number of the frame, from 0
    start_s: float  # begin of the exposure (s)
    end_s: float  # end of the exposure (s)
    due_s: float  # planned time of delivery (s). A busy machine delivers later
    light: float  # mean brightness of the LEDs during the exposure, as a share of their full power
    lowest: float  # smallest brightness during the exposure, as a share
    highest: float  # largest brightness during the exposure, as a share


@dataclasses.dataclass(frozen=True)
class State(Seen):
    """The scene and the lights at one time, on the twin's clock."""

    now_s: float
    levels: protocol.Levels  # duty cycles of the four LED channels, 0 to 255


class TwinFrame(NamedTuple):
    """One frame of the camera: its ground truth, and the image as a client receives it."""

    exposure: Exposure
    jpeg: bytes


class Twin(contextlib.AbstractContextManager["Twin"]):
    """A simulated sensor: LED controller, LEDs, scene and camera.

    A new twin runs on a virtual clock. Only `step`, `capture`, `set` and `ping` advance this clock, so the same calls
    with the same seeds return the same frames. `Served` runs a twin on the real clock instead, behind a serial port and
    a camera stream. `docs/hardware/twin.md` has examples.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        rate: float = 30.0,
        imperfections: photometry.Imperfections | None = None,
        lens: Lens | None = None,
        seed: int = 0,
        log: str | os.PathLike | None = None,
        record: str | os.PathLike | None = None,
    ):
        """Boot the twin with its lights off.

        Args:
            scene: Scene in front of the camera.
            rate: Frame rate of the camera (frames/s).
            imperfections: Deviations of the camera and the lights from ideal ones. Default: `Imperfections()`.
            lens: Fisheye lens of the camera. Default: the frames are rectified.
            seed: Seed of the noise and of the random delays of the frames.
            log: File that receives one JSON line with the fields of `Exposure` per frame.
            record: Motion JPEG file that receives all frames in the order of the log.
        """
        self.imperfections = photometry.Imperfections() if imperfections is None else imperfections
        fastest = 1 / self.imperfections.exposure_s
        if not 0 < rate <= fastest:
            raise ValueError(f"rate must be in (0, 1 / imperfections.exposure_s = {fastest:g}] frames/s, got {rate:g}")
        self.scene = scene
        self.rate = rate
        self.serial_number = f"TWIN{seed}"  # of the LED controller
        self.blender = photometry.Blender(self.imperfections, sensor=scene.sensor, lens=lens, seed=seed)
        self._random = random.Random(seed)
        self._lock = threading.Lock()  # protects the controller, the lights and the scene's commands
        self._commands = threading.Lock()  # lets one command run at a time
        self._clock: Callable[[], float] | None = None
        self._virtual_s = 0.0
        self._sequence = itertools.cycle(range(1, protocol.LAST_SEQUENCE + 1))  # numbers of requests
        self._index = -1  # number of the last frame that `capture` returned
        self._due_s = -math.inf  # time of delivery of the last frame
        with contextlib.ExitStack() as files:
            self._log = None if log is None else files.enter_context(Path(log).open("w", buffering=1))
            self._record = None if record is None else files.enter_context(Path(record).open("wb", buffering=0))
            self._files = files.pop_all()  # keeps the files open after this block, because both could be opened
        self._boot(0.0)

    @property
    def now_s(self) -> float:
        """The current time on the twin's clock (s)."""
        return self._virtual_s if self._clock is None else self._clock()

    @property
    def state(self) -> State:
        """The current state of the scene and the lights."""
        with self._lock:
            now = self.now_s
            return State(**vars(self.scene.at(now)), now_s=now, levels=self._controller.levels)

    def run_on(self, clock: Callable[[], float]) -> None:
        """Replace the virtual clock, which must not have advanced, by a function such as `time.monotonic`."""
        if self._virtual_s:
            raise RuntimeError(f"the virtual clock of this Twin is at {self._virtual_s} s already: make a new Twin")
        self._clock = clock
        self._boot(clock())

    def command(self, command: str) -> State:
        """Move the object by a command of the scene, and return the state after it.

        On the real clock, the images that are needed are rendered first.
        """
        with self._commands:
            if self._clock is not None:
                self.scene.prepare(command, self.blender)
            with self._lock:
                self.scene.command(command, self.now_s)
        return self.state

    def choose(self, category: str, seed: int = 0) -> State:
        """Replace the object by another one, such as ("bottle", 3), from the next command `hold` on."""
        with self._commands:
            self.scene.choose(category, seed)
        return self.state

    def receive(self, data: bytes = b"") -> bytes:
        """Pass bytes from the host to the LED controller, with its watchdog. Returns the bytes that it sends back."""
        with self._lock:
            now = self.now_s
            sent = self._controller.receive(data, now)
            self._lights.set(now, self._controller.levels)
        return sent

    def end_s(self, index: int) -> float:
        """Time on the twin's clock at which the exposure of a frame ends (s). Frames are counted from 0."""
        return self._epoch_s + self.imperfections.exposure_s + index / self.rate

    def make(self, index: int) -> TwinFrame:
        """Produce a frame after the end of its exposure, and log it. `index` increases from call to call."""
        constants, end = self.imperfections, self.end_s(index)
        start = end - constants.exposure_s
        with self._lock:
            light = self._lights.over(start, end)
            seen = self.scene.at((start + end) / 2)
        self._due_s = max(self._due_s, end + constants.lag_s + self._random.uniform(0, constants.jitter_s))
        exposure = Exposure(**vars(seen), index=index, start_s=start, end_s=end, due_s=self._due_s, **light._asdict())
        image = self.blender.frame(self.scene.ends(seen, self.blender), light.light)
        jpeg = photometry.encode(image, constants.jpeg_quality)
        if self._record is not None:
            self._record.write(jpeg)
        if self._log is not None:
            self._log.write(json.dumps(dataclasses.asdict(exposure)) + "\n")
        return TwinFrame(exposure, jpeg)

    def step(self, seconds: float) -> None:
        """Advance the virtual clock, with the controller's watchdog."""
        if self._clock is not None:
            raise RuntimeError("this Twin runs on the real clock: read it through hardware.STS, or make a new Twin")
        if not 0 <= seconds < math.inf:
            raise ValueError(f"seconds must be >= 0 and finite, got {seconds}")
        target = self._virtual_s + seconds
        while self._virtual_s < target:
            self._virtual_s = min(self._virtual_s + _TICK_S, target)
            self.receive()

    def capture(self) -> tuple[Exposure, UInt8[np.ndarray, "height width 3"]]:
        """Advance the virtual clock until the next frame is delivered. Returns its ground truth and its RGB image."""
        elapsed = self.now_s - self.imperfections.lag_s - self.end_s(0)
        self._index = max(self._index + 1, math.ceil(elapsed * self.rate - 1e-6))
        self.step(max(0.0, self.end_s(self._index) + self.imperfections.lag_s - self.now_s))
        exposure, jpeg = self.make(self._index)
        self.step(max(0.0, exposure.due_s - self.now_s))
        return exposure, photometry.decode(jpeg)

    def set(self, levels: Sequence[int]) -> Lit:
        """Set the four levels (0 to 255), and advance the virtual clock by 4 ms. Returns the applied levels."""
        first, second, third, fourth = levels
        return self._request(protocol.Set(next(self._sequence), (first, second, third, fourth)))

    def ping(self) -> Lit:
        """Ask for the levels, which keeps the lights on for another 1 s, and advance the clock by 4 ms."""
        return self._request(protocol.Ping(next(self._sequence)))

    def close(self) -> None:
        """Wait for the end of a command, and close the files of the log. Closing twice is allowed."""
        with self._commands:  # a thread that renders while Python ends would abort the process
            self._files.close()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _boot(self, now_s: float) -> None:
        self._epoch_s = now_s  # begin of the camera's first exposure
        self._controller = protocol.EmulatedController(now_s=now_s, serial_number=self.serial_number)
        self._lights = photometry.LightHistory(self.imperfections.rise_s)

    def _request(self, request: protocol.Set | protocol.Ping) -> Lit:
        """Pass a request to the controller, which executes it after half of 4 ms."""
        sent_s = self.now_s
        self.step(_ANSWER_S / 2)
        lines = self.receive(protocol.encode_request(request)).splitlines(keepends=True)
        self.step(_ANSWER_S / 2)
        reply = next(reply for reply in map(protocol.decode_reply, lines) if isinstance(reply, protocol.State))
        return Lit(reply.levels, reply.counter, reply.boot, sent_s, self.now_s)


class _Devices(Leds):
    """Camera, LED controller and clock of a twin, as `STS` uses them."""

    source, port, is_connected = CAMERA, CAMERA, True

    def __init__(self, twin: Twin):
        self._twin = twin

    def connect(self, warmup_s: float = 1.0) -> None:  # type: ignore[override]
        raise AssertionError("a twin is connected already")

    def async_read(self, timeout_ms: float | None = None) -> Captured:
        del timeout_ms  # a virtual frame always arrives
        exposure, image = self._twin.capture()
        image.flags.writeable = False
        time_s = self._twin.now_s
        self.ping()  # keeps the lights on, as the thread of `hardware.Leds` does
        return Captured(image, time_s, exposure.index)

    def set(self, levels: Sequence[int]) -> Lit:
        return self._twin.set(levels)

    def ping(self) -> Lit:
        return self._twin.ping()

    def monotonic(self) -> float:
        return self._twin.now_s

    def sleep(self, seconds: float) -> None:
        self._twin.step(seconds)

    def close(self) -> None:
        """The twin stays open."""

    disconnect = close


class VirtualSensor(STS):
    """An `STS` of a `Twin` on its virtual clock. `origin` identifies it for `hardware.Session`."""

    def __init__(self, twin: Twin, *, levels: Sequence[int] = (255, 255, 255, 255), settling: Settling | None = None):
        """Connect to a twin. Without `settling`, the settling times are measured. The scene must then be at rest."""
        devices = _Devices(twin)
        super().__init__(camera=devices, leds=devices, levels=levels, settling=settling, clock=devices)
        height, width, _ = twin.capture()[1].shape
        self.origin = Origin(CAMERA, twin.serial_number, width, height, self.levels)
        self.connect()


def read_log(path: str | os.PathLike) -> list[Exposure]:
    """Read the log file of a `Twin`, which may still be writing it: an incomplete last line is ignored."""
    text = Path(path).read_text()
    lines = text[: text.rfind("\n") + 1].splitlines()
    return [storage.decode(Exposure, json.loads(line), "frame") for line in lines]
