"""`STS`: camera and lights as one sensor. Every image is proven to be of one light."""

import contextlib
import dataclasses
import itertools
import os
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import UInt8

from sts_jax.hardware import protocol
from sts_jax.hardware.camera import Camera
from sts_jax.hardware.camera_config import CameraConfig
from sts_jax.hardware.camera_errors import CameraError, CameraLostError, CameraNotConnectedError, StaleFrameError
from sts_jax.hardware.devices import FoundCamera, find_cameras
from sts_jax.hardware.frames import Captured
from sts_jax.hardware.leds import Leds, Lit
from sts_jax.hardware.ports import DisconnectedError, LedTimeoutError, Port, find_controllers
from sts_jax.hardware.sensor_file import Device
from sts_jax.hardware.settling import Settling, Switch, Thumbnail, check_contrast, difference, settling, thumbnail

Stream = Literal["visual", "tactile"]

_DEPARTED = 0.5  # of the contrast, by which a frame must differ from the last one before the switch
_AGAIN_S = 1.0  # s, after which a switch that does not show is repeated
_ATTEMPTS = 3  # to measure the settling
_SWITCHES = 8  # of each direction, to measure the settling
_PHASE = 0.618  # of a period, by which the phase of the measured switches advances
_CHECK_S = 0.1  # s, least time between two questions to the controller while frames show another light
_GRACE_S = 0.2  # s, by which a wait for the camera may exceed a limit, so that the cause of a delay is the one reported
_STILL = 6.0  # of 255, change of a thumbnail's pixel that always counts as still
_NOISE = 8.0  # times the median change of all pixels, which counts as still too. Noise has changes of 5 times that


class LightError(RuntimeError):
    """No image of the wanted light could be taken in time."""


class NotStillError(TimeoutError):
    """The view did not come to rest in time."""


class FoundSensors(NamedTuple):
    """Cameras and serial ports of this machine, of which sensors can consist."""

    cameras: list[FoundCamera]
    ports: list[Port]


@dataclasses.dataclass(frozen=True, eq=False)
class Shot:
    """An image of one stream.

    The lights were the same without interruption from `before.acknowledged_s` until `until_s`, and the frame arrived
    between both, later than the settling time after the former.
    """

    image: UInt8[np.ndarray, "height width 3"]  # RGB, raw and uncropped, read-only
    stream: Stream
    time_s: float  # arrival of the frame, on the clock `time.monotonic` (s)
    sequence: int  # number of the frame
    epoch: int  # number of the camera's connection
    before: Lit  # the controller's answer before the frame
    until_s: float  # time until which the controller's later answer proves the lights unchanged (s)


