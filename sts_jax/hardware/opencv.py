"""`OpenCVCamera`: reads frames and the times of their arrival from a V4L2 device, a network stream or a video file."""

import atexit
import collections
import contextlib
import dataclasses
import http.client
import math
import os
import socket
import statistics
import sys
import threading
import time
import urllib.parse
import warnings
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import UInt8

from sts_jax.hardware.camera import (
    CameraBusyError,
    CameraConfig,
    CameraError,
    CameraLostError,
    CameraNotConnectedError,
    CameraNotFoundError,
    CameraOpenError,
    CameraPermissionError,
    CameraStatistics,
    CameraTimeoutError,
    Captured,
    EndOfVideoError,
    FrameSizeError,
    FrozenCameraError,
    StaleFrameError,
    cameras_found,
    device_path,
    is_black,
    locked,
    stable_path,
    users_of,
)

_INTERVALS = 61  # number of recent intervals between frames. Their median is the period
_FEWEST = 8  # smallest number of intervals from which the period is measured
_LONG = 2.5  # periods. A frame after a longer interval was delayed
_SHORT = 0.5  # periods. A frame that follows a delayed frame after a shorter interval was delayed too
_MADE_UP = 4  # frames after the missing ones by which a gap may be corrected. More would add up the error of the period


class _Gap(NamedTuple):
    """A long interval between two frames, after which frames are missing."""

    start_s: float  # time of the frame before the interval
    frames: int  # number of frames since this time
    missing: int  # number of missing frames
    limit: int  # number of frames after which `missing` is final


class Pace:
    """Measures the period of a camera's frames, and estimates how many frames were lost.

    After an interval of n + 1 periods between two frames, n frames count as lost. The attribute `dropped` is the number
    of all lost frames. If the next frames follow each other in less than one period, some or all of the n frames were
    only late, not lost. `dropped` is then reduced by the number of late frames. Each call of the method `arrived`
    records one frame, and returns the estimated number of frames that were lost just before it. Late frames are not
    subtracted from these results, so the sum of the results can exceed `dropped`.
    """

    def __init__(self, nominal: float | None):
        """Make an estimator that has not seen a frame yet.

        Args:
            nominal: Frames per second that are assumed until the period is measured. None: unknown.
        """
        self._nominal = None if nominal is None else 1 / nominal
        self._last: float | None = None
        self._gap: _Gap | None = None
        self._intervals: collections.deque[float] = collections.deque(maxlen=_INTERVALS)
        self.dropped = 0
        self.delayed = False  # True if the last frame was delayed

    @property
    def rate(self) -> float | None:
        """Measured frames per second, or None if too few frames have arrived."""
        return 1 / statistics.median(self._intervals) if len(self._intervals) >= _FEWEST else None

    def arrived(self, time_s: float) -> int:
        """Record a frame, and return the estimated number of frames that were lost just before this frame.

        Args:
            time_s: Time of the frame (s).

        Returns:
            Estimated number of lost frames. The number is 0 if this is the first frame, if the period is unknown,
            or if `time_s` is not later than the time of the previous frame.
        """
        last, self._last = self._last, time_s
        if last is None or time_s <= last:
            return 0
        period = 1 / self.rate if self.rate is not None else self._nominal
        if period is None:
            self._intervals.append(time_s - last)
            self.delayed = False
            return 0
        periods = (time_s - last) / period
        self.delayed = periods > _LONG or (self.delayed and periods < _SHORT)
        late_together = self.delayed and periods < _SHORT and self._gap is not None
        if not late_together:  # the intervals between frames that a network held back are not those of the camera
            self._intervals.append(time_s - last)
        missing = max(round((time_s - last) / period) - 1, 0)
        if missing:
            self._gap = _Gap(last, 1, missing, missing + _MADE_UP)
            self.dropped += missing
        elif self._gap is not None:
            self._make_up(self._gap, time_s, period)
        return missing

    def _make_up(self, gap: _Gap, time_s: float, period: float) -> None:
        """Reduce the number of missing frames if the frames after the gap arrive early."""
        frames = gap.frames + 1
        missing = min(max(round((time_s - gap.start_s) / period) - frames, 0), gap.missing)
        self.dropped -= gap.missing - missing
        self._gap = gap._replace(frames=frames, missing=missing) if missing and frames < gap.limit else None

    def interrupted(self) -> None:
        """Ignore the interval before the next frame when measuring the frame period and counting lost frames.

        Call this method after an interruption of the connection. The next frame counts as delayed, because it may have
        waited in a buffer while the connection was opened.
        """
        self._last, self._gap, self.delayed = None, None, True


