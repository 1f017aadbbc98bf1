"""Cameras: configuration, frames, errors, and the list of the cameras of this machine."""

import contextlib
import dataclasses
import hashlib
import math
import os
import re
import struct
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import UInt8

from sts_jax import storage


class CameraError(RuntimeError):
    """A camera failed. This is the base class of all errors of the camera."""


class CameraNotFoundError(CameraError):
    """There is no such device, file or host. For a device, the message lists the cameras that were found."""


class CameraPermissionError(CameraError):
    """The user is not allowed to open the device or the file."""


class CameraBusyError(CameraError):
    """Another process, or another part of this process, uses the camera. The message names the process."""


class CameraOpenError(CameraError):
    """The source exists, but it cannot be opened as a camera or a video."""


class CameraNotConnectedError(CameraError):
    """The method `connect` was not called, or `disconnect` was called during the call of another method."""


class CameraTimeoutError(CameraError, TimeoutError):
    """No frame arrived in time."""


class CameraLostError(CameraError):
    """The device or the stream was lost. The camera's background thread tries to open the lost source again."""


class FrameSizeError(CameraError):
    """The size of the camera's frames differs from the configured size, or from the size of earlier frames."""


class FrozenCameraError(CameraError):
    """The camera has sent the same image for longer than `CameraConfig.frozen_after_s`."""


class StaleFrameError(CameraError):
    """The newest frame is older than the caller allows, or there is no frame yet."""


class EndOfVideoError(CameraError):
    """The video file or the recording has no more frames."""


Kind = Literal["device", "stream", "file"]

_URL = re.compile(r"^[a-zA-Z][a-zA-Z0-9+.-]*://")


@dataclasses.dataclass(frozen=True)
class CameraConfig:
    """The configuration of a `Camera`.

    The source is a V4L2 device (its index or a path below `/dev`), the URL of a stream (motion JPEG over HTTP, or
    RTSP), or the path of a video file. Prefer a path in `/dev/v4l/by-id` to an index, because indices change when
    devices are replugged.

    Raises:
        ValueError: A value is out of range.
    """

    source: int | str | Path  # index or path of a device, URL of a stream, or path of a video file
    width: int | None = 1640  # width of the images (pixels), None: the width that the source sends
    height: int | None = 1232  # height of the images (pixels), None: the height that the source sends
    fps: float | None = None  # rate of a device, or playback rate of a video file (frames per second), None: unchanged
    fourcc: str | None = None  # pixel format of a device, such as "MJPG", None: the driver's
    lock: bool = True  # turn off a device's automatic control of exposure, white balance and focus after the warm-up
    exposure: float | None = None  # exposure in the driver's unit (V4L2: 0.1 ms), None: its value after the warm-up
    gain: float | None = None  # gain in the driver's unit, None: unchanged
    white_balance: float | None = None  # colour temperature (K), None: its value after the warm-up
    focus: float | None = None  # focus in the driver's unit, None: its value after the warm-up
    timeout_s: float = 5.0  # longest wait for the opening of the source and for each frame (s)
    buffer: int = 1  # number of frames kept for `async_read`. If one more arrives, the oldest is discarded
    in_flight: int = 2  # number of frames that may be in exposure or transfer at once. `read` discards as many frames
    frozen_after_s: float | None = 1.0  # time of identical frames after which reading raises an error (s), None: never
    realtime: bool = True  # play a video file in real time. False: each frame waits until it is read, and none is lost

    def __post_init__(self) -> None:
        if isinstance(self.source, bool) or (isinstance(self.source, int) and self.source < 0):
            raise ValueError(f"source must be a device's index >= 0, a path or a URL, got {self.source!r}")
        if str(self.source) in ("", "."):
            raise ValueError("source is empty: give a device's index, a path or a URL")
        if (self.width is None) != (self.height is None):
            raise ValueError(f"width and height must both be given or both be None, got {self.width} x {self.height}")
        for name in ("width", "height", "buffer"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"{name} must be >= 1, got {value}")
        for name in ("fps", "timeout_s", "frozen_after_s"):
            value = getattr(self, name)
            if value is not None and not (value > 0 and math.isfinite(value)):
                raise ValueError(f"{name} must be > 0 and finite, got {value}")
        if self.in_flight < 0:
            raise ValueError(
                f"in_flight must be >= 0, got {self.in_flight}: give the number of frames that can be "
                "exposed or transferred at the same time"
            )
        if self.fourcc is not None and len(self.fourcc) != 4:
            raise ValueError(f"fourcc must have four characters, such as 'MJPG', got {self.fourcc!r}")

    @property
    def target(self) -> int | str:
        """The source as an index, a path or a URL. A string of digits is an index, unless a file has this name."""
        if isinstance(self.source, int):
            return self.source
        text = str(self.source)
        return int(text) if text.isdecimal() and not Path(text).exists() else text

    @property
    def kind(self) -> Kind:
        """The kind of the source: "device", "stream" or "file" (a video file)."""
        if isinstance(self.target, int):
            return "device"
        if _URL.match(self.target):
            return "stream"
        return "device" if self.target.startswith("/dev/") or Path(self.target).is_char_device() else "file"

    @property
    def public(self) -> str:
        """The source as text. If the source is a URL, the user name and the password are left out."""
        return re.sub(r"(?<=://)[^/@]*@", "", str(self.target))

    @property
    def name(self) -> str:
        """The name that messages use for the source. The user name and the password in a URL are replaced by ***."""
        if isinstance(self.target, int):
            return f"camera {self.target}"
        return re.sub(r"(?<=://)[^/@]*@", "***@", self.target)


