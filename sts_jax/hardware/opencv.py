"""`OpenCVCamera`: reads frames and the times of their arrival from a V4L2 device or a network stream."""

import atexit
import collections
import dataclasses
import math
import os
import threading
import time
import urllib.parse
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from sts_jax.hardware.camera import (
    CameraConfig,
    CameraError,
    CameraLostError,
    CameraTimeoutError,
    Captured,
    FrameSizeError,
    FrozenCameraError,
    Pace,
    find_cameras,
    public,
    stable_path,
)

FIRST_WAIT_S = 0.25  # s, wait before a lost source is opened again. It doubles after each failure
LONGEST_WAIT_S = 5.0  # s, longest of these waits

_IN_FLIGHT = 2  # frames that may be in exposure or transfer at once. `read` discards as many
_MJPG = cv2.VideoWriter.fourcc(*"MJPG")
_TAIL = 1024  # bytes within which a complete JPEG image ends with its marker
_AGES = 61  # number of frames whose ages are compared
_LATE_S = 0.02  # a frame of a device that is older than the youngest one by more than this was delayed (s)
_RATE_TOLERANCE = 0.02  # share by which a driver may round the frame rate

# Field of `CameraConfig`, OpenCV's property, the property of its automatic control, and the value that turns this off
_SETTINGS: tuple[tuple[str, str, str, float], ...] = (
    ("exposure", "EXPOSURE", "AUTO_EXPOSURE", 1.0),  # V4L2_EXPOSURE_MANUAL
    ("white_balance", "WB_TEMPERATURE", "AUTO_WB", 0.0),
    ("focus", "FOCUS", "AUTOFOCUS", 0.0),
)
_UNSUPPORTED = -1.0  # returned by OpenCV for a property that the driver lacks
_TOLERANCE = 0.5  # largest difference that counts as accepted, because drivers store whole numbers


@dataclasses.dataclass
class CameraStatistics:
    """Counts of frames since `OpenCVCamera.connect`."""

    frames: int = 0  # frames that were complete, of the right size and not frozen
    dropped: int = 0  # frames that camera or driver lost, estimated from the times
    skipped: int = 0  # frames that were replaced by newer frames before they were read
    damaged: int = 0  # frames that could not be decoded
    rate: float | None = None  # frames per second, from the median interval of recent frames. None: not measured yet


