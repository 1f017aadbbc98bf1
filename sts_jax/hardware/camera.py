"""`Camera`: frames of a V4L2 device, a stream or a video file, each with its time."""

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
    """A camera, a stream or a video file.

    ```python
    with Camera(CameraConfig("/dev/v4l/by-id/usb-Maker_Camera_0123-video-index0")) as camera:
        frame = camera.read()
    ```

    A thread fetches the frames continuously, so no frame grows old in the driver. If the device is lost, the thread
    opens it again under the same path or URL, and later frames have another `epoch`. Threads may share a camera. A
    frame is returned by `async_read` to one of them only.
    """

    def __init__(self, config: CameraConfig):
        """Keep the configuration. `connect` opens the camera."""
        self.config = config
        self._grabber: Grabber | None = None

    def connect(self, warmup_s: float = 1.0) -> "Camera":
        """Open the camera, let its automatic controls settle, and lock them.

        It takes at most `warmup_s` and four times `timeout_s`. A video file starts at its first frame, without a
        warm-up.

        Args:
            warmup_s: time for exposure and white balance to settle (s). The frames of this time are discarded.

        Returns:
            This camera.

        Raises:
            CameraError: the camera is connected already, or cannot be opened. Subclasses name the cause.
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
        except BaseException:  # also a warning that is turned into an error
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
                f"{config.name} is a stream, whose AUTO_EXPOSURE and AUTO_WB cannot be turned off from here: lock them "
                "at its server, then pass lock=False in CameraConfig.",
                stacklevel=3,
            )

    def disconnect(self) -> None:
        """Close the camera, within `timeout_s` and a second. Without a connection, it does nothing."""
        grabber, self._grabber = self._grabber, None
        if grabber is not None and not grabber.stop():
            warnings.warn(
                f"the driver of {self.config.name} does not return. The camera is closed as soon as it does.",
                stacklevel=2,
            )

    @property
    def is_connected(self) -> bool:
        """Whether frames can be expected. False while the camera is lost, and after the end of a video file."""
        return self._grabber is not None and self._grabber.running

    @property
    def statistics(self) -> CameraStatistics:
        """Counts since `connect`."""
        return self._connected().statistics

    @property
    def refused(self) -> tuple[str, ...]:
        """The settings that the driver did not accept when it was last opened."""
        return tuple(self._connected().refused)

    @property
    def source(self) -> str:
        """The camera's identity: its path, which contains its serial number if it has one, or its URL.

        User name and password of a URL are left out.
        """
        config = _with_stable_path(self.config)
        return devices.device_path(config.target) if config.kind == "device" else config.public

    @property
    def locked(self) -> dict[str, float]:
        """The values of the locked settings of a device, by field of `CameraConfig`. Empty for streams and files."""
        return self._connected().held

    def set_exposure(self, exposure: float) -> float | None:
        """Set the exposure of a device, between two frames. The frames that show it first come some frames later.

        Args:
            exposure: in the driver's unit (V4L2: 0.1 ms).

        Returns:
            The exposure that the device has now, which drivers round and limit. None: the driver does not let it be
            set.

        Raises:
            CameraError: the source is no device, or no frame has arrived in time.
        """
        if not exposure > 0:
            raise ValueError(f"exposure must be > 0, got {exposure}")
        if self.config.kind != "device":
            raise CameraError(f"the exposure of {self.config.name} is not set from here: set it at its server.")
        return self._connected().set_exposure(exposure, self.config.timeout_s)

    def read(self, timeout_ms: float | None = None) -> Captured:
        """Return a frame that was exposed after the call.

        The first `in_flight` frames that arrive after the call are discarded, because they may have been exposed
        before it. Of a video file, the next frame is returned.

        Args:
            timeout_ms: longest wait (ms), None: `timeout_s`. A call that begins while the camera is lost waits as long
                for its return.

        Raises:
            CameraTimeoutError: no such frame has arrived in time.
            CameraLostError: the camera is lost.
            FrozenCameraError: the camera has sent the same image for longer than `frozen_after_s`.
            FrameSizeError: the camera sends frames of another size.
            EndOfVideoError: the video file has ended.
            CameraNotConnectedError: the camera is not connected.
        """
        return self._connected().wait(self._timeout_s(timeout_ms), exposed_now=self.config.kind != "file")

    def async_read(self, timeout_ms: float | None = None) -> Captured:
        """Return the oldest of the newest `buffer` frames that has not been returned yet, or wait for the next frame.

        Args and errors are those of `read`.
        """
        return self._connected().wait(self._timeout_s(timeout_ms), exposed_now=False)

    def read_latest(self, max_age_ms: float = 500.0) -> Captured:
        """Return the newest frame without waiting. The same frame may be returned several times.

        Args:
            max_age_ms: largest allowed time since the frame's arrival (ms).

        Raises:
            StaleFrameError: the newest frame is older.
            CameraError: there are no frames at present, for the reasons that `read` states.
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
                "allowed: check the device or its server, or raise max_age_ms."
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
    """Replace the number of a device by its path with its serial number, under which it returns after replugging."""
    if config.kind != "device":
        return config
    path = devices.device_path(config.target)
    stable = devices.stable_path(path)
    return config if stable == path or not Path(path).exists() else dataclasses.replace(config, source=stable)
