"""The light that a frame of simulated devices shows, by the camera's own log."""

from typing import NamedTuple

_TOLERANCE = (
    1e-3  # of the lights' power. The twin's read noise is 1.5e-3, and its light approaches a new level for ever
)


class Shown(NamedTuple):
    """The light of one frame."""

    number: int  # of the frame
    light: float  # mean share of the lights' power during the exposure

    def is_of(self, share: float) -> bool:
        """Whether the light had this share during the exposure."""
        return abs(self.light - share) <= _TOLERANCE