class OpenCVCamera:
    """A `Camera` that reads a V4L2 device or a network stream through OpenCV.

    ```python
    with OpenCVCamera(CameraConfig("/dev/v4l/by-id/usb-Maker_Camera_0123-video-index0")) as camera:
        frame = camera.read()
    ```

    A background thread fetches the frames continuously, so that no old frames wait in the driver. Only this thread
    uses OpenCV, and it opens a lost source again. Several threads may use one camera: each frame goes to one of them.
    """

    def __init__(self, config: CameraConfig):
        """Keep the configuration. `connect` opens the camera."""
        self.config = config
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()  # set while the camera is not connected
        self._stop.set()
        self._changed = threading.Condition()  # protects the attributes of `_reset`
        self._reset()

    def _reset(self) -> None:
        self._queue: collections.deque[Captured] = collections.deque()
        self._newest: Captured | None = None
        self._problem: CameraError | None = None  # why there are no frames at present
        self._counts = CameraStatistics()
        self._pace = Pace(self.config.fps)
        self._next = 0  # sequence number of the next frame
        self._epoch = -1
        self._task: Callable[[Capture], None] | None = None  # to be done on the open device after the next frame
        # Locked settings, by field of `CameraConfig`. At first, these are the requested ones
        wanted = [(field, getattr(self.config, field)) for field, *_ in _SETTINGS if self.config.kind == "device"]
        self._held: dict[str, float] = {field: value for field, value in wanted if value is not None}
        self._refused: list[str] = []  # settings that the driver did not accept

    def connect(self, warmup_s: float = 1.0) -> "OpenCVCamera":
        """See `Camera.connect`. A setting that the source does not accept is a warning."""
        config = self.config
        if not self._stop.is_set() or (self._thread is not None and self._thread.is_alive()):
            raise CameraError(f"{config.name} is connected already, or its driver does not respond.")
        self._reset()
        self._stop.clear()
        self._thread = threading.Thread(target=self._run, name=f"sts_jax {config.name}", daemon=True)
        self._thread.start()
        atexit.register(self.disconnect)  # a thread that is inside OpenCV must not outlive the interpreter
        try:
            with self._changed:
                self._changed.wait_for(lambda: self._newest or self._problem, 3 * config.timeout_s)
                if self._newest is None:
                    raise self._error(3 * config.timeout_s)
            time.sleep(warmup_s)
            if config.lock and config.kind == "device":
                self._between_frames(self._lock_all)
                with self._changed:
                    self._queue.clear()
            elif config.lock:
                self._refused = [
                    "AUTO_EXPOSURE and AUTO_WB of a stream cannot be turned off from here: lock exposure and white "
                    "balance at its server, then pass lock=False in CameraConfig"
                ]
            for text in self._refused:
                warnings.warn(f"{config.name} did not accept a setting. {text}.", stacklevel=2)
        except BaseException:  # includes a warning that Python turns into an error
            self.disconnect()
            raise
        return self

    def disconnect(self) -> None:
        """Close the camera. A driver that does not respond for `timeout_s` closes it later, which is a warning."""
        atexit.unregister(self.disconnect)
        self._stop.set()
        with self._changed:
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join(self.config.timeout_s + 1)
            if self._thread.is_alive():
                warnings.warn(f"the driver of {self.config.name} does not respond. It is closed later.", stacklevel=2)

    def __enter__(self) -> "OpenCVCamera":
        return self.connect() if self._stop.is_set() else self

    def __exit__(self, *error: object) -> None:
        self.disconnect()

    @property
    def is_connected(self) -> bool:
        """True if the camera is open and not lost."""
        return self._thread is not None and self._thread.is_alive() and not self._stop.is_set() and not self._is_lost()

    @property
    def statistics(self) -> CameraStatistics:
        """Counts of frames since `connect`."""
        with self._changed:
            return dataclasses.replace(self._counts, dropped=self._pace.dropped, rate=self._pace.rate)

    @property
    def source(self) -> str:
        """The path of the camera, with the serial number if there is one, or the URL without password."""
        return stable_path(self.config.path) if self.config.kind == "device" else public(self.config.path)

    @property
    def locked(self) -> dict[str, float]:
        """The settings of a device that are locked, by field of `CameraConfig`, such as {"exposure": 200.0}."""
        return dict(self._held)

    def set_exposure(self, exposure: float) -> float | None:
        """Set the exposure in the driver's unit (V4L2: 0.1 ms). It appears in the images a few frames later.

        Returns the exposure that the device has now, which drivers round and limit. None: the driver supports none.
        """
        if not exposure > 0:
            raise ValueError(f"exposure must be > 0, got {exposure}")
        if self.config.kind != "device":
            raise CameraError(f"{self.config.name} is a stream: set the exposure at its server.")

        held: dict[str, float] = {}

        def task(capture: Capture) -> None:
            held.update(lock(capture.device, {"exposure": exposure})[0])
            self._held |= held  # empty if the camera is being lost, and then has the earlier exposure when it is back

        self._between_frames(task)
        return held.get("exposure")

    def read(self, timeout_ms: float | None = None) -> Captured:
        """Return a frame whose exposure began after the start of this call: the third that arrives."""
        with self._changed:
            first = self._next + _IN_FLIGHT
            return self._wait(timeout_ms, lambda frame: frame.sequence >= first and not frame.delayed)

    def async_read(self, timeout_ms: float | None = None) -> Captured:
        """See `Camera.async_read`. The newest `CameraConfig.buffer` frames are kept."""
        with self._changed:
            return self._wait(timeout_ms, lambda frame: True)

    def read_latest(self, max_age_ms: float = 500.0) -> Captured:
        """Return the newest frame without waiting. The same frame may be returned several times."""
        with self._changed:
            frame = self._newest
            if frame is None or self._problem is not None or self._stop.is_set():
                raise self._error(0.0)
        age_ms = 1000 * (time.monotonic() - frame.time_s)
        if age_ms > max_age_ms:
            raise CameraTimeoutError(
                f"the newest frame of {self.config.name} is {age_ms:.0f} ms old, more than max_age_ms={max_age_ms:g}."
            )
        return frame

    def _wait(self, timeout_ms: float | None, wanted: Callable[[Captured], bool]) -> Captured:
        """Return the next wanted frame of the queue, and discard those before it."""
        limit_s = self.config.timeout_s if timeout_ms is None else timeout_ms / 1000
        deadline = time.monotonic() + limit_s
        epoch, lost_before = self._epoch, self._is_lost()
        while True:
            while self._queue and not self._stop.is_set():
                if wanted(frame := self._queue.popleft()):
                    return frame
            remaining = deadline - time.monotonic()
            failed = self._problem is not None and not (lost_before and self._is_lost())
            if self._epoch != epoch and not lost_before and not failed and not self._stop.is_set():
                raise CameraLostError(f"{self.config.name} was lost during the call and found again: repeat the call.")
            if self._stop.is_set() or failed or remaining <= 0:
                raise self._error(limit_s)
            self._changed.wait(remaining)

    def _between_frames(self, task: Callable[["Capture"], None]) -> None:
        """Let the thread do a task after the next frame, and wait for it. A lost camera may be found meanwhile."""
        with self._changed:
            self._task = task
            self._changed.wait_for(lambda: self._task is None or self._stop.is_set(), self.config.timeout_s)
            if self._task is not None:
                self._task = None
                raise self._error(self.config.timeout_s)

    def _lock_all(self, capture: "Capture") -> None:
        self._held, refused = lock(capture.device, self._held, current=True)
        self._refused = capture.warnings + refused

    def _is_lost(self) -> bool:
        return isinstance(self._problem, CameraLostError)

    def _error(self, limit_s: float) -> CameraError:
        """The reason why there is no frame."""
        if self._stop.is_set():
            return CameraError(f"{self.config.name} is not connected: call connect() first.")
        if self._problem is not None:
            return type(self._problem)(*self._problem.args)
        return CameraTimeoutError(
            f"{self.config.name} has sent no usable frame within {1000 * limit_s:.0f} ms ({self._counts.damaged} "
            "damaged frames since connect): check the device, or the stream's server."
        )

    # The thread

    def _run(self) -> None:
        """Read the source until `disconnect` is called or an error occurs. A lost source is opened again."""
        config = self.config
        if config.kind == "device" and Path(config.path).exists():  # the stable path survives replugging
            config = dataclasses.replace(config, source=stable_path(config.path))
        try:
            while (capture := self._open(config)) is not None:
                try:
                    self._fetch(capture)
                finally:
                    capture.device.release()
        except CameraError as error:
            self._fail(error)
        except Exception as error:  # an error that ends the thread must reach the caller, who would wait otherwise
            self._fail(CameraError(f"{config.name} failed ({error!r}): call disconnect(), then connect()."))

    def _open(self, config: CameraConfig) -> "Capture | None":
        """Open the source, or return None after `disconnect`. A source that was open before is tried until it opens."""
        wait_s = FIRST_WAIT_S
        while not self._stop.is_set():
            try:
                capture = Capture(config)
            except CameraError as error:
                if self._epoch < 0:
                    raise
                self._fail(_lost(config, f" The last attempt: {error}"))
                self._stop.wait(wait_s)
                wait_s = min(2 * wait_s, LONGEST_WAIT_S)
                continue
            # A device forgets its settings without power.
            self._refused = capture.warnings + lock(capture.device, self._held)[1]
            with self._changed:
                if self._epoch >= 0:
                    self._pace.interrupted()
                self._epoch += 1
            return capture
        return None

    def _fetch(self, capture: "Capture") -> None:
        """Publish frames until the source is lost or `disconnect` is called."""
        config = self.config
        previous: Captured | None = None
        repeats, same_since = 0, 0.0
        # Ages at which recent frames arrived (s), on clocks with an unknown difference. The driver keeps frames that
        # this thread fetches too late. They are older than others, as the first frame of a camera that was lost may be.
        ages: collections.deque[float] = collections.deque(maxlen=_AGES)
        while capture.grab():
            # Time and number are set under one lock, so a later call of `read` sees that this frame arrived before.
            with self._changed:
                time_s, sequence = time.monotonic(), self._next
                self._next += 1
                stamp = capture.stamp()
                dropped = self._pace.arrived(stamp or time_s)
                delayed = self._pace.delayed
                if stamp:
                    delayed = (not ages and self._epoch > 0) or time_s - stamp > min(ages, default=math.inf) + _LATE_S
                    ages.append(time_s - stamp)
            image = capture.retrieve()
            if self._stop.is_set():
                return
            if image is None:
                self._counts.damaged += 1
                continue
            if image.shape[1::-1] != capture.size:
                self._fail(_wrong_size(config, image.shape[1::-1], capture.size))
                continue
            # The first row is compared first, because it nearly always differs.
            same = previous is not None and np.array_equal(image[0], previous.image[0])
            if previous is not None and same and np.array_equal(image, previous.image):
                repeats += 1
            else:
                repeats, same_since = 0, time_s
            image.flags.writeable = False
            limit_s = config.frozen_after_s
            counted = 0 if limit_s is None else repeats
            frame = previous = Captured(image, time_s, sequence, self._epoch, dropped, counted, delayed)
            late = counted and limit_s is not None and time_s - same_since > limit_s
            if late and not frame.black and image.min() < 255:  # wholly black or white frames are equal
                remedy = "replug it or restart its server, or set frozen_after_s=None if it may repeat images"
                self._fail(FrozenCameraError(f"{config.name} has sent the same image for {limit_s:g} s: {remedy}."))
                continue
            self._publish(frame)
            if (task := self._task) is not None:
                task(capture)
                with self._changed:
                    self._task = None
                    self._changed.notify_all()
        if not self._stop.is_set():
            self._fail(_lost(config))
            self._stop.wait(FIRST_WAIT_S)

    def _publish(self, frame: Captured) -> None:
        with self._changed:
            self._counts.frames += 1
            while len(self._queue) >= self.config.buffer:
                self._queue.popleft()
                self._counts.skipped += 1
            self._queue.append(frame)
            self._newest, self._problem = frame, None
            self._changed.notify_all()

    def _fail(self, problem: CameraError) -> None:
        with self._changed:
            self._problem = problem
            self._queue.clear()
            self._changed.notify_all()