@runtime_checkable
class Properties(Protocol):
    """The methods of `cv2.VideoCapture` that read and set the properties of a device."""

    def get(self, propId: int, /) -> float: ...  # noqa: D102

    def set(self, propId: int, value: float, /) -> bool: ...  # noqa: D102


@dataclasses.dataclass(frozen=True)
class _Setting:
    field: str  # field of `CameraConfig`
    name: str  # OpenCV's name of the property, without CAP_PROP_
    prop: int  # OpenCV's number of the property
    automatic: tuple[str, int, float] | None  # automatic control: name, number, and value that turns it off


_MANUAL = 1.0  # V4L2_EXPOSURE_MANUAL
_SETTINGS = (
    _Setting("exposure", "EXPOSURE", cv2.CAP_PROP_EXPOSURE, ("AUTO_EXPOSURE", cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL)),
    _Setting("gain", "GAIN", cv2.CAP_PROP_GAIN, None),
    _Setting("white_balance", "WB_TEMPERATURE", cv2.CAP_PROP_WB_TEMPERATURE, ("AUTO_WB", cv2.CAP_PROP_AUTO_WB, 0.0)),
    _Setting("focus", "FOCUS", cv2.CAP_PROP_FOCUS, ("AUTOFOCUS", cv2.CAP_PROP_AUTOFOCUS, 0.0)),
)
_UNSUPPORTED = -1.0  # returned by OpenCV for a property that the driver lacks
_TOLERANCE = 0.5  # largest difference that counts as accepted, because drivers store whole numbers


@dataclasses.dataclass(frozen=True)
class Refusal:
    """A property that the driver did not set to the requested value."""

    name: str  # OpenCV's name of the property, without CAP_PROP_
    asked: float  # requested value
    found: float | None  # value after the request. None: the driver does not support the property

    def __str__(self) -> str:
        found = "the driver lacks it" if self.found is None else f"found {self.found:g}"
        return f"{self.name}: asked for {self.asked:g}, {found}"


def asked(config: CameraConfig) -> dict[str, float]:
    """Return the values that a camera configuration requests for exposure, gain, white balance and focus.

    Args:
        config: Camera configuration. A field that is None requests no value.

    Returns:
        Requested values, by field name: `exposure`, `gain`, `white_balance` or `focus`.
    """
    values = {setting.field: getattr(config, setting.field) for setting in _SETTINGS}
    return {field: value for field, value in values.items() if value is not None}


def lock(
    capture: Properties, values: Mapping[str, float], *, current: bool = False
) -> tuple[dict[str, float], list[Refusal]]:
    """Lock settings of a device: turn their automatic controls off, set their values, and check the result.

    Args:
        capture: Open device.
        values: Values to set, by field name of `CameraConfig` (`exposure`, `gain`, `white_balance`, `focus`).
        current: If True, the settings that `values` does not contain are locked at their current values. This applies
            to exposure, white balance and focus.

    Returns:
        The values that the device has now, by field name, and a list of the properties that the driver did not set.
        A property that the driver lacks is in the list only in two cases. In the first case, the property is needed to
        set one of `values`. In the second case, the property controls automatic exposure or automatic white balance.
    """
    held: dict[str, float] = {}
    refused: list[Refusal] = []
    for setting in _SETTINGS:
        wanted = values.get(setting.field)
        if wanted is None and (not current or setting.automatic is None):
            continue
        before = capture.get(setting.prop)
        if setting.automatic is not None:
            refused += _set(capture, *setting.automatic, needed=wanted is not None or setting.field != "focus")
        if wanted is None and before == _UNSUPPORTED:
            continue
        refused += _set(capture, setting.name, setting.prop, before if wanted is None else wanted, needed=True)
        found = capture.get(setting.prop)
        if found != _UNSUPPORTED:
            held[setting.field] = found
    return held, refused


def _set(capture: Properties, name: str, prop: int, value: float, needed: bool) -> list[Refusal]:
    """Set one property, read it back, and return a refusal or none. An unsupported property is one only if `needed`."""
    capture.set(prop, value)
    found = capture.get(prop)
    if found == _UNSUPPORTED:
        return [Refusal(name, value, None)] * needed
    return [Refusal(name, value, found)] * (abs(found - value) > _TOLERANCE)


