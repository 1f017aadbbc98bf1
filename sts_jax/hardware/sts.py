"""`STS`: camera and lights as one sensor. The lights do not change during the exposure of a returned image."""

import dataclasses
import itertools
import os
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8

from sts_jax.hardware import protocol
from sts_jax.hardware.background import Background
from sts_jax.hardware.camera import (
    CameraConfig,
    CameraError,
    CameraNotConnectedError,
    FoundCamera,
    StaleFrameError,
    find_cameras,
)
from sts_jax.hardware.leds import Leds, Port, find_controllers
from sts_jax.hardware.opencv import OpenCVCamera
from sts_jax.hardware.proof import NotStillError, Pair, ProvenFrames, Settling, Shot, Stream, thumbnail
from sts_jax.hardware.sensor_file import Device

_SWITCHES = 8  # number of switches in each direction that measure the settling times
_STILL = 6.0  # change of a thumbnail's pixel that always counts as still (of 255)
_NOISE = 8.0  # multiple of the median change that counts as still too. The noise of a camera reaches 5 times the median


class FoundSensors(NamedTuple):
    """The cameras and the serial ports of this machine. An `STS` needs one camera and one serial port."""

    cameras: list[FoundCamera]  # cameras, as `find_cameras` lists them
    ports: list[Port]  # serial ports to which an LED controller may be connected, as `find_controllers` lists them


def find_sensors() -> FoundSensors:
    """List the cameras and serial ports of this machine. No serial port is opened."""
    return FoundSensors(find_cameras(), find_controllers())