def _lost(config: CameraConfig, attempt: str = "") -> CameraLostError:
    return CameraLostError(
        f"{config.name} was lost, and a thread tries to open it again: check its cable or its server.{attempt}"
    )


def _wrong_size(config: CameraConfig, size: tuple[int, ...], wanted: tuple[int, ...]) -> FrameSizeError:
    return FrameSizeError(
        f"{config.name} sends frames of {size[0]} x {size[1]} pixels, but {wanted[0]} x {wanted[1]} were asked for: "
        f"give CameraConfig a size that it sends (`v4l2-ctl -d {config.path} --list-formats-ext` lists those of a "
        "device, and some need fourcc='MJPG')."
    )


class Capture:
    """A device or a stream that is open for reading.

    FFmpeg rescales the frames of a stream whose size changes, and OpenCV does not report this. The frames of motion
    JPEG streams are therefore decoded here, which keeps their size and shows incomplete frames.
    """

    def __init__(self, config: CameraConfig):
        """Open the source."""
        self._is_device = config.kind == "device"
        self.device = _open(config)
        self.warnings: list[str] = []  # requests that the driver did not accept
        self._jpeg = False
        try:
            if not self.device.isOpened():
                remedy = "check the address, the path and the password, and that its server sends video."
                if self._is_device:
                    remedy = (
                        f"it is missing, in use (`fuser {config.path}`), your user is not in the group video, or it is "
                        f"no camera. Cameras found: {', '.join(map(str, find_cameras())) or 'none'}."
                    )
                raise CameraError(f"{config.name} cannot be opened: {remedy}")
            if self._is_device:
                self._request_format(config)
            elif self._fourcc() == _MJPG:
                self._jpeg = self.device.set(cv2.CAP_PROP_FORMAT, -1)
            sides = cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT
            self.size = tuple(round(self.device.get(side)) for side in sides)
            wanted = config.width or self.size[0], config.height or self.size[1]
            if self.size != wanted:
                raise _wrong_size(config, self.size, wanted)
        except BaseException:
            self.device.release()
            raise

    def _request_format(self, config: CameraConfig) -> None:
        """Request the format, the size and the frame rate of a device."""
        device = self.device
        if config.fourcc is not None:
            device.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*config.fourcc))
            fourcc = self._fourcc().to_bytes(4, "little").decode(errors="replace")
            if fourcc != config.fourcc:
                self.warnings.append(f"FOURCC: asked for {config.fourcc}, found {fourcc}")
        if config.width is not None and config.height is not None:
            device.set(cv2.CAP_PROP_FRAME_WIDTH, config.width)
            device.set(cv2.CAP_PROP_FRAME_HEIGHT, config.height)
        if config.fps is not None:
            device.set(cv2.CAP_PROP_FPS, config.fps)
            rate = device.get(cv2.CAP_PROP_FPS)
            if abs(rate - config.fps) > _RATE_TOLERANCE * config.fps:
                self.warnings.append(f"FPS: asked for {config.fps:g}, found {rate:g}")

    def _fourcc(self) -> int:
        return int(self.device.get(cv2.CAP_PROP_FOURCC)) & 0xFFFFFFFF

    def stamp(self) -> float | None:
        """Time of the last frame on the clock of the device's driver (s), which has no jitter. None for a stream."""
        time_ms = self.device.get(cv2.CAP_PROP_POS_MSEC) if self._is_device else 0.0
        return time_ms / 1000 if time_ms > 0 else None

    def grab(self) -> bool:
        """Wait for the next frame, and return whether there is one."""
        try:
            return self.device.grab()
        except cv2.error:
            return False

    def retrieve(self) -> UInt8[np.ndarray, "height width 3"] | None:
        """Decode the frame of the last `grab` to an RGB image. The result is None if the frame is damaged."""
        try:
            complete, image = self.device.retrieve()
            if not complete or image is None or not image.size:
                return None
            if self._jpeg:
                if b"\xff\xd9" not in image.reshape(-1)[-_TAIL:].tobytes():
                    return None
                decoded = cv2.imdecode(image.reshape(-1), cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION)
                return None if decoded is None else np.asarray(decoded)
            return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))
        except cv2.error:
            return None


