"""Errors of the camera. Each message states the cause and the remedy."""


class CameraError(RuntimeError):
    """A camera failed. This is the base class of all errors of the camera."""


class CameraNotFoundError(CameraError):
    """There is no such device, file or host. For a device, the message lists the cameras that were found."""


class CameraPermissionError(CameraError):
    """The user is not allowed to open the device or the file."""


class CameraBusyError(CameraError):
    """Another process, or another part of this process, uses the camera. The message names the process."""


class CameraOpenError(CameraError):
    """The source exists, but it cannot be opened as a camera or a video."""


class CameraNotConnectedError(CameraError):
    """The method `connect` was not called, or `disconnect` was called during the call of another method."""


class CameraTimeoutError(CameraError, TimeoutError):
    """No frame arrived in time."""


class CameraLostError(CameraError):
    """The device or the stream was lost. The camera's background thread tries to open the lost source again."""


class FrameSizeError(CameraError):
    """The size of the camera's frames differs from the configured size, or from the size of earlier frames."""


class FrozenCameraError(CameraError):
    """The camera has sent the same image for longer than `CameraConfig.frozen_after_s`."""


class StaleFrameError(CameraError):
    """The newest frame is older than the caller allows, or there is no frame yet."""


class EndOfVideoError(CameraError):
    """The video file or the recording has no more frames."""
