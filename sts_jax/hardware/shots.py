"""`Shot` and `Pair`: images, each with the start and the end of a time interval in which the lights did not change."""

import dataclasses
from typing import Literal

import numpy as np
from jaxtyping import UInt8

from sts_jax.hardware.leds import Lit

Stream = Literal["visual", "tactile"]


class LightError(RuntimeError):
    """No image with the requested lights could be taken in time, or the settling times could not be measured.

    The lights must be off in a visual image and on in a tactile image. The settling time is the time after a switch of
    the lights during which frames may still show the previous state of the lights.
    """


class NotStillError(TimeoutError):
    """The visual stream did not become still in time, because something in the view moved or changed."""


@dataclasses.dataclass(frozen=True, eq=False)
class Shot:
    """An image of the visual stream (lights off) or of the tactile stream (lights on).

    The field `before` is the LED controller's answer to the last switch of the lights before the image. The answer
    arrived at the time `before.acknowledged_s`. The lights did not change between this time and the time `until_s`. The
    frame arrived between these two times, at least one settling time after `before.acknowledged_s`. Frames that arrive
    during the settling time may still show the previous levels of the lights.
    """

    image: UInt8[np.ndarray, "height width 3"]  # RGB, raw and uncropped, read-only
    stream: Stream
    time_s: float  # arrival of the frame, on the clock `time.monotonic` (s)
    sequence: int  # number of the frame since the camera was connected
    epoch: int  # number of the camera's connection, which changes when a lost camera is found again
    before: Lit  # the controller's answer to the switch of the lights before the frame
    until_s: float  # time until which the lights did not change (s). The controller's next answer proves this


@dataclasses.dataclass(frozen=True, eq=False)
class Pair:
    """A visual image and a tactile image. `STS` takes these two images one after the other."""

    visual: Shot  # image with the lights off
    tactile: Shot  # image with the lights on
