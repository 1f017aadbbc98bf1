"""The real sensor as a device. Imperative, NumPy only."""

from sts_jax.hardware.leds import (
    DisconnectedError,
    LedError,
    Leds,
    LedTimeoutError,
    Lit,
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
    "Lit",
    "NotALedControllerError",
    "Port",
    "PortInUseError",
    "PortNotFoundError",
    "PortPermissionError",
    "WrongVersionError",
    "find_controllers",
]
