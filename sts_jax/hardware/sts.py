"""`STS`: camera and lights as one sensor. Every image is proven to be of one light."""

import dataclasses
import itertools
import os
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

import numpy as np

from sts_jax.hardware import protocol
from sts_jax.hardware.background import Background
from sts_jax.hardware.camera import Camera
from sts_jax.hardware.camera_config import CameraConfig
from sts_jax.hardware.camera_errors import CameraNotConnectedError, StaleFrameError
from sts_jax.hardware.devices import FoundCamera, find_cameras
from sts_jax.hardware.leds import Leds
from sts_jax.hardware.ports import Port, find_controllers
from sts_jax.hardware.proof import ProvenFrames
from sts_jax.hardware.sensor_file import Device
from sts_jax.hardware.settling import Settling, thumbnail
from sts_jax.hardware.shots import NotStillError, Pair, Shot, Stream

_SWITCHES = 8  # of each direction, to measure the settling
_STILL = 6.0  # of 255, change of a thumbnail's pixel that always counts as still
_NOISE = 8.0  # times the median change of all pixels, which counts as still too. Noise has changes of 5 times that


class FoundSensors(NamedTuple):
    """Cameras and serial ports of this machine, of which sensors can consist."""

    cameras: list[FoundCamera]
    ports: list[Port]


def find_sensors() -> FoundSensors:
    """The cameras and serial ports of this machine. Nothing is opened."""
    return FoundSensors(find_cameras(), find_controllers())


