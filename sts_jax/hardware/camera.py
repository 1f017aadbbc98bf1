"""`Camera`: what `STS` needs from a camera, with its frames, configuration and errors. `OpenCVCamera` is a backend."""

import collections
import contextlib
import dataclasses
import functools
import re
import statistics
from pathlib import Path
from typing import Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8

BLACK = 8  # largest value in a black image (of 255). The noise of dark JPEG images stays below it

_INTERVALS = 61  # number of recent intervals between frames. Their median is the period
_FEWEST = 8  # smallest number of intervals from which the period is measured
_LONG = 2.5  # periods. A frame after a longer interval was delayed
_SHORT = 0.5  # periods. A frame that follows a delayed frame after a shorter interval was delayed too
_MADE_UP = 4  # frames after the missing ones by which a gap may be corrected. More would add up the error of the period

_URL = re.compile(r"^[a-zA-Z][a-zA-Z0-9+.-]*://")


class CameraError(RuntimeError):
    """A camera failed. The message states the cause and the remedy."""


class CameraTimeoutError(CameraError, TimeoutError):
    """No frame arrived in time."""


class CameraLostError(CameraError):
    """The device or the stream was lost. The camera tries to open it again."""


class FrameSizeError(CameraError):
    """The frames have another size than the configuration, or than earlier frames."""


class FrozenCameraError(CameraError):
    """The camera has sent the same image for longer than `CameraConfig.frozen_after_s`."""


@dataclasses.dataclass(frozen=True, eq=False)
class Captured:
    """One frame of a camera."""

    image: UInt8[np.ndarray, "height width 3"]  # RGB, read-only, row 0 at the top
    time_s: float  # arrival of the frame on the clock `time.monotonic` (s), before it was decoded
    sequence: int  # number of the frame since `connect`, from 0. Damaged and replaced frames count, too
    epoch: int = 0  # number of the connection, starting at 0. It increases when a lost device is found again
    dropped: int = 0  # frames lost just before this frame, estimated from the times
    repeats: int = 0  # number of identical frames just before this frame. 0 if the source may repeat frames
    delayed: bool = False  # True if the frame was delayed, so it may have been exposed long before it arrived

    @functools.cached_property
    def black(self) -> bool:
        """True if no value of the image exceeds 8 of 255. This is no error, because the lights may be off."""
        return bool(self.image.max(initial=0) <= BLACK)


@runtime_checkable
class Camera(Protocol):
    """A camera. Write a class with these methods to read a camera that OpenCV does not support, and pass it to `STS`.

    A backend whose driver can set the exposure also has `set_exposure(exposure) -> float | None`, see `OpenCVCamera`.
    """

    @property
    def source(self) -> str:
        """Name that identifies the camera, and that sessions store."""

    @property
    def is_connected(self) -> bool:
        """True after `connect`."""

    def connect(self, warmup_s: float = 1.0) -> object:
        """Open the camera, and after `warmup_s` (s) keep exposure, white balance and focus constant."""

    def async_read(self, timeout_ms: float | None = None) -> Captured:
        """Return the oldest frame that was not returned yet, or wait for the next one.

        A camera that was lost raises a `CameraLostError` until it is found again.
        """

    def disconnect(self) -> None:
        """Close the camera."""


