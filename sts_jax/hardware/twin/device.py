"""`Twin`: the LED controller and the camera of a simulated sensor on one clock."""

import dataclasses
import math
import os
import random
import threading
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import NamedTuple

import numpy as np

from sts_jax.hardware import protocol
from sts_jax.hardware.emulation import EmulatedController
from sts_jax.hardware.leds import Lit
from sts_jax.hardware.twin import faults, photometry
from sts_jax.hardware.twin.lights import LightHistory
from sts_jax.hardware.twin.log import Exposure, Log
from sts_jax.hardware.twin.scene import Phase, Scene

ANSWER_S = 0.004  # s, duration of a request on the virtual clock. The levels apply in its middle
_TICK_S = 0.005  # s, period of the watchdog's checks on the virtual clock


@dataclasses.dataclass(frozen=True)
class State:
    """The twin at one moment."""

    now_s: float  # of the twin's clock
    phase: str  # of the scene: empty, held, moving or still
    trajectory: int  # number of the trajectory, or -1 before the first
    frame: int  # index of the drawn pose in the trajectory
    pose: tuple[float, ...] | None  # mesh frame in the sensor frame (m, quaternion)
    levels: protocol.Levels  # of the LEDs
    counter: int  # changes of the levels since the controller's boot
    boot: int  # number of the controller's boot
    frames: int  # frames produced so far


class Made(NamedTuple):
    """One frame, as it is delivered."""

    exposure: Exposure
    jpeg: bytes


