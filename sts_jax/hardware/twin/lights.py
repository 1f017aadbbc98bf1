"""The brightness of the LEDs over time, and its mean over an exposure."""

import bisect
import math
from typing import NamedTuple

from sts_jax.hardware import protocol

_RISEN = 30.0  # time constants after which the target counts as reached, because exp(-30) is 1e-13


class Light(NamedTuple):
    """The brightness of the LEDs during an interval, as a share of their full power, 0 to 1."""

    mean: float  # mean share
    lowest: float  # smallest share
    highest: float  # largest share


class _Change(NamedTuple):
    """A change of the levels. From here to the next change, the brightness goes from `share` to `target`."""

    time_s: float  # time of the change (s)
    share: float  # share of the full power at this time
    target: float  # share of the full power of the new levels


class LightHistory:
    """The brightness of the LEDs over time, as a share of their full power.

    The levels are the settings of the four LEDs, from 0 to 255. If the levels are changed at time t0, the share
    approaches its new value exponentially:

        s(t) = a + (s0 - a) exp(-(t - t0) / tau)

    The symbol `s0` is the share at t0, `a` is the new value of the share, and `tau` is the argument `rise_s`. The new
    value is the mean of the four levels divided by 255. LEDs are dimmed by pulses at 31 kHz. These pulses are far
    shorter than an exposure, so only the mean of the pulses matters. A `LightHistory` is not thread-safe.
    """

    def __init__(self, rise_s: float = 0.0):
        """Start with the lights off.

        Args:
            rise_s: Time constant tau, >= 0 (s). At 0, the brightness follows the levels at once.

        Raises:
            ValueError: `rise_s` is negative or not finite.
        """
        if not 0 <= rise_s < math.inf:
            raise ValueError(f"rise_s must be >= 0 and finite, got {rise_s}")
        self._rise_s = rise_s
        self._changes = [_Change(-math.inf, 0.0, 0.0)]

    def set(self, time_s: float, levels: protocol.Levels) -> None:
        """Record a change of the LED levels. The call is ignored if the mean of the four levels stays the same.

        Args:
            time_s: Time of the change (s), not earlier than the time of the last change.
            levels: Duty cycles of the four LED channels, 0 (off) to 255 (always on).

        Raises:
            ValueError: `time_s` is earlier than the time of the last change.
        """
        last, target = self._changes[-1], sum(levels) / (255 * len(levels))
        if time_s < last.time_s:
            raise ValueError(f"time_s must be at least {last.time_s} s, the time of the last change, got {time_s} s")
        if target != last.target:
            self._changes.append(_Change(time_s, self._share(last, time_s), target))

    def over(self, start_s: float, end_s: float) -> Light:
        """Return the mean, smallest and largest brightness of the LEDs between two times.

        Args:
            start_s: Start of the interval (s).
            end_s: End of the interval (s), later than `start_s`.

        Returns:
            The three values, as shares of the full power of the LEDs, 0 to 1. The mean is the exact integral of the
            brightness over the interval, divided by the length of the interval.

        Raises:
            ValueError: `start_s` is not less than `end_s`.
        """
        if not start_s < end_s:
            raise ValueError(f"start_s must be less than end_s, got start_s = {start_s} and end_s = {end_s}")
        first = bisect.bisect_right(self._changes, start_s, key=lambda change: change.time_s) - 1
        integral, shares = 0.0, []
        for i in range(first, len(self._changes)):
            change = self._changes[i]
            begin = max(start_s, change.time_s)
            end = min(end_s, self._changes[i + 1].time_s) if i + 1 < len(self._changes) else end_s
            if begin >= end:
                break
            low, high = self._share(change, begin), self._share(change, end)
            # The integral of (s0 - a) exp(-(t - t0) / tau) over the interval is tau times its decrease.
            integral += change.target * (end - begin) + self._rise_s * (low - high)
            shares += [low, high]
        lowest, highest = min(shares), max(shares)
        return Light(min(max(integral / (end_s - start_s), lowest), highest), lowest, highest)

    def forget(self, before_s: float) -> None:
        """Delete the changes of the LED levels up to the time `before_s`, except the latest of these changes.

        The latest of these changes is kept, because it determines the brightness at the time `before_s`. After this
        call, the method `over` needs a `start_s` of at least `before_s`.

        Args:
            before_s: Time (s), on the same clock as the argument `time_s` of `set`.
        """
        keep = bisect.bisect_right(self._changes, before_s, key=lambda change: change.time_s) - 1
        del self._changes[:keep]

    def _share(self, change: _Change, time_s: float) -> float:
        """The share of the full power at a time after a change and before the next one."""
        if change.share == change.target or time_s - change.time_s >= _RISEN * self._rise_s:
            return change.target
        return change.target + (change.share - change.target) * math.exp((change.time_s - time_s) / self._rise_s)
