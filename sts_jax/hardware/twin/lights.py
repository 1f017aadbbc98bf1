"""The light of the LEDs over time, and its mean over an exposure."""

import bisect
import math
from typing import NamedTuple

from sts_jax.hardware import protocol

_RISEN = 30.0  # rise times after which the target is reached, to 1e-13


class Light(NamedTuple):
    """The share of the LEDs' full power during an interval, 0 to 1."""

    mean: float
    lowest: float
    highest: float


class _Change(NamedTuple):
    """The share from one change of the levels to the next: it approaches `target` from `share`."""

    time_s: float
    share: float
    target: float


class LightHistory:
    """The levels of the LEDs over time.

    After a change at time t0, the share of the full power approaches its target a exponentially from s0:

        share(t) = a + (s0 - a) exp(-(t - t0) / rise)

    The share of a state is the mean of its four levels over 255. The pulses of the modulation (31 kHz) are far shorter
    than an exposure and therefore count with their mean. The object is not thread-safe.
    """

    def __init__(self, rise_s: float = 0.0):
        """Start with the lights off.

        Args:
            rise_s: Time constant of the approach (s). At 0 the light follows the levels at once.
        """
        if not 0 <= rise_s < math.inf:
            raise ValueError(f"rise_s must be >= 0 and finite, got {rise_s}")
        self._rise_s = rise_s
        self._changes = [_Change(-math.inf, 0.0, 0.0)]

    def set(self, time_s: float, levels: protocol.Levels) -> None:
        """Record the levels from a time on (s). Times must not decrease. Unchanged levels are ignored.

        Raises:
            ValueError: The time is before that of the last change.
        """
        last, target = self._changes[-1], sum(levels) / (255 * len(levels))
        if time_s < last.time_s:
            raise ValueError(f"time_s must be at least that of the last change, {last.time_s}, got {time_s}")
        if target != last.target:
            self._changes.append(_Change(time_s, self._share(last, time_s), target))

    def over(self, start_s: float, end_s: float) -> Light:
        """The mean (an exact integral), lowest and highest share between two times (s).

        Raises:
            ValueError: The interval is empty.
        """
        if not start_s < end_s:
            raise ValueError(f"start_s must be less than end_s, got {start_s} and {end_s}")
        first = bisect.bisect_right(self._changes, start_s, key=lambda change: change.time_s) - 1
        integral, shares = 0.0, []
        for i in range(first, len(self._changes)):
            change = self._changes[i]
            begin = max(start_s, change.time_s)
            end = min(end_s, self._changes[i + 1].time_s) if i + 1 < len(self._changes) else end_s
            if begin >= end:
                break
            low, high = self._share(change, begin), self._share(change, end)
            # The integral of the exponential is the rise time times its difference.
            integral += change.target * (end - begin) + self._rise_s * (low - high)
            shares += [low, high]
        lowest, highest = min(shares), max(shares)
        return Light(min(max(integral / (end_s - start_s), lowest), highest), lowest, highest)

    def forget(self, before_s: float) -> None:
        """Drop the changes that no interval after a time (s) needs."""
        keep = bisect.bisect_right(self._changes, before_s, key=lambda change: change.time_s) - 1
        del self._changes[:keep]

    def _share(self, change: _Change, time_s: float) -> float:
        if change.share == change.target or time_s - change.time_s >= _RISEN * self._rise_s:
            return change.target
        return change.target + (change.share - change.target) * math.exp((change.time_s - time_s) / self._rise_s)