_MJPG = cv2.VideoWriter.fourcc(*"MJPG")
_ANSI = int.from_bytes(b"ansi", "little")  # FFmpeg's name for a plain text, which it draws as a video
_VIDEO = 81  # Linux's major number of video devices
_TAIL = 1024  # bytes within which a complete JPEG image ends with its marker
_RATE_TOLERANCE = 0.02  # share by which a driver may round the frame rate


class Capture:
    """A device, a stream or a video file that is open for reading.

    If the size of a stream's frames changes, FFmpeg rescales the frames, and OpenCV does not report the change. This
    class therefore decodes the frames of motion JPEG streams itself. The decoder of this class keeps the size of each
    frame and rejects incomplete frames.
    """

    def __init__(self, config: CameraConfig):
        """Open the source of a configuration.

        Raises:
            CameraError: The source cannot be opened. The message names the cause.
        """
        self._config = config
        check_source(config)
        self.properties = _open(config)
        self._jpeg = False
        try:
            if not self.properties.isOpened():
                raise opening_error(config)
            self.warnings = self._set_up()
        except BaseException:
            self.properties.release()
            raise

    def _set_up(self) -> list[str]:
        """Request format, size and rate, check the size, and return a text for each request that was not met."""
        config, warnings = self._config, []
        if config.kind == "device":
            if config.fourcc is not None:
                self.properties.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*config.fourcc))
                found = self._fourcc().to_bytes(4, "little").decode(errors="replace")
                if found != config.fourcc:
                    warnings.append(f"FOURCC: asked for {config.fourcc}, found {found}")
            if config.width is not None and config.height is not None:
                self.properties.set(cv2.CAP_PROP_FRAME_WIDTH, config.width)
                self.properties.set(cv2.CAP_PROP_FRAME_HEIGHT, config.height)
            if config.fps is not None:
                self.properties.set(cv2.CAP_PROP_FPS, config.fps)
                rate = self.properties.get(cv2.CAP_PROP_FPS)
                if abs(rate - config.fps) > _RATE_TOLERANCE * config.fps:
                    warnings.append(f"FPS: asked for {config.fps:g}, found {rate:g}")
        if config.kind == "file" and (self.frame_count is None or self._fourcc() == _ANSI):
            raise CameraOpenError(
                f"{config.name} is a picture, a text file, or a video whose header lacks the number of frames: give a "
                "video file whose header contains this number, such as a complete MP4 file."
            )
        if config.kind == "stream" and self._fourcc() == _MJPG:
            self._jpeg = self.properties.set(cv2.CAP_PROP_FORMAT, -1)
        width, height = (round(self.properties.get(p)) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        if config.width is not None and (width, height) != (config.width, config.height):
            raise size_error(config, width, height)
        self.size = (width, height)
        return warnings

    def _fourcc(self) -> int:
        return int(self.properties.get(cv2.CAP_PROP_FOURCC)) & 0xFFFFFFFF

    @property
    def frame_count(self) -> int | None:
        """Number of frames according to the header of a video file, or None if the header lacks this number."""
        count = self.properties.get(cv2.CAP_PROP_FRAME_COUNT)
        return round(count) if count > 0 else None

    @property
    def rate(self) -> float | None:
        """Frames per second of a device or a video file, or None if unknown. The rate of a stream is unknown."""
        rate = self.properties.get(cv2.CAP_PROP_FPS) if self._config.kind != "stream" else 0.0
        return rate if rate > 0 and np.isfinite(rate) else None

    def stamp(self) -> float | None:
        """Return the time of the last frame (s), or None if this time is unknown.

        The time is on the clock of the device's driver. It has no jitter, unlike the time at which the frame reaches
        this process. For files and streams, this method returns None.
        """
        time_ms = self.properties.get(cv2.CAP_PROP_POS_MSEC) if self._config.kind == "device" else 0.0
        return time_ms / 1000 if time_ms > 0 else None

    def grab(self) -> bool:
        """Wait for the next frame, and return whether there is one."""
        try:
            return self.properties.grab()
        except cv2.error:
            return False

    def retrieve(self) -> UInt8[np.ndarray, "height width 3"] | None:
        """Decode the frame of the last `grab` to an RGB image. The result is None if the frame is damaged."""
        try:
            complete, image = self.properties.retrieve()
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

    def release(self) -> None:
        """Close the device, the stream or the video file."""
        self.properties.release()


def _open(config: CameraConfig) -> cv2.VideoCapture:
    milliseconds = round(1000 * config.timeout_s)
    if config.kind == "device":
        if sys.platform == "linux":
            # OpenCV reads this variable at its first frame. Without it, a stalled device blocks for 10 s.
            os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", str(math.ceil(config.timeout_s)))
            return cv2.VideoCapture(device_path(config.target), cv2.CAP_V4L2)
        return cv2.VideoCapture(config.target, cv2.CAP_ANY)
    parameters = []
    if config.kind == "stream":
        # A decoder with n threads delays the images by n frames.
        parameters = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, milliseconds, cv2.CAP_PROP_READ_TIMEOUT_MSEC, milliseconds]
        parameters += [cv2.CAP_PROP_N_THREADS, 1]
    return cv2.VideoCapture(str(config.target), cv2.CAP_FFMPEG, parameters)


