"""The light under which an emulated camera took a frame, from the camera's own log."""

from typing import NamedTuple

# Share of the lights' full power. The twin's LEDs approach a new level exponentially, so a tolerance is needed. It is
# below the twin's read noise of 1.5e-3.
_TOLERANCE = 1e-3


class Shown(NamedTuple):
    """The number of a frame, and the mean light during its exposure."""

    number: int  # number of the frame
    light: float  # mean light during the exposure, as a share of the full power

    def is_of(self, share: float) -> bool:
        """Return True if the mean light during the exposure differs from `share` by at most 0.001 of the full power."""
        return abs(self.light - share) <= _TOLERANCE
