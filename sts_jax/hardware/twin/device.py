"""`Twin`: a simulated sensor, whose LED controller and camera share one clock."""

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
    """The state of a `Twin` (a simulated sensor) at one time: its scene, its lights and its camera."""

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
    """One frame of a `Twin` (a simulated sensor): its ground truth and its JPEG image.

    The ground truth contains the times of the exposure, the brightness of the LEDs, and the pose of the object.
    """

    exposure: Exposure  # ground truth of the frame
    jpeg: bytes  # image of the frame, as a client receives it


class Twin:
    """A simulated sensor: LED controller, LEDs, scene and camera.

    A new twin runs on a virtual clock. Only `step`, `capture`, `set` and `ping` advance this clock, so the same calls
    with the same seeds return the same frames. `Served` runs a twin on the real clock instead, behind a serial port and
    a camera stream.

    ```python
    body = sts_jax.objects.make(jax.random.key(0), "bottle")
    with Twin(ObjectScene(body)) as twin:
        twin.command("hold")  # place the bottle on the pad
        twin.set((255, 255, 255, 255))  # turn all lights on
        truth, image = twin.capture()  # ground truth and image of the next frame
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
            seed: Seed of the image noise, of the random delays of the frames, and of the random times at which the twin
                holds and releases the object.
            release_every: Mean time for which the object is held plus mean time for which the object then rests (s).
                The twin holds and releases the object at random times. Default: the object moves only when `command`
                is called.
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
                f"at most {1 / rate:.4f} s: give a smaller rate or exposure_s"
            )
        if release_every is not None and not 0 < release_every < math.inf:
            raise ValueError(f"release_every must be None or a positive and finite time (s), got {release_every}")
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
        """Serial number of the LED controller: `TWIN` followed by the seed of the twin, such as `TWIN0`."""
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
        """Replace the virtual clock by the given clock, and reset the LED controller, the lights and the camera.

        Args:
            clock: Function that returns the time of the new clock (s), such as `time.monotonic`.

        Raises:
            RuntimeError: The virtual clock has advanced already, so times of both clocks would be mixed.
        """
        if self._virtual_s:
            raise RuntimeError(
                f"the virtual clock of this Twin is at {self._virtual_s} s, but Served needs a Twin whose virtual "
                "clock is at 0 s, because Served replaces this clock: make a new Twin, and pass the new Twin to Served "
                "before any call of `Twin.step`, `Twin.capture`, `Twin.set` or `Twin.ping`"
            )
        self._clock = clock
        self._boot(clock())

    def command(self, command: str) -> State:
        """Move the object in the scene.

        On the real clock, this method first renders the images that the command needs, which may take seconds. On the
        virtual clock, `capture` renders each pose the first time that the pose is needed.

        Args:
            command: `hold` holds the object on the pad in the first pose of the next trajectory, `release` lets it go,
                and `clear` takes it away.

        Returns:
            The state after the command.

        Raises:
            ValueError: The command is unknown, the scene is constant (such as a `Picture`), `release` is given while no
                object is held, or the object does not come to rest in any of 32 simulated trajectories in a row.
        """
        with self._commands:
            if self._clock is not None:
                self.scene.prepare(command, self.blender)
            with self._lock:
                self.scene.command(command, self.now_s)
        return self.state

    def operate(self) -> None:
        """Hold or release the object when a randomly chosen time is reached.

        The argument `release_every` of `Twin` is the mean time for which an object is held plus the mean time for which
        it then rests (s). If this argument is None, this method does nothing. `step` and `Served` call this method
        regularly.
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
        """Pass bytes from the host to the LED controller, and return the bytes that the controller sends back."""
        with self._lock:
            now = self.now_s
            sent = self._controller.receive(data, now)
            self._lights.set(now, self._controller.levels)
        return sent

    def tick(self) -> bytes:
        """Run the LED controller's watchdog, and return the bytes that the controller sends.

        The watchdog turns the lights off if no request has arrived within its period, 1 s by default.
        """
        return self.receive(b"")

    def inject(self, fault: faults.Fault) -> None:
        """Simulate a fault of the camera or a restart of the LED controller.

        Args:
            fault: Fault of the kind `stall`, `repeat`, `black`, `resize` or `reboot`. `Fault` describes the kinds.

        Raises:
            ValueError: The fault is of another kind. The other kinds concern a connection, and a twin has connections
                only while `Served` runs it. Pass these faults to `Served.inject`.
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
                f"the kinds {', '.join(faults.DEVICE_KINDS)}: pass the twin to Served, and call Served.inject"
            )

    def end_s(self, index: int) -> float:
        """Return the time on the twin's clock at which the exposure of a frame ends (s). Frames are counted from 0."""
        return self._epoch_s + self.imperfections.exposure_s + index / self.rate

    def next_index(self, after: int, now_s: float) -> int:
        """Return the number of the first frame that is delivered at a given time or later.

        Frames up to the number `after` are skipped. The random part of the delay (`Imperfections.jitter_s`) is ignored.

        Args:
            after: Number of the last frame to skip, or -1 to skip none.
            now_s: Earliest time of delivery on the twin's clock (s).

        Returns:
            A number greater than `after`.
        """
        elapsed = now_s - self.imperfections.lag_s - self.end_s(0)
        return max(after + 1, math.ceil(elapsed * self.rate - 1e-6))

    def make(self, index: int) -> Made | None:
        """Produce a frame, and write it to the files `log` and `record` of the twin.

        Call this method at the time `end_s(index)` or later, when the exposure of the frame has ended, and always from
        the same thread.

        Args:
            index: Number of the frame, from 0. It must increase from call to call.

        Returns:
            The frame, or None while the fault `stall` stops the camera.
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
        """Advance the virtual clock.

        Meanwhile, the LED controller turns the lights off if no request arrives for 1 s. If the argument
        `release_every` of `Twin` was given, the object is held and released at random times.

        Args:
            seconds: Time by which the clock advances, >= 0 (s).

        Raises:
            ValueError: `seconds` is negative or not finite.
            RuntimeError: The twin runs on the real clock.
        """
        if self._clock is not None:
            raise RuntimeError(
                "`step`, `capture`, `set` and `ping` need a Twin that runs on its virtual clock, but this Twin runs on "
                "the real clock: read its images through hardware.STS, or make a new Twin, because a new Twin runs on "
                "a virtual clock"
            )
        if not 0 <= seconds < math.inf:
            raise ValueError(f"seconds must be >= 0 and finite, got {seconds}")
        target = self._virtual_s + seconds
        while self._virtual_s < target:
            self._virtual_s = min(self._virtual_s + _TICK_S, target)
            self.tick()
            self.operate()

    def capture(self) -> tuple[Exposure, np.ndarray]:
        """Advance the virtual clock until the next frame is delivered, and return this frame.

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
        """Set the lights, and advance the virtual clock by 4 ms (`ANSWER_S`), the duration of a request.

        Args:
            levels: Duty cycles of the four LED channels, 0 (off) to 255 (always on).

        Returns:
            The controller's answer with the applied levels. Its times are on the virtual clock.

        Raises:
            ValueError: There are not four levels, or one is out of range.
            RuntimeError: The twin runs on the real clock.
        """
        first, second, third, fourth = levels
        return self._request(protocol.Set(self._next_sequence(), (first, second, third, fourth)))

    def ping(self) -> Lit:
        """Ask the LED controller for the levels of its LEDs, and advance the virtual clock by 4 ms (`ANSWER_S`).

        The controller turns the lights off after 1 s without a request. Regular calls of this method keep them on.

        Returns:
            The controller's answer with the current levels. Its times are on the virtual clock.

        Raises:
            RuntimeError: The twin runs on the real clock.
        """
        return self._request(protocol.Ping(self._next_sequence()))

    def close(self) -> None:
        """Stop the scene's rendering thread, and close the files of the log. Closing twice is allowed."""
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
        raise AssertionError(f"the emulated LED controller must answer a request with a State reply, got {lines!r}")
