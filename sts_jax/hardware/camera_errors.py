"""Errors of the camera. Each message names the camera, the finding and the remedy."""


class CameraError(RuntimeError):
    """A camera failed. All other errors of the camera derive from this one."""


class CameraNotFoundError(CameraError):
    """There is no such device, file or host. The message lists the cameras that were found."""


class CameraPermissionError(CameraError):
    """The user may not open the device or the file."""


class CameraBusyError(CameraError):
    """Another process, or another part of this one, uses the camera. The message names the process."""


class CameraOpenError(CameraError):
    """The source exists, but it cannot be opened as a camera or a video."""


class CameraNotConnectedError(CameraError):
    """The camera is not connected, or it was disconnected during the call."""


class CameraTimeoutError(CameraError, TimeoutError):
    """No frame arrived in time."""


class CameraLostError(CameraError):
    """The device or the stream was lost. It is opened again in the background."""


class FrameSizeError(CameraError):
    """The camera's frames have another size than the configuration."""


class FrozenCameraError(CameraError):
    """The camera has sent the same image for too long."""


class StaleFrameError(CameraError):
    """The newest frame is older than the caller allows."""


class EndOfVideoError(CameraError):
    """All frames of the video file have been returned."""
