"""Cameras of this machine: finding them, the processes that use them, and one lock per camera."""

import contextlib
import dataclasses
import hashlib
import os
import struct
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from sts_jax import _files
from sts_jax.hardware.camera_config import CameraConfig
from sts_jax.hardware.camera_errors import CameraBusyError, CameraError

_QUERYCAP = 0x80685600  # VIDIOC_QUERYCAP
_CAPABILITY = struct.Struct("=16s32s32s3I12x")  # struct v4l2_capability
_CAPTURES = 0x1 | 0x1000  # V4L2_CAP_VIDEO_CAPTURE, V4L2_CAP_VIDEO_CAPTURE_MPLANE
_OWN = 0x80000000  # V4L2_CAP_DEVICE_CAPS: the third number holds the capabilities of this node alone


@dataclasses.dataclass(frozen=True)
class FoundCamera:
    """A camera of this machine."""

    source: str  # for `CameraConfig`: the most stable path of the device
    device: str  # the path that `source` points to, such as /dev/video0
    name: str  # the driver's name
    users: tuple[int, ...]  # process ids that have opened it, as far as this user may see them

    def __str__(self) -> str:
        busy = f", in use by process {', '.join(map(str, self.users))}" if self.users else ""
        return f"{self.source} ({self.name}{busy})"


def find_cameras(root: Path = Path("/")) -> list[FoundCamera]:
    """List the V4L2 cameras of this machine. Linux only, elsewhere the list is empty.

    A camera is named by its path in `/dev/v4l/by-id`, which contains its serial number. A camera without one is named
    by its USB port (`/dev/v4l/by-path`), else by its number (`/dev/video0`). Nodes that carry no images are left out.

    Args:
        root: the folder that contains `dev` and `sys`.
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
    """The path in `/dev/v4l/by-id` of a device, or the given path if there is none."""
    target = Path(device).resolve()
    for link in sorted((root / "dev/v4l/by-id").glob("*")):
        if link.resolve() == target:
            return str(link)
    return device


def cameras_found() -> str:
    """The cameras of this machine, as a sentence for messages."""
    found = find_cameras()
    if found:
        return f"Cameras found: {', '.join(map(str, found))}."
    return "No cameras were found: connect one, then look for it with `sts_jax.hardware.find_cameras()`."


def users_of(device: Path) -> tuple[int, ...]:
    """The ids of the processes that have opened a device. Linux only, elsewhere empty."""
    target, users = os.path.realpath(device), []
    for folder in Path("/proc").glob("[0-9]*/fd"):
        with contextlib.suppress(OSError):  # the process has ended, or belongs to another user
            if any(_points_to(link, target) for link in folder.iterdir()):
                users.append(int(folder.parent.name))
    return tuple(sorted(users))


@contextlib.contextmanager
def locked(config: CameraConfig) -> Iterator[None]:
    """Hold the lock of a device or a stream. Video files have none.

    Raises:
        CameraBusyError: another process, or another part of this one, holds it.
        CameraError: the lock cannot be created.
    """
    with contextlib.ExitStack() as stack:
        if config.kind != "file":
            folder = _lock_folder(config)
            try:
                stack.enter_context(_files.lock(folder))
            except _files.LockedError:
                raise CameraBusyError(
                    f"{config.name} is in use by {_text(folder / _files.OWNER) or 'another process'}: disconnect it "
                    "there, or choose another camera."
                ) from None
            except OSError as error:
                raise CameraError(
                    f"cannot lock {config.name} ({error}): set XDG_RUNTIME_DIR to a folder that can be written to."
                ) from error
        yield


def device_path(target: int | str) -> str:
    """The path of a V4L2 device, given its index or path."""
    return f"/dev/video{target}" if isinstance(target, int) else target


def _lock_folder(config: CameraConfig) -> Path:
    """The folder that is locked. All names of one device lead to the same folder."""
    key = os.path.realpath(device_path(config.target)) if config.kind == "device" else str(config.target)
    base = os.environ.get("XDG_RUNTIME_DIR")
    user = os.getuid() if sys.platform != "win32" else os.environ.get("USERNAME", "user")
    parent = Path(base) / "sts_jax" if base else Path(tempfile.gettempdir()) / f"sts_jax-{user}"
    return parent / f"camera-{hashlib.sha256(key.encode()).hexdigest()[:16]}"


def _captures(device: Path, properties: Path) -> bool:
    """Whether a node delivers images, by the driver's answer, or if it has none by the node's place in the camera."""
    with contextlib.suppress(OSError, ImportError):
        import fcntl  # not on Windows

        descriptor = os.open(device, os.O_RDWR | os.O_NONBLOCK)
        try:
            return captures(fcntl.ioctl(descriptor, _QUERYCAP, bytes(_CAPABILITY.size)))
        finally:
            os.close(descriptor)
    return _text(properties / "index") in ("", "0")


def captures(capability: bytes) -> bool:
    """Whether a `struct v4l2_capability` describes a node that delivers images."""
    *_, whole, own = _CAPABILITY.unpack(capability)
    return bool((own if whole & _OWN else whole) & _CAPTURES)


def _points_to(link: Path, target: str) -> bool:
    with contextlib.suppress(OSError):
        return os.readlink(link) == target
    return False


def _text(path: Path) -> str:
    """The content of a small file, or nothing if it cannot be read."""
    with contextlib.suppress(OSError):
        return path.read_text(errors="replace").strip()
    return ""