class STS:
    """A See-Through-your-Skin sensor.

    ```python
    with STS(camera="/dev/v4l/by-id/usb-Maker_Camera_0123-video-index0", leds="/dev/ttyACM0") as sensor:
        pair = sensor.read()  # pair.visual.image and pair.tactile.image
    ```

    A frame counts as of one light if it arrives later than the settling time after the controller's acknowledgement, if
    two frames in a row have shown since the switch that the image has changed, and if the controller's next answer
    proves that its lights have not changed in between. All other frames are discarded, also those of a stalled stream
    that arrive late, those that repeat the frame before them (unless the camera's `frozen_after_s` is None), and black
    ones of a stream that was not black.

    One thread may use a sensor at a time.
    """

    def __init__(
        self,
        *,
        camera: CameraConfig | Camera | str | int | Path,
        leds: str | Leds,
        levels: Sequence[int] = (255, 255, 255, 255),
        settling: Settling | None = None,
        exposures: tuple[float, float] | None = None,
        timeout_s: float = 5.0,
        reconnect_s: float = 30.0,
    ):
        """Keep the configuration. `connect` opens the devices.

        Args:
            camera: A camera, its configuration, or its source.
            leds: An open controller, or the name of its port.
            levels: Duty cycles of the four channels in the tactile stream, 0 to 255. All are 0 in the visual stream.
            settling: Times after which a switch shows, from the sensor file or an earlier connection. None: measured by
                `connect`, which needs a scene at rest.
            exposures: Exposure of the visual and of the tactile stream, in the unit of the camera's driver, set at each
                switch of the lights. None: the camera's own. Needs a camera that is a device.
            timeout_s: Longest time of one image (s), without the time of a reconnection.
            reconnect_s: Longest search for a lost controller (s).

        Raises:
            ValueError: A level is out of range or all are 0, or a time or an exposure is not positive.
        """
        if exposures is not None and not min(exposures) > 0:
            raise ValueError(f"exposures must be > 0, got {exposures}")
        self._levels = checked_levels(levels)
        for name, value in (("timeout_s", timeout_s), ("reconnect_s", reconnect_s)):
            if not 0 < value < float("inf"):
                raise ValueError(f"{name} must be positive and finite, got {value}")
        if isinstance(camera, Camera):
            self._camera = camera
        else:
            config = camera if isinstance(camera, CameraConfig) else CameraConfig(camera)
            self._camera = Camera(dataclasses.replace(config, buffer=max(config.buffer, 8)))
        self._port = leds
        self._leds: Leds | None = leds if isinstance(leds, Leds) else None
        self._settling = settling
        self._exposures = exposures
        self._device: Device | None = None
        self._timeout_s, self._reconnect_s = timeout_s, reconnect_s
        self._frames: ProvenFrames | None = None  # of the last connection
        self._background: Background | None = None

    @classmethod
    def from_file(
        cls,
        path: str | os.PathLike,
        *,
        camera: CameraConfig | str | None = None,
        leds: str | None = None,
        timeout_s: float = 5.0,
        reconnect_s: float = 30.0,
    ) -> "STS":
        """The sensor of a file that `python -m experiments.commission` wrote.

        ```python
        with STS.from_file("bench") as sensor:
            pair = sensor.read()
        ```

        The camera is the one at the path or URL of the file. The LED controller is looked for on all USB ports by its
        serial number. Size, rate, exposures, light levels and settling times are those of the file, so the scene need
        not be at rest.

        Args:
            path: Path of the sensor file or of its folder.
            camera: Source of the camera, such as its URL with a password, or its whole configuration. None: that of the
                file.
            leds: Port of the controller, such as a pseudo-terminal, which is not on the list of USB ports. None: found
                by `connect`.
            timeout_s: As in `STS`.
            reconnect_s: As in `STS`.

        Returns:
            The sensor, which is not connected yet.

        Raises:
            FileNotFoundError: There is no such file.
            SensorFileError: The file is damaged or describes no device.
            WrongDeviceError: The camera is not the one of the file. `connect` raises it if the controller is not.
        """
        device = Device.load(path)
        config = camera if isinstance(camera, CameraConfig) else device.camera_config(camera)
        device.check_identity(camera=Camera(config).source)
        sensor = cls(
            camera=config,
            leds=leds or "",
            levels=device.levels,
            settling=Settling(device.settle_off_s, device.settle_on_s),
            exposures=device.exposures if config.kind == "device" else None,
            timeout_s=timeout_s,
            reconnect_s=reconnect_s,
        )
        sensor._device = device
        return sensor

    @property
    def device(self) -> Device | None:
        """The content of the sensor file, or None if the sensor was not made by `from_file`."""
        return self._device

    @property
    def camera(self) -> Camera:
        """The camera."""
        return self._camera

    @property
    def leds(self) -> Leds:
        """The LED controller.

        Raises:
            CameraNotConnectedError: The sensor is not connected.
        """
        if self._leds is None:
            raise CameraNotConnectedError("the sensor is not connected: call connect() first.")
        return self._leds

    @property
    def levels(self) -> protocol.Levels:
        """Duty cycles of the channels in the tactile stream, 0 to 255."""
        return self._levels

    @property
    def discarded(self) -> int:
        """Number of frames since `connect` that could not be proven to be of one light."""
        return 0 if self._frames is None else self._frames.discarded

    @property
    def settling(self) -> Settling:
        """The settling times that are in use.

        Raises:
            CameraNotConnectedError: They were not given, and the sensor is not connected.
        """
        if self._settling is None:
            raise CameraNotConnectedError("the settling times are not known yet: call connect() first.")
        return self._settling

    def connect(self, warmup_s: float = 1.0) -> "STS":
        """Open both devices, switch the lights on and off, and measure the settling times unless they were given.

        Args:
            warmup_s: Time for the camera's automatic controls to settle (s).

        Returns:
            This sensor.

        Raises:
            LedError: The controller cannot be opened. Subclasses name the cause.
            CameraError: The camera cannot be opened. Subclasses name the cause.
            NoContrastError: The lights do not change the image.
            WrongDeviceError: The controller is not the one of the sensor file.
        """
        if self._leds is None:
            if self._device is not None and not self._port:
                self._leds = Leds.find(self._device.leds)
            else:
                self._leds = Leds.connect(str(self._port))
        try:
            if self._device is not None:
                self._device.check_identity(leds=self._leds.serial_number)
            if not self._camera.is_connected:
                self._camera.connect(warmup_s)
            self._frames = ProvenFrames(
                self._camera,
                self._leds,
                levels=self._levels,
                exposures=self._exposures,
                timeout_s=self._timeout_s,
                reconnect_s=self._reconnect_s,
            )
            if self._settling is None:
                self.measure_settling()
            else:
                self._frames.see_both(self._settling)
        except BaseException:
            self.disconnect()
            raise
        return self

    def disconnect(self) -> None:
        """Turn the lights off and close both devices. Without a connection, it does nothing."""
        self._stop_background()
        leds, self._leds = self._leds, None
        if leds is not None:
            leds.close()
        self._camera.disconnect()

    def read(self, timeout_ms: float | None = None) -> Pair:
        """Take an image of each stream. Both arrive after the call.

        A frame was exposed at most the settling time before its arrival. The stream whose light is on comes first, so
        successive pairs need one switch each.

        Args:
            timeout_ms: Longest time (ms), None: two times `timeout_s`. A reconnection comes on top, and so does the
                last request to the controller, whose time `Leds` states.

        Raises:
            LightError: No frame could be proven to be of the wanted light in time.
            LedError: The controller does not answer, or was not found again.
            CameraError: There are no frames, for the reasons that `Camera.read` states.
        """
        self._stop_background()
        return self._connected.pair(time.monotonic() + self._limit_s(timeout_ms, 2))

    def async_read(self, timeout_ms: float | None = None) -> Pair:
        """Return the newest pair that has not been returned yet, or wait for the next one.

        The first call starts a thread that takes pairs continuously, until `read`, `stream`, `wait_until_still` or
        `disconnect` is called.

        Args:
            timeout_ms: Longest wait (ms), None: three times `timeout_s`.

        Raises:
            LightError: No pair came in time.
            LedError: As in `read`.
            CameraError: As in `read`.
        """
        return self._started().next(self._limit_s(timeout_ms, 3))

    def read_latest(self, max_age_ms: float = 500.0) -> Pair:
        """Return the newest pair of the thread of `async_read` without waiting.

        Args:
            max_age_ms: Largest allowed time since the arrival of the older of its two frames (ms).

        Raises:
            StaleFrameError: The newest pair is older, or there is none yet.
            LedError: As in `read`.
            CameraError: As in `read`.
        """
        if not max_age_ms > 0:
            raise ValueError(f"max_age_ms must be > 0, got {max_age_ms}")
        pair = self._started().latest()
        taken_s = None if pair is None else min(pair.visual.time_s, pair.tactile.time_s)
        if pair is None or taken_s is None:
            raise StaleFrameError("no pair has been taken yet: call async_read() to wait for the first one.")
        age_ms = 1000 * (time.monotonic() - taken_s)
        if age_ms > max_age_ms:
            raise StaleFrameError(
                f"the newest pair is {age_ms:.0f} ms old, but at most {max_age_ms:g} ms are allowed: raise max_age_ms, "
                "or call read()."
            )
        return pair

    def stream(self, duty: float = 0.5, *, dwell: int = 1) -> Iterator[Shot]:
        """Images without end, a share of which is tactile.

        Args:
            duty: Share of tactile images, 0 to 1.
            dwell: Images of one stream before the lights may switch. A switch costs the settling time.

        Raises:
            ValueError: An argument is out of range.
            LightError, LedError, CameraError: As in `read`, at each image.
        """
        stream_order(duty, dwell)
        self._stop_background()
        return self._images(duty, dwell)

    def wait_until_still(self, timeout_s: float = 10.0, *, window_s: float = 0.5) -> Shot:
        """Wait until nothing moves in the visual stream.

        The view is still if no block of the image changes by more than 6 of 255, or by more than the noise of all
        blocks explains, during a window.

        Args:
            timeout_s: Longest wait (s).
            window_s: Length of the window (s).

        Returns:
            The last image of the window.

        Raises:
            NotStillError: Something still moves.
            LightError, LedError, CameraError: As in `read`.
        """
        self._stop_background()
        return first_still(self._images(0.0, 1), timeout_s, window_s)

    def measure_settling(self, switches: int = _SWITCHES, *, watch_s: float = 1.0) -> Settling:
        """Measure how long after an acknowledgement frames with the former light arrive, and use the result.

        Args:
            switches: Number of switches in each direction.
            watch_s: Time for which frames are watched after the first switch in each direction (s). The settling must
                be shorter. Later switches are watched for three times the settling that the first ones show.

        Raises:
            NoContrastError: The lights do not change the image.
            LightError: The image still changes at the end of a watch, three times in a row.
        """
        self._settling = self._connected.measure_settling(switches, watch_s)
        return self._settling

    def __enter__(self) -> "STS":
        return self if self._leds is not None and self._camera.is_connected else self.connect()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.disconnect()

    def _images(self, duty: float, dwell: int) -> Iterator[Shot]:
        for stream in stream_order(duty, dwell):
            yield self._connected.shot(stream, time.monotonic() + self._timeout_s)

    def _limit_s(self, timeout_ms: float | None, images: int) -> float:
        if timeout_ms is None:
            return images * self._timeout_s
        if not timeout_ms > 0:
            raise ValueError(f"timeout_ms must be > 0, got {timeout_ms}")
        return timeout_ms / 1000

    @property
    def _connected(self) -> ProvenFrames:
        if self._leds is None or self._frames is None:
            raise CameraNotConnectedError("the sensor is not connected: call connect() first.")
        return self._frames

    def _started(self) -> Background:
        """The thread in the background, a new one if the last one has failed and its error has been raised."""
        frames = self._connected
        if self._background is None or self._background.reported:
            self._background = Background(
                lambda: frames.pair(time.monotonic() + self._limit_s(None, 2)), interrupt=frames.stop
            )
        return self._background

    def _stop_background(self) -> None:
        background, self._background = self._background, None
        if background is not None:
            background.stop()
            self._connected.resume()


