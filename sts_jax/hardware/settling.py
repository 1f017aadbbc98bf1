"""The settling time: the time from switching the lights on or off until the frames show only the new state."""

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float, UInt8

_SIZE = 32, 24  # width and height of a thumbnail (pixels). Each pixel is the mean of many, which averages noise out
_LEAST_CONTRAST = 2.0  # smallest mean difference of thumbnails between lights off and on (of 255)
_VISIBLE = 0.5  # smallest effect of the lights on a value of a thumbnail that is used (of 255). The noise is below it
_CLEAR = 0.25  # smallest effect on a value that is used, as a share of the median visible effect
_TOLERANCE = 0.02  # largest difference from the last share of the light at which a frame counts as settled

Thumbnail = Float[np.ndarray, "24 32 3"]  # a small copy of an image, 0 to 255


class NoContrastError(RuntimeError):
    """The image with the lights off differs from the image with the lights on by less than 2 of 255 on average."""


@dataclasses.dataclass(frozen=True)
class Settling:
    """The settling times: `visual_s` after the lights are switched off, and `tactile_s` after they are switched on.

    A settling time begins when the LED controller acknowledges that it has switched the lights. Frames that arrive
    during the settling time are discarded, because these frames may still show the previous state of the lights.

    Raises:
        ValueError: A time is not between 0 and 60 s.
    """

    visual_s: float  # settling time after the lights were switched off (s)
    tactile_s: float  # settling time after the lights were switched on (s)

    def __post_init__(self) -> None:
        for name in ("visual_s", "tactile_s"):
            value = getattr(self, name)
            if not 0 < value < 60:
                raise ValueError(f"{name} must be in (0, 60) s, got {value}")


@dataclasses.dataclass(frozen=True, eq=False)
class Switch:
    """The frames that arrive after the lights are switched on or off.

    The last frame must arrive after the lights have stopped changing.
    """

    delays_s: Float[np.ndarray, "n"]  # time from the acknowledgement to the arrival of each frame (s)
    thumbnails: Float[np.ndarray, "n 24 32 3"]  # thumbnail of each frame, 0 to 255


def thumbnail(image: UInt8[np.ndarray, "height width 3"]) -> Thumbnail:
    """Return a small copy of an image.

    Args:
        image: RGB image, 0 to 255.

    Returns:
        The image is divided into 24 rows and 32 columns of blocks. The result is the mean colour of each block, shape
        (24, 32, 3), 0 to 255.
    """
    return cv2.resize(image, _SIZE, interpolation=cv2.INTER_AREA).astype(np.float32)


def difference(first: Thumbnail, second: Thumbnail) -> float:
    """Return the mean absolute difference between the values of two thumbnails, 0 to 255."""
    return float(np.abs(first - second).mean())


def check_contrast(contrast: float) -> None:
    """Raise an error if the lights do not change the image.

    Args:
        contrast: Mean absolute difference between the images with the lights off and on, 0 to 255.

    Raises:
        NoContrastError: The difference is less than 2.
    """
    if contrast < _LEAST_CONTRAST:
        raise NoContrastError(
            f"the images with the lights off and on differ by {contrast:.2f} on average (pixel values are 0 to 255), "
            f"but they must differ by at least {_LEAST_CONTRAST:g}: check the LEDs' wiring and levels, and lock the "
            "camera's exposure."
        )


def light_share(look: Thumbnail, dark: Thumbnail, lit: Thumbnail) -> float:
    """Return the brightness of the lights in an image, as a share of their full brightness.

    The share is the number `s` for which `dark + s (lit - dark)` is closest to `look` in the least-squares sense.
    Parts of the view that the lights do not reach have no influence.

    Args:
        look: Thumbnail of the image.
        dark: Thumbnail with the lights off.
        lit: Thumbnail with the lights on.

    Returns:
        0 for an image like `dark`, 1 for an image like `lit`.
    """
    change = lit - dark
    return float(((look - dark) * change).sum() / (change**2).sum())


def switched_share(look: Thumbnail, before: Thumbnail, change: Thumbnail) -> float:
    """Return how far the lights had been switched on or off when an image was taken: 0 means not yet, 1 means fully.

    A value of `change` counts as visible if its magnitude is at least 0.5 (of 255). A visible value counts as clear if
    its magnitude is at least a quarter of the median magnitude of all visible values. The result is the median of
    `(look - before) / change` over the clear values. Because of the median, an object that moves in less than half of
    the view has no influence.

    Args:
        look: Thumbnail of the image.
        before: Thumbnail of an image before the switch.
        change: Effect of a complete switch on a thumbnail, from two earlier images. It is the thumbnail with the new
            state of the lights minus the thumbnail with the old state.

    Returns:
        0 if the image shows the lights before the switch, and 1 if it shows the lights after the switch. The result is
        also 0 if no value of `change` is visible.
    """
    effect = np.abs(change)
    visible = effect >= _VISIBLE
    if not visible.any():
        return 0.0
    used = effect >= max(_VISIBLE, _CLEAR * float(np.median(effect[visible])))
    return float(np.median((look - before)[used] / change[used]))


def settling(on: Sequence[Switch], off: Sequence[Switch], period_s: float) -> Settling:
    """Compute the settling times from the frames after several switches of the lights.

    The `light_share` of a frame is 0 if the lights are off and 1 if they are on. A frame is settled if its
    `light_share` differs by at most 0.02 from the `light_share` of the last frame in the same `Switch`. The delay of a
    frame is its time of arrival after the controller's acknowledgement. A settling time is the largest delay of a frame
    that is not settled, plus `period_s`. One settling time is computed from `on`, and another from `off`.
    `period_s` is added because a switch can occur at any time within the exposure of a frame, and the measured switches
    occurred at only a few such times.

    Args:
        on: Switches from off to on. The scene must be at rest.
        off: Switches from on to off. The scene must be at rest.
        period_s: Time between two frames (s).

    Returns:
        The settling times.

    Raises:
        NoContrastError: The lights do not change the image.
    """
    dark = np.mean([switch.thumbnails[-1] for switch in off], axis=0)
    lit = np.mean([switch.thumbnails[-1] for switch in on], axis=0)
    contrast = difference(dark, lit)
    check_contrast(contrast)
    last_off, last_on = (max(last_mixed(switch, dark, lit) for switch in switches) for switches in (off, on))
    return Settling(last_off + period_s, last_on + period_s)


def last_mixed(switch: Switch, dark: Thumbnail, lit: Thumbnail) -> float:
    """Return the time from the acknowledgement of a switch to the arrival of the last frame that is not settled (s).

    The `light_share` of a frame is 0 for a frame like `dark` and 1 for a frame like `lit`. A frame is settled if its
    `light_share` differs by at most 0.02 from the `light_share` of the last frame in `switch`. If all frames are
    settled, the result is 0. The result is never negative.

    Args:
        switch: The frames after a switch of the lights.
        dark: Thumbnail with the lights off.
        lit: Thumbnail with the lights on.
    """
    shares = np.array([light_share(look, dark, lit) for look in switch.thumbnails])
    mixed = np.flatnonzero(np.abs(shares - shares[-1]) > _TOLERANCE)
    return max(float(switch.delays_s[mixed[-1]]), 0.0) if len(mixed) else 0.0
