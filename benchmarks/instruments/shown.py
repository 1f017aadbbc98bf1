"""The light that a frame of simulated devices shows, by the camera's own log."""

from typing import NamedTuple

_TOLERANCE = 1e-6  # of the share of the light, for what remains of an exponential approach


class Shown(NamedTuple):
    """The light of one frame."""

    number: int  # of the frame
    lowest: float  # share of the lights' power during the exposure: lowest
    highest: float  # and highest value

    def is_of(self, share: float) -> bool:
        """Whether the light had this share during the whole exposure."""
        return share - _TOLERANCE <= self.lowest and self.highest <= share + _TOLERANCE
