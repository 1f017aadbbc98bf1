"""`Shot` and `Pair`: images, each with the start and the end of a time interval in which the lights did not change."""

import dataclasses
from typing import Literal

import numpy as np
from jaxtyping import UInt8

from sts_jax.hardware.leds import Lit

Stream = Literal["visual", "tactile"]


class LightError(RuntimeError):
    """An image of the requested stream, with the lights in the right state, could not be taken in time."""


class NotStillError(TimeoutError):
    """The visual stream did not become still in time, because something in the view moved or changed."""


@dataclasses.dataclass(frozen=True, eq=False)
class Shot:
    """An image of one stream, with the start and the end of a time interval in which the lights did not change.

    The lights did not change between the times `before.acknowledged_s` and `until_s`. The frame arrived between these
    times, at least one settling time after `before.acknowledged_s`, so it does not show earlier levels of the lights.
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
