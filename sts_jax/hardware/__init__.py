"""The real sensor as a device. Imperative, NumPy only."""

from sts_jax.hardware.leds import Leds, Lit
from sts_jax.hardware.lens import Lens, Pinhole, distorted, distortion, project, rectification, rectified
from sts_jax.hardware.ports import (
    DisconnectedError,
    LedError,
    LedTimeoutError,
    NotALedControllerError,
    Port,
    PortInUseError,
    PortNotFoundError,
    PortPermissionError,
    WrongVersionError,
    find_controllers,
)

__all__ = [
    "DisconnectedError",
    "LedError",
    "LedTimeoutError",
    "Leds",
    "Lens",
    "Lit",
    "NotALedControllerError",
    "Pinhole",
    "Port",
    "PortInUseError",
    "PortNotFoundError",
    "PortPermissionError",
    "WrongVersionError",
    "distorted",
    "distortion",
    "find_controllers",
    "project",
    "rectification",
    "rectified",
]
