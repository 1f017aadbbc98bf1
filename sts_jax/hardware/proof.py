"""The proof that no image shows a wrong or mixed light: `ProvenFrames` takes a camera's frames, `Settling` is measured.

The lights are off in the visual stream and on in the tactile stream. `docs/hardware/reading.md` states the proof.
"""

import dataclasses
import time
from collections.abc import Sequence
from typing import Literal, Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from sts_jax.hardware import protocol
from sts_jax.hardware.camera import CameraError, CameraLostError, Captured
from sts_jax.hardware.leds import DisconnectedError, LedTimeoutError, Lit

_SIZE = 32, 24  # width and height of a thumbnail (pixels). Each pixel is the mean of many, which averages noise out
_LEAST_CONTRAST = 2.0  # smallest mean difference of thumbnails between lights off and on (of 255)
_VISIBLE = 0.5  # smallest effect of the lights on a value of a thumbnail that is used (of 255). The noise is below it
_CLEAR = 0.25  # smallest effect on a value that is used, as a share of the median visible effect
_TOLERANCE = 0.02  # largest difference from the last share of the light at which a frame counts as settled
_DEPARTED = 0.5  # share of the lights' effect that the median value of a frame must show after a switch
_KEPT = 0.5  # share of the lights' effect that the last images must show to replace the stored effect
_AGAIN_S = 1.0  # s after the settling time. A switch that no frame shows by then is repeated
_ATTEMPTS = 3  # attempts to measure the settling times
_PHASE = 0.618  # share of the camera's period by which the phase advances from one measured switch to the next
_CHECK_S = 0.1  # s, shortest time between two requests to the controller while frames do not show the switch
_GRACE_S = 0.2  # s by which the wait for a frame may exceed the deadline, so that a lost camera raises its own error

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


def other(stream: Stream) -> Stream:
    """The stream that is not this one."""
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


def light_share(look: Thumbnail, dark: Thumbnail, lit: Thumbnail) -> float:
    """Brightness of the lights: the number `s` for which `dark + s (lit - dark)` is closest to `look`."""
    change = lit - dark
    return float(((look - dark) * change).sum() / (change**2).sum())


def switched_share(look: Thumbnail, before: Thumbnail, change: Thumbnail) -> float:
    """How far the lights had been switched when an image was taken: 0 means not yet, 1 means fully.

    The result is the median of `(look - before) / change` over the values that the switch changes clearly, where
    `change` is the effect of a complete switch. Because of the median, an object that moves in less than half of the
    view has no influence.
    """
    effect = np.abs(change)
    visible = effect >= _VISIBLE
    if not visible.any():
        return 0.0
    used = effect >= max(_VISIBLE, _CLEAR * float(np.median(effect[visible])))
    return float(np.median((look - before)[used] / change[used]))


def settling(on: Sequence[Switch], off: Sequence[Switch], period_s: float) -> Settling:
    """Settling times from the frames after several switches of the lights in a scene at rest.

    A settling time is the largest delay of a frame that is not settled, plus the period of the camera, because a switch
    can occur at any time within an exposure, and the measured switches occurred at only a few such times.
    """
    dark = np.mean([switch.thumbnails[-1] for switch in off], axis=0)
    lit = np.mean([switch.thumbnails[-1] for switch in on], axis=0)
    check_contrast(dark, lit)
    last_off, last_on = (max(last_mixed(switch, dark, lit) for switch in switches) for switches in (off, on))
    return Settling(last_off + period_s, last_on + period_s)


def last_mixed(switch: Switch, dark: Thumbnail, lit: Thumbnail) -> float:
    """Delay of the last frame whose `light_share` differs from that of the last frame of a switch (s). Never < 0."""
    shares = np.array([light_share(look, dark, lit) for look in switch.thumbnails])
    mixed = np.flatnonzero(np.abs(shares - shares[-1]) > _TOLERANCE)
    return max(float(switch.delays_s[mixed[-1]]), 0.0) if len(mixed) else 0.0


@runtime_checkable
class _Frames(Protocol):  # the part of a `Camera` that is needed here
    @property
    def source(self) -> str: ...
    def async_read(self, timeout_ms: float | None = None) -> Captured: ...


@runtime_checkable
class _Lights(Protocol):  # the part of `Leds` that is needed here
    def set(self, levels: protocol.Levels) -> Lit: ...
    def ping(self) -> Lit: ...
    def reconnect(self, *, limit_s: float) -> object: ...


