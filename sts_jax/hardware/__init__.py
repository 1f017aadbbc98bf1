"""The real sensor as a device. Imperative, NumPy only."""

from sts_jax.hardware.calibration import (
    Board,
    Calibration,
    CalibrationError,
    FoundCorners,
    board_image,
    calibrate,
    find_board,
    fit_lens,
    save_board,
)
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
from sts_jax.hardware.sensor_file import Background, Device, SensorFileError, WrongDeviceError

__all__ = [
    "Background",
    "Board",
    "Calibration",
    "CalibrationError",
    "Device",
    "DisconnectedError",
    "FoundCorners",
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
    "SensorFileError",
    "WrongDeviceError",
    "WrongVersionError",
    "board_image",
    "calibrate",
    "distorted",
    "distortion",
    "find_board",
    "find_controllers",
    "fit_lens",
    "project",
    "rectification",
    "rectified",
    "save_board",
]
