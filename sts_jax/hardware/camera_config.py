"""`CameraConfig`: the source of a camera's frames, their size, and the settings that are locked."""

import dataclasses
import math
import re
from pathlib import Path
from typing import Literal

Kind = Literal["device", "stream", "file"]

_URL = re.compile(r"^[a-zA-Z][a-zA-Z0-9+.-]*://")


@dataclasses.dataclass(frozen=True)
class CameraConfig:
    """The configuration of a `Camera`.

    The source is a V4L2 device (its index or a path below `/dev`), the URL of a stream (motion JPEG over HTTP, or
    RTSP), or a video file. Prefer paths in `/dev/v4l/by-id`, because indices change when devices are replugged.

    Raises:
        ValueError: a value is out of range.
    """

    source: int | str | Path
    width: int | None = 1640  # pixels, None: as the source has it
    height: int | None = 1232  # pixels, None: as the source has it
    fps: float | None = None  # frames per second, None: the device's. Of a video file: the rate at which it is played
    fourcc: str | None = None  # pixel format of a device, such as "MJPG", None: the driver's
    lock: bool = True  # turn off automatic exposure, white balance and focus
    exposure: float | None = None  # in the driver's unit (V4L2: 0.1 ms), None: its value after the warm-up
    gain: float | None = None  # in the driver's unit, None: unchanged
    white_balance: float | None = None  # K, None: its value after the warm-up
    focus: float | None = None  # in the driver's unit, None: its value after the warm-up
    timeout_s: float = 5.0  # s, longest wait for the source when it is opened and for each frame
    buffer: int = 1  # frames kept for `async_read`. When it is full, the oldest frame is discarded
    in_flight: int = 2  # frames that exposure and transfer may hold at once. `read` discards as many
    frozen_after_s: float | None = 1.0  # s of identical frames after which the camera is frozen, None: never
    realtime: bool = True  # play a video file at its own rate. False: as fast as it is read, without loss

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
            raise ValueError(f"in_flight must be >= 0, got {self.in_flight}")
        if self.fourcc is not None and len(self.fourcc) != 4:
            raise ValueError(f"fourcc must have four characters, such as 'MJPG', got {self.fourcc!r}")

    @property
    def target(self) -> int | str:
        """The source as an index, a path or a URL. Digits in a string are an index."""
        if isinstance(self.source, int):
            return self.source
        text = str(self.source)
        return int(text) if text.isdecimal() and not Path(text).exists() else text

    @property
    def kind(self) -> Kind:
        """Whether the source is a device, a stream or a file."""
        if isinstance(self.target, int):
            return "device"
        if _URL.match(self.target):
            return "stream"
        return "device" if self.target.startswith("/dev/") or Path(self.target).is_char_device() else "file"

    @property
    def public(self) -> str:
        """The source without the user name and password of a URL."""
        return re.sub(r"(?<=://)[^/@]*@", "", str(self.target))

    @property
    def name(self) -> str:
        """The source for messages. A password in a URL is hidden."""
        if isinstance(self.target, int):
            return f"camera {self.target}"
        return re.sub(r"(?<=://)[^/@]*@", "***@", self.target)
