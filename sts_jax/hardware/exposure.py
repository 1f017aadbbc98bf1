"""The exposure with which a stream is bright and not saturated."""

import time
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8

from sts_jax.hardware.camera import Camera
from sts_jax.hardware.camera_errors import CameraError

SATURATED = 250.0  # of 255, brightness from which details are lost
_PERCENTILE = 99
_WANTED = 200.0  # of 255
_TOLERANCE = 25.0  # of 255
_DARKER = 0.4  # factor for a saturated image, whose true brightness is unknown
_MOST = 4.0  # largest factor of one attempt
_ATTEMPTS = 10
LAG_S = 0.3  # s, after which frames have a new exposure


class Exposed(NamedTuple):
    """An exposure and the image that it gives."""

    exposure: float  # in the driver's unit
    brightness: float  # see `brightness`


def brightness(image: UInt8[np.ndarray, "height width 3"]) -> float:
    """The value that 99 % of the pixels do not exceed in their brightest channel, 0 to 255."""
    return float(np.percentile(image.max(axis=-1), _PERCENTILE))


def choose_exposure(camera: Camera, *, longest: float) -> Exposed:
    """Set the exposure of a device so that its image is bright and not saturated.

    The exposure is changed in proportion until `brightness` is within 25 of 200, or until the driver goes no further.

    Args:
        camera: The connected camera. The lights of the stream must be set.
        longest: Largest exposure in the driver's unit. If it exceeds the time between two frames, the rate sinks.

    Returns:
        The exposure that is set now. It may still be too dark, or saturated (`SATURATED`).

    Raises:
        CameraError: The driver does not let the exposure be set, or there are no frames.
    """
    found = camera.set_exposure(min(camera.locked.get("exposure") or longest, longest))
    for _ in range(_ATTEMPTS):
        if found is None:
            break
        time.sleep(LAG_S)
        seen = brightness(camera.read().image)
        if abs(seen - _WANTED) <= _TOLERANCE:
            return Exposed(found, seen)
        factor = _DARKER if seen >= SATURATED else min(_WANTED / max(seen, 1.0), _MOST)
        wanted = min(max(found * factor, 1.0), longest)
        before, found = found, camera.set_exposure(wanted)
        if found == before:
            return Exposed(found, seen)
    if found is None:
        raise CameraError(f"the driver of {camera.config.name} does not let the exposure be set.")
    time.sleep(LAG_S)
    return Exposed(found, brightness(camera.read().image))