def size_error(config: CameraConfig, width: int, height: int) -> FrameSizeError:
    """Make the exception that reports that the camera's frames do not have the size in the configuration.

    The caller compares the sizes before it calls this function.

    Args:
        config: Configuration of the camera.
        width: Width of the frames that the camera sends (pixels).
        height: Height of these frames (pixels).
    """
    if config.kind == "device":
        path = device_path(config.target)
        remedy = (
            f"choose one of the sizes that `v4l2-ctl -d {path} --list-formats-ext` prints (some need fourcc='MJPG')"
        )
    else:
        remedy = f"set width={width}, height={height} in CameraConfig, or let the source send the size asked for"
    return FrameSizeError(
        f"{config.name} sends frames of {width} x {height} pixels, but {config.width} x {config.height} were asked "
        f"for: {remedy}."
    )


def check_source(config: CameraConfig) -> None:
    """Check the device or the video file of a configuration before OpenCV opens it.

    Streams are not checked. Devices are checked on Linux only.

    Raises:
        CameraError: The path does not exist or is a folder, the user lacks a permission, the device is not a camera, or
            the file is empty.
    """
    if config.kind == "stream" or (config.kind == "device" and sys.platform != "linux"):
        return
    path = Path(device_path(config.target))
    device = config.kind == "device"
    if not path.exists():
        remedy = cameras_found() if device else f"Check the path (the working directory is {Path.cwd()})."
        raise CameraNotFoundError(f"there is no {'device' if device else 'file'} {path}. {remedy}")
    if path.is_dir():
        raise CameraOpenError(f"{path} is a folder: give {'the path of a camera' if device else 'a video file'}.")
    if not os.access(path, os.R_OK | os.W_OK if device else os.R_OK):
        group = _group(path)
        remedy = f"add your user to the group {group} with `sudo usermod -aG {group} $USER`, then log in again"
        raise CameraPermissionError(
            f"no permission to open {path}: {remedy if device else f'change its permissions with `chmod u+r {path}`'}."
        )
    if device and not (path.is_char_device() and os.major(path.stat().st_rdev) == _VIDEO):
        raise CameraOpenError(f"{path} is not a camera. {cameras_found()}")
    if not device and not path.stat().st_size:
        raise CameraOpenError(f"{path} is empty: give a video file.")


def _group(path: Path) -> str:
    """Return the name of the group that owns a device, or "video" if the group is unknown or root."""
    with contextlib.suppress(OSError, KeyError, ImportError):
        import grp  # not on Windows

        group = grp.getgrgid(path.stat().st_gid).gr_name
        return "video" if group == "root" else group
    return "video"


def opening_error(config: CameraConfig) -> CameraError:
    """Return the error for a source that passed `check_source`, but that OpenCV could not open."""
    if config.kind == "stream":
        return _stream_error(config)
    if config.kind == "file":
        return CameraOpenError(
            f"{config.name} cannot be read as a video: it is damaged, incomplete or of an unknown format. Play it with "
            "another program, or record it again."
        )
    users = users_of(Path(device_path(config.target))) if sys.platform == "linux" else ()
    if users:
        return CameraBusyError(
            f"{config.name} is in use by process {', '.join(map(str, users))}: end this process, or choose another "
            "camera."
        )
    return CameraOpenError(
        f"{config.name} cannot be opened as a camera: it may deliver no images, or a process of another user may use "
        f"it. {cameras_found()}"
    )


