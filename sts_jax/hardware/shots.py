"""`Shot` and `Pair`: images that are proven to be of one light, and the errors where none can be taken."""

import dataclasses
from typing import Literal

import numpy as np
from jaxtyping import UInt8

from sts_jax.hardware.leds import Lit

Stream = Literal["visual", "tactile"]


class LightError(RuntimeError):
    """No image of the wanted light could be taken in time."""


class NotStillError(TimeoutError):
    """The view did not come to rest in time."""


@dataclasses.dataclass(frozen=True, eq=False)
class Shot:
    """An image of one stream.

    The lights were the same without interruption from `before.acknowledged_s` until `until_s`, and the frame arrived
    between both, later than the settling time after the former.
    """

    image: UInt8[np.ndarray, "height width 3"]  # RGB, raw and uncropped, read-only
    stream: Stream
    time_s: float  # arrival of the frame, on the clock `time.monotonic` (s)
    sequence: int  # number of the frame
    epoch: int  # number of the camera's connection
    before: Lit  # the controller's answer before the frame
    until_s: float  # time until which the controller's later answer proves the lights unchanged (s)


@dataclasses.dataclass(frozen=True, eq=False)
class Pair:
    """Both streams of one moment."""

    visual: Shot
    tactile: Shot
