"""Functions that list the cameras of this machine, find the processes that use a camera, and lock a camera."""

import contextlib
import dataclasses
import hashlib
import os
import struct
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from sts_jax import storage
from sts_jax.hardware.camera_config import CameraConfig
from sts_jax.hardware.camera_errors import CameraBusyError, CameraError

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