def _stream_error(config: CameraConfig) -> CameraError:
    """Return the error for a stream that was not opened. Connects to its server once more to find the cause."""
    name, timeout_s = config.name, min(config.timeout_s, 2.0)
    try:
        url = urllib.parse.urlsplit(str(config.target))
        host, port = url.hostname or "", url.port
    except ValueError as error:
        return CameraOpenError(f"{name} is not a valid URL ({error}).")
    if url.scheme not in ("http", "https", "rtsp"):
        return CameraOpenError(f"{name} cannot be opened: check the address and that its server is running.")
    port = port or {"http": 80, "https": 443, "rtsp": 554}[url.scheme]
    try:
        if url.scheme == "rtsp":
            socket.create_connection((host, port), timeout_s).close()
            return CameraOpenError(f"the server of {name} answers, but sends no video: check the path and password.")
        kind = http.client.HTTPSConnection if url.scheme == "https" else http.client.HTTPConnection
        with contextlib.closing(kind(host, port, timeout=timeout_s)) as connection:
            connection.request("GET", (url.path or "/") + (f"?{url.query}" if url.query else ""))
            answer = connection.getresponse()
            content = answer.headers.get_content_type()
            if answer.status != 200:
                return CameraOpenError(
                    f"the server of {name} answers {answer.status} {answer.reason}: check the path and password."
                )
            return CameraOpenError(
                f"{name} has content of type {content}, from which no video could be read within "
                f"{config.timeout_s:g} s: give the URL of the video stream itself."
            )
    except ConnectionRefusedError:
        return CameraOpenError(f"{name} refuses the connection: start its server, or check the host and port.")
    except socket.gaierror as error:
        return CameraNotFoundError(f"the host of {name} is unknown ({error.strerror}): check the address.")
    except TimeoutError:
        return CameraOpenError(
            f"{name} has not answered within {config.timeout_s:g} s: check its server, or raise timeout_s."
        )
    except (OSError, http.client.HTTPException) as error:
        return CameraOpenError(f"{name} cannot be opened ({error}): check the address and its server.")


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

    It runs from the call of `OpenCVCamera.connect` to `disconnect`, or to an earlier end of the video file
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
        self._held: dict[str, float] = asked(config) if config.kind == "device" else {}
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
        """Counts of frames, lost connections and other events since `OpenCVCamera.connect`."""
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
            CameraError: There is no frame. See `OpenCVCamera.read` for the subclasses of this error.
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
            CameraError: There are no frames at present. See `OpenCVCamera.read` for the subclasses of this error.
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
            with locked(self._config):
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
                _, refusals = lock(capture.properties, self._held)
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
        held, refusals = lock(capture.properties, self._held, current=True)
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
        held, refusals = lock(capture.properties, {"exposure": wanted})
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


