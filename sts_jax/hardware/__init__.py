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
    "EndOfVideoError",
    "FoundCamera",
    "FrameSizeError",
    "FrozenCameraError",
    "StaleFrameError",
    "find_cameras",
    "is_black",
]
