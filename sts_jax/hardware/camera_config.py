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