def stream_order(duty: float, dwell: int) -> Iterator[Stream]:
    """The streams of successive images, so that the share of tactile ones is as near to `duty` as possible.

    Args:
        duty: Share of tactile images, 0 to 1.
        dwell: Images of one stream before the other may follow.

    Raises:
        ValueError: An argument is out of range.
    """
    if not 0 <= duty <= 1:
        raise ValueError(f"duty must be in [0, 1], got {duty}")
    if dwell < 1:
        raise ValueError(f"dwell must be >= 1, got {dwell}")

    def order() -> Iterator[Stream]:
        number = tactile = 0
        while True:
            stream: Stream = "tactile" if tactile + 0.5 < duty * (number + 1) + 1e-9 else "visual"
            number, tactile = number + 1, tactile + (stream == "tactile")
            yield from itertools.repeat(stream, dwell)

    return order()


def first_still(shots: Iterable[Shot], timeout_s: float, window_s: float) -> Shot:
    """The first image at which nothing has moved during a window, see `STS.wait_until_still`.

    Args:
        shots: Successive images of the visual stream.
        timeout_s: Longest time from the first image (s).
        window_s: Length of the window (s).

    Raises:
        NotStillError: Something still moves.
    """
    started_s: float | None = None
    first, look, change, allowed = None, None, 0.0, _STILL
    for shot in shots:
        now = thumbnail(shot.image)
        changes = np.zeros(1) if look is None else np.abs(now - look)
        change, allowed = float(changes.max()), max(_STILL, _NOISE * float(np.median(changes)))
        started_s = shot.time_s if started_s is None else started_s
        if first is None or look is None or change > allowed or shot.epoch != first.epoch:
            first, look = shot, now
        elif shot.time_s - first.time_s >= window_s:
            return shot
        if shot.time_s - started_s > timeout_s:
            break
    raise NotStillError(
        f"the view still changes after {timeout_s:g} s, by {change:.0f} of 255 in one block (allowed are "
        f"{allowed:.0f}): wait longer, or check the room's light."
    )


def checked_levels(levels: Sequence[int]) -> protocol.Levels:
    """The levels of the tactile stream.

    Raises:
        ValueError: There are not four levels of 0 to 255, or all are 0.
    """
    values = tuple(int(level) for level in levels)
    if len(values) != protocol.CHANNELS or not all(0 <= value <= 255 for value in values) or not any(values):
        raise ValueError(f"levels must be four numbers from 0 to 255, at least one above 0, got {tuple(levels)}")
    first, second, third, fourth = values
    return first, second, third, fourth