@dataclasses.dataclass(frozen=True, eq=False)
class Pair:
    """Both streams of one moment."""

    visual: Shot
    tactile: Shot


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
        self._lit: Lit | None = None  # the last answer of the controller about lights that this object has set
        self._stream: Stream = "visual"
        self._contrast: float | None = None  # of images without and with the light, of 255
        self._looks: dict[Stream, Thumbnail] = {}  # of the last image of each stream
        self._black: dict[Stream, bool] = {}  # whether this image was black
        self._previous: Captured | None = None  # the last frame of the camera
        self._reference: Thumbnail | None = None  # of the last frame before the switch
        self._departed = 0  # successive frames since the switch that show the new light, 2 and more: all are of it
        self._doubtful = False  # whether the lights may have switched without an answer, so late frames may show it
        self._background: _Background | None = None
        self._stopping = False  # whether the thread in the background is to end
        self.discarded = 0  # frames that could not be proven to be of one light

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
            if self._settling is None:
                self._settling = self.measure_settling()
            else:
                self._see_both(self._settling)
        except BaseException:
            self.disconnect()
            raise
        return self

    def disconnect(self) -> None:
        """Turn the lights off and close both devices. Without a connection, it does nothing."""
        self._stop_background()
        leds, self._leds, self._lit = self._leds, None, None
        self._contrast, self._looks = None, {}
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
        return self._pair(timeout_ms)

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
        """Measure how long after an acknowledgement frames with the former light arrive.

        Args:
            switches: Number of switches in each direction.
            watch_s: Time for which frames are watched after the first switch in each direction (s). The settling must
                be shorter. Later switches are watched for three times the settling that the first ones show.

        Raises:
            NoContrastError: The lights do not change the image.
            LightError: The image still changes at the end of a watch, three times in a row.
        """
        for _ in range(_ATTEMPTS - 1):
            with contextlib.suppress(LightError):
                return self._measured(switches, watch_s)
        return self._measured(switches, watch_s)

    def _measured(self, switches: int, watch_s: float) -> Settling:
        """One attempt of `measure_settling`, which a movement or a delay of the computer can spoil."""
        self._lit = None
        period_s = self._period_s()
        self._watched("visual", watch_s)
        on, off = [self._watched("tactile", watch_s)], [self._watched("visual", watch_s)]
        found = self._settled(on, off, period_s, watch_s)
        shorter_s = min(3 * max(found.visual_s, found.tactile_s) + 3 * period_s, watch_s)
        for number in range(1, switches):
            phase_s = period_s * (_PHASE * number % 1)  # a watch ends just after a frame
            time.sleep(phase_s)
            on.append(self._watched("tactile", shorter_s))
            time.sleep(phase_s)
            off.append(self._watched("visual", shorter_s))
        found = self._settled(on, off, period_s, shorter_s)
        self._compare_with(off[-1].thumbnails[-1], on[-1].thumbnails[-1])
        return found

    def _compare_with(self, dark: Thumbnail, lit: Thumbnail) -> None:
        """Keep images without and with the light, with which later ones are compared."""
        self._contrast = difference(dark, lit)
        check_contrast(self._contrast)
        self._looks = {"visual": dark, "tactile": lit}

    def _see_both(self, settling: Settling) -> None:
        """Take an image of each light, with which the first frames are compared."""
        lit = self._watched("tactile", 2 * settling.tactile_s).thumbnails[-1]
        dark = self._watched("visual", 2 * settling.visual_s).thumbnails[-1]
        self._compare_with(dark, lit)

    def _settled(self, on: list[Switch], off: list[Switch], period_s: float, watch_s: float) -> Settling:
        found = settling(on, off, period_s)
        slowest_s = max(found.visual_s, found.tactile_s)
        if slowest_s > watch_s - period_s:
            raise LightError(
                f"the image still changes {slowest_s:.2f} s after a switch: keep the scene at rest, lock the camera's "
                f"exposure, or watch for longer than {watch_s:.2f} s."
            )
        return found

    def __enter__(self) -> "STS":
        return self if self._leds is not None and self._camera.is_connected else self.connect()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.disconnect()

    def _pair(self, timeout_ms: float | None = None) -> Pair:
        deadline = time.monotonic() + self._limit_s(timeout_ms, 2)
        first = self._stream
        second: Stream = "tactile" if first == "visual" else "visual"
        while True:
            one = self._shot(first, deadline, after_s=time.monotonic(), then=second)
            two = self._shot(second, deadline)
            if one.epoch == two.epoch and one.before.boot == two.before.boot:
                return Pair(one, two) if first == "visual" else Pair(two, one)

    def _images(self, duty: float, dwell: int) -> Iterator[Shot]:
        for stream in stream_order(duty, dwell):
            yield self._shot(stream, time.monotonic() + self._timeout_s)

    def _shot(self, stream: Stream, deadline: float, *, after_s: float = 0.0, then: Stream | None = None) -> Shot:
        """An image of one stream that arrives after a time.

        With `then`, the lights are switched to that stream afterwards, and the answer to this switch is the proof.
        """
        while True:
            try:
                if self._doubtful:
                    # Late frames may show the former light and then a mixed one. After a frame of the other light, all
                    # frames that still come are of a single switch.
                    self._frame("visual" if stream == "tactile" else "tactile", deadline, 0.0)
                    self._doubtful = False
                before, frame = self._frame(stream, deadline, after_s)
                until_s = self._proof(before, then)
            except (DisconnectedError, LedTimeoutError):
                lost_s = time.monotonic()
                self._lit, self._doubtful = None, True
                self.leds.reconnect(limit_s=self._reconnect_s)
                deadline += time.monotonic() - lost_s
                continue
            if until_s is not None:
                self._black[stream], self._looks[stream] = frame.black, thumbnail(frame.image)
                return Shot(frame.image, stream, frame.time_s, frame.sequence, frame.epoch, before, until_s)
            self.discarded += 1
            self._doubtful = True

    def _frame(self, stream: Stream, deadline: float, after_s: float) -> tuple[Lit, Captured]:
        """A frame that arrives when the light has settled, and the answer of the controller before it."""
        lit, checked_s = self._switched(stream), 0.0
        settled_s = self.settling.visual_s if stream == "visual" else self.settling.tactile_s
        while not self._stopping:
            left_s = deadline - time.monotonic()
            if left_s <= 0:
                raise self._light_error(stream)
            try:
                frame = self._camera.async_read(1000 * (left_s + _GRACE_S))
            except CameraLostError:
                if time.monotonic() >= deadline:
                    raise
                continue
            spoilt = self._repeats(frame) or (frame.black and self._black.get(stream) is False)
            if self._departed < 2 and not spoilt:
                self._departed = (self._departed * self._in_order(frame) + 1) * self._shows(frame, stream)
            self._previous = frame
            late_s = frame.time_s - max(lit.acknowledged_s + settled_s, after_s)
            if self._departed >= 2 and late_s >= 0 and not spoilt:
                return lit, frame
            self.discarded += 1
            if self._departed == 0 and late_s >= 0 and time.monotonic() >= checked_s + _CHECK_S:
                if not self.leds.ping().unchanged_since(lit):  # the controller has turned its lights off
                    lit = self._set(stream)
                elif frame.time_s > lit.acknowledged_s + settled_s + _AGAIN_S:
                    # The scene may have changed at the switch. It is repeated, and compared with a newer frame.
                    self._watched("tactile" if stream == "visual" else "visual", settled_s)
                    lit = self._set(stream)
                checked_s = time.monotonic()
        raise LightError("the thread that takes pairs was stopped.")

    def _light_error(self, stream: Stream) -> LightError:
        cause = "check that the LEDs light up, that the camera's exposure is locked, and its rate"
        if self._previous is not None and self._previous.black:
            cause = "its frames are black now, so check the camera, or connect again if the scene has become dark"
        return LightError(
            f"no frame of {self._camera.config.name} could be proven to be of the {stream} stream in time "
            f"({self.discarded} frames were discarded so far): {cause}."
        )

    def _shows(self, frame: Captured, stream: Stream) -> bool:
        """Whether the image has changed since the switch by at least half as much as it does with the light.

        If the light before is unknown, whether the image is nearer to the last one of its stream than to the other.
        """
        look = thumbnail(frame.image)
        if self._reference is not None and self._contrast is not None:
            return difference(look, self._reference) > _DEPARTED * self._contrast
        if len(self._looks) < 2:
            return True
        other: Stream = "tactile" if stream == "visual" else "visual"
        return difference(look, self._looks[stream]) < difference(look, self._looks[other])

    def _repeats(self, frame: Captured) -> bool:
        """Whether a frame is the one before once more, in a scene that is not free of noise."""
        return frame.repeats > 0 and self._camera.config.frozen_after_s is not None

    def _in_order(self, frame: Captured) -> bool:
        """Whether a frame is the next one after the last."""
        last = self._previous
        return last is not None and (frame.epoch, frame.sequence) == (last.epoch, last.sequence + 1)

    def _switched(self, stream: Stream) -> Lit:
        """Set the lights of a stream unless they are known to be set."""
        if self._lit is None or self._stream != stream:
            self._set(stream)
        assert self._lit is not None
        return self._lit

    def _set(self, stream: Stream) -> Lit:
        before = self._previous if self._lit is not None and self._stream != stream else None
        if self._exposures is not None and self._exposures[0] != self._exposures[1]:
            self._expose(self._exposures[stream == "tactile"])
        lit = self.leds.set(self._levels if stream == "tactile" else protocol.DARK)
        self._reference = None if before is None else thumbnail(before.image)
        self._lit, self._stream, self._departed = lit, stream, 0
        return lit

    def _expose(self, exposure: float) -> None:
        """Set the exposure before the lights, so that the settling covers both."""
        if self._camera.set_exposure(exposure) is None:
            raise CameraError(
                f"the driver of {self._camera.config.name} does not let the exposure be set to {exposure:g}: give "
                "exposures=None."
            )

    def _proof(self, before: Lit, then: Stream | None) -> float | None:
        """The time until which the lights are proven to be unchanged, or None if they changed. May switch them."""
        if then == self._stream:
            then = None
        # The watchdog turns the lights off as a switch to the visual stream does, and the counter of changes would not
        # tell one from the other.
        if then is None or self._stream == "tactile":
            after = self.leds.ping()
            if not after.unchanged_since(before):
                self._lit = None
                return None
            if then is not None:
                self._set(then)
            return after.sent_s
        after = self._set(then)
        # Nothing but a request turns the lights on, so a single change is that of this request.
        return after.sent_s if (after.boot, after.counter) == (before.boot, before.counter + 1) else None

    def _watched(self, stream: Stream, watch_s: float) -> Switch:
        """Switch the lights and collect the frames that arrive during a time, with thumbnails."""
        lit = self._set(stream)
        delays: list[float] = []
        looks: list[Thumbnail] = []
        while not delays or delays[-1] < watch_s:
            frame = self._previous = self._camera.async_read(1000 * self._timeout_s)
            delays.append(frame.time_s - lit.acknowledged_s)
            looks.append(thumbnail(frame.image))
        return Switch(np.array(delays, np.float32), np.array(looks, np.float32))

    def _period_s(self) -> float:
        """The time between two frames, measured from some frames if it is not known yet."""
        while True:
            rate = self._camera.statistics.rate
            if rate is not None:
                return 1 / rate
            self._camera.async_read()

    def _limit_s(self, timeout_ms: float | None, images: int) -> float:
        if timeout_ms is None:
            return images * self._timeout_s
        if not timeout_ms > 0:
            raise ValueError(f"timeout_ms must be > 0, got {timeout_ms}")
        return timeout_ms / 1000

    def _started(self) -> "_Background":
        self.leds  # noqa: B018  raises an error if the sensor is not connected
        if self._background is None:
            self._background = _Background(self)
        return self._background

    def _stop_background(self) -> None:
        background, self._background = self._background, None
        if background is not None:
            self._stopping = True
            background.stop()
            self._stopping = False


