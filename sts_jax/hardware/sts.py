"""`STS`: camera and lights as one sensor, with a proof that no image shows a wrong or mixed light.

The lights are off in the visual stream and on in the tactile stream. `docs/hardware/reading.md` states the proof.
"""

import dataclasses
import itertools
import os
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from sts_jax.hardware import protocol
from sts_jax.hardware.camera import Camera, CameraConfig, CameraError, CameraLostError, Captured
from sts_jax.hardware.leds import DisconnectedError, Leds, LedTimeoutError, Lit, checked_levels
from sts_jax.hardware.opencv import OpenCVCamera
from sts_jax.hardware.sensor_file import Device

_BUFFER = 8  # frames that the camera keeps while the controller answers
_SIZE = 32, 24  # width and height of a thumbnail (pixels). Each pixel is the mean of many, which averages noise out
_LEAST_CONTRAST = 2.0  # smallest mean difference of thumbnails between lights off and on (of 255)
_VISIBLE = 0.5  # smallest effect of the lights on a value of a thumbnail that is used (of 255). The noise is below it
_CLEAR = 0.25  # smallest effect on a value that is used, as a share of the median visible effect
_SETTLED = 0.02  # largest difference from the last share of the light at which a frame counts as settled
_DEPARTED = 0.5  # share of the lights' effect that the median value of a frame must show after a switch
_KEPT = 0.5  # share of the lights' effect that the last images must show to replace the stored effect
_AGAIN_S = 1.0  # s after the settling time. A switch that no frame shows by then is repeated
_SETTLING_ATTEMPTS = 3  # attempts to measure the settling times
_PHASE = 0.618  # share of the camera's period by which the phase advances from one measured switch to the next
_CHECK_S = 0.1  # s, shortest time between two requests to the controller while frames do not show the switch
_GRACE_S = 0.2  # s by which the wait for a frame may exceed the deadline, so that a lost camera raises its own error
_STILL = 6.0  # change of a thumbnail's pixel that always counts as still (of 255)
_NOISE = 8.0  # multiple of the median change that counts as still too. The noise of a camera reaches 5 times the median

SATURATED = 250.0  # brightness of 255 from which details are lost
LAG_S = 0.3  # time after which all frames have the new exposure (s)
_WANTED = 200.0  # wanted brightness, of 255
_TOLERANCE = 25.0  # largest difference from the wanted brightness, of 255
_DARKER = 0.4  # factor on the exposure of a saturated image, whose true brightness is unknown
_MOST = 4.0  # largest factor on the exposure in one attempt
_ATTEMPTS = 10


Stream = Literal["visual", "tactile"]
Thumbnail = Float[np.ndarray, "24 32 3"]  # mean colours of 24 x 32 blocks of an image, 0 to 255


class LightError(RuntimeError):
    """No image of the requested light could be taken in time, or the lights do not change the image."""


@dataclasses.dataclass(frozen=True, eq=False)
class Shot:
    """An image of one stream.

    The lights did not change from `before.acknowledged_s` to `until_s`. The frame arrived in between.
    """

    image: UInt8[np.ndarray, "height width 3"]  # RGB, raw and uncropped, read-only
    stream: Stream
    time_s: float  # arrival of the frame, on the clock `time.monotonic` (s)
    sequence: int  # number of the frame since the camera was connected
    epoch: int  # number of the camera's connection, which changes when a lost camera is found again
    before: Lit  # the controller's answer to the switch of the lights before the frame
    until_s: float  # time until which the lights did not change (s). The controller's next answer proves this


@dataclasses.dataclass(frozen=True, eq=False)
class Pair:
    """A visual image and a tactile image, taken one after the other."""

    visual: Shot
    tactile: Shot


