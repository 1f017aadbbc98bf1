"""The real sensor as a device. Imperative, NumPy only."""

from sts_jax.hardware.camera import Camera
from sts_jax.hardware.camera_config import CameraConfig
from sts_jax.hardware.camera_errors import (
    CameraBusyError,
    CameraError,
    CameraLostError,
    CameraNotConnectedError,
    CameraNotFoundError,
    CameraOpenError,
    CameraPermissionError,
    CameraTimeoutError,
    EndOfVideoError,
    FrameSizeError,
    FrozenCameraError,
    StaleFrameError,
)
from sts_jax.hardware.devices import FoundCamera, find_cameras
from sts_jax.hardware.frames import CameraStatistics, Captured, is_black
from sts_jax.hardware.leds import Leds, Lit
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
    "Camera",
    "CameraBusyError",
    "CameraConfig",
    "CameraError",
    "CameraLostError",
    "CameraNotConnectedError",
    "CameraNotFoundError",
    "CameraOpenError",
    "CameraPermissionError",
    "CameraStatistics",
    "CameraTimeoutError",
    "Captured",
    "DisconnectedError",
    "EndOfVideoError",
    "FoundCamera",
    "FrameSizeError",
    "FrozenCameraError",
    "LedError",
    "LedTimeoutError",
    "Leds",
    "Lit",
    "NotALedControllerError",
    "Port",
    "PortInUseError",
    "PortNotFoundError",
    "PortPermissionError",
    "StaleFrameError",
    "WrongVersionError",
    "find_cameras",
    "find_controllers",
    "is_black",
]
