"""The time after which a switch of the lights shows in whole frames, from frames around the switch."""

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float, UInt8

_SIZE = 32, 24  # pixels of a thumbnail, width and height. Its pixels are means of many, so noise hardly counts
_LEAST_CONTRAST = 2.0  # of 255, mean difference of thumbnails of both lights below which no switch is recognised
_VISIBLE = 0.5  # of 255, least effect of the light on a value of a thumbnail, which has less noise
_CLEAR = 0.25  # of the median visible effect, below which a value is not used
_TOLERANCE = 0.02  # of the share of the light, within which a frame has the new light

Thumbnail = Float[np.ndarray, "24 32 3"]


class NoContrastError(RuntimeError):
    """The image is the same with and without the lights."""


@dataclasses.dataclass(frozen=True)
class Settling:
    """Times after the controller's acknowledgement of a switch. Frames that arrive earlier are discarded."""

    visual_s: float  # after the lights went off (s)
    tactile_s: float  # after the lights went on (s)

    def __post_init__(self) -> None:
        for name in ("visual_s", "tactile_s"):
            value = getattr(self, name)
            if not 0 < value < 60:
                raise ValueError(f"{name} must be in (0, 60) s, got {value}")


@dataclasses.dataclass(frozen=True, eq=False)
class Switch:
    """The frames that followed a switch of the lights, until long after it."""

    delays_s: Float[np.ndarray, "n"]  # from the acknowledgement to the arrival of each frame (s)
    thumbnails: Float[np.ndarray, "n 24 32 3"]


def thumbnail(image: UInt8[np.ndarray, "height width 3"]) -> Thumbnail:
    """The means of an image's blocks, 0 to 255."""
    return cv2.resize(image, _SIZE, interpolation=cv2.INTER_AREA).astype(np.float32)


def difference(first: Thumbnail, second: Thumbnail) -> float:
    """Mean absolute difference of two thumbnails, of 255."""
    return float(np.abs(first - second).mean())


def check_contrast(contrast: float) -> None:
    """Raise an error if the lights do not change the image.

    Args:
        contrast: Difference of the images without and with the lights, of 255.

    Raises:
        NoContrastError: The difference is too small.
    """
    if contrast < _LEAST_CONTRAST:
        raise NoContrastError(
            f"the image changes by {contrast:.2f} of 255 on average between lights off and on, and at least "
            f"{_LEAST_CONTRAST:g} are needed: check the LEDs' wiring and levels, and whether the camera adapts its "
            "exposure."
        )


def light_share(look: Thumbnail, dark: Thumbnail, lit: Thumbnail) -> float:
    """The share of the light in an image, by least squares between images without (0) and with the light (1).

    Changes of parts that the light does not reach have no influence.
    """
    change = lit - dark
    return float(((look - dark) * change).sum() / (change**2).sum())


def switched_share(look: Thumbnail, before: Thumbnail, change: Thumbnail) -> float:
    """The share of a change of the light that an image shows in comparison with an image before the switch.

    It is the median over the values on which the light has an effect, so what moves in less than half of the view has
    no influence.

    Args:
        look: The image.
        before: The image before the switch.
        change: The difference that the switch makes, from earlier images.

    Returns:
        0 for the light before the switch, 1 for the one after it, and 0 if the change has no effect anywhere.
    """
    effect = np.abs(change)
    visible = effect >= _VISIBLE
    if not visible.any():
        return 0.0
    used = effect >= max(_VISIBLE, _CLEAR * float(np.median(effect[visible])))
    return float(np.median((look - before)[used] / change[used]))


def settling(on: Sequence[Switch], off: Sequence[Switch], period_s: float) -> Settling:
    """The settling times that a number of switches show.

    A frame has the new light if the share of the light in it is within 2 % of the last one of its switch. The time is
    that of the latest frame without the new light, and one period of the camera more, because the switches sample the
    phase of the exposure.

    Args:
        on: Switches from dark to lit. The scene must be at rest.
        off: Switches from lit to dark.
        period_s: Time between two frames (s).

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
    """Delay (s) of the last frame that does not have the new light yet, at least 0."""
    shares = np.array([light_share(look, dark, lit) for look in switch.thumbnails])
    mixed = np.flatnonzero(np.abs(shares - shares[-1]) > _TOLERANCE)
    return max(float(switch.delays_s[mixed[-1]]), 0.0) if len(mixed) else 0.0