class STS:
    """A See-Through-your-Skin sensor.

    ```python
    with STS(camera="/dev/v4l/by-id/usb-Maker_Camera_0123-video-index0", leds="/dev/ttyACM0") as sensor:
        pair = sensor.read()  # pair.visual.image and pair.tactile.image
    ```

    The lights are off in the visual stream and on in the tactile stream. For each returned image, it is proven that the
    lights were in the right state during the whole exposure. A frame of the camera must meet all of these conditions:

    - It arrived after the settling time. This time begins when the LED controller acknowledges the switch of the
      lights. Earlier frames may show the previous state of the lights.
    - It is the second of two successive frames that show the effect of the switch, or it arrived after these frames.
    - After the frame arrived, the controller answered the next request. This answer shows that the lights have not
      changed since the acknowledgement.
    - It was not delayed. A delayed frame may have been exposed long before it arrived.
    - It is not identical to the frame before. This condition is omitted if `CameraConfig.frozen_after_s` is None.
    - It is not black. This condition is omitted if the last image of the same stream was black, or if no image of this
      stream has been returned since `connect`.

    All other frames are discarded. Only one thread may use a sensor at a time.
    """

    def __init__(
        self,
        *,
        camera: CameraConfig | OpenCVCamera | str | int | Path,
        leds: str | Leds,
        levels: Sequence[int] = (255, 255, 255, 255),
        settling: Settling | None = None,
        exposures: tuple[float, float] | None = None,
        timeout_s: float = 5.0,
        reconnect_s: float = 30.0,
    ):
        """Keep the configuration. `connect` opens the devices.

        Args:
            camera: A `Camera`, its `CameraConfig`, or the `source` of a `CameraConfig`: the index or path of a device,
                or the URL of a stream.
            leds: An open LED controller, or the name of its port. `disconnect` closes the controller in both cases, and
                a later `connect` opens its port again.
            levels: Duty cycles of the four channels in the tactile stream, 0 to 255. All are 0 in the visual stream.
            settling: Settling times from an earlier measurement with the same devices. After each switch of the lights,
                frames are discarded for the settling time. None: `connect` measures the settling times, which needs a
                scene at rest.
            exposures: Exposures of the visual and of the tactile stream, in the unit of the camera's driver. If they
                differ, the source of the camera must be a device, not a stream or a file, and the exposure is set at
                each switch of the lights. If the two exposures are equal, `STS` does not set them: use
                `CameraConfig.exposure` instead. None: not changed.
            timeout_s: Longest wait for one image (s), not counting the time of a reconnection.
            reconnect_s: Longest search for a controller that was lost (s).

        Raises:
            ValueError: There are not four levels in 0 to 255, all levels are 0, an exposure is not positive, or a time
                is not positive and finite.
        """
        if exposures is not None and not min(exposures) > 0:
            raise ValueError(f"exposures must be two numbers > 0 (visual, tactile) or None, got {exposures}")
        self._levels = checked_levels(levels)
        for name, value in (("timeout_s", timeout_s), ("reconnect_s", reconnect_s)):
            if not 0 < value < float("inf"):
                raise ValueError(f"{name} must be positive and finite, got {value}")
        if isinstance(camera, OpenCVCamera):
            self._camera = camera
        else:
            config = camera if isinstance(camera, CameraConfig) else CameraConfig(camera)
            self._camera = OpenCVCamera(dataclasses.replace(config, buffer=max(config.buffer, 8)))
        self._port = leds.port if isinstance(leds, Leds) else leds
        self._leds: Leds | None = leds if isinstance(leds, Leds) else None
        self._settling = settling
        self._exposures = exposures
        self._device: Device | None = None
        self._timeout_s, self._reconnect_s = timeout_s, reconnect_s
        self._frames: ProvenFrames | None = None  # None before the first `connect`
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
        """Make the sensor that a sensor file describes. `python -m experiments.commission` writes such files.

        ```python
        with STS.from_file("bench") as sensor:  # the folder "bench" contains the sensor file
            pair = sensor.read()
        ```

        The file contains the path or URL of the camera, the serial number of the LED controller, the size and rate of
        the images, the exposures, the light levels and the settling times. The settling times are not measured again,
        so the scene need not be at rest.

        Args:
            path: Path of the sensor file or of the folder that contains it.
            camera: Another source for the same camera, such as its URL with a password, or a whole configuration.
                None: the configuration of the file.
            leds: Name of the controller's port. It is needed for a port that is not a USB device, such as a
                pseudo-terminal. None: `connect` searches all USB ports for the controller's serial number.
            timeout_s: Longest wait for one image (s), not counting the time of a reconnection.
            reconnect_s: Longest search for a controller that was lost (s).

        Returns:
            The sensor. Call `connect` before the first image.

        Raises:
            FileNotFoundError: There is no such file.
            SensorFileError: The file is damaged, or has no description of a camera and lights.
            WrongDeviceError: The camera is not the camera that the file names. `connect` raises the same error if the
                LED controller is not the controller that the file names.
            ValueError: A time is not positive and finite.
        """
        device = Device.load(path)
        config = camera if isinstance(camera, CameraConfig) else device.camera_config(camera)
        device.check_identity(camera=OpenCVCamera(config).source)
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
        """The content of the sensor file: a description of the camera, the lights and the lens.

        None if the sensor was not made by `from_file`.
        """
        return self._device

    @property
    def camera(self) -> OpenCVCamera:
        """The `Camera` that takes the sensor's images."""
        return self._camera

    @property
    def leds(self) -> Leds:
        """The open connection to the LED controller, which switches the sensor's lights.

        Raises:
            CameraNotConnectedError: The sensor is not connected.
        """
        if self._leds is None:
            raise CameraNotConnectedError("the sensor is not connected: call connect() first.")
        return self._leds

    @property
    def levels(self) -> protocol.Levels:
        """Duty cycles of the four LED channels while tactile images are taken, 0 (off) to 255 (always on)."""
        return self._levels

    @property
    def discarded(self) -> int:
        """Number of frames since `connect` that were discarded, such as those before the lights have settled."""
        return 0 if self._frames is None else self._frames.discarded

    @property
    def settling(self) -> Settling:
        """The settling times. After the lights are switched off or on, frames are discarded for the settling time.

        Raises:
            CameraNotConnectedError: No settling times were given, and `connect` has not measured them yet.
        """
        if self._settling is None:
            raise CameraNotConnectedError("the settling times were not measured yet: call connect() first.")
        return self._settling

    def connect(self, warmup_s: float = 1.0) -> "STS":
        """Open the camera and the LED controller, and measure the settling times unless they were given.

        After the lights are switched on or off, frames may still show the previous state of the lights for a short
        time. This time is the settling time. Even if the settling times were given, `connect` switches the lights on
        and off. This provides a visual and a tactile image, with which later images are compared.

        Args:
            warmup_s: Time for the camera's automatic exposure and white balance to settle before they are locked (s).

        Returns:
            This sensor.

        Raises:
            LedError: The controller cannot be opened, or does not answer. Subclasses name the cause.
            CameraError: The camera cannot be opened, sends no frames, or does not accept the `exposures` that were
                given. Subclasses name the cause.
            NoContrastError: The lights do not change the image.
            LightError: The settling times could not be measured, because the image keeps changing.
            WrongDeviceError: The LED controller is not the controller that the sensor file names.
            ValueError: `warmup_s` is negative or not finite.
        """
        if self._leds is None:
            if self._device is not None and not self._port:
                self._leds = Leds.find(self._device.leds)
            else:
                self._leds = Leds.connect(self._port)
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
        """Turn the lights off, and close the camera and the LED controller.

        Repeated calls have no effect.
        """
        self._stop_background()
        leds, self._leds = self._leds, None
        if leds is not None:
            leds.close()
        self._camera.disconnect()

    def read(self, timeout_ms: float | None = None) -> Pair:
        """Take one image of the visual stream and one image of the tactile stream.

        Both frames arrive after the start of the call. However, the exposure of the first frame may begin before the
        call. The time from this beginning to the call is at most the settling time of the lights (`settling`). The
        first image belongs to the stream for which the lights are already set, so the lights are switched only once for
        a pair.

        Args:
            timeout_ms: Longest wait for the pair (ms). None: two times the sensor's `timeout_s`. If the LED controller
                is lost during the wait, the limit is extended by the duration of the reconnection. The last request to
                the controller may exceed the limit.

        Returns:
            The two images.

        Raises:
            LightError: Within `timeout_ms`, no frame of one of the streams met the conditions that the description of
                `STS` lists.
            LedError: The controller does not answer, or a lost controller was not found within `reconnect_s`.
            CameraError: The sensor is not connected, or the camera sends no usable frames. For the subclasses of
                `CameraError`, see `Camera.read`.
            ValueError: `timeout_ms` is not positive.
        """
        self._stop_background()
        return self._connected.pair(time.monotonic() + self._limit_s(timeout_ms, 2))

    def async_read(self, timeout_ms: float | None = None) -> Pair:
        """Return the newest pair of images that this method has not returned yet, or wait for the next pair.

        The first call starts a thread that takes pairs continuously, until `read`, `stream`, `wait_until_still` or
        `disconnect` is called. An error ends the thread. The first call of `async_read` or `read_latest` after the
        error raises the same error, and the second call starts a new thread.

        Args:
            timeout_ms: Longest wait (ms). None: three times the sensor's `timeout_s`.

        Returns:
            The two images.

        Raises:
            LightError: No pair was taken in time.
            LedError, CameraError, ValueError: The causes are those of `read`.
        """
        return self._started().next(self._limit_s(timeout_ms, 3))

    def read_latest(self, max_age_ms: float = 500.0) -> Pair:
        """Return, without waiting, the newest pair of images that the thread of `async_read` has taken.

        The same pair may be returned several times. The thread is started if it is not running.

        Args:
            max_age_ms: Largest allowed time since the arrival of the pair's older frame (ms).

        Returns:
            The two images.

        Raises:
            StaleFrameError: The newest pair is older than `max_age_ms`, or no pair has been taken yet.
            LightError, LedError, CameraError: The thread has ended with this error. The causes are those of `read`.
            ValueError: `max_age_ms` is not positive.
        """
        if not max_age_ms > 0:
            raise ValueError(f"max_age_ms must be > 0, got {max_age_ms}")
        pair = self._started().latest()
        taken_s = None if pair is None else min(pair.visual.time_s, pair.tactile.time_s)
        if pair is None or taken_s is None:
            raise StaleFrameError(
                "no pair of a visual and a tactile image has been taken yet: call async_read() to wait for the first "
                "pair."
            )
        age_ms = 1000 * (time.monotonic() - taken_s)
        if age_ms > max_age_ms:
            raise StaleFrameError(
                f"the newest pair is {age_ms:.0f} ms old, but at most {max_age_ms:g} ms are allowed: raise max_age_ms, "
                "or call read() to take a new pair."
            )
        return pair

    def stream(self, duty: float = 0.5, *, dwell: int = 1) -> Iterator[Shot]:
        """Return an endless iterator over images of the visual stream and the tactile stream.

        Args:
            duty: Share of tactile images, 0 to 1.
            dwell: Number of successive images of one stream, >= 1. With a larger number, the lights switch less often.
                Each switch costs the settling time.

        Returns:
            The iterator. Each step waits for one image, for at most the sensor's `timeout_s`. If the LED controller is
            lost, the limit is extended by the duration of the reconnection.

        Raises:
            ValueError: An argument is out of range.
            LightError, LedError, CameraError: A step of the iterator fails. The causes are those of `read`.
        """
        stream_order(duty, dwell)
        self._stop_background()
        return self._images(duty, dwell)

    def wait_until_still(self, timeout_s: float = 10.0, *, window_s: float = 0.5) -> Shot:
        """Wait until nothing moves in the visual stream.

        Each image is divided into 32 x 24 blocks, and the mean colours of the blocks (0 to 255) are compared. The view
        counts as still if, for `window_s` seconds, no block differs by more than a limit from the same block at the
        beginning of this period. The limit is 8 times the median difference over all blocks, but at least 6.

        Args:
            timeout_s: Time after the first image at which the method gives up (s).
            window_s: Time during which the view must not change (s).

        Returns:
            The last image of the period in which the view was still.

        Raises:
            NotStillError: Within `timeout_s`, there was no period of `window_s` without movement.
            LightError, LedError, CameraError: The causes are those of `read`.
        """
        self._stop_background()
        return first_still(self._images(0.0, 1), timeout_s, window_s)

    def measure_settling(self, switches: int = _SWITCHES, *, watch_s: float = 1.0) -> Settling:
        """Measure the settling times, and use them from now on. The scene must be at rest.

        The lights are switched several times in each direction, and the frames after each switch are compared. The
        first frames may still show the previous state of the lights, fully or partly. The delay of a frame is the time
        from the controller's acknowledgement of the switch to the arrival of the frame. The settling time is the
        largest delay of all frames that still show the previous state fully or partly, plus the time between two
        frames.

        Args:
            switches: Number of switches of the lights in each direction, off to on and on to off.
            watch_s: Time for which frames are collected after the first switch in each direction (s). It must be longer
                than the settling times. After the later switches, frames are collected for a shorter time, which is
                computed from the frames after the first switches.

        Returns:
            The settling times.

        Raises:
            NoContrastError: The lights do not change the image.
            LightError: In each of three attempts, the image was still changing at the end of the time `watch_s` after a
                switch.
            LedError: The controller does not answer.
            CameraError: The sensor is not connected, or the camera sends no usable frames.
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
        """Return the thread that takes pairs. A new one replaces a thread whose error was raised already."""
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
    """Return an endless iterator that chooses "visual" or "tactile" for each successive image.

    Args:
        duty: Share of tactile images, 0 to 1. After each group of `dwell` images, the share of tactile images so far
            is as close to `duty` as possible.
        dwell: Number of successive images in a group, >= 1. All images of a group are of the same stream.

    Returns:
        The iterator, whose items are "visual" or "tactile".

    Raises:
        ValueError: An argument is out of range.
    """
    if not 0 <= duty <= 1:
        raise ValueError(f"duty, the share of tactile images, must be in [0, 1], got {duty}")
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
    """Wait until the view has been still for `window_s` seconds, and return the last image of this period.

    See `STS.wait_until_still` for the definition of a still view.

    Args:
        shots: Successive images of the visual stream.
        timeout_s: Time after the first image at which the function gives up (s).
        window_s: Time during which the view must not change (s).

    Raises:
        NotStillError: The limit `timeout_s` was exceeded, or `shots` ended, before the view was still for `window_s`
            seconds.
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
        f"within {timeout_s:g} s, there was no period of {window_s:g} s without movement. An image counts as still if "
        f"no part of it differs from the first image of the period by more than {allowed:.2f} of 255. For the last "
        f"image, the largest difference was {change:.2f}. Keep the scene at rest, raise timeout_s, or check whether "
        "the light of the room changes."
    )


