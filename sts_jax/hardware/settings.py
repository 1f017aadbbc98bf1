"""Locking of exposure, white balance and focus: set through OpenCV, read back, and compared."""

import dataclasses
from collections.abc import Mapping
from typing import Protocol, runtime_checkable

import cv2

from sts_jax.hardware.camera_config import CameraConfig


@runtime_checkable
class Properties(Protocol):
    """The part of `cv2.VideoCapture` that holds a device's properties."""

    def get(self, propId: int, /) -> float: ...  # noqa: D102

    def set(self, propId: int, value: float, /) -> bool: ...  # noqa: D102


@dataclasses.dataclass(frozen=True)
class _Setting:
    field: str  # field of `CameraConfig`
    name: str  # OpenCV's name, without CAP_PROP_
    prop: int
    automatic: tuple[str, int, float] | None  # name, property, and value that turns the automatic control off


_MANUAL = 1.0  # V4L2_EXPOSURE_MANUAL
_SETTINGS = (
    _Setting("exposure", "EXPOSURE", cv2.CAP_PROP_EXPOSURE, ("AUTO_EXPOSURE", cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL)),
    _Setting("gain", "GAIN", cv2.CAP_PROP_GAIN, None),
    _Setting("white_balance", "WB_TEMPERATURE", cv2.CAP_PROP_WB_TEMPERATURE, ("AUTO_WB", cv2.CAP_PROP_AUTO_WB, 0.0)),
    _Setting("focus", "FOCUS", cv2.CAP_PROP_FOCUS, ("AUTOFOCUS", cv2.CAP_PROP_AUTOFOCUS, 0.0)),
)
_UNSUPPORTED = -1.0  # returned by OpenCV for a property that the driver lacks
_TOLERANCE = 0.5  # drivers store whole numbers


@dataclasses.dataclass(frozen=True)
class Refusal:
    """A property that the driver did not set."""

    name: str  # OpenCV's name, without CAP_PROP_
    asked: float
    found: float | None  # None: the driver lacks the property

    def __str__(self) -> str:
        found = "the driver lacks it" if self.found is None else f"found {self.found:g}"
        return f"{self.name}: asked for {self.asked:g}, {found}"


def asked(config: CameraConfig) -> dict[str, float]:
    """The values that a configuration states, by field."""
    values = {setting.field: getattr(config, setting.field) for setting in _SETTINGS}
    return {field: value for field, value in values.items() if value is not None}


def lock(
    capture: Properties, values: Mapping[str, float], *, current: bool = False
) -> tuple[dict[str, float], list[Refusal]]:
    """Turn the automatic controls off and set values, then read both back.

    Args:
        capture: the opened device.
        values: the values to set, by field of `CameraConfig`.
        current: lock the settings without a value at their current one.

    Returns:
        The values that the device has now, and the properties that it refused. A control that the device lacks is a
        refusal only if a value was asked for, or if its automatic control cannot be turned off.
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
    """Set one property and read it back. A property that the driver lacks is no refusal unless it is needed."""
    capture.set(prop, value)
    found = capture.get(prop)
    if found == _UNSUPPORTED:
        return [Refusal(name, value, None)] * needed
    return [Refusal(name, value, found)] * (abs(found - value) > _TOLERANCE)