@dataclasses.dataclass(frozen=True)
class Settling:
    """Times from the controller's acknowledgement of a switch to the first frame that shows only the new light."""

    visual_s: float  # settling time after the lights were switched off (s)
    tactile_s: float  # settling time after the lights were switched on (s)

    def __post_init__(self) -> None:
        for name in ("visual_s", "tactile_s"):
            if not 0 < getattr(self, name) < 60:
                raise ValueError(f"{name} must be in (0, 60) s, got {getattr(self, name)}")


@dataclasses.dataclass(frozen=True, eq=False)
class Switch:
    """The frames after a switch of the lights, up to one that arrives after the lights have stopped changing."""

    delays_s: Float[np.ndarray, "n"]  # time from the acknowledgement to the arrival of each frame (s)
    thumbnails: Float[np.ndarray, "n 24 32 3"]  # thumbnail of each frame, 0 to 255


class STS:
    """A See-Through-your-Skin sensor.

    ```python
    with STS(camera="/dev/v4l/by-id/usb-Maker_Camera_0123-video-index0", leds="/dev/ttyACM0") as sensor:
        pair = sensor.read()  # pair.visual.image and pair.tactile.image
    ```

    For each returned image, it is proven that the lights were in the right state during the whole exposure. Only one
    thread may use a sensor at a time.
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
        clock: Any = time,
    ):
        """Keep the configuration. `connect` opens the devices.

        Args:
            camera: A `Camera`, or the configuration or the source of an `OpenCVCamera`.
            leds: An open LED controller, or the name of its port. `disconnect` closes it in both cases, and a later
                `connect` opens its port again.
            levels: Duty cycles of the four channels in the tactile stream, 0 to 255. All are 0 in the visual stream.
            settling: Settling times from an earlier measurement with the same devices. None: `connect` measures them,
                which needs a scene at rest.
            exposures: Exposures of the visual and of the tactile stream, in the unit of the camera's driver. If they
                differ, the exposure is set at each switch of the lights, else never. None: not changed.
            timeout_s: Longest wait for one image (s), not counting the time of a reconnection.
            reconnect_s: Longest search for a controller that was lost (s).
            clock: Clock of the devices, with the functions `monotonic` and `sleep` of the module `time`.
        """
        self.levels = checked_levels(levels)
        if isinstance(camera, str | int | Path):
            camera = CameraConfig(camera)
        if isinstance(camera, CameraConfig):
            camera = OpenCVCamera(dataclasses.replace(camera, buffer=max(camera.buffer, _BUFFER)))
        self.camera: Camera = camera
        self.device: Device | None = None  # content of the sensor file, see `from_file`
        self._port = leds if isinstance(leds, str) else leds.port
        self._leds: Leds | None = None if isinstance(leds, str) else leds
        self._settling, self._exposures, self._clock = settling, exposures, clock
        self._timeout_s, self._reconnect_s = timeout_s, reconnect_s
        self._reset()

    def _reset(self) -> None:
        self.discarded = 0  # frames since `connect` that were not returned, such as those before the lights settle
        self._lit: Lit | None = None  # answer to the last switch. None: the state of the lights is unknown
        self._stream: Stream = "visual"  # stream for which the lights were set last
        self._effect: Thumbnail = np.zeros((24, 32, 3), np.float32)  # of the lights: the tactile minus the visual image
        self._looks: dict[Stream, Thumbnail] = {}  # last image of each stream
        self._black: dict[Stream, bool] = {}  # True if the last image of the stream was black
        self._previous: Captured | None = None  # last frame of the camera
        self._reference: Thumbnail | None = None  # last frame before the switch
        self._departed = 0  # successive frames since the switch that show its effect. From 2 on, none is compared
        self._doubtful = False  # True if the lights may have switched without an answer, which late frames could show
        self._lost_s = 0.0  # time spent in reconnections to the controller (s)

    @classmethod
    def from_file(
        cls, path: str | os.PathLike, *, camera: CameraConfig | str | None = None, leds: str | None = None
    ) -> "STS":
        """Make the sensor that a sensor file describes. `python -m experiments.commission` writes such files.

        Args:
            path: Path of the sensor file or of its folder.
            camera: Another source for the same camera, such as its URL with a password, or a whole configuration.
            leds: Port of the controller. None: `connect` searches all USB ports for its serial number.
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
    def settling(self) -> Settling:
        """The settling times, given or measured by `connect`."""
        if self._settling is None:
            raise CameraError("the settling times were not measured yet: call connect() first.")
        return self._settling

    def connect(self, warmup_s: float = 1.0) -> "STS":
        """Open the camera and the LED controller, and measure the settling times unless they were given.

        The camera's exposure and white balance are locked after `warmup_s` (s).
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
            self._reset()
            if self._settling is None:
                self.measure_settling()
            else:
                lit = self._watched("tactile", 2 * self._settling.tactile_s).thumbnails[-1]
                dark = self._watched("visual", 2 * self._settling.visual_s).thumbnails[-1]
                self._begin(self._settling, dark, lit)
        except BaseException:
            self.disconnect()
            raise
        return self

    def disconnect(self) -> None:
        """Turn the lights off, and close the camera and the LED controller. Repeated calls have no effect."""
        leds, self._leds, self._lit = self._leds, None, None
        if leds is not None:
            leds.close()
        self.camera.disconnect()

    def __enter__(self) -> "STS":
        connected = self._looks and self._leds is not None and self.camera.is_connected
        return self if connected else self.connect()

    def __exit__(self, *error: object) -> None:
        self.disconnect()

    def read(self, timeout_ms: float | None = None) -> Pair:
        """Take one image of each stream. Both frames arrive after the start of the call.

        The exposure of the first frame may begin before the call, by at most the settling time. After `timeout_ms`
        (default: two times `timeout_s`) without reconnections, a `LightError`, `CameraError` or `LedError` names the
        fault.
        """
        deadline = self._worked_s() + (2 * self._timeout_s if timeout_ms is None else timeout_ms / 1000)
        first = self._stream  # the lights are set for it, so they are switched only once for a pair
        second = _other(first)
        while True:
            one = self._shot(first, deadline, after_s=self._clock.monotonic(), then=second)
            two = self._shot(second, deadline)
            if one.epoch == two.epoch and one.before.boot == two.before.boot:
                return Pair(one, two) if first == "visual" else Pair(two, one)

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
                    yield self._shot(stream, self._worked_s() + self._timeout_s)

        return images()

    def wait_until_still(self, timeout_s: float = 10.0, *, window_s: float = 0.5) -> Shot:
        """Wait until the visual stream has been still for `window_s` (s), and return the last image of this period.

        The view counts as still if no pixel of the `thumbnail` differs from the beginning of the period by more than 8
        times the median difference, or by more than 6 of 255. `timeout_s` (s) after the first image, the method gives
        up with a `TimeoutError`.
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
        """Measure the settling times of a scene at rest from a number of switches on and off, and use them from now on.

        Frames are collected for `watch_s` (s) after the first switch, which must exceed the settling times.
        """
        for _ in range(_SETTLING_ATTEMPTS):
            if (measured := self._measured(switches, watch_s)) is not None:
                return measured
        raise LightError(
            f"the image was still changing {watch_s:.2f} s after the lights were switched, in {_SETTLING_ATTEMPTS} "
            "attempts: keep the scene at rest and lock the camera's exposure. For slow lights, pass STS(settling=...)."
        )

    def _measured(self, switches: int, watch_s: float) -> Settling | None:
        """Measure the settling times once. None: a movement or a delay of the computer has spoilt the measurement."""
        self._lit = None
        intervals = np.diff(self._watched("visual", watch_s).delays_s)
        period_s = float(np.median(intervals)) if len(intervals) else watch_s
        on, off = [self._watched("tactile", watch_s)], [self._watched("visual", watch_s)]
        measured = settling_times(on, off, period_s)
        slowest_s = max(measured.visual_s, measured.tactile_s)
        if slowest_s > watch_s - period_s:
            return None
        shorter_s = min(3 * slowest_s + 3 * period_s, watch_s)
        for number in range(1, switches):
            phase_s = period_s * (_PHASE * number % 1)  # the collection of frames ends just after a frame
            self._clock.sleep(phase_s)
            on.append(self._watched("tactile", shorter_s))
            self._clock.sleep(phase_s)
            off.append(self._watched("visual", shorter_s))
        measured = settling_times(on, off, period_s)
        if max(measured.visual_s, measured.tactile_s) > shorter_s - period_s:
            return None
        self._begin(measured, off[-1].thumbnails[-1], on[-1].thumbnails[-1])
        return measured

    def _begin(self, settling: Settling, dark: Thumbnail, lit: Thumbnail) -> None:
        """Compare later frames with an image of each stream."""
        check_contrast(dark, lit)
        self._settling, self._effect, self._looks = settling, lit - dark, {"visual": dark, "tactile": lit}

    def _worked_s(self) -> float:
        """Time without that of reconnections (s), so that a reconnection extends each deadline."""
        return self._clock.monotonic() - self._lost_s

    def _shot(self, stream: Stream, deadline: float, *, after_s: float = 0.0, then: Stream | None = None) -> Shot:
        """Take an image whose frame arrives after `after_s` (s), before the time `deadline` of `_worked_s`.

        With `then`, the lights are switched to that stream after the frame.
        """
        while True:
            try:
                if self._doubtful:
                    # Late frames may show two switches of the lights. After a frame that shows the lights of the other
                    # stream, all later frames can show only one switch.
                    self._frame(_other(stream), deadline, 0.0)
                    self._doubtful = False
                before, frame = self._frame(stream, deadline, after_s)
                until_s = self._proof(before, then)
            except (DisconnectedError, LedTimeoutError):
                began_s = self._clock.monotonic()
                self._lit, self._doubtful = None, True
                self.leds.reconnect(limit_s=self._reconnect_s)
                self._lost_s += self._clock.monotonic() - began_s
                continue
            if until_s is not None:
                self._black[stream], self._looks[stream] = frame.black, thumbnail(frame.image)
                self._follow()
                return Shot(frame.image, stream, frame.time_s, frame.sequence, frame.epoch, before, until_s)
            self.discarded += 1
            self._doubtful = True

    def _follow(self) -> None:
        """Update the stored effect of the lights from the last images, unless it is too weak, as with failed lights."""
        effect = self._looks["tactile"] - self._looks["visual"]
        if np.abs(effect).mean() > _KEPT * np.abs(self._effect).mean():
            self._effect = effect

    def _frame(self, stream: Stream, deadline: float, after_s: float) -> tuple[Lit, Captured]:
        """Return a frame that arrives after the lights have settled, and the controller's answer to their switch."""
        lit, checked_s = self._lit, 0.0
        if lit is None or self._stream != stream:
            lit = self._set(stream)
        settled_s = self.settling.visual_s if stream == "visual" else self.settling.tactile_s
        while (left_s := deadline - self._worked_s()) > 0:
            try:
                frame = self.camera.async_read(1000 * (left_s + _GRACE_S))
            except CameraLostError:
                if self._worked_s() >= deadline:
                    raise
                continue
            spoilt = frame.repeats > 0 or (frame.black and self._black.get(stream) is False)
            if self._departed < 2 and not spoilt:
                last = self._previous
                in_order = last is not None and (frame.epoch, frame.sequence) == (last.epoch, last.sequence + 1)
                self._departed = (self._departed * in_order + 1) * self._shows(frame, stream)
            self._previous = frame
            late_s = frame.time_s - max(lit.acknowledged_s + settled_s, after_s)
            if self._departed >= 2 and late_s >= 0 and not spoilt and not frame.delayed:
                return lit, frame
            self.discarded += 1
            if self._departed == 0 and late_s >= 0 and self._clock.monotonic() >= checked_s + _CHECK_S:
                if not self.leds.ping().unchanged_since(lit):  # the watchdog or a restart has turned the lights off
                    lit = self._set(stream)
                elif frame.time_s > lit.acknowledged_s + settled_s + _AGAIN_S:
                    # The scene may have changed at the switch. The repeated switch is compared with a newer frame.
                    self._watched(_other(stream), settled_s)
                    lit = self._set(stream)
                checked_s = self._clock.monotonic()
        remedy = "check that the LEDs light up, that the camera's exposure is locked, and that enough frames arrive"
        if self._previous is not None and self._previous.black:
            remedy = "the frames are black now. Check the camera, or connect again if the scene has become dark"
        raise LightError(
            f"no frame of {self.camera.source} could be proven to show the lights of the {stream} stream in time "
            f"({self.discarded} frames were discarded since the connection): {remedy}."
        )

    def _shows(self, frame: Captured, stream: Stream) -> bool:
        """Return whether a frame shows the last switch: the median value changes by more than half of the effect."""
        # The last frame before the switch is compared, if the lights before the switch are known.
        before = self._looks[_other(stream)] if self._reference is None else self._reference
        change = self._effect if stream == "tactile" else -self._effect
        return switched_share(thumbnail(frame.image), before, change) > _DEPARTED

    def _set(self, stream: Stream) -> Lit:
        before = self._previous if self._lit is not None and self._stream != stream else None
        if self._exposures is not None and self._exposures[0] != self._exposures[1]:
            # It is set before the lights, so that the settling time covers both changes.
            exposure, set_exposure = self._exposures[stream == "tactile"], getattr(self.camera, "set_exposure", None)
            if set_exposure is None or set_exposure(exposure) is None:
                raise CameraError(
                    f"{self.camera.source} does not support a manual exposure, so it cannot be set to {exposure:g}: "
                    "pass exposures=None to STS."
                )
        lit = self.leds.set(self.levels if stream == "tactile" else protocol.DARK)
        self._reference = None if before is None else thumbnail(before.image)
        self._lit, self._stream, self._departed = lit, stream, 0
        return lit

    def _proof(self, before: Lit, then: Stream | None) -> float | None:
        """Return the time until which the lights did not change since `before` (s), or None if they changed.

        With `then`, the lights are switched to that stream.
        """
        if then == self._stream:
            then = None
        # A switch to the visual stream and the watchdog both turn the lights off. The counter of changes cannot
        # distinguish them, so a request without a switch comes first.
        if then is None or self._stream == "tactile":
            after = self.leds.ping()
            if not after.unchanged_since(before):
                self._lit = None
                return None
            if then is not None:
                self._set(then)
            return after.sent_s
        after = self._set(then)
        # Only a request turns the lights on, so a single change is due to this request.
        return after.sent_s if (after.boot, after.counter) == (before.boot, before.counter + 1) else None

    def _watched(self, stream: Stream, watch_s: float) -> Switch:
        """Switch the lights, and collect the frames that arrive until `watch_s` after the switch (s)."""
        lit = self._set(stream)
        delays: list[float] = []
        looks: list[Thumbnail] = []
        while not delays or delays[-1] < watch_s:
            frame = self._previous = self.camera.async_read(1000 * self._timeout_s)
            delays.append(frame.time_s - lit.acknowledged_s)
            looks.append(thumbnail(frame.image))
        return Switch(np.array(delays, np.float32), np.array(looks, np.float32))