def _open(config: CameraConfig) -> cv2.VideoCapture:
    if config.kind == "device":
        # OpenCV reads this variable at its first frame. Without it, a stalled device blocks for 10 s.
        os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", str(math.ceil(config.timeout_s)))
        return cv2.VideoCapture(config.path, cv2.CAP_V4L2)
    host, exempt = urllib.parse.urlsplit(config.path).hostname, os.environ.get("no_proxy", "")
    if host in ("127.0.0.1", "localhost") and host not in exempt:  # FFmpeg would ask a proxy for this computer
        os.environ["no_proxy"] = f"{exempt},{host}".strip(",")
    milliseconds = round(1000 * config.timeout_s)
    parameters = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, milliseconds, cv2.CAP_PROP_READ_TIMEOUT_MSEC, milliseconds]
    parameters += [cv2.CAP_PROP_N_THREADS, 1]  # a decoder with n threads delays the images by n frames
    return cv2.VideoCapture(config.path, cv2.CAP_FFMPEG, parameters)


def lock(device: Any, values: Mapping[str, float], *, current: bool = False) -> tuple[dict[str, float], list[str]]:
    """Turn the automatic controls of settings off, set their values by field of `CameraConfig`, and read them back.

    With `current`, settings that `values` lacks are locked at their current values. Returns the locked values that the
    device has now, and texts on the properties that the driver did not set.
    """
    held: dict[str, float] = {}
    refused: list[str] = []

    def put(name: str, value: float, needed: bool = True) -> float:
        device.set(_property(name), value)
        actual = device.get(_property(name))
        if actual != _UNSUPPORTED and abs(actual - value) > _TOLERANCE:
            refused.append(f"{name}: asked for {value:g}, found {actual:g}")
        elif actual == _UNSUPPORTED and needed:
            refused.append(f"{name}: asked for {value:g}, the driver lacks it")
        return actual

    for field, name, automatic, off in _SETTINGS:
        if field not in values and not current:
            continue
        before = device.get(_property(name))
        control = put(automatic, off, needed=field in values or field != "focus")  # many cameras have a fixed focus
        if field in values or before != _UNSUPPORTED:
            actual = put(name, values.get(field, before))
            if actual != _UNSUPPORTED and control in (off, _UNSUPPORTED):
                held[field] = actual
    return held, refused


def _property(name: str) -> int:
    return int(getattr(cv2, f"CAP_PROP_{name}"))
