"""Search for the camera exposure at which the images of a stream are bright but not saturated."""

import time
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8

from sts_jax.hardware.camera import Camera
from sts_jax.hardware.camera_errors import CameraError

SATURATED = 250.0  # brightness of 255 from which details are lost
_PERCENTILE = 99
_WANTED = 200.0  # wanted brightness, of 255
_TOLERANCE = 25.0  # largest difference from the wanted brightness, of 255
_DARKER = 0.4  # factor on the exposure of a saturated image, whose true brightness is unknown
_MOST = 4.0  # largest factor on the exposure in one attempt
_ATTEMPTS = 10
LAG_S = 0.3  # time after which all frames have the new exposure (s)


class Exposed(NamedTuple):
    """An exposure and the brightness of an image that was taken with it."""

    exposure: float  # exposure that is set, in the unit of the camera's driver
    brightness: float  # result of the function `brightness` for this image, 0 to 255


def brightness(image: UInt8[np.ndarray, "height width 3"]) -> float:
    """Return the brightness of an image, 0 to 255.

    The function takes the largest colour value of each pixel. The brightness is the 99th percentile of these values.

    Args:
        image: RGB image.
    """
    return float(np.percentile(image.max(axis=-1), _PERCENTILE))


def choose_exposure(camera: Camera, *, longest: float) -> Exposed:
    """Set the exposure of a camera so that its images are bright but not saturated.

    The exposure is adjusted, in at most 10 attempts, until the brightness of an image is between 175 and 225. To
    compute the brightness, the largest of the three colour values of each pixel is taken. The brightness is the 99th
    percentile of these values (0 to 255). The search also stops if the driver does not change the exposure any more.

    Args:
        camera: Connected camera whose driver can set the exposure. Before the call, switch the sensor's lights on
            for the exposure of the tactile stream, or off for the exposure of the visual stream.
        longest: Largest allowed exposure, in the unit of the driver. An exposure that is longer than the time between
            two frames lowers the frame rate.

    Returns:
        The exposure that is set now, and the brightness of an image with this exposure. If the search has failed, the
        image may still be too dark, or saturated (brightness of at least 250).

    Raises:
        CameraError: The driver does not allow setting the exposure, or the camera sends no frames.
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
        raise CameraError(
            f"the driver of {camera.config.name} does not support a manual exposure: use the camera's automatic "
            "exposure instead of choose_exposure()."
        )
    time.sleep(LAG_S)
    return Exposed(found, brightness(camera.read().image))