def checked_levels(levels: Sequence[int]) -> protocol.Levels:
    """Check the levels of the lights in the tactile stream, and return them as a tuple of four integers.

    Raises:
        ValueError: The number of levels is not four, a level is not an integer from 0 to 255, or all levels are 0.
    """
    values = tuple(int(level) for level in levels)
    allowed = values == tuple(levels) and all(0 <= value <= 255 for value in values) and any(values)
    if len(values) != protocol.CHANNELS or not allowed:
        raise ValueError(f"levels must be four integers from 0 to 255, at least one above 0, got {tuple(levels)}")
    first, second, third, fourth = values
    return first, second, third, fourth


SATURATED = 250.0  # brightness of 255 from which details are lost
_PERCENTILE = 99
_WANTED = 200.0  # wanted brightness, of 255
_TOLERANCE = 25.0  # largest difference from the wanted brightness, of 255
_DARKER = 0.4  # factor on the exposure of a saturated image, whose true brightness is unknown
_MOST = 4.0  # largest factor on the exposure in one attempt
_ATTEMPTS = 10
LAG_S = 0.3  # time after which all frames have the new exposure (s)


class Exposed(NamedTuple):
    """An exposure and the brightness of an image that was taken with it."""

    exposure: float  # exposure that is set, in the unit of the camera's driver
    brightness: float  # result of the function `brightness` for this image, 0 to 255