def _other(stream: Stream) -> Stream:
    return "tactile" if stream == "visual" else "visual"


def thumbnail(image: UInt8[np.ndarray, "height width 3"]) -> Thumbnail:
    """Mean colours of 24 rows and 32 columns of blocks of an RGB image, 0 to 255."""
    return cv2.resize(image, _SIZE, interpolation=cv2.INTER_AREA).astype(np.float32)


def check_contrast(dark: Thumbnail, lit: Thumbnail) -> None:
    """Raise a `LightError` if the lights do not change the image."""
    contrast = float(np.abs(dark - lit).mean())
    if contrast < _LEAST_CONTRAST:
        raise LightError(
            f"the images with the lights off and on differ by {contrast:.2f} of 255 on average, but they must differ "
            f"by {_LEAST_CONTRAST:g}: check the LEDs' wiring and levels, and lock the camera's exposure."
        )


def switched_share(look: Thumbnail, before: Thumbnail, change: Thumbnail) -> float:
    """How far the lights had been switched when an image was taken: 0 means not yet, 1 means fully.

    The median of `(look - before) / change` over the values that a complete switch (`change`) changes clearly. An
    object that moves in less than half of the view has no influence on it.
    """
    effect = np.abs(change)
    visible = effect >= _VISIBLE
    if not visible.any():
        return 0.0
    used = effect >= max(_VISIBLE, _CLEAR * float(np.median(effect[visible])))
    return float(np.median((look - before)[used] / change[used]))