class _Background:
    """A thread that takes pairs continuously and keeps the newest one."""

    def __init__(self, sensor: STS):
        self._sensor = sensor
        self._changed = threading.Condition()
        self._pair: Pair | None = None
        self._fresh = False
        self._error: BaseException | None = None
        self._stopped = False
        self._thread = threading.Thread(target=self._run, name="pairs of the sensor", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stopped:
            try:
                pair = self._sensor._pair()
            except Exception as error:  # raised by the next call of the user
                with self._changed:
                    self._error = error
                    self._changed.notify_all()
                return
            with self._changed:
                self._pair, self._fresh = pair, True
                self._changed.notify_all()

    def latest(self) -> Pair | None:
        """The newest pair, or None. Raises the thread's error."""
        with self._changed:
            self._raise()
            return self._pair

    def next(self, limit_s: float) -> Pair:
        """The newest pair that was not returned by this method yet. Raises the thread's error."""
        with self._changed:
            if not self._changed.wait_for(lambda: self._fresh or self._error is not None, limit_s):
                raise LightError(f"no pair was taken within {limit_s:g} s: call read() to see the reason.")
            self._raise()
            self._fresh = False
            assert self._pair is not None
            return self._pair

    def stop(self) -> None:
        """End the thread."""
        self._stopped = True
        self._thread.join()

    def _raise(self) -> None:
        if self._error is not None:
            self._sensor._background = None
            raise self._error


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
