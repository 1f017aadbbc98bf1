"""The thread that fetches a camera's frames, and opens the camera again after a loss."""

import atexit
import collections
import dataclasses
import threading
import time

import numpy as np
from jaxtyping import UInt8

from sts_jax.hardware import devices, settings
from sts_jax.hardware.camera_config import CameraConfig
from sts_jax.hardware.camera_errors import (
    CameraError,
    CameraLostError,
    CameraNotConnectedError,
    CameraTimeoutError,
    EndOfVideoError,
    FrozenCameraError,
)
from sts_jax.hardware.capture import Capture, size_error
from sts_jax.hardware.frames import CameraStatistics, Captured, Pace, is_black

FIRST_WAIT_S = 0.25  # s, wait before a lost source is opened again. It doubles after each failure
LONGEST_WAIT_S = 5.0  # s, longest of these waits


@dataclasses.dataclass(frozen=True)
class _Problem:
    """The reason why there are no frames at present."""

    error: type[CameraError]
    message: str
    final: bool = False  # True if the thread has ended

    def __call__(self) -> CameraError:
        return self.error(self.message)


class Grabber:
    """The thread that fetches the frames of a camera.

    It runs from the call of `Camera.connect` to the call of `Camera.disconnect`, or to an earlier end of the video file
    or an error after which the camera cannot be used any more.

    Only this thread opens, reads and closes the source, which is a device, a network stream or a video file. While the
    thread runs, no other `Camera` can use the device or the network stream.
    """

    def __init__(self, config: CameraConfig):
        self._config = config
        self._changed = threading.Condition()  # protects all attributes below
        self._queue: collections.deque[Captured] = collections.deque()
        self._newest: Captured | None = None
        self._problem: _Problem | None = None
        self._counts = CameraStatistics()
        self._pace = Pace(config.fps)
        self._next = 0  # sequence number of the next frame
        self._epoch = -1
        self._opened = False
        self._settle = False  # True if the thread must lock the settings at their current values
        self._wanted: float | None = None  # exposure that the thread must set
        self._held: dict[str, float] = settings.asked(config) if config.kind == "device" else {}
        self.refused: list[str] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"sts_jax {config.name}", daemon=True)

    def start(self, timeout_s: float) -> None:
        """Start the thread and wait for the first frame.

        Args:
            timeout_s: Longest wait (s).

        Raises:
            CameraError: The source cannot be opened, or sends no frame in time. In both cases the thread is stopped.
        """
        self._thread.start()
        atexit.register(self.stop)  # a thread that is inside OpenCV must not outlive the interpreter
        with self._changed:
            ready = self._changed.wait_for(lambda: self._newest is not None or self._problem is not None, timeout_s)
            problem = self._problem
        if problem is not None or not ready:
            atexit.unregister(self.stop)
            self._stop.set()
            self._thread.join(0.1 if problem is None else self._config.timeout_s)
            if problem is not None:
                raise problem()
            raise CameraTimeoutError(
                f"{self._config.name} has sent no frame within {timeout_s:g} s: check the device or the stream's "
                "server, or raise timeout_s in CameraConfig."
            )

    def stop(self) -> bool:
        """Stop the thread, wait for its end, and return whether it has ended.

        The wait lasts at most `CameraConfig.timeout_s` plus 1 s. If the camera's driver does not respond in this time,
        the thread has not ended yet. It then ends as soon as the driver responds.
        """
        atexit.unregister(self.stop)
        self._stop.set()
        with self._changed:
            self._changed.notify_all()
        self._thread.join(self._config.timeout_s + 1)
        return not self._thread.is_alive()

    def lock_settings(self, timeout_s: float) -> list[str]:
        """Turn off the automatic control of exposure, white balance and focus, and keep the current values.

        The method waits for the next frame, locks the settings, and then discards all frames in the queue.

        Args:
            timeout_s: Longest wait for the next frame (s).

        Returns:
            Descriptions of the settings that the driver did not accept.

        Raises:
            CameraError: The camera has a problem, for example it was lost, or no frame has arrived in time.
        """
        with self._changed:
            self._settle = True
            self._changed.wait_for(lambda: not self._settle or self._problem is not None, timeout_s)
            if self._settle:
                raise self._problem() if self._problem is not None else self._timeout(timeout_s)
            self._queue.clear()
            return list(self.refused)

    def set_exposure(self, value: float, timeout_s: float) -> float | None:
        """Wait for the next frame, then set the exposure.

        Args:
            value: Exposure in the driver's unit (V4L2: 0.1 ms).
            timeout_s: Longest wait for the next frame (s). If the camera is lost, the time until it is found again
                counts towards this limit.

        Returns:
            The exposure that the device has now, or None if the driver does not support a manual exposure.

        Raises:
            CameraError: No frame has arrived in time, or the thread that fetches the frames has ended.
        """
        with self._changed:
            self._wanted = value
            self._changed.wait_for(lambda: self._wanted is None or self._ended(), timeout_s)
            if self._wanted is not None:
                self._wanted = None
                raise self._problem() if self._problem is not None else self._timeout(timeout_s)
            return self._held.get("exposure")

    def _ended(self) -> bool:
        return self._stop.is_set() or (self._problem is not None and self._problem.final)

    @property
    def held(self) -> dict[str, float]:
        """The settings that are locked to a value, such as {"exposure": 200.0}.

        The keys are field names of `CameraConfig`.
        """
        with self._changed:
            return dict(self._held)

    @property
    def running(self) -> bool:
        """True if the thread is running and the source is not lost."""
        with self._changed:
            lost = self._problem is not None and (self._problem.final or self._problem.error is CameraLostError)
            return self._thread.is_alive() and not self._stop.is_set() and not lost

    @property
    def statistics(self) -> CameraStatistics:
        """Counts of frames, lost connections and other events since `Camera.connect`."""
        with self._changed:
            return dataclasses.replace(self._counts, rate=self._pace.rate)

    def wait(self, timeout_s: float, exposed_now: bool) -> Captured:
        """Return the oldest frame in the queue, or wait for the next one.

        Args:
            timeout_s: Longest wait (s).
            exposed_now: True to discard the frames that may have been exposed before this call.

        Returns:
            The frame.

        Raises:
            CameraError: There is no frame. See `Camera.read` for the subclasses of this error.
        """
        deadline = time.monotonic() + timeout_s
        with self._changed:
            first = self._next + self._config.in_flight if exposed_now else 0
            epoch = self._epoch
            lost_before = self._problem is not None and self._problem.error is CameraLostError
            while True:
                while self._queue:
                    frame = self._queue.popleft()
                    self._changed.notify_all()  # the queue has room for the next frame of a file
                    if frame.sequence >= first and not (exposed_now and frame.delayed):
                        return frame
                if self._stop.is_set():
                    raise CameraNotConnectedError(
                        f"disconnect() of {self._config.name} was called during this call: call connect() to open the "
                        "camera again."
                    )
                remaining = deadline - time.monotonic()
                if self._problem is not None and not (lost_before and self._is_lost() and remaining > 0):
                    raise self._problem()
                if self._epoch != epoch and not lost_before:
                    raise CameraLostError(
                        f"{self._config.name} was lost during the call and found again: repeat the call. The frames of "
                        f"the new connection have epoch={self._epoch}."
                    )
                if remaining <= 0:
                    raise self._timeout(timeout_s)
                self._changed.wait(remaining)

    def latest(self) -> Captured:
        """Return the newest frame. After the end of a video file, the newest frame is the last frame of the file.

        Raises:
            CameraError: There are no frames at present. See `Camera.read` for the subclasses of this error.
        """
        with self._changed:
            ended = self._problem is not None and self._problem.error is EndOfVideoError
            if self._problem is not None and not (ended and self._newest is not None):
                raise self._problem()
            if self._newest is None:
                raise self._timeout(0.0)
            return self._newest

    def problem(self) -> CameraError | None:
        """Return the reason why there are no frames at present, or None if there are frames."""
        with self._changed:
            return self._problem() if self._problem is not None else None

    def _is_lost(self) -> bool:
        return self._problem is not None and self._problem.error is CameraLostError

    def _timeout(self, timeout_s: float) -> CameraTimeoutError:
        last = "none has arrived so far"
        if self._newest is not None:
            last = f"the last one arrived {time.monotonic() - self._newest.time_s:.2f} s ago"
        return CameraTimeoutError(
            f"{self._config.name} has sent no usable frame within {1000 * timeout_s:.0f} ms ({last}, "
            f"{self._counts.damaged} damaged frames since connect): check the device or the stream's server, or raise "
            "the timeout (timeout_ms or timeout_s)."
        )

    # The thread

    def _run(self) -> None:
        """Read the source until `stop` is called, the file ends or an error occurs. A lost source is opened again."""
        try:
            with devices.locked(self._config):
                while not self._stop.is_set():
                    capture = self._open()
                    if capture is None:
                        return
                    try:
                        again = self._stream(capture)
                    finally:
                        capture.release()
                    if not again:
                        return
        except CameraError as error:
            self._set_problem(_Problem(type(error), str(error), final=True))
        except Exception as error:  # an error that ends the thread must reach the caller, who would wait otherwise
            self._set_problem(
                _Problem(
                    CameraError,
                    f"{self._config.name} failed ({error!r}): call disconnect(), then connect() again.",
                    final=True,
                )
            )
        finally:
            with self._changed:
                self._changed.notify_all()

    def _open(self) -> Capture | None:
        """Open the source, or return None after `stop`.

        The first opening raises the error of a failure. Later openings, after a loss, are repeated until they succeed.
        """
        wait_s = FIRST_WAIT_S
        while not self._stop.is_set():
            try:
                capture = Capture(self._config)
            except CameraError as error:
                if not self._opened:
                    raise
                self._set_problem(_Problem(CameraLostError, f"{self._lost()} The last attempt: {error}"))
                self._stop.wait(wait_s)
                wait_s = min(2 * wait_s, LONGEST_WAIT_S)
                continue
            refused = list(capture.warnings)
            if self._held:
                _, refusals = settings.lock(capture.properties, self._held)
                refused += map(str, refusals)
            with self._changed:
                self.refused = refused
                self._epoch += 1
                self._pace.interrupted()
                if not self._opened:
                    self._pace = Pace(self._config.fps or capture.rate)
            self._opened = True
            return capture
        return None

    def _lost(self) -> str:
        return (
            f"{self._config.name} was lost. A thread tries to open it again every {FIRST_WAIT_S:g} to "
            f"{LONGEST_WAIT_S:g} s, until it succeeds or disconnect() is called: check its cable or its server."
        )

    def _stream(self, capture: Capture) -> bool:
        """Publish frames until the source ends. Return True if the source must be opened again."""
        config = self._config
        playback = _Playback(config, capture) if config.kind == "file" else None
        previous: UInt8[np.ndarray, "height width 3"] | None = None
        repeats, same_since = 0, 0.0
        while not self._stop.is_set():
            if playback is not None and not self._turn(playback):
                return False
            if not capture.grab():
                if self._stop.is_set():
                    return False
                if playback is not None:
                    self._set_problem(playback.end())
                    return False
                with self._changed:
                    self._counts = dataclasses.replace(self._counts, losses=self._counts.losses + 1)
                self._set_problem(_Problem(CameraLostError, self._lost()))
                self._stop.wait(FIRST_WAIT_S)
                return True
            # Time and number are set under one lock, so a later call of `wait` sees that this frame arrived before.
            with self._changed:
                time_s, sequence = time.monotonic(), self._next
                self._next += 1
                if playback is None:
                    stamp = capture.stamp()
                    dropped = self._pace.arrived(stamp or time_s)
                    delayed = self._pace.delayed and not stamp
                    self._counts = dataclasses.replace(self._counts, dropped=self._pace.dropped)
                else:
                    dropped, delayed = 0, False
                    self._pace.arrived(time_s)
            if playback is not None:
                while playback.late() and capture.grab():
                    dropped += 1
                if dropped:
                    self._count(dropped=dropped)
            image = capture.retrieve()
            if image is None:
                self._count(damaged=1)
                continue
            if image.shape[1::-1] != capture.size:
                self._count(wrong_size=1)
                error = size_error(
                    dataclasses.replace(config, width=capture.size[0], height=capture.size[1]),
                    image.shape[1],
                    image.shape[0],
                )
                self._set_problem(_Problem(type(error), str(error)))
                continue
            black = is_black(image)
            if previous is not None and _identical(image, previous):
                repeats += 1
            else:
                repeats, same_since = 0, time_s
            previous = image
            limit_s = config.frozen_after_s
            if playback is None and repeats and not black and limit_s is not None and time_s - same_since > limit_s:
                self._count(repeated=1)
                self._set_problem(
                    _Problem(
                        FrozenCameraError,
                        f"{config.name} has sent the same image {repeats + 1} times, for {time_s - same_since:.1f} s: "
                        "replug the camera or restart its server. If the source can send identical images "
                        "without a fault, set frozen_after_s=None in CameraConfig.",
                    )
                )
                continue
            image.flags.writeable = False
            self._publish(Captured(image, time_s, sequence, self._epoch, dropped, repeats, black, delayed))
            self._settle_now(capture)
            self._expose_now(capture)
        return False

    def _turn(self, playback: "_Playback") -> bool:
        """Wait until the next frame of a file may be read, and return False if `stop` was called.

        In real time, this is the time at which the frame is due. Otherwise the queue must have room for the frame.
        """
        if playback.realtime:
            return not self._stop.wait(playback.wait_s())
        with self._changed:
            self._changed.wait_for(lambda: len(self._queue) < self._config.buffer or self._stop.is_set())
        return not self._stop.is_set()

    def _publish(self, frame: Captured) -> None:
        with self._changed:
            counts = self._counts
            self._counts = dataclasses.replace(
                counts,
                frames=counts.frames + 1,
                repeated=counts.repeated + (frame.repeats > 0),
                black=counts.black + frame.black,
                skipped=counts.skipped + (len(self._queue) >= self._config.buffer),
            )
            while len(self._queue) >= self._config.buffer:
                self._queue.popleft()
            self._queue.append(frame)
            self._newest, self._problem = frame, None
            self._changed.notify_all()

    def _settle_now(self, capture: Capture) -> None:
        """Lock the settings at their current values if `lock_settings` has requested it."""
        if not self._settle:
            return
        held, refusals = settings.lock(capture.properties, self._held, current=True)
        with self._changed:
            self._held = held
            self.refused = capture.warnings + [str(refusal) for refusal in refusals]
            self._settle = False
            self._changed.notify_all()

    def _expose_now(self, capture: Capture) -> None:
        """Set the exposure if `set_exposure` has requested it."""
        wanted = self._wanted
        if wanted is None:
            return
        held, refusals = settings.lock(capture.properties, {"exposure": wanted})
        automatic = any(refusal.name == "AUTO_EXPOSURE" for refusal in refusals)
        with self._changed:
            self._held.pop("exposure", None)
            if not automatic:
                self._held.update(held)
            self._wanted = None
            self._changed.notify_all()

    def _count(self, **more: int) -> None:
        with self._changed:
            totals = {name: getattr(self._counts, name) + number for name, number in more.items()}
            self._counts = dataclasses.replace(self._counts, **totals)

    def _set_problem(self, problem: _Problem) -> None:
        """Set the reason why there are no frames. The queue is cleared, except at the end of a video file."""
        with self._changed:
            self._problem = problem
            if problem.error is not EndOfVideoError:
                self._queue.clear()
            self._changed.notify_all()


