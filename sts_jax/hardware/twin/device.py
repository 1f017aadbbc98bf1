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

ANSWER_S = 0.004  # duration of a request on the virtual clock (s). Its levels apply after half of this time
_TICK_S = 0.005  # period with which the watchdog is checked on the virtual clock (s)


@dataclasses.dataclass(frozen=True)
class State:
    """The state of a twin at one time."""

    now_s: float  # time on the twin's clock (s)
    phase: str  # phase of the scene: empty, held, moving or still
    trajectory: int  # number of the current or last trajectory, or -1 before the first one
    frame: int  # index of the rendered pose in the trajectory
    pose: tuple[float, ...] | None  # object's position (m) and quaternion (w, x, y, z), or None without an object
    levels: protocol.Levels  # duty cycles of the four LED channels, 0 to 255
    counter: int  # number of changes of the levels since the controller's boot
    boot: int  # number of the controller's boot
    frames: int  # number of frames produced so far


class Made(NamedTuple):
    """One frame that the camera has produced."""

    exposure: Exposure  # ground truth of the frame
    jpeg: bytes  # image of the frame, as a client receives it


class Twin:
    """A simulated sensor: LED controller, LEDs, scene and camera.

    A new twin runs on a virtual clock. Only `step`, `capture`, `set` and `ping` advance this clock, so the same calls
    with the same seeds return the same frames. `Served` runs a twin on the real clock instead, behind a serial port and
    a camera stream.

    ```python
    with Twin(ObjectScene(body)) as twin:
        twin.command("hold")
        twin.set((255, 255, 255, 255))
        truth, image = twin.capture()
    ```
    """

    # `_boot` sets these.
    _epoch_s: float  # begin of the camera's first exposure
    _controller: EmulatedController
    _lights: LightHistory
    _sequence: int  # number of the last request of `set` and `ping`
    _index: int  # number of the last frame that `capture` returned
    _made: int  # number of frames produced so far
    _last: Made | None  # last frame that was produced
    _due_s: float  # time of delivery of the last frame
    _stalled_until_s: float
    _phase: str | None  # phase at the last call of `operate`
    _next_s: float  # time of the next command of `operate`

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
        """Boot the twin with its lights off.

        Args:
            scene: Scene in front of the camera.
            rate: Frame rate of the camera (frames/s).
            imperfections: Deviations of the camera and the lights from ideal ones. Default: `Imperfections()`.
            warp: Lens distortion, made by `lens_warp`. Default: no distortion.
            seed: Seed of the noise, the jitter and the times of `release_every`.
            release_every: Mean time for which an object is held plus mean time for which it then rests (s). The twin
                holds and releases objects at random times by itself. Default: objects move on `command` only.
            log: Path of a file that receives one JSON line with the fields of `Exposure` per frame. Default: no log.
            record: Path of a motion JPEG file that receives all frames in the order of the log. Default: no file.

        Raises:
            ValueError: `rate` or `release_every` is not positive and finite, or the exposure is longer than the time
                between two frames.
            OSError: `log` or `record` cannot be written.
        """
        self.imperfections = photometry.Imperfections() if imperfections is None else imperfections
        if not 0 < rate < math.inf:
            raise ValueError(f"rate must be positive and finite, got {rate}")
        if self.imperfections.exposure_s > 1 / rate:
            raise ValueError(
                f"imperfections.exposure_s is {self.imperfections.exposure_s} s, but at {rate:g} frames/s it must be "
                f"at most {1 / rate:.4f} s: lower rate or exposure_s"
            )
        if release_every is not None and not 0 < release_every < math.inf:
            raise ValueError(f"release_every must be positive and finite, got {release_every}")
        self.scene = scene
        self.rate = rate
        self.blender = photometry.Blender(self.imperfections, exposure=scene.exposure, warp=warp, seed=seed)
        self._release_every = release_every
        self._random = random.Random(seed)
        self._serial_number = f"TWIN{seed}"
        self._lock = threading.Lock()  # protects the controller, the lights, the scene's commands and the faults
        self._commands = threading.Lock()  # lets one command run at a time
        self._waiting = faults.Queue()
        self._log = Log(log, record)
        self._clock: Callable[[], float] | None = None
        self._virtual_s = 0.0
        self._boot(0.0)

    @property
    def now_s(self) -> float:
        """The current time on the twin's clock (s)."""
        return self._virtual_s if self._clock is None else self._clock()

    @property
    def serial_number(self) -> str:
        """Serial number of the LED controller: `TWIN` followed by the seed."""
        return self._serial_number

    @property
    def state(self) -> State:
        """The current state of the scene, the lights and the camera."""
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
        """Replace the virtual clock by another one, and boot the controller again.

        Args:
            clock: Function that returns the time of the new clock (s), such as `time.monotonic`.

        Raises:
            RuntimeError: The virtual clock has advanced already, so times of both clocks would be mixed.
        """
        if self._virtual_s:
            raise RuntimeError(
                f"the virtual clock of this Twin has advanced to {self._virtual_s} s, but a twin must be served before "
                "its clock advances: make a new Twin to serve it"
            )
        self._clock = clock
        self._boot(clock())

    def command(self, command: str) -> State:
        """Move the object in the scene.

        On the real clock, this method first renders the images that the command needs, which may take seconds. On the
        virtual clock, `capture` renders a pose when a frame shows it for the first time.

        Args:
            command: `hold` holds the object on the pad in the first pose of the next trajectory, `release` lets it go,
                and `clear` takes it away.

        Returns:
            The state after the command.

        Raises:
            ValueError: The command is unknown or not possible in the present phase, or no simulated trajectory settles.
        """
        with self._commands:
            if self._clock is not None:
                self.scene.prepare(command, self.blender)
            with self._lock:
                self.scene.command(command, self.now_s)
        return self.state

    def operate(self) -> None:
        """Hold or release the object if this is due.

        `step` and `Served` call this method regularly. It acts at random times if `release_every` was given, and does
        nothing otherwise.
        """
        if self._release_every is None:
            return
        now, phase = self.now_s, self.state.phase
        if phase != self._phase:
            self._phase = phase
            self._next_s = now + self._release_every * self._random.uniform(0.25, 0.75)
        if now >= self._next_s and phase != Phase.MOVING:
            self.command("release" if phase == Phase.HELD else "hold")

    def receive(self, data: bytes) -> bytes:
        """Pass bytes of the host to the LED controller, and return the bytes that the controller sends."""
        with self._lock:
            now = self.now_s
            sent = self._controller.receive(data, now)
            self._lights.set(now, self._controller.levels)
        return sent

    def tick(self) -> bytes:
        """Let the controller's watchdog check the time, and return the bytes that the controller sends."""
        return self.receive(b"")

    def inject(self, fault: faults.Fault) -> None:
        """Simulate a fault of the camera or a restart of the LED controller.

        Args:
            fault: Fault of one of the kinds `stall`, `repeat`, `black`, `resize` and `reboot`.

        Raises:
            ValueError: The fault concerns a connection. Only a served twin has connections, see `Served.inject`.
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
            raise ValueError(
                f"fault has the kind {fault.kind!r}, which concerns a connection, but Twin.inject accepts only "
                f"{', '.join(faults.DEVICE_KINDS)}: serve the twin, and call Served.inject"
            )

    def end_s(self, index: int) -> float:
        """The time at which the exposure of frame `index` ends (s)."""
        return self._epoch_s + self.imperfections.exposure_s + index / self.rate

    def next_index(self, after: int, now_s: float) -> int:
        """The number of the next frame whose delivery is still possible.

        Args:
            after: Number of an earlier frame.
            now_s: Time before which the frame must not be delivered (s).

        Returns:
            The smallest number that is greater than `after` and whose frame, without jitter, is delivered at `now_s` or
            later.
        """
        elapsed = now_s - self.imperfections.lag_s - self.end_s(0)
        return max(after + 1, math.ceil(elapsed * self.rate - 1e-6))

    def make(self, index: int) -> Made | None:
        """Produce a frame whose exposure has ended, and write it to the log.

        Only one thread may call this method.

        Args:
            index: Number of the frame. It must be greater than in the call before.

        Returns:
            The frame, or None while the fault `stall` lasts.
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
        """Advance the virtual clock. The watchdog and `release_every` act whenever they are due.

        Args:
            seconds: Time by which the clock advances, >= 0 (s).

        Raises:
            ValueError: `seconds` is negative or not finite.
            RuntimeError: The twin runs on the real clock.
        """
        if self._clock is not None:
            raise RuntimeError(
                "the twin is served on the real clock, which advances by itself: read it through hardware.STS, or make "
                "a new Twin for step, capture, set and ping"
            )
        if not 0 <= seconds < math.inf:
            raise ValueError(f"seconds must be >= 0 and finite, got {seconds}")
        target = self._virtual_s + seconds
        while self._virtual_s < target:
            self._virtual_s = min(self._virtual_s + _TICK_S, target)
            self.tick()
            self.operate()

    def capture(self) -> tuple[Exposure, np.ndarray]:
        """Advance the virtual clock until the next frame is delivered.

        Returns:
            The ground truth of the frame, and its image as uint8 RGB of shape (height, width, 3), decoded from its
            JPEG.

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
        """Set the lights, and advance the virtual clock by the duration of the request (`ANSWER_S`).

        Args:
            levels: Duty cycles of the four LED channels, 0 (off) to 255 (always on).

        Returns:
            The controller's answer, as `hardware.Leds.set` returns it.

        Raises:
            ValueError: There are not four levels, or one is out of range.
            RuntimeError: The twin runs on the real clock.
        """
        first, second, third, fourth = levels
        return self._request(protocol.Set(self._next_sequence(), (first, second, third, fourth)))

    def ping(self) -> Lit:
        """Ask the controller for the current levels, and advance the virtual clock by `ANSWER_S`.

        A request also resets the watchdog, which turns the lights off after 1 s without one.

        Returns:
            The controller's answer, as `hardware.Leds.ping` returns it.

        Raises:
            RuntimeError: The twin runs on the real clock.
        """
        return self._request(protocol.Ping(self._next_sequence()))

    def close(self) -> None:
        """Stop the scene's rendering thread and close the log. Closing twice is allowed."""
        self.scene.close()
        self._log.close()

    def __enter__(self) -> "Twin":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _boot(self, now_s: float) -> None:
        """Reset the controller, the lights and the camera at a time (s)."""
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
        """Pass a request to the controller, which executes it after half of `ANSWER_S`."""
        sent_s = self.now_s
        self.step(ANSWER_S / 2)
        lines = self.receive(protocol.encode_request(request)).splitlines(keepends=True)
        self.step(ANSWER_S / 2)
        for reply in map(protocol.decode_reply, lines):
            if isinstance(reply, protocol.State):
                return Lit(reply.levels, reply.counter, reply.boot, sent_s, self.now_s)
        raise AssertionError(f"the emulated controller answered {lines!r}")