@runtime_checkable
class _Clock(Protocol):  # the module `time`, or the virtual clock of a twin
    def monotonic(self) -> float: ...
    def sleep(self, seconds: float, /) -> None: ...


class ProvenFrames:
    """Switches the lights of a connected sensor, and takes frames that are proven to show the new state of the lights.

    `STS` states the conditions. Only one thread may take images.
    """

    def __init__(
        self,
        camera: _Frames,
        leds: _Lights,
        *,
        levels: protocol.Levels,
        exposures: tuple[float, float] | None,
        timeout_s: float,
        reconnect_s: float,
        clock: _Clock = time,
    ):
        """Use open devices, see `STS`. Call `measure_settling` or `see_both` before the first image is taken."""
        self._camera, self._leds, self._clock = camera, leds, clock
        self._levels, self._exposures = levels, exposures
        self._timeout_s, self._reconnect_s = timeout_s, reconnect_s
        self._settling: Settling | None = None
        self._lit: Lit | None = None  # answer to the last switch. None: the state of the lights is unknown
        self._effect: Thumbnail | None = None  # effect of the lights: the tactile image minus the visual image
        self._looks: dict[Stream, Thumbnail] = {}  # last image of each stream
        self._black: dict[Stream, bool] = {}  # True if the last image of the stream was black
        self._previous: Captured | None = None  # last frame of the camera
        self._reference: Thumbnail | None = None  # last frame before the switch
        self._departed = 0  # successive frames since the switch that show its effect. From 2 on, none is compared
        self._doubtful = False  # True if the lights may have switched without an answer, which late frames could show
        self._lost_s = 0.0  # time spent in reconnections to the controller (s)
        self.stream: Stream = "visual"  # stream for which the lights were set last
        self.discarded = 0  # frames that `shot` did not return

    def measure_settling(self, switches: int, watch_s: float) -> Settling:
        """See `STS.measure_settling`."""
        for _ in range(_ATTEMPTS):
            if (measured := self._measured(switches, watch_s)) is not None:
                return measured
        raise LightError(
            f"the image was still changing {watch_s:.2f} s after the lights were switched, in {_ATTEMPTS} attempts: "
            "keep the scene at rest and lock the camera's exposure. For slow lights, pass STS(settling=...)."
        )

    def _measured(self, switches: int, watch_s: float) -> Settling | None:
        """Measure the settling times once. None: a movement or a delay of the computer has spoilt the measurement."""
        self._lit = None
        intervals = np.diff(self._watched("visual", watch_s).delays_s)
        period_s = float(np.median(intervals)) if len(intervals) else watch_s
        on, off = [self._watched("tactile", watch_s)], [self._watched("visual", watch_s)]
        measured = settling(on, off, period_s)
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
        measured = settling(on, off, period_s)
        if max(measured.visual_s, measured.tactile_s) > shorter_s - period_s:
            return None
        self._begin(measured, off[-1].thumbnails[-1], on[-1].thumbnails[-1])
        return measured

    def see_both(self, settling: Settling) -> None:
        """Use known settling times from now on, and take an image of each stream to compare later frames with."""
        lit = self._watched("tactile", 2 * settling.tactile_s).thumbnails[-1]
        dark = self._watched("visual", 2 * settling.visual_s).thumbnails[-1]
        self._begin(settling, dark, lit)

    def _begin(self, settling: Settling, dark: Thumbnail, lit: Thumbnail) -> None:
        self._settling = settling
        check_contrast(dark, lit)
        self._effect, self._looks = lit - dark, {"visual": dark, "tactile": lit}

    def pair(self, deadline: float) -> Pair:
        """Take an image of each stream. Both frames arrive after the start of this call.

        Args:
            deadline: Time on the clock at which the wait for frames ends (s). A reconnection to the controller extends
                it.
        """
        first = self.stream
        second = other(first)
        while True:
            lost_s = self._lost_s
            one = self.shot(first, deadline, after_s=self._clock.monotonic(), then=second)
            deadline, lost_s = deadline + self._lost_s - lost_s, self._lost_s
            two = self.shot(second, deadline)
            if one.epoch == two.epoch and one.before.boot == two.before.boot:
                return Pair(one, two) if first == "visual" else Pair(two, one)
            deadline += self._lost_s - lost_s

    def shot(self, stream: Stream, deadline: float, *, after_s: float = 0.0, then: Stream | None = None) -> Shot:
        """Take an image of one stream.

        Args:
            stream: Stream of the image.
            deadline: See `pair`.
            after_s: Earliest arrival time of the frame on the same clock (s).
            then: Stream for which the lights are set after the frame.
        """
        while True:
            try:
                if self._doubtful:
                    # Late frames may show two switches of the lights. After a frame that shows the lights of the other
                    # stream, all later frames can show only one switch.
                    self._frame(other(stream), deadline, 0.0)
                    self._doubtful = False
                before, frame = self._frame(stream, deadline, after_s)
                until_s = self._proof(before, then)
            except (DisconnectedError, LedTimeoutError):
                began_s = self._clock.monotonic()
                self._lit, self._doubtful = None, True
                self._leds.reconnect(limit_s=self._reconnect_s)
                reconnected_s = self._clock.monotonic() - began_s
                self._lost_s, deadline = self._lost_s + reconnected_s, deadline + reconnected_s
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
        if self._effect is not None and np.abs(effect).mean() > _KEPT * np.abs(self._effect).mean():
            self._effect = effect

    def _frame(self, stream: Stream, deadline: float, after_s: float) -> tuple[Lit, Captured]:
        """Return a frame that arrives after the lights have settled, and the controller's answer to their switch."""
        lit, checked_s = self._lit, 0.0
        if lit is None or self.stream != stream:
            lit = self._set(stream)
        assert self._settling is not None, "call measure_settling or see_both first"
        settled_s = self._settling.visual_s if stream == "visual" else self._settling.tactile_s
        while (left_s := deadline - self._clock.monotonic()) > 0:
            try:
                frame = self._camera.async_read(1000 * (left_s + _GRACE_S))
            except CameraLostError:
                if self._clock.monotonic() >= deadline:
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
                if not self._leds.ping().unchanged_since(lit):  # the watchdog or a restart has turned the lights off
                    lit = self._set(stream)
                elif frame.time_s > lit.acknowledged_s + settled_s + _AGAIN_S:
                    # The scene may have changed at the switch. The repeated switch is compared with a newer frame.
                    self._watched(other(stream), settled_s)
                    lit = self._set(stream)
                checked_s = self._clock.monotonic()
        remedy = "check that the LEDs light up, that the camera's exposure is locked, and that enough frames arrive"
        if self._previous is not None and self._previous.black:
            remedy = "the frames are black now. Check the camera, or connect again if the scene has become dark"
        raise LightError(
            f"no frame of {self._camera.source} could be proven to show the lights of the {stream} stream in time "
            f"({self.discarded} frames were discarded since the connection): {remedy}."
        )

    def _shows(self, frame: Captured, stream: Stream) -> bool:
        """Return whether a frame shows the last switch: the median value changes by more than half of the effect."""
        if self._effect is None:
            return True
        before = self._reference  # the last frame before the switch, if the lights before the switch are known
        if before is None:
            before = self._looks[other(stream)]
        change = self._effect if stream == "tactile" else -self._effect
        return switched_share(thumbnail(frame.image), before, change) > _DEPARTED

    def _set(self, stream: Stream) -> Lit:
        before = self._previous if self._lit is not None and self.stream != stream else None
        if self._exposures is not None and self._exposures[0] != self._exposures[1]:
            self._expose(self._exposures[stream == "tactile"])
        lit = self._leds.set(self._levels if stream == "tactile" else protocol.DARK)
        self._reference = None if before is None else thumbnail(before.image)
        self._lit, self.stream, self._departed = lit, stream, 0
        return lit

    def _expose(self, exposure: float) -> None:
        """Set the exposure. It is set before the lights, so that the settling time covers both changes."""
        set_exposure = getattr(self._camera, "set_exposure", None)
        if set_exposure is None or set_exposure(exposure) is None:
            raise CameraError(
                f"{self._camera.source} does not support a manual exposure, so the exposure cannot be set to "
                f"{exposure:g}: pass exposures=None to STS."
            )

    def _proof(self, before: Lit, then: Stream | None) -> float | None:
        """Return the time until which the lights did not change since `before` (s), or None if they changed.

        With `then`, the lights are switched to that stream.
        """
        if then == self.stream:
            then = None
        # A switch to the visual stream and the watchdog both turn the lights off. The counter of changes cannot
        # distinguish them, so a request without a switch comes first.
        if then is None or self.stream == "tactile":
            after = self._leds.ping()
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
            frame = self._previous = self._camera.async_read(1000 * self._timeout_s)
            delays.append(frame.time_s - lit.acknowledged_s)
            looks.append(thumbnail(frame.image))
        return Switch(np.array(delays, np.float32), np.array(looks, np.float32))
