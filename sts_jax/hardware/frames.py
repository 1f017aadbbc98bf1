"""`Captured`: one frame of a camera with its time and number. `CameraStatistics`: counts of frames and other events."""

import collections
import dataclasses
import statistics
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8

BLACK = 8  # largest value in a black image (of 255). The noise of dark JPEG images stays below it
_INTERVALS = 61  # number of recent intervals between frames. Their median is the period
_FEWEST = 8  # smallest number of intervals from which the period is measured
_LONG = 2.5  # periods. A frame after a longer interval was delayed
_SHORT = 0.5  # periods. A frame that follows a delayed frame after a shorter interval was delayed too
_MADE_UP = 4  # frames after the missing ones by which a gap may be corrected. More would add up the error of the period


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
