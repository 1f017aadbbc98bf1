"""`Captured`: one frame of a camera with its time and number, and the statistics of all frames."""

import collections
import dataclasses
import statistics
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8

BLACK = 8  # largest value of an image that counts as black. The noise of dark JPEG images stays below it
_INTERVALS = 61  # recent intervals between frames, of which the median is the period
_FEWEST = 8  # intervals from which a period is measured
_LONG, _SHORT = 2.5, 0.5  # periods: a frame that comes later was held back, and so were those that follow it sooner
_MADE_UP = 4  # frames after late ones that may still be early. More would add up the error of the period


@dataclasses.dataclass(frozen=True, eq=False)
class Captured:
    """One frame of a camera.

    The clock is `time.monotonic`. Numbers that are missing between two frames belong to frames that were not fetched
    or that were discarded as damaged.
    """

    image: UInt8[np.ndarray, "height width 3"]  # RGB, read-only, row 0 at the top
    time_s: float  # arrival of the frame (s), before it was decoded
    sequence: int  # number of the frame since `connect`, from 0
    epoch: int  # number of the connection, from 0. It changes when a lost device is found again
    dropped: int  # frames that the camera lost just before this one, estimated from the times
    repeats: int  # frames just before this one that are identical with it
    black: bool  # whether the image is black, see `is_black`
    held_back: bool = False  # whether it may be older than its arrival: it came late, or together with one that did


@dataclasses.dataclass(frozen=True)
class CameraStatistics:
    """Counts since `connect`."""

    frames: int = 0  # complete frames
    dropped: int = 0  # frames that the camera or the driver lost, estimated from the times
    skipped: int = 0  # complete frames that were replaced before `async_read` fetched them
    damaged: int = 0  # frames that could not be decoded
    wrong_size: int = 0  # frames of another size
    repeated: int = 0  # frames identical with the one before
    black: int = 0  # black frames
    losses: int = 0  # losses of the device or the stream
    rate: float | None = None  # frames per second, from the median interval of recent frames, None: not yet measured


def is_black(image: UInt8[np.ndarray, "height width 3"]) -> bool:
    """Whether no value of an image exceeds 8 of 255. The lights may be off, so this is no error."""
    return bool(image.max(initial=0) <= BLACK)


class _Gap(NamedTuple):
    """Frames that are missing after a long interval."""

    start_s: float  # the frame before the interval
    frames: int  # frames since then
    missing: int
    limit: int  # frames after which it is final


class Pace:
    """The period of the frames, and the frames that are missing between them.

    A gap of n + 1 periods counts as n lost frames. If the frames after the gap arrive early enough to make up for it,
    they were only late, and `dropped` is corrected. The number that `arrived` has returned for the first of them stays.
    """

    def __init__(self, nominal: float | None):
        """Start without frames.

        Args:
            nominal: frames per second until the period is measured, or None if they are unknown.
        """
        self._nominal = None if nominal is None else 1 / nominal
        self._last: float | None = None
        self._gap: _Gap | None = None
        self._intervals: collections.deque[float] = collections.deque(maxlen=_INTERVALS)
        self.dropped = 0
        self.held_back = False  # whether the last frame came after 2.5 periods or more, or together with one that did

    @property
    def rate(self) -> float | None:
        """Measured frames per second, or None if too few frames have arrived."""
        return 1 / statistics.median(self._intervals) if len(self._intervals) >= _FEWEST else None

    def arrived(self, time_s: float) -> int:
        """Record a frame and return the estimated number of frames lost before it."""
        last, self._last = self._last, time_s
        if last is None or time_s <= last:
            return 0
        period = 1 / self.rate if self.rate is not None else self._nominal
        self._intervals.append(time_s - last)
        if period is None:
            return 0
        periods = (time_s - last) / period
        self.held_back = periods > _LONG or (self.held_back and periods < _SHORT)
        missing = max(round((time_s - last) / period) - 1, 0)
        if missing:
            self._gap = _Gap(last, 1, missing, missing + _MADE_UP)
            self.dropped += missing
        elif self._gap is not None:
            self._make_up(self._gap, time_s, period)
        return missing

    def _make_up(self, gap: _Gap, time_s: float, period: float) -> None:
        """Correct a gap by the frames that came after it."""
        frames = gap.frames + 1
        missing = min(max(round((time_s - gap.start_s) / period) - frames, 0), gap.missing)
        self.dropped -= gap.missing - missing
        self._gap = gap._replace(frames=frames, missing=missing) if missing and frames < gap.limit else None

    def interrupted(self) -> None:
        """Forget the last frame, because the connection was interrupted."""
        self._last, self._gap, self.held_back = None, None, False