class OpenCVCamera:
    """A camera that reads frames from a V4L2 device, a network stream or a video file.

    ```python
    with OpenCVCamera(CameraConfig("/dev/v4l/by-id/usb-Maker_Camera_0123-video-index0")) as camera:
        frame = camera.read()
    ```

    A background thread fetches the frames continuously, so that no old frames wait in the driver. If a device or
    stream is lost, this thread opens it again under the same path or URL. The `epoch` of a frame counts the
    reconnections before this frame.

    Several threads may use one camera. `async_read` then returns each frame to only one of them.
    """

    def __init__(self, config: CameraConfig):
        """Keep the configuration. `connect` opens the camera.

        Args:
            config: Source of the frames, their size, and the locked settings.
        """
        self.config = config
        self._grabber: Grabber | None = None

    def connect(self, warmup_s: float = 1.0) -> "OpenCVCamera":
        """Open the camera, and wait `warmup_s` for its automatic exposure and white balance to settle.

        If the source is a V4L2 device and `CameraConfig.lock` is True, the call then locks the settings: it turns off
        the automatic control of exposure, white balance and focus, and discards all earlier frames. A video file starts
        at its first frame, without a wait. The call lasts at most `warmup_s` plus four times `CameraConfig.timeout_s`.

        Args:
            warmup_s: Time for the automatic exposure and white balance to settle (s).

        Returns:
            This camera.

        Raises:
            CameraError: The camera is connected already, or cannot be opened. Subclasses name the cause.
            ValueError: `warmup_s` is negative or not finite.

        Warns:
            UserWarning: The source did not accept a setting, or `CameraConfig.lock` is True but the source is a stream.
                A `Camera` cannot lock the settings of a stream.
        """
        if not 0 <= warmup_s < float("inf"):
            raise ValueError(f"warmup_s must be >= 0 and finite, got {warmup_s}")
        if self._grabber is not None:
            raise CameraError(f"{self.config.name} is connected already: call disconnect() first.")
        grabber = Grabber(_with_stable_path(self.config))
        grabber.start(3 * self.config.timeout_s)
        self._grabber = grabber
        try:
            if self.config.kind != "file":
                time.sleep(warmup_s)
                self._lock_settings(grabber)
        except BaseException:  # includes a warning that Python turns into an error
            self.disconnect()
            raise
        return self

    def _lock_settings(self, grabber: Grabber) -> None:
        config = self.config
        if config.kind == "device" and config.lock:
            refused = grabber.lock_settings(config.timeout_s)
        else:
            refused = list(grabber.refused)
        for text in refused:
            warnings.warn(f"{config.name} did not accept a setting. {text}.", stacklevel=3)
        if config.kind == "stream" and config.lock:
            warnings.warn(
                f"{config.name} is a stream, so AUTO_EXPOSURE and AUTO_WB cannot be turned off by this program: lock "
                "exposure and white balance at the stream's server, then pass lock=False in CameraConfig.",
                stacklevel=3,
            )

    def disconnect(self) -> None:
        """Close the camera. Does nothing if the camera is not connected.

        The call lasts at most `CameraConfig.timeout_s` plus 1 s. If the camera's driver does not respond in this time,
        a background thread closes the camera as soon as the driver responds.

        Warns:
            UserWarning: The driver did not respond in time.
        """
        grabber, self._grabber = self._grabber, None
        if grabber is not None and not grabber.stop():
            warnings.warn(
                f"the driver of {self.config.name} does not respond. The camera will be closed when the driver "
                "responds.",
                stacklevel=2,
            )

    @property
    def is_connected(self) -> bool:
        """True if the camera is open and its background thread reads frames.

        False before `connect`, after `disconnect`, while the camera is lost, after the end of a video file, and after
        an error that ends the thread. The value stays True after a `FrozenCameraError` or a `FrameSizeError`.
        """
        return self._grabber is not None and self._grabber.running

    @property
    def statistics(self) -> CameraStatistics:
        """Counts of frames, lost connections and other events since `connect`."""
        return self._connected().statistics

    @property
    def refused(self) -> tuple[str, ...]:
        """Descriptions of the settings that the driver did not accept when the camera was last opened.

        An example is "FPS: asked for 60, found 30".
        """
        return tuple(self._connected().refused)

    @property
    def source(self) -> str:
        """The name that identifies the camera: the path of a device or file, or the URL of a stream.

        The path of a device contains the camera's serial number if `/dev/v4l/by-id` lists the camera. The user name and
        the password of a URL are left out.
        """
        config = _with_stable_path(self.config)
        return device_path(config.target) if config.kind == "device" else config.public

    @property
    def locked(self) -> dict[str, float]:
        """The settings of a device that are locked at fixed values, and these values, such as {"exposure": 200.0}.

        The keys are field names of `CameraConfig`. For streams and files, the result is empty.
        """
        return self._connected().held

    def set_exposure(self, exposure: float) -> float | None:
        """Set the exposure of the camera as soon as the next frame has arrived.

        The new exposure appears in the images a few frames after the call.

        Args:
            exposure: New exposure, > 0, in the driver's unit (V4L2: 0.1 ms).

        Returns:
            The exposure that the camera has now. It may differ from the argument `exposure`, because drivers round and
            limit this value. The result is None if the driver does not support a manual exposure.

        Raises:
            CameraError: The source is a stream or a file, the camera is not connected, or no frame has arrived within
                `CameraConfig.timeout_s`.
            ValueError: `exposure` is not positive.
        """
        if not exposure > 0:
            raise ValueError(f"exposure must be > 0, got {exposure}")
        if self.config.kind != "device":
            remedy = "set it at the server of the stream" if self.config.kind == "stream" else "use a device"
            raise CameraError(
                f"{self.config.name} is a {self.config.kind}, but the exposure can be set only for a device: {remedy}."
            )
        return self._connected().set_exposure(exposure, self.config.timeout_s)

    def read(self, timeout_ms: float | None = None) -> Captured:
        """Return a frame whose exposure began after the start of this call.

        The first `CameraConfig.in_flight` frames that arrive after the start of the call are discarded, because their
        exposure may have begun earlier. Delayed frames (`Captured.delayed`) are discarded for the same reason. If the
        source is a video file, no frame is discarded, and the method returns the oldest frame that has not been
        returned yet.

        Args:
            timeout_ms: Longest wait (ms). None: `CameraConfig.timeout_s`. If the camera was lost before the call, this
                time includes the wait until the camera is found again.

        Returns:
            The frame.

        Raises:
            CameraTimeoutError: No such frame has arrived in time.
            CameraLostError: The camera was lost during the call, or was not found again in time.
            FrozenCameraError: The camera has sent the same image for longer than `CameraConfig.frozen_after_s`.
            FrameSizeError: The size of the camera's frames has changed.
            EndOfVideoError: The video file has ended.
            CameraNotConnectedError: `connect` was not called, or `disconnect` was called before the frame arrived.
            ValueError: `timeout_ms` is not positive.
        """
        return self._connected().wait(self._timeout_s(timeout_ms), exposed_now=self.config.kind != "file")

    def async_read(self, timeout_ms: float | None = None) -> Captured:
        """Return the oldest frame in the buffer, or wait for the next frame if the buffer is empty.

        The buffer contains the newest frames that have not been returned yet, at most `CameraConfig.buffer` frames. A
        frame may have been exposed before the call.

        Args:
            timeout_ms: Longest wait (ms). None: `CameraConfig.timeout_s`.

        Returns:
            The frame.

        Raises:
            CameraError: There is no frame. See the documentation of `read` for the subclasses of CameraError.
            ValueError: `timeout_ms` is not positive.
        """
        return self._connected().wait(self._timeout_s(timeout_ms), exposed_now=False)

    def read_latest(self, max_age_ms: float = 500.0) -> Captured:
        """Return the newest frame without waiting. The same frame may be returned several times.

        Args:
            max_age_ms: Largest allowed time since the frame's arrival (ms).

        Returns:
            The frame.

        Raises:
            StaleFrameError: The newest frame is older than `max_age_ms`.
            CameraError: There are no frames at present. See the documentation of `read` for the subclasses of
                CameraError.
            ValueError: `max_age_ms` is not positive.
        """
        if not max_age_ms > 0:
            raise ValueError(f"max_age_ms must be > 0, got {max_age_ms}")
        grabber = self._connected()
        frame = grabber.latest()
        age_ms = 1000 * (time.monotonic() - frame.time_s)
        if age_ms > max_age_ms:
            if isinstance(problem := grabber.problem(), EndOfVideoError):
                raise problem
            raise StaleFrameError(
                f"the newest frame of {self.config.name} is {age_ms:.0f} ms old, but at most {max_age_ms:g} ms are "
                "allowed: check the device or the stream's server, or raise max_age_ms."
            )
        return frame

    def _connected(self) -> Grabber:
        if self._grabber is None:
            raise CameraNotConnectedError(f"{self.config.name} is not connected: call connect() first.")
        return self._grabber

    def _timeout_s(self, timeout_ms: float | None) -> float:
        if timeout_ms is None:
            return self.config.timeout_s
        if not timeout_ms > 0:
            raise ValueError(f"timeout_ms must be > 0, got {timeout_ms}")
        return timeout_ms / 1000

    def __enter__(self) -> "OpenCVCamera":
        return self if self._grabber is not None else self.connect()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.disconnect()

    def __repr__(self) -> str:
        return f"OpenCVCamera({self.config.name!r}, {'connected' if self.is_connected else 'not connected'})"


def _with_stable_path(config: CameraConfig) -> CameraConfig:
    """Replace the source of a device by its path in `/dev/v4l/by-id`, if there is one.

    This path contains the camera's serial number, so it is the same after replugging.
    """
    if config.kind != "device":
        return config
    path = device_path(config.target)
    stable = stable_path(path)
    return config if stable == path or not Path(path).exists() else dataclasses.replace(config, source=stable)