class _Playback:
    """The clock that decides when the frames of a video file are due."""

    def __init__(self, config: CameraConfig, capture: Capture):
        self._config = config
        self._frames = capture.frame_count
        self._period = 1 / (config.fps or capture.rate or 30.0)
        self._start = time.monotonic()
        self._number = 0
        self.realtime = config.realtime

    def wait_s(self) -> float:
        """Advance to the next frame, and return the time until it is due (s)."""
        due = self._start + self._number * self._period
        self._number += 1
        return max(due - time.monotonic(), 0.0)

    def late(self) -> bool:
        """Return whether the frame after the current frame is already due. If so, advance to that frame."""
        last = self._frames is not None and self._number >= self._frames
        if not self.realtime or last or time.monotonic() < self._start + self._number * self._period:
            return False
        self._number += 1
        return True

    def end(self) -> _Problem:
        """Return the reason why there are no more frames after the end of the file."""
        return _Problem(
            EndOfVideoError,
            f"{self._config.name} has ended (its header states {self._frames} frames): call disconnect(), then "
            "connect() to play it again from its start.",
            final=True,
        )


def _identical(a: UInt8[np.ndarray, "..."], b: UInt8[np.ndarray, "..."]) -> bool:
    """Return whether two images are equal. The first row is compared first, because it nearly always differs."""
    return np.array_equal(a[0], b[0]) and np.array_equal(a, b)