BLACK = 8  # largest value in a black image (of 255). The noise of dark JPEG images stays below it


@dataclasses.dataclass(frozen=True, eq=False)
class Captured:
    """One frame of a camera.

    Each frame that arrives has the next `sequence` number. If a number is missing between two returned frames, a frame
    arrived but was not returned, for example because it was damaged or replaced by a newer frame.
    """

    image: UInt8[np.ndarray, "height width 3"]  # RGB, read-only, row 0 at the top
    time_s: float  # arrival of the frame on the clock `time.monotonic` (s), before it was decoded
    sequence: int  # number of the frame since `Camera.connect`, starting at 0
    epoch: int  # number of the connection, starting at 0. It increases when a lost device is found again
    dropped: int  # frames lost just before this frame, estimated from the times, or skipped in a video file
    repeats: int  # number of frames just before this frame that are identical to it
    black: bool  # True if no value of the image exceeds 8 of 255
    delayed: bool = False  # True if the frame was delayed, so it may have been exposed long before it arrived


@dataclasses.dataclass(frozen=True)
class CameraStatistics:
    """Counts of frames, lost connections and other events since `Camera.connect`."""

    frames: int = 0  # frames that were complete, of the right size and not frozen
    dropped: int = 0  # frames that camera or driver lost, estimated from the times, or frames skipped in a video file
    skipped: int = 0  # frames that were replaced by newer frames before they were read
    damaged: int = 0  # frames that could not be decoded
    wrong_size: int = 0  # frames of another size
    repeated: int = 0  # frames identical to the frame before
    black: int = 0  # black frames
    losses: int = 0  # losses of the device or the stream
    rate: float | None = None  # frames per second, from the median interval of recent frames. None: not measured yet


def is_black(image: UInt8[np.ndarray, "height width 3"]) -> bool:
    """Return whether an image is black: none of its values exceeds 8 of 255.

    A black image is not an error, because the lights may be off.

    Args:
        image: The image.
    """
    return bool(image.max(initial=0) <= BLACK)


_QUERYCAP = 0x80685600  # VIDIOC_QUERYCAP
_CAPABILITY = struct.Struct("=16s32s32s3I12x")  # struct v4l2_capability
_CAPTURES = 0x1 | 0x1000  # V4L2_CAP_VIDEO_CAPTURE, V4L2_CAP_VIDEO_CAPTURE_MPLANE
_OWN = 0x80000000  # V4L2_CAP_DEVICE_CAPS: the third number describes this device alone, and not the whole camera


@dataclasses.dataclass(frozen=True)
class FoundCamera:
    """A camera that `find_cameras` has found: its path, its name, and the processes that use it."""

    source: str  # most stable path of the camera, which `CameraConfig` accepts as its source
    device: str  # path that `source` points to, such as /dev/video0
    name: str  # name that the driver gives the camera
    users: tuple[int, ...]  # ids of the processes that have opened it, as far as this user may see them

    def __str__(self) -> str:
        busy = f", in use by process {', '.join(map(str, self.users))}" if self.users else ""
        return f"{self.source} ({self.name}{busy})"


def find_cameras(root: Path = Path("/")) -> list[FoundCamera]:
    """List the V4L2 cameras of this machine. The list is empty on other systems than Linux.

    The `source` of a camera is its path in `/dev/v4l/by-id`, which contains the serial number. If there is no such
    path, the source is its path in `/dev/v4l/by-path`, which contains the USB port. If both are missing, the source is
    the path of the device itself, such as `/dev/video0`. Devices that deliver no images, such as those for a camera's
    metadata, are left out.

    Args:
        root: Folder that contains the system's folders `dev` and `sys`. Only tests pass another folder.

    Returns:
        The cameras, in the order of the numbers in `/dev/video0`, `/dev/video1` and so on.
    """
    names: dict[Path, Path] = {}
    for folder in ("by-id", "by-path"):
        for link in sorted((root / "dev/v4l" / folder).glob("*")):
            names.setdefault(link.resolve(), link)
    found = []
    for device in sorted((root / "dev").glob("video[0-9]*"), key=lambda path: (len(path.name), path.name)):
        properties = root / "sys/class/video4linux" / device.name
        if _captures(device, properties):
            name = _text(properties / "name") or "unnamed"
            found.append(FoundCamera(str(names.get(device.resolve(), device)), str(device), name, users_of(device)))
    return found