@dataclasses.dataclass(frozen=True)
class CameraConfig:
    """The configuration of an `OpenCVCamera`."""

    # Index or path of a V4L2 device (best in /dev/v4l/by-id), or URL of a stream (motion JPEG over HTTP, or RTSP)
    source: int | str | Path
    width: int | None = 1640  # width of the images (pixels), None: the width that the source sends
    height: int | None = 1232  # height of the images (pixels), None: the height that the source sends
    fps: float | None = None  # frame rate of a device (frames per second), None: unchanged
    fourcc: str | None = None  # pixel format of a device, such as "MJPG", None: the driver's
    lock: bool = True  # turn off a device's automatic control of exposure, white balance and focus after the warm-up
    exposure: float | None = None  # exposure in the driver's unit (V4L2: 0.1 ms), None: its value after the warm-up
    white_balance: float | None = None  # colour temperature (K), None: its value after the warm-up
    focus: float | None = None  # focus in the driver's unit, None: its value after the warm-up
    timeout_s: float = 5.0  # longest wait for the opening of the source and for each frame (s)
    buffer: int = 1  # number of frames kept for `async_read`. If one more arrives, the oldest is discarded
    frozen_after_s: float | None = 1.0  # time of identical frames after which reading raises an error (s), None: never

    def __post_init__(self) -> None:
        if str(self.source) in ("", ".") or (isinstance(self.source, int) and self.source < 0):
            raise ValueError(f"source must be a device's index >= 0, a path or a URL, got {str(self.source)!r}")
        if (self.width is None) != (self.height is None):
            raise ValueError(f"width and height must both be given or both be None, got {self.width} x {self.height}")
        for name in ("width", "height", "fps", "timeout_s", "buffer", "frozen_after_s"):
            value = getattr(self, name)
            if value is not None and not 0 < value < float("inf"):
                raise ValueError(f"{name} must be > 0 and finite, got {value}")
        if self.fourcc is not None and len(self.fourcc) != 4:
            raise ValueError(f"fourcc must have four characters, such as 'MJPG', got {self.fourcc!r}")

    @property
    def kind(self) -> Literal["device", "stream"]:
        """The kind of the source."""
        return "stream" if _URL.match(str(self.source)) else "device"

    @property
    def path(self) -> str:
        """The path of the device, or the URL of the stream."""
        return f"/dev/video{self.source}" if str(self.source).isdecimal() else str(self.source)

    @property
    def name(self) -> str:
        """The name of the source in messages, without the user name and the password of a URL."""
        return f"camera {self.source}" if str(self.source).isdecimal() else public(self.path)


def public(url: str) -> str:
    """Remove the user name and the password from a URL."""
    return re.sub(r"(?<=://)[^/?#]*@", "", url)


class _Gap(NamedTuple):
    start_s: float  # time of the frame before the interval
    frames: int  # number of frames since this time
    missing: int  # number of missing frames
    limit: int  # number of frames after which `missing` is final


class Pace:
    """Measures the period of a camera's frames, and counts n lost frames after an interval of n + 1 periods.

    Frames that follow in less than one period were only late, and reduce `dropped`.
    """

    def __init__(self, nominal: float | None):
        """Assume `nominal` frames per second until the period is measured."""
        self._nominal = None if nominal is None else 1 / nominal
        self._last: float | None = None
        self._gap: _Gap | None = None
        self._intervals: collections.deque[float] = collections.deque(maxlen=_INTERVALS)
        self.dropped = 0  # number of all lost frames
        self.delayed = False  # True if the last frame was delayed

    @property
    def rate(self) -> float | None:
        """Measured frames per second, or None if too few frames have arrived."""
        return 1 / statistics.median(self._intervals) if len(self._intervals) >= _FEWEST else None

    def arrived(self, time_s: float) -> int:
        """Record a frame, and estimate how many were lost just before it. Late frames are not subtracted from this."""
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
        if not (self.delayed and periods < _SHORT and self._gap is not None):
            # the intervals between frames that a network held back are not those of the camera
            self._intervals.append(time_s - last)
        missing = max(round(periods) - 1, 0)
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
        """Begin anew after a lost connection. The next frame counts as delayed, because it may have waited."""
        self._last, self._gap, self.delayed = None, None, True


@dataclasses.dataclass(frozen=True)
class FoundCamera:
    """A camera that `find_cameras` has found."""

    source: str  # most stable path of the camera, which `CameraConfig` accepts as its source
    name: str  # name that the driver gives the camera

    def __str__(self) -> str:
        return f"{self.source} ({self.name})"


def find_cameras(root: Path = Path("/")) -> list[FoundCamera]:
    """List the V4L2 cameras of this machine by number. The list is empty on other systems than Linux."""
    cameras = []
    for device in sorted((root / "dev").glob("video[0-9]*"), key=lambda path: (len(path.name), path.name)):
        properties = root / "sys/class/video4linux" / device.name
        if _text(properties / "index") in ("", "0"):  # the others deliver a camera's metadata
            cameras.append(FoundCamera(stable_path(str(device), root), _text(properties / "name") or "unnamed"))
    return cameras


def stable_path(device: str, root: Path = Path("/")) -> str:
    """Return the path of a device in `/dev/v4l/by-id`, which survives replugging, or `device` if there is none."""
    links = sorted((root / "dev/v4l/by-id").glob("*"))
    return next((str(link) for link in links if link.resolve() == Path(device).resolve()), device)


def _text(path: Path) -> str:
    with contextlib.suppress(OSError):
        return path.read_text(errors="replace").strip()
    return ""
