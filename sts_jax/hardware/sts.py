"""`STS`: camera and lights as one sensor. The lights do not change during the exposure of a returned image."""

import dataclasses
import functools
import itertools
import os
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8

from sts_jax.hardware import leds as leds_module
from sts_jax.hardware import protocol
from sts_jax.hardware.camera import Camera, CameraConfig, CameraError
from sts_jax.hardware.leds import Leds
from sts_jax.hardware.opencv import OpenCVCamera
from sts_jax.hardware.proof import Pair, ProvenFrames, Settling, Shot, Stream, thumbnail
from sts_jax.hardware.sensor_file import Device

_BUFFER = 8  # frames that the camera keeps while the controller answers
_STILL = 6.0  # change of a thumbnail's pixel that always counts as still (of 255)
_NOISE = 8.0  # multiple of the median change that counts as still too. The noise of a camera reaches 5 times the median

SATURATED = 250.0  # brightness of 255 from which details are lost
LAG_S = 0.3  # time after which all frames have the new exposure (s)
_PERCENTILE = 99
_WANTED = 200.0  # wanted brightness, of 255
_TOLERANCE = 25.0  # largest difference from the wanted brightness, of 255
_DARKER = 0.4  # factor on the exposure of a saturated image, whose true brightness is unknown
_MOST = 4.0  # largest factor on the exposure in one attempt
_ATTEMPTS = 10