def stable_path(device: str, root: Path = Path("/")) -> str:
    """Return the path of a device in `/dev/v4l/by-id`, or `device` if this folder does not list the device.

    Args:
        device: Path of the device, such as `/dev/video0`.
        root: Folder that contains the system's folder `dev`. Only tests pass another folder.
    """
    target = Path(device).resolve()
    for link in sorted((root / "dev/v4l/by-id").glob("*")):
        if link.resolve() == target:
            return str(link)
    return device


def cameras_found() -> str:
    """List the cameras of this machine in a sentence for error messages."""
    found = find_cameras()
    if found:
        return f"Cameras found: {', '.join(map(str, found))}."
    return "No cameras were found: connect one, then look for it with `sts_jax.hardware.find_cameras()`."


def users_of(device: Path) -> tuple[int, ...]:
    """Return the ids of the processes that have opened a device.

    Processes of other users may be missing. On systems other than Linux, the result is empty.
    """
    target, users = os.path.realpath(device), []
    for folder in Path("/proc").glob("[0-9]*/fd"):
        with contextlib.suppress(OSError):  # the process has ended, or another user runs it
            if any(_points_to(link, target) for link in folder.iterdir()):
                users.append(int(folder.parent.name))
    return tuple(sorted(users))


@contextlib.contextmanager
def locked(config: CameraConfig) -> Iterator[None]:
    """Lock a camera while the context is active, so that no other `Camera` object can use it.

    Devices and network streams are locked. If the source of `config` is a video file, nothing is locked.

    Args:
        config: Configuration of the camera.

    Raises:
        CameraBusyError: Another process, or another part of this process, has reserved the camera.
        CameraError: The lock file cannot be created.
    """
    with contextlib.ExitStack() as stack:
        if config.kind != "file":
            folder = _lock_folder(config)
            try:
                stack.enter_context(storage.lock(folder))
            except storage.LockedError:
                raise CameraBusyError(
                    f"{config.name} is in use by {_text(folder / storage.OWNER) or 'another process'}: disconnect the "
                    "camera in that process, or choose another camera."
                ) from None
            except OSError as error:
                raise CameraError(
                    f"cannot lock {config.name} ({error}): set the environment variable XDG_RUNTIME_DIR to a folder "
                    "that can be written to."
                ) from error
        yield


def device_path(target: int | str) -> str:
    """Return the path of a V4L2 device, given its index or its path."""
    return f"/dev/video{target}" if isinstance(target, int) else target


def _lock_folder(config: CameraConfig) -> Path:
    """Return the folder that stands for a camera in `storage.lock`. All names of one device have the same folder."""
    key = os.path.realpath(device_path(config.target)) if config.kind == "device" else str(config.target)
    base = os.environ.get("XDG_RUNTIME_DIR")
    user = os.getuid() if sys.platform != "win32" else os.environ.get("USERNAME", "user")
    parent = Path(base) / "sts_jax" if base else Path(tempfile.gettempdir()) / f"sts_jax-{user}"
    return parent / f"camera-{hashlib.sha256(key.encode()).hexdigest()[:16]}"


def _captures(device: Path, properties: Path) -> bool:
    """Return whether a device delivers images.

    The driver is asked. If it does not answer, only a device with index 0 or without an index is assumed to do so.
    """
    with contextlib.suppress(OSError, ImportError):
        import fcntl  # not on Windows

        descriptor = os.open(device, os.O_RDWR | os.O_NONBLOCK)
        try:
            return captures(fcntl.ioctl(descriptor, _QUERYCAP, bytes(_CAPABILITY.size)))
        finally:
            os.close(descriptor)
    return _text(properties / "index") in ("", "0")


def captures(capability: bytes) -> bool:
    """Return whether the bytes of a `struct v4l2_capability` describe a device that delivers images."""
    *_, whole, own = _CAPABILITY.unpack(capability)
    return bool((own if whole & _OWN else whole) & _CAPTURES)


def _points_to(link: Path, target: str) -> bool:
    with contextlib.suppress(OSError):
        return os.readlink(link) == target
    return False


def _text(path: Path) -> str:
    """Return the text of a small file, or an empty string if it cannot be read."""
    with contextlib.suppress(OSError):
        return path.read_text(errors="replace").strip()
    return ""
