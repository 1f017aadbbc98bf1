"""Opening a camera, a stream or a video file through OpenCV, with errors that name the cause."""

import contextlib
import http.client
import math
import os
import socket
import sys
import urllib.parse
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from sts_jax.hardware import devices
from sts_jax.hardware.camera_config import CameraConfig
from sts_jax.hardware.camera_errors import (
    CameraBusyError,
    CameraError,
    CameraNotFoundError,
    CameraOpenError,
    CameraPermissionError,
    FrameSizeError,
)

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
            return cv2.VideoCapture(devices.device_path(config.target), cv2.CAP_V4L2)
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
        path = devices.device_path(config.target)
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
    path = Path(devices.device_path(config.target))
    device = config.kind == "device"
    if not path.exists():
        remedy = devices.cameras_found() if device else f"Check the path (the working directory is {Path.cwd()})."
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
        raise CameraOpenError(f"{path} is not a camera. {devices.cameras_found()}")
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
    users = devices.users_of(Path(devices.device_path(config.target))) if sys.platform == "linux" else ()
    if users:
        return CameraBusyError(
            f"{config.name} is in use by process {', '.join(map(str, users))}: end this process, or choose another "
            "camera."
        )
    return CameraOpenError(
        f"{config.name} cannot be opened as a camera: it may deliver no images, or a process of another user may use "
        f"it. {devices.cameras_found()}"
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