def settling_times(on: Sequence[Switch], off: Sequence[Switch], period_s: float) -> Settling:
    """Settling times from the frames after several switches of the lights in a scene at rest.

    A settling time is the largest delay of a frame that is not settled, plus the period of the camera, because the
    measured switches occurred at only a few of the possible times within an exposure.
    """
    dark = np.mean([switch.thumbnails[-1] for switch in off], axis=0)
    lit = np.mean([switch.thumbnails[-1] for switch in on], axis=0)
    check_contrast(dark, lit)
    last_off, last_on = (max(_last_mixed(switch, dark, lit) for switch in switches) for switches in (off, on))
    return Settling(last_off + period_s, last_on + period_s)


def _last_mixed(switch: Switch, dark: Thumbnail, lit: Thumbnail) -> float:
    """Delay of the last frame in which the lights are not as bright as in the last frame of a switch (s). Never < 0."""
    change = lit - dark
    # The brightness `s` of the lights is that for which `dark + s (lit - dark)` is closest to the image.
    shares = np.array([((look - dark) * change).sum() / (change**2).sum() for look in switch.thumbnails], float)
    mixed = np.flatnonzero(np.abs(shares - shares[-1]) > _SETTLED)
    return max(float(switch.delays_s[mixed[-1]]), 0.0) if len(mixed) else 0.0


