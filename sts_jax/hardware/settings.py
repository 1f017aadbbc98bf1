"""The locking of exposure, gain, white balance and focus. The values are set through OpenCV, read back and checked."""

import dataclasses
from collections.abc import Mapping
from typing import Protocol, runtime_checkable

import cv2

from sts_jax.hardware.camera_config import CameraConfig


@runtime_checkable
class Properties(Protocol):
    """The methods of `cv2.VideoCapture` that read and set the properties of a device."""

    def get(self, propId: int, /) -> float: ...  # noqa: D102

    def set(self, propId: int, value: float, /) -> bool: ...  # noqa: D102


@dataclasses.dataclass(frozen=True)
class _Setting:
    field: str  # field of `CameraConfig`
    name: str  # OpenCV's name of the property, without CAP_PROP_
    prop: int  # OpenCV's number of the property
    automatic: tuple[str, int, float] | None  # automatic control: name, number, and value that turns it off


_MANUAL = 1.0  # V4L2_EXPOSURE_MANUAL
_SETTINGS = (
    _Setting("exposure", "EXPOSURE", cv2.CAP_PROP_EXPOSURE, ("AUTO_EXPOSURE", cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL)),
    _Setting("gain", "GAIN", cv2.CAP_PROP_GAIN, None),
    _Setting("white_balance", "WB_TEMPERATURE", cv2.CAP_PROP_WB_TEMPERATURE, ("AUTO_WB", cv2.CAP_PROP_AUTO_WB, 0.0)),
    _Setting("focus", "FOCUS", cv2.CAP_PROP_FOCUS, ("AUTOFOCUS", cv2.CAP_PROP_AUTOFOCUS, 0.0)),
)
_UNSUPPORTED = -1.0  # returned by OpenCV for a property that the driver lacks
_TOLERANCE = 0.5  # largest difference that counts as accepted, because drivers store whole numbers


@dataclasses.dataclass(frozen=True)
class Refusal:
    """A property that the driver did not set to the requested value."""

    name: str  # OpenCV's name of the property, without CAP_PROP_
    asked: float  # requested value
    found: float | None  # value after the request. None: the driver does not support the property

    def __str__(self) -> str:
        found = "the driver lacks it" if self.found is None else f"found {self.found:g}"
        return f"{self.name}: asked for {self.asked:g}, {found}"


def asked(config: CameraConfig) -> dict[str, float]:
    """Return the values that a camera configuration requests for exposure, gain, white balance and focus.

    Args:
        config: Camera configuration. A field that is None requests no value.

    Returns:
        Requested values, by field name: `exposure`, `gain`, `white_balance` or `focus`.
    """
    values = {setting.field: getattr(config, setting.field) for setting in _SETTINGS}
    return {field: value for field, value in values.items() if value is not None}


def lock(
    capture: Properties, values: Mapping[str, float], *, current: bool = False
) -> tuple[dict[str, float], list[Refusal]]:
    """Lock settings of a device: turn their automatic controls off, set their values, and check the result.

    Args:
        capture: Open device.
        values: Values to set, by field name of `CameraConfig` (`exposure`, `gain`, `white_balance`, `focus`).
        current: If True, the settings that `values` does not contain are locked at their current values. This applies
            to exposure, white balance and focus.

    Returns:
        The values that the device has now, by field name, and a list of the properties that the driver did not set.
        A property that the driver lacks is in the list only in two cases. In the first case, the property is needed to
        set one of `values`. In the second case, the property controls automatic exposure or automatic white balance.
    """
    held: dict[str, float] = {}
    refused: list[Refusal] = []
    for setting in _SETTINGS:
        wanted = values.get(setting.field)
        if wanted is None and (not current or setting.automatic is None):
            continue
        before = capture.get(setting.prop)
        if setting.automatic is not None:
            refused += _set(capture, *setting.automatic, needed=wanted is not None or setting.field != "focus")
        if wanted is None and before == _UNSUPPORTED:
            continue
        refused += _set(capture, setting.name, setting.prop, before if wanted is None else wanted, needed=True)
        found = capture.get(setting.prop)
        if found != _UNSUPPORTED:
            held[setting.field] = found
    return held, refused


def _set(capture: Properties, name: str, prop: int, value: float, needed: bool) -> list[Refusal]:
    """Set one property, read it back, and return a refusal or none. An unsupported property is one only if `needed`."""
    capture.set(prop, value)
    found = capture.get(prop)
    if found == _UNSUPPORTED:
        return [Refusal(name, value, None)] * needed
    return [Refusal(name, value, found)] * (abs(found - value) > _TOLERANCE)
