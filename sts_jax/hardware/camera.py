"""`Camera`: reads frames and the times of their arrival from a V4L2 device, a network stream or a video file."""

import dataclasses
import time
import warnings
from pathlib import Path
from types import TracebackType

from sts_jax.hardware import devices
from sts_jax.hardware.camera_config import CameraConfig
from sts_jax.hardware.camera_errors import (
    CameraError,
    CameraNotConnectedError,
    EndOfVideoError,
    StaleFrameError,
)
from sts_jax.hardware.frames import CameraStatistics, Captured
from sts_jax.hardware.grabber import Grabber


class Camera:
    """A camera that reads frames from a V4L2 device, a network stream or a video file.

    ```python
    with Camera(CameraConfig("/dev/v4l/by-id/usb-Maker_Camera_0123-video-index0")) as camera:
        frame = camera.read()
    ```

    A background thread fetches the frames continuously, so that no old frames wait in the driver. If a device or
    stream is lost, this thread opens it again under the same path or URL. The `epoch` of a frame counts the
    reconnections before this frame.

    Several threads may use one camera. `async_read` then returns each frame to only one of them.
    """

    def __init__(self, config: CameraConfig):
        """Keep the configuration. `connect` opens the camera.

        Args:
            config: Source of the frames, their size, and the locked settings.
        """
        self.config = config
        self._grabber: Grabber | None = None

    def connect(self, warmup_s: float = 1.0) -> "Camera":
        """Open the camera, and wait `warmup_s` for its automatic exposure and white balance to settle.

        If the source is a V4L2 device and `CameraConfig.lock` is True, the call then locks the settings: it turns off
        the automatic control of exposure, white balance and focus, and discards all earlier frames. A video file starts
        at its first frame, without a wait. The call lasts at most `warmup_s` plus four times `CameraConfig.timeout_s`.

        Args:
            warmup_s: Time for the automatic exposure and white balance to settle (s).

        Returns:
            This camera.

        Raises:
            CameraError: The camera is connected already, or cannot be opened. Subclasses name the cause.
            ValueError: `warmup_s` is negative or not finite.

        Warns:
            UserWarning: The source did not accept a setting, or `CameraConfig.lock` is True but the source is a stream.
                A `Camera` cannot lock the settings of a stream.
        """
        if not 0 <= warmup_s < float("inf"):
            raise ValueError(f"warmup_s must be >= 0 and finite, got {warmup_s}")
        if self._grabber is not None:
            raise CameraError(f"{self.config.name} is connected already: call disconnect() first.")
        grabber = Grabber(_with_stable_path(self.config))
        grabber.start(3 * self.config.timeout_s)
        self._grabber = grabber
        try:
            if self.config.kind != "file":
                time.sleep(warmup_s)
                self._lock_settings(grabber)
        except BaseException:  # includes a warning that Python turns into an error
            self.disconnect()
            raise
        return self

    def _lock_settings(self, grabber: Grabber) -> None:
        config = self.config
        if config.kind == "device" and config.lock:
            refused = grabber.lock_settings(config.timeout_s)
        else:
            refused = list(grabber.refused)
        for text in refused:
            warnings.warn(f"{config.name} did not accept a setting. {text}.", stacklevel=3)
        if config.kind == "stream" and config.lock:
            warnings.warn(
                f"{config.name} is a stream, so AUTO_EXPOSURE and AUTO_WB cannot be turned off by this program: lock "
                "exposure and white balance at the stream's server, then pass lock=False in CameraConfig.",
                stacklevel=3,
            )

    def disconnect(self) -> None:
        """Close the camera. Does nothing if the camera is not connected.

        The call lasts at most `CameraConfig.timeout_s` plus 1 s. If the camera's driver does not respond in this time,
        a background thread closes the camera as soon as the driver responds.

        Warns:
            UserWarning: The driver did not respond in time.
        """
        grabber, self._grabber = self._grabber, None
        if grabber is not None and not grabber.stop():
            warnings.warn(
                f"the driver of {self.config.name} does not respond. The camera will be closed when the driver "
                "responds.",
                stacklevel=2,
            )

    @property
    def is_connected(self) -> bool:
        """True if the camera is open and its background thread reads frames.

        False before `connect`, after `disconnect`, while the camera is lost, after the end of a video file, and after
        an error that ends the thread. The value stays True after a `FrozenCameraError` or a `FrameSizeError`.
        """
        return self._grabber is not None and self._grabber.running

    @property
    def statistics(self) -> CameraStatistics:
        """Counts of frames, lost connections and other events since `connect`."""
        return self._connected().statistics

    @property
    def refused(self) -> tuple[str, ...]:
        """Descriptions of the settings that the driver did not accept when the camera was last opened.

        An example is "FPS: asked for 60, found 30".
        """
        return tuple(self._connected().refused)

    @property
    def source(self) -> str:
        """The name that identifies the camera: the path of a device or file, or the URL of a stream.

        The path of a device contains the camera's serial number if `/dev/v4l/by-id` lists the camera. The user name and
        the password of a URL are left out.
        """
        config = _with_stable_path(self.config)
        return devices.device_path(config.target) if config.kind == "device" else config.public

    @property
    def locked(self) -> dict[str, float]:
        """The settings of a device that are locked at fixed values, and these values, such as {"exposure": 200.0}.

        The keys are field names of `CameraConfig`. For streams and files, the result is empty.
        """
        return self._connected().held

    def set_exposure(self, exposure: float) -> float | None:
        """Set the exposure of the camera as soon as the next frame has arrived.

        The new exposure appears in the images a few frames after the call.

        Args:
            exposure: New exposure, > 0, in the driver's unit (V4L2: 0.1 ms).

        Returns:
            The exposure that the camera has now. It may differ from the argument `exposure`, because drivers round and
            limit this value. The result is None if the driver does not support a manual exposure.

        Raises:
            CameraError: The source is a stream or a file, the camera is not connected, or no frame has arrived within
                `CameraConfig.timeout_s`.
            ValueError: `exposure` is not positive.
        """
        if not exposure > 0:
            raise ValueError(f"exposure must be > 0, got {exposure}")
        if self.config.kind != "device":
            remedy = "set it at the server of the stream" if self.config.kind == "stream" else "use a device"
            raise CameraError(
                f"{self.config.name} is a {self.config.kind}, but the exposure can be set only for a device: {remedy}."
            )
        return self._connected().set_exposure(exposure, self.config.timeout_s)

    def read(self, timeout_ms: float | None = None) -> Captured:
        """Return a frame whose exposure began after the start of this call.

        The first `CameraConfig.in_flight` frames that arrive after the start of the call are discarded, because their
        exposure may have begun earlier. Delayed frames (`Captured.delayed`) are discarded for the same reason. If the
        source is a video file, no frame is discarded, and the method returns the oldest frame that has not been
        returned yet.

        Args:
            timeout_ms: Longest wait (ms). None: `CameraConfig.timeout_s`. If the camera was lost before the call, this
                time includes the wait until the camera is found again.

        Returns:
            The frame.

        Raises:
            CameraTimeoutError: No such frame has arrived in time.
            CameraLostError: The camera was lost during the call, or was not found again in time.
            FrozenCameraError: The camera has sent the same image for longer than `CameraConfig.frozen_after_s`.
            FrameSizeError: The size of the camera's frames has changed.
            EndOfVideoError: The video file has ended.
            CameraNotConnectedError: `connect` was not called, or `disconnect` was called before the frame arrived.
            ValueError: `timeout_ms` is not positive.
        """
        return self._connected().wait(self._timeout_s(timeout_ms), exposed_now=self.config.kind != "file")

    def async_read(self, timeout_ms: float | None = None) -> Captured:
        """Return the oldest frame in the buffer, or wait for the next frame if the buffer is empty.

        The buffer contains the newest frames that have not been returned yet, at most `CameraConfig.buffer` frames. A
        frame may have been exposed before the call.

        Args:
            timeout_ms: Longest wait (ms). None: `CameraConfig.timeout_s`.

        Returns:
            The frame.

        Raises:
            CameraError: There is no frame. See the documentation of `read` for the subclasses of CameraError.
            ValueError: `timeout_ms` is not positive.
        """
        return self._connected().wait(self._timeout_s(timeout_ms), exposed_now=False)

    def read_latest(self, max_age_ms: float = 500.0) -> Captured:
        """Return the newest frame without waiting. The same frame may be returned several times.

        Args:
            max_age_ms: Largest allowed time since the frame's arrival (ms).

        Returns:
            The frame.

        Raises:
            StaleFrameError: The newest frame is older than `max_age_ms`.
            CameraError: There are no frames at present. See the documentation of `read` for the subclasses of
                CameraError.
            ValueError: `max_age_ms` is not positive.
        """
        if not max_age_ms > 0:
            raise ValueError(f"max_age_ms must be > 0, got {max_age_ms}")
        grabber = self._connected()
        frame = grabber.latest()
        age_ms = 1000 * (time.monotonic() - frame.time_s)
        if age_ms > max_age_ms:
            if isinstance(problem := grabber.problem(), EndOfVideoError):
                raise problem
            raise StaleFrameError(
                f"the newest frame of {self.config.name} is {age_ms:.0f} ms old, but at most {max_age_ms:g} ms are "
                "allowed: check the device or the stream's server, or raise max_age_ms."
            )
        return frame

    def _connected(self) -> Grabber:
        if self._grabber is None:
            raise CameraNotConnectedError(f"{self.config.name} is not connected: call connect() first.")
        return self._grabber

    def _timeout_s(self, timeout_ms: float | None) -> float:
        if timeout_ms is None:
            return self.config.timeout_s
        if not timeout_ms > 0:
            raise ValueError(f"timeout_ms must be > 0, got {timeout_ms}")
        return timeout_ms / 1000

    def __enter__(self) -> "Camera":
        return self if self._grabber is not None else self.connect()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.disconnect()

    def __repr__(self) -> str:
        return f"Camera({self.config.name!r}, {'connected' if self.is_connected else 'not connected'})"


def _with_stable_path(config: CameraConfig) -> CameraConfig:
    """Replace the source of a device by its path in `/dev/v4l/by-id`, if there is one.

    This path contains the camera's serial number, so it is the same after replugging.
    """
    if config.kind != "device":
        return config
    path = devices.device_path(config.target)
    stable = devices.stable_path(path)
    return config if stable == path or not Path(path).exists() else dataclasses.replace(config, source=stable)