def brightness(image: UInt8[np.ndarray, "height width 3"]) -> float:
    """99th percentile of the largest colour value of each pixel, 0 to 255."""
    return float(np.percentile(image.max(axis=-1), 99))


def choose_exposure(camera: OpenCVCamera, *, longest: float) -> tuple[float, float]:
    """Set a connected camera's exposure so that the `brightness` of its images is between 175 and 225.

    Switch the lights for the stream before. An exposure longer than the time between two frames lowers the frame rate.
    Returns the exposure in the unit of the driver, and the brightness, which the limits may keep out of the range.
    """
    exposure, attempts = camera.set_exposure(min(camera.locked.get("exposure") or longest, longest)), 0
    while exposure is not None:
        time.sleep(LAG_S)
        seen = brightness(camera.read().image)
        if abs(seen - _WANTED) <= _TOLERANCE or attempts == _ATTEMPTS:
            return exposure, seen
        factor = _DARKER if seen >= SATURATED else min(_WANTED / max(seen, 1.0), _MOST)
        before, attempts = exposure, attempts + 1
        exposure = camera.set_exposure(min(max(exposure * factor, 1.0), longest))
        if exposure == before:
            return before, seen
    raise CameraError(
        f"the driver of {camera.config.name} does not support a manual exposure: use its automatic exposure"
    )
