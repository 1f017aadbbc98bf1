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
from sts_jax.hardware.device import STS, FoundSensors, LightError, NotStillError, Pair, Shot, find_sensors
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
from sts_jax.hardware.settling import NoContrastError, Settling

__all__ = [
    "STS",
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
    "FoundSensors",
    "FrameSizeError",
    "FrozenCameraError",
    "LedError",
    "LedTimeoutError",
    "Leds",
    "LightError",
    "Lit",
    "NoContrastError",
    "NotALedControllerError",
    "NotStillError",
    "Pair",
    "Port",
    "PortInUseError",
    "PortNotFoundError",
    "PortPermissionError",
    "Settling",
    "Shot",
    "StaleFrameError",
    "WrongVersionError",
    "find_cameras",
    "find_controllers",
    "find_sensors",
    "is_black",
]
