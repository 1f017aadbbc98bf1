"""The real sensor: camera, LED controller, calibration, and recording. Only its digital twin, `twin`, uses JAX."""

from sts_jax.hardware.board import Board, FoundCorners, board_image, find_board, save_board
from sts_jax.hardware.calibration import Calibration, CalibrationError, calibrate, fit_lens
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
from sts_jax.hardware.collecting import Action, AutomaticPerson, PairReader, Person, View, collect
from sts_jax.hardware.coverage import check_view, covered, view_angle
from sts_jax.hardware.devices import FoundCamera, find_cameras
from sts_jax.hardware.exposure import Exposed, brightness, choose_exposure
from sts_jax.hardware.frames import CameraStatistics, Captured, is_black
from sts_jax.hardware.guide import EmptyPad, GuideConfig, Stage, known_pad
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
from sts_jax.hardware.recorder import Recorder
from sts_jax.hardware.recordings import (
    Entry,
    Images,
    RecordedTrajectory,
    Recordings,
    confirm_recording,
    discard_recording,
    list_recordings,
    load_recordings,
    next_recording,
    restore_recording,
)
from sts_jax.hardware.replay import Replay
from sts_jax.hardware.sensor_file import Background, Device, SensorFileError, WrongDeviceError
from sts_jax.hardware.session import Origin, Session, SessionError
from sts_jax.hardware.settling import NoContrastError, Settling
from sts_jax.hardware.shots import LightError, NotStillError, Pair, Shot
from sts_jax.hardware.sts import STS, FoundSensors, find_sensors
from sts_jax.hardware.views import RecordedImages, SensorView, recorded_images, relit, sensor_view

__all__ = [
    "STS",
    "Action",
    "AutomaticPerson",
    "Background",
    "Board",
    "Calibration",
    "CalibrationError",
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
    "Device",
    "DisconnectedError",
    "EmptyPad",
    "EndOfVideoError",
    "Entry",
    "Exposed",
    "FoundCamera",
    "FoundCorners",
    "FoundSensors",
    "FrameSizeError",
    "FrozenCameraError",
    "GuideConfig",
    "Images",
    "LedError",
    "LedTimeoutError",
    "Leds",
    "Lens",
    "LightError",
    "Lit",
    "NoContrastError",
    "NotALedControllerError",
    "NotStillError",
    "Origin",
    "Pair",
    "PairReader",
    "Person",
    "Pinhole",
    "Port",
    "PortInUseError",
    "PortNotFoundError",
    "PortPermissionError",
    "RecordedImages",
    "RecordedTrajectory",
    "Recorder",
    "Recordings",
    "Replay",
    "SensorFileError",
    "SensorView",
    "Session",
    "SessionError",
    "Settling",
    "Shot",
    "Stage",
    "StaleFrameError",
    "View",
    "WrongDeviceError",
    "WrongVersionError",
    "board_image",
    "brightness",
    "calibrate",
    "check_view",
    "choose_exposure",
    "collect",
    "confirm_recording",
    "covered",
    "discard_recording",
    "distorted",
    "distortion",
    "find_board",
    "find_cameras",
    "find_controllers",
    "find_sensors",
    "fit_lens",
    "is_black",
    "known_pad",
    "list_recordings",
    "load_recordings",
    "next_recording",
    "project",
    "recorded_images",
    "rectification",
    "rectified",
    "relit",
    "restore_recording",
    "save_board",
    "sensor_view",
    "view_angle",
]