def brightness(image: UInt8[np.ndarray, "height width 3"]) -> float:
    """Return the brightness of an image, 0 to 255.

    The function takes the largest colour value of each pixel. The brightness is the 99th percentile of these values.

    Args:
        image: RGB image.
    """
    return float(np.percentile(image.max(axis=-1), _PERCENTILE))


def choose_exposure(camera: OpenCVCamera, *, longest: float) -> Exposed:
    """Set the exposure of a camera so that its images are bright but not saturated.

    The exposure is adjusted, in at most 10 attempts, until the brightness of an image is between 175 and 225. To
    compute the brightness, the largest of the three colour values of each pixel is taken. The brightness is the 99th
    percentile of these values (0 to 255). The search also stops if the driver does not change the exposure any more.

    Args:
        camera: Connected camera whose driver can set the exposure. Before the call, switch the sensor's lights on
            for the exposure of the tactile stream, or off for the exposure of the visual stream.
        longest: Largest allowed exposure, in the unit of the driver. An exposure that is longer than the time between
            two frames lowers the frame rate.

    Returns:
        The exposure that is set now, and the brightness of an image with this exposure. If the search has failed, the
        image may still be too dark, or saturated (brightness of at least 250).

    Raises:
        CameraError: The driver does not allow setting the exposure, or the camera sends no frames.
    """
    found = camera.set_exposure(min(camera.locked.get("exposure") or longest, longest))
    for _ in range(_ATTEMPTS):
        if found is None:
            break
        time.sleep(LAG_S)
        seen = brightness(camera.read().image)
        if abs(seen - _WANTED) <= _TOLERANCE:
            return Exposed(found, seen)
        factor = _DARKER if seen >= SATURATED else min(_WANTED / max(seen, 1.0), _MOST)
        wanted = min(max(found * factor, 1.0), longest)
        before, found = found, camera.set_exposure(wanted)
        if found == before:
            return Exposed(found, seen)
    if found is None:
        raise CameraError(
            f"the driver of {camera.config.name} does not support a manual exposure: use the camera's automatic "
            "exposure instead of choose_exposure()."
        )
    time.sleep(LAG_S)
    return Exposed(found, brightness(camera.read().image))