class STS:
    """A See-Through-your-Skin sensor.

    ```python
    with STS(camera="/dev/v4l/by-id/usb-Maker_Camera_0123-video-index0", leds="/dev/ttyACM0") as sensor:
        pair = sensor.read()  # pair.visual.image and pair.tactile.image
    ```

    For each returned image, it is proven that the lights were in the right state during the whole exposure. A frame of
    the camera must meet all of these conditions:

    - It arrived after the settling time, which begins when the controller acknowledges the switch of the lights.
    - It is the second of two successive frames that show the effect of the switch, or it arrived after these frames.
    - The controller's next answer shows that the lights have not changed since the acknowledgement.
    - It was not delayed, repeats no earlier frame, and is not black after an image of the same stream that was not.

    All other frames are discarded. Only one thread may use a sensor at a time.

    Attributes:
        device: The content of the sensor file. None if the sensor was not made by `from_file`.
    """

    def __init__(
        self,
        *,
        camera: Camera | CameraConfig | str | int | Path,
        leds: str | Leds,
        levels: Sequence[int] = (255, 255, 255, 255),
        settling: Settling | None = None,
        exposures: tuple[float, float] | None = None,
        timeout_s: float = 5.0,
        reconnect_s: float = 30.0,
    ):
        """Keep the configuration. `connect` opens the devices.

        Args:
            camera: A `Camera`, or the configuration or the source of an `OpenCVCamera`.
            leds: An open LED controller, or the name of its port. `disconnect` closes the controller in both cases, and
                a later `connect` opens its port again.
            levels: Duty cycles of the four channels in the tactile stream, 0 to 255. All are 0 in the visual stream.
            settling: Settling times from an earlier measurement with the same devices. None: `connect` measures them,
                which needs a scene at rest.
            exposures: Exposures of the visual and of the tactile stream, in the unit of the camera's driver. If they
                differ, the exposure is set at each switch of the lights, else never. None: not changed.
            timeout_s: Longest wait for one image (s), not counting the time of a reconnection.
            reconnect_s: Longest search for a controller that was lost (s).
        """
        if exposures is not None and not min(exposures) > 0:
            raise ValueError(f"exposures must be two numbers > 0 (visual, tactile) or None, got {exposures}")
        self.levels = checked_levels(levels)
        for name, value in (("timeout_s", timeout_s), ("reconnect_s", reconnect_s)):
            if not 0 < value < float("inf"):
                raise ValueError(f"{name} must be positive and finite, got {value}")
        if isinstance(camera, str | int | Path):
            camera = CameraConfig(camera)
        if isinstance(camera, CameraConfig):
            camera = OpenCVCamera(dataclasses.replace(camera, buffer=max(camera.buffer, _BUFFER)))
        self.camera: Camera = camera
        self._port = leds.port if isinstance(leds, Leds) else leds
        self._leds: Leds | None = leds if isinstance(leds, Leds) else None
        self._settling = settling
        self.device: Device | None = None
        self._timeout_s = timeout_s
        self._frames: ProvenFrames | None = None  # None before the first `connect`
        self._prove = functools.partial(
            ProvenFrames, levels=self.levels, exposures=exposures, timeout_s=timeout_s, reconnect_s=reconnect_s
        )

    @classmethod
    def from_file(
        cls,
        path: str | os.PathLike,
        *,
        camera: CameraConfig | str | None = None,
        leds: str | None = None,
    ) -> "STS":
        """Make the sensor that a sensor file describes. `python -m experiments.commission` writes such files.

        Args:
            path: Path of the sensor file or of the folder that contains it.
            camera: Another source for the same camera, such as its URL with a password, or a whole configuration.
            leds: Name of the controller's port, needed for a port that is not a USB device. None: `connect` searches
                all USB ports for the controller's serial number.
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
        )
        sensor.device = device
        return sensor

    @property
    def leds(self) -> Leds:
        """The open connection to the LED controller."""
        if self._leds is None:
            raise CameraError("the sensor is not connected: call connect() first.")
        return self._leds

    @property
    def discarded(self) -> int:
        """Number of frames since `connect` that were discarded, such as those before the lights have settled."""
        return 0 if self._frames is None else self._frames.discarded

    @property
    def settling(self) -> Settling:
        """The settling times, given or measured by `connect`."""
        if self._settling is None:
            raise CameraError("the settling times were not measured yet: call connect() first.")
        return self._settling

    def connect(self, warmup_s: float = 1.0) -> "STS":
        """Open the camera and the LED controller, and measure the settling times unless they were given.

        Args:
            warmup_s: Time for the camera's automatic exposure and white balance to settle before they are locked (s).
        """
        if self._leds is None and self.device is not None and not self._port:
            self._leds = Leds.find(self.device.leds)
        elif self._leds is None:
            self._leds = Leds.connect(self._port)
        try:
            if self.device is not None:
                self.device.check_identity(leds=self._leds.serial_number)
            if not self.camera.is_connected:
                self.camera.connect(warmup_s)
            self._frames = self._prove(self.camera, self._leds)
            if self._settling is None:
                self.measure_settling()
            else:
                self._frames.see_both(self._settling)
        except BaseException:
            self.disconnect()
            raise
        return self

    def disconnect(self) -> None:
        """Turn the lights off, and close the camera and the LED controller. Repeated calls have no effect."""
        leds, self._leds = self._leds, None
        if leds is not None:
            leds.close()
        self.camera.disconnect()

    def read(self, timeout_ms: float | None = None) -> Pair:
        """Take one image of each stream. Both frames arrive after the start of the call.

        The exposure of the first frame may begin before the call, by at most the settling time. The first image belongs
        to the stream for which the lights are already set, so the lights are switched only once for a pair.

        Args:
            timeout_ms: Longest wait for the pair (ms), not counting the time of a reconnection. None: two times the
                sensor's `timeout_s`.

        Raises:
            LightError: No frame of one of the streams met the conditions of `STS` in time.
            LedError: The controller does not answer, or a lost controller was not found within `reconnect_s`.
            CameraError: The sensor is not connected, or the camera sends no usable frames.
        """
        if timeout_ms is not None and not timeout_ms > 0:
            raise ValueError(f"timeout_ms must be > 0, got {timeout_ms}")
        limit_s = 2 * self._timeout_s if timeout_ms is None else timeout_ms / 1000
        return self._connected.pair(time.monotonic() + limit_s)

    def stream(self, duty: float = 0.5, *, dwell: int = 1) -> Iterator[Shot]:
        """Return an endless iterator over images of both streams. Each step waits for at most `timeout_s`.

        Args:
            duty: Share of tactile images, 0 to 1. After each group, the share so far is as close to it as possible.
            dwell: Number of successive images of one stream, >= 1. Each switch costs the settling time.
        """
        if not 0 <= duty <= 1:
            raise ValueError(f"duty, the share of tactile images, must be in [0, 1], got {duty}")
        if dwell < 1:
            raise ValueError(f"dwell must be >= 1, got {dwell}")

        def images() -> Iterator[Shot]:
            tactile = 0
            for number in itertools.count(1):
                stream: Stream = "tactile" if tactile + 0.5 < duty * number + 1e-9 else "visual"
                tactile += stream == "tactile"
                for _ in range(dwell):
                    yield self._connected.shot(stream, time.monotonic() + self._timeout_s)

        return images()

    def wait_until_still(self, timeout_s: float = 10.0, *, window_s: float = 0.5) -> Shot:
        """Wait until the visual stream has been still for `window_s`, and return the last image of this period.

        The view counts as still if no pixel of the `thumbnail` differs from the beginning of the period by more than 8
        times the median difference, or by more than 6 of 255.

        Args:
            timeout_s: Time after the first image at which the method gives up with a `TimeoutError` (s).
            window_s: Time during which the view must not change (s).
        """
        shots = self.stream(0.0)
        first = last = next(shots)
        started_s, look, change, allowed = first.time_s, thumbnail(first.image), 0.0, _STILL
        while last.time_s - started_s <= timeout_s:
            last = next(shots)
            now = thumbnail(last.image)
            changes = np.abs(now - look)
            change, allowed = float(changes.max()), max(_STILL, _NOISE * float(np.median(changes)))
            if change > allowed or last.epoch != first.epoch:
                first, look = last, now
            elif last.time_s - first.time_s >= window_s:
                return last
        raise TimeoutError(
            f"within {timeout_s:g} s, there was no period of {window_s:g} s without movement (the last change is "
            f"{change:.2f} of 255, {allowed:.2f} are allowed): keep the scene at rest, and the light of the room."
        )

    def measure_settling(self, switches: int = 8, *, watch_s: float = 1.0) -> Settling:
        """Measure the settling times, and use them from now on. The scene must be at rest.

        Args:
            switches: Number of switches of the lights in each direction, off to on and on to off.
            watch_s: Time for which frames are collected after the first switch, longer than the settling times (s).
        """
        self._settling = self._connected.measure_settling(switches, watch_s)
        return self._settling

    def __enter__(self) -> "STS":
        return self if self._leds is not None and self.camera.is_connected else self.connect()

    def __exit__(self, *error: object) -> None:
        self.disconnect()

    @property
    def _connected(self) -> ProvenFrames:
        if self._leds is None or self._frames is None:
            raise CameraError("the sensor is not connected: call connect() first.")
        return self._frames


def checked_levels(levels: Sequence[int]) -> protocol.Levels:
    """Return the levels of the tactile stream as four integers from 0 to 255, of which one must be above 0."""
    checked = leds_module.checked_levels(levels)
    if not any(checked):
        raise ValueError(f"levels must have at least one above 0, got {checked}")
    return checked


class Exposed(NamedTuple):
    """An exposure and the brightness of an image that was taken with it."""

    exposure: float  # exposure that is set, in the unit of the camera's driver
    brightness: float  # 0 to 255


def brightness(image: UInt8[np.ndarray, "height width 3"]) -> float:
    """99th percentile of the largest colour value of each pixel, 0 to 255."""
    return float(np.percentile(image.max(axis=-1), _PERCENTILE))


def choose_exposure(camera: OpenCVCamera, *, longest: float) -> Exposed:
    """Set the exposure of a camera so that the `brightness` of its images is between 175 and 225.

    Args:
        camera: Connected camera whose driver can set the exposure. Switch the lights for the stream before.
        longest: Largest allowed exposure, in the unit of the driver. An exposure that is longer than the time between
            two frames lowers the frame rate.

    Returns:
        The exposure that is set now. At the driver's limits, the image may still be too dark or saturated.
    """
    exposure, attempts = camera.set_exposure(min(camera.locked.get("exposure") or longest, longest)), 0
    while exposure is not None:
        time.sleep(LAG_S)
        seen = brightness(camera.read().image)
        if abs(seen - _WANTED) <= _TOLERANCE or attempts == _ATTEMPTS:
            return Exposed(exposure, seen)
        factor = _DARKER if seen >= SATURATED else min(_WANTED / max(seen, 1.0), _MOST)
        before, attempts = exposure, attempts + 1
        exposure = camera.set_exposure(min(max(exposure * factor, 1.0), longest))
        if exposure == before:
            return Exposed(before, seen)
    raise CameraError(
        f"the driver of {camera.config.name} does not support a manual exposure: use its automatic exposure"
    )