class Twin:
    """A simulated sensor: EmulatedController, light, scene, and camera.

    It runs on a virtual clock, which advances with `step`, `capture`, `set` and `ping` only. The same calls and seeds
    give the same frames. `Served` runs it on the real clock behind a serial port and a camera stream instead.

    ```python
    with Twin(ObjectScene(body)) as twin:
        twin.command("hold")
        twin.set((255, 255, 255, 255))
        truth, image = twin.capture()
    ```
    """

    # Set at the boot
    _epoch_s: float  # the camera's first exposure begins
    _controller: EmulatedController
    _lights: LightHistory
    _sequence: int  # number of the last request of `set` and `ping`
    _index: int  # the last frame of `capture`
    _made: int  # number of frames
    _last: Made | None
    _due_s: float  # delivery of the last frame
    _stalled_until_s: float
    _phase: str | None  # seen by `operate`
    _next_s: float  # next action of `operate`

    def __init__(
        self,
        scene: Scene,
        *,
        rate: float = 30.0,
        imperfections: photometry.Imperfections | None = None,
        warp: photometry.Warp | None = None,
        seed: int = 0,
        release_every: float | None = None,
        log: str | os.PathLike | None = None,
        record: str | os.PathLike | None = None,
    ):
        """Boot with the lights off.

        Args:
            scene: The contents of the view.
            rate: Frames per second of the camera.
            imperfections: Of camera and lights.
            warp: From the rendered view to the raw view of a lens, `lens_warp`. Default: no distortion.
            seed: Of noise, jitter and the times of `release_every`.
            release_every: Mean duration (s) of one cycle of holding and resting, with which objects are held and
                released at random. Their motion comes in addition. Default: on command only.
            log: File for one JSON line per frame (`Exposure`).
            record: File for all frames as motion JPEG, in the order of the log.

        Raises:
            ValueError: A value is out of range.
            OSError: A file cannot be written.
        """
        self.imperfections = photometry.Imperfections() if imperfections is None else imperfections
        if not 0 < rate < math.inf:
            raise ValueError(f"rate must be positive and finite, got {rate}")
        if self.imperfections.exposure_s > 1 / rate:
            raise ValueError(
                f"exposure_s is {self.imperfections.exposure_s} s, but at {rate:g} frames/s it must be at most "
                f"{1 / rate:.4f} s: lower rate or exposure_s"
            )
        if release_every is not None and not 0 < release_every < math.inf:
            raise ValueError(f"release_every must be positive and finite, got {release_every}")
        self.scene = scene
        self.rate = rate
        self.blender = photometry.Blender(self.imperfections, exposure=scene.exposure, warp=warp, seed=seed)
        self._release_every = release_every
        self._random = random.Random(seed)
        self._serial_number = f"TWIN{seed}"
        self._lock = threading.Lock()  # of the controller, the lights, the scene's commands and the faults
        self._commands = threading.Lock()  # one command at a time
        self._waiting = faults.Queue()
        self._log = Log(log, record)
        self._clock: Callable[[], float] | None = None
        self._virtual_s = 0.0
        self._boot(0.0)

    @property
    def now_s(self) -> float:
        """Current time (s)."""
        return self._virtual_s if self._clock is None else self._clock()

    @property
    def serial_number(self) -> str:
        """Serial number of the LED controller."""
        return self._serial_number

    @property
    def state(self) -> State:
        """The current state."""
        with self._lock:
            now = self.now_s
            seen, leds = self.scene.at(now), self._controller
            return State(
                now,
                seen.phase,
                seen.trajectory,
                seen.frame,
                seen.pose,
                leds.levels,
                leds.counter,
                leds.boot,
                self._made,
            )

    def run_on(self, clock: Callable[[], float]) -> None:
        """Leave the virtual clock for another one (s). The controller boots.

        Raises:
            RuntimeError: The virtual clock has advanced, so times would be mixed.
        """
        if self._virtual_s:
            raise RuntimeError(f"the virtual clock is at {self._virtual_s} s: make a new Twin to serve it")
        self._clock = clock
        self._boot(clock())

    def command(self, command: str) -> State:
        """Apply `hold`, `release` or `clear` to the scene. Returns when the scene has changed.

        On the real clock, the renderings that the command needs come first, so it may take seconds. On the virtual
        clock, a pose is rendered when a frame shows it.

        Raises:
            ValueError: The command is unknown or not possible now.
        """
        with self._commands:
            if self._clock is not None:
                self.scene.prepare(command, self.blender)
            with self._lock:
                self.scene.command(command, self.now_s)
        return self.state

    def operate(self) -> None:
        """Hold or release the object if `release_every` demands it now."""
        if self._release_every is None:
            return
        now, phase = self.now_s, self.state.phase
        if phase != self._phase:
            self._phase = phase
            self._next_s = now + self._release_every * self._random.uniform(0.25, 0.75)
        if now >= self._next_s and phase != Phase.MOVING:
            self.command("release" if phase == Phase.HELD else "hold")

    def receive(self, data: bytes) -> bytes:
        """Pass bytes to the LED controller. Returns the bytes that it sends."""
        with self._lock:
            now = self.now_s
            sent = self._controller.receive(data, now)
            self._lights.set(now, self._controller.levels)
        return sent

    def tick(self) -> bytes:
        """Let the controller's watchdog act. Returns the bytes that the controller sends."""
        return self.receive(b"")

    def inject(self, fault: faults.Fault) -> None:
        """Inject a fault of the camera (`stall`, `repeat`, `black`, `resize`) or restart the controller (`reboot`).

        `Served.inject` accepts all faults.

        Raises:
            ValueError: The fault concerns a connection, which the virtual clock does not have.
        """
        if fault.kind == "reboot":
            with self._lock:
                now = self.now_s
                boot = (self._controller.boot + 1) % 65536
                self._controller = EmulatedController(now_s=now, boot=boot, serial_number=self._serial_number)
                self._lights.set(now, self._controller.levels)
        elif fault.kind == "stall":
            with self._lock:
                self._stalled_until_s = self.now_s + fault.seconds
        elif fault.kind in faults.IMAGE_KINDS:
            with self._lock:
                self._waiting.add(fault)
        else:
            raise ValueError(f"the fault {fault.kind} concerns a connection: serve the twin, and use Served.inject")

    def end_s(self, index: int) -> float:
        """End of the exposure of a frame (s)."""
        return self._epoch_s + self.imperfections.exposure_s + index / self.rate

    def next_index(self, after: int, now_s: float) -> int:
        """The first frame after another one that is not delivered before a time (s)."""
        elapsed = now_s - self.imperfections.lag_s - self.end_s(0)
        return max(after + 1, math.ceil(elapsed * self.rate - 1e-6))

    def make(self, index: int) -> Made | None:
        """Produce a frame whose exposure has ended, and log it. One thread calls it, with increasing numbers.

        Returns:
            The frame, or None while the camera is stalled.
        """
        constants = self.imperfections
        end = self.end_s(index)
        start = end - constants.exposure_s
        with self._lock:
            if self.now_s < self._stalled_until_s:
                return None
            light = self._lights.over(start, end)
            self._lights.forget(start)
            seen = self.scene.at((start + end) / 2)
            fault = self._waiting.take(*faults.IMAGE_KINDS)
            self._made += 1
        self._due_s = max(self._due_s, end + constants.lag_s + self._random.uniform(0, constants.jitter_s))
        kind = None if fault is None or (fault.kind == "repeat" and self._last is None) else fault.kind
        if kind == "repeat" and self._last is not None:
            exposure = dataclasses.replace(self._last.exposure, index=index, due_s=self._due_s, fault=kind)
            made = Made(exposure, self._last.jpeg)
        else:
            exposure = Exposure(
                index,
                start,
                end,
                self._due_s,
                light.mean,
                light.lowest,
                light.highest,
                seen.phase,
                seen.trajectory,
                seen.frame,
                seen.pose,
                kind,
            )
            image = self.blender.frame(self.scene.ends(seen, self.blender), light.mean)
            if kind == "black":
                image = np.zeros_like(image)
            elif kind == "resize":
                image = np.ascontiguousarray(image[::2, ::2])
            made = Made(exposure, photometry.encode(image, constants.jpeg_quality))
        self._last = made
        self._log.write(*made)
        return made

    def step(self, seconds: float) -> None:
        """Advance the virtual clock (s). Watchdog and `release_every` act on time.

        Raises:
            ValueError: The time is negative.
            RuntimeError: The twin runs on the real clock.
        """
        if self._clock is not None:
            raise RuntimeError("the twin runs on the real clock, which advances by itself")
        if not 0 <= seconds < math.inf:
            raise ValueError(f"seconds must be >= 0 and finite, got {seconds}")
        target = self._virtual_s + seconds
        while self._virtual_s < target:
            self._virtual_s = min(self._virtual_s + _TICK_S, target)
            self.tick()
            self.operate()

    def capture(self) -> tuple[Exposure, np.ndarray]:
        """Advance the virtual clock to the delivery of the next frame.

        Returns:
            The truth about the frame, and its image, uint8 RGB (height, width, 3), decoded from its JPEG.

        Raises:
            RuntimeError: The twin runs on the real clock.
        """
        while True:
            self._index = self.next_index(self._index, self.now_s)
            self.step(max(0.0, self.end_s(self._index) + self.imperfections.lag_s - self.now_s))
            if (made := self.make(self._index)) is not None:
                self.step(max(0.0, made.exposure.due_s - self.now_s))
                return made.exposure, photometry.decode(made.jpeg)

    def set(self, levels: Sequence[int]) -> Lit:
        """Set the lights, as `Leds.set` does. It advances the virtual clock by `ANSWER_S`."""
        first, second, third, fourth = levels
        return self._request(protocol.Set(self._next_sequence(), (first, second, third, fourth)))

    def ping(self) -> Lit:
        """Ask for the levels that are applied now, as `Leds.ping` does. It advances the virtual clock by `ANSWER_S`."""
        return self._request(protocol.Ping(self._next_sequence()))

    def close(self) -> None:
        """End the renderer's thread and close the log. Closing twice is allowed."""
        self.scene.close()
        self._log.close()

    def __enter__(self) -> "Twin":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _boot(self, now_s: float) -> None:
        self._epoch_s = now_s
        self._controller = EmulatedController(now_s=now_s, serial_number=self._serial_number)
        self._lights = LightHistory(self.imperfections.rise_s)
        self._sequence = 0
        self._index = -1
        self._made = 0
        self._last = None
        self._due_s = self._stalled_until_s = -math.inf
        self._phase = None
        self._next_s = math.inf

    def _next_sequence(self) -> int:
        self._sequence = self._sequence % protocol.LAST_SEQUENCE + 1
        return self._sequence

    def _request(self, request: protocol.Set | protocol.Ping) -> Lit:
        sent_s = self.now_s
        self.step(ANSWER_S / 2)
        lines = self.receive(protocol.encode_request(request)).splitlines(keepends=True)
        self.step(ANSWER_S / 2)
        for reply in map(protocol.decode_reply, lines):
            if isinstance(reply, protocol.State):
                return Lit(reply.levels, reply.counter, reply.boot, sent_s, self.now_s)
        raise AssertionError(f"the emulated controller answered {lines!r}")
