"""`ProvenFrames`: takes camera frames, and ensures that the lights did not change during their exposure.

After each frame, the LED controller must confirm that the lights have not changed since they were last switched.
"""

import contextlib
import dataclasses
import time
from collections.abc import Sequence
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from sts_jax.hardware import protocol
from sts_jax.hardware.camera import CameraError, CameraLostError, Captured
from sts_jax.hardware.leds import DisconnectedError, Leds, LedTimeoutError, Lit
from sts_jax.hardware.opencv import OpenCVCamera

_SIZE = 32, 24  # width and height of a thumbnail (pixels). Each pixel is the mean of many, which averages noise out
_LEAST_CONTRAST = 2.0  # smallest mean difference of thumbnails between lights off and on (of 255)
_VISIBLE = 0.5  # smallest effect of the lights on a value of a thumbnail that is used (of 255). The noise is below it
_CLEAR = 0.25  # smallest effect on a value that is used, as a share of the median visible effect
_TOLERANCE = 0.02  # largest difference from the last share of the light at which a frame counts as settled

Thumbnail = Float[np.ndarray, "24 32 3"]  # a small copy of an image, 0 to 255


class NoContrastError(RuntimeError):
    """The image with the lights off differs from the image with the lights on by less than 2 of 255 on average."""


@dataclasses.dataclass(frozen=True)
class Settling:
    """The settling times: `visual_s` after the lights are switched off, and `tactile_s` after they are switched on.

    A settling time begins when the LED controller acknowledges that it has switched the lights. Frames that arrive
    during the settling time are discarded, because these frames may still show the previous state of the lights.

    Raises:
        ValueError: A time is not between 0 and 60 s.
    """

    visual_s: float  # settling time after the lights were switched off (s)
    tactile_s: float  # settling time after the lights were switched on (s)

    def __post_init__(self) -> None:
        for name in ("visual_s", "tactile_s"):
            value = getattr(self, name)
            if not 0 < value < 60:
                raise ValueError(f"{name} must be in (0, 60) s, got {value}")


@dataclasses.dataclass(frozen=True, eq=False)
class Switch:
    """The frames that arrive after the lights are switched on or off.

    The last frame must arrive after the lights have stopped changing.
    """

    delays_s: Float[np.ndarray, "n"]  # time from the acknowledgement to the arrival of each frame (s)
    thumbnails: Float[np.ndarray, "n 24 32 3"]  # thumbnail of each frame, 0 to 255


def thumbnail(image: UInt8[np.ndarray, "height width 3"]) -> Thumbnail:
    """Return a small copy of an image.

    Args:
        image: RGB image, 0 to 255.

    Returns:
        The image is divided into 24 rows and 32 columns of blocks. The result is the mean colour of each block, shape
        (24, 32, 3), 0 to 255.
    """
    return cv2.resize(image, _SIZE, interpolation=cv2.INTER_AREA).astype(np.float32)


def difference(first: Thumbnail, second: Thumbnail) -> float:
    """Return the mean absolute difference between the values of two thumbnails, 0 to 255."""
    return float(np.abs(first - second).mean())


def check_contrast(contrast: float) -> None:
    """Raise an error if the lights do not change the image.

    Args:
        contrast: Mean absolute difference between the images with the lights off and on, 0 to 255.

    Raises:
        NoContrastError: The difference is less than 2.
    """
    if contrast < _LEAST_CONTRAST:
        raise NoContrastError(
            f"the images with the lights off and on differ by {contrast:.2f} on average (pixel values are 0 to 255), "
            f"but they must differ by at least {_LEAST_CONTRAST:g}: check the LEDs' wiring and levels, and lock the "
            "camera's exposure."
        )


def light_share(look: Thumbnail, dark: Thumbnail, lit: Thumbnail) -> float:
    """Return the brightness of the lights in an image, as a share of their full brightness.

    The share is the number `s` for which `dark + s (lit - dark)` is closest to `look` in the least-squares sense.
    Parts of the view that the lights do not reach have no influence.

    Args:
        look: Thumbnail of the image.
        dark: Thumbnail with the lights off.
        lit: Thumbnail with the lights on.

    Returns:
        0 for an image like `dark`, 1 for an image like `lit`.
    """
    change = lit - dark
    return float(((look - dark) * change).sum() / (change**2).sum())


def switched_share(look: Thumbnail, before: Thumbnail, change: Thumbnail) -> float:
    """Return how far the lights had been switched on or off when an image was taken: 0 means not yet, 1 means fully.

    A value of `change` counts as visible if its magnitude is at least 0.5 (of 255). A visible value counts as clear if
    its magnitude is at least a quarter of the median magnitude of all visible values. The result is the median of
    `(look - before) / change` over the clear values. Because of the median, an object that moves in less than half of
    the view has no influence.

    Args:
        look: Thumbnail of the image.
        before: Thumbnail of an image before the switch.
        change: Effect of a complete switch on a thumbnail, from two earlier images. It is the thumbnail with the new
            state of the lights minus the thumbnail with the old state.

    Returns:
        0 if the image shows the lights before the switch, and 1 if it shows the lights after the switch. The result is
        also 0 if no value of `change` is visible.
    """
    effect = np.abs(change)
    visible = effect >= _VISIBLE
    if not visible.any():
        return 0.0
    used = effect >= max(_VISIBLE, _CLEAR * float(np.median(effect[visible])))
    return float(np.median((look - before)[used] / change[used]))


def settling(on: Sequence[Switch], off: Sequence[Switch], period_s: float) -> Settling:
    """Compute the settling times from the frames after several switches of the lights.

    The `light_share` of a frame is 0 if the lights are off and 1 if they are on. A frame is settled if its
    `light_share` differs by at most 0.02 from the `light_share` of the last frame in the same `Switch`. The delay of a
    frame is its time of arrival after the controller's acknowledgement. A settling time is the largest delay of a frame
    that is not settled, plus `period_s`. One settling time is computed from `on`, and another from `off`.
    `period_s` is added because a switch can occur at any time within the exposure of a frame, and the measured switches
    occurred at only a few such times.

    Args:
        on: Switches from off to on. The scene must be at rest.
        off: Switches from on to off. The scene must be at rest.
        period_s: Time between two frames (s).

    Returns:
        The settling times.

    Raises:
        NoContrastError: The lights do not change the image.
    """
    dark = np.mean([switch.thumbnails[-1] for switch in off], axis=0)
    lit = np.mean([switch.thumbnails[-1] for switch in on], axis=0)
    contrast = difference(dark, lit)
    check_contrast(contrast)
    last_off, last_on = (max(last_mixed(switch, dark, lit) for switch in switches) for switches in (off, on))
    return Settling(last_off + period_s, last_on + period_s)


def last_mixed(switch: Switch, dark: Thumbnail, lit: Thumbnail) -> float:
    """Return the time from the acknowledgement of a switch to the arrival of the last frame that is not settled (s).

    The `light_share` of a frame is 0 for a frame like `dark` and 1 for a frame like `lit`. A frame is settled if its
    `light_share` differs by at most 0.02 from the `light_share` of the last frame in `switch`. If all frames are
    settled, the result is 0. The result is never negative.

    Args:
        switch: The frames after a switch of the lights.
        dark: Thumbnail with the lights off.
        lit: Thumbnail with the lights on.
    """
    shares = np.array([light_share(look, dark, lit) for look in switch.thumbnails])
    mixed = np.flatnonzero(np.abs(shares - shares[-1]) > _TOLERANCE)
    return max(float(switch.delays_s[mixed[-1]]), 0.0) if len(mixed) else 0.0


Stream = Literal["visual", "tactile"]


class LightError(RuntimeError):
    """No image with the requested lights could be taken in time, or the settling times could not be measured.

    The lights must be off in a visual image and on in a tactile image. The settling time is the time after a switch of
    the lights during which frames may still show the previous state of the lights.
    """


class NotStillError(TimeoutError):
    """The visual stream did not become still in time, because something in the view moved or changed."""


@dataclasses.dataclass(frozen=True, eq=False)
class Shot:
    """An image of the visual stream (lights off) or of the tactile stream (lights on).

    The field `before` is the LED controller's answer to the last switch of the lights before the image. The answer
    arrived at the time `before.acknowledged_s`. The lights did not change between this time and the time `until_s`. The
    frame arrived between these two times, at least one settling time after `before.acknowledged_s`. Frames that arrive
    during the settling time may still show the previous levels of the lights.
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
    """A visual image and a tactile image. `STS` takes these two images one after the other."""

    visual: Shot  # image with the lights off
    tactile: Shot  # image with the lights on


_DEPARTED = 0.5  # share of the lights' effect that the median value of a frame must show after a switch
_KEPT = 0.5  # share of the lights' effect that the last images must show to replace the stored effect
_AGAIN_S = 1.0  # s after the settling time. A switch that no frame shows by then is repeated
_ATTEMPTS = 3  # attempts to measure the settling times
_PHASE = 0.618  # share of the camera's period by which the phase advances from one measured switch to the next
_CHECK_S = 0.1  # s, shortest time between two requests to the controller while frames do not show the switch
_GRACE_S = 0.2  # s by which the wait for a frame may exceed the deadline, so that a lost camera raises its own error


class ProvenFrames:
    """Switches the lights of a connected sensor, and takes frames that are proven to show the new state of the lights.

    The lights are off in the visual stream and on in the tactile stream. The proof consists of two checks:

    - After each switch of the lights, the frames are compared with a frame from before the switch. Frames are discarded
      until two successive frames show the new state of the lights.
    - After each taken frame, the controller must confirm that the lights have not changed since the switch.

    Only one thread may take images. Other threads may only call `stop`.
    """

    def __init__(
        self,
        camera: OpenCVCamera,
        leds: Leds,
        *,
        levels: protocol.Levels,
        exposures: tuple[float, float] | None,
        timeout_s: float,
        reconnect_s: float,
    ):
        """Store the open devices. Call `measure_settling` or `see_both` before the first image is taken.

        Args:
            camera: The connected camera.
            leds: The open LED controller.
            levels: Duty cycles of the four channels in the tactile stream, 0 to 255.
            exposures: Exposures of the visual and of the tactile stream, in the unit of the camera's driver. If the
                two exposures are equal, or if `exposures` is None, the camera's exposure is not changed.
            timeout_s: Longest wait for a frame in `measure_settling` and `see_both`, and while `shot` repeats a switch
                of the lights (s).
            reconnect_s: Longest search for a controller that was lost (s).
        """
        self._camera, self._leds = camera, leds
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
        self._stopping = False  # True if `shot` must end in the thread that takes images
        self._lost_s = 0.0  # time spent in reconnections to the controller (s)
        self.stream: Stream = "visual"  # stream for which the lights were set last
        self.discarded = 0  # frames that `shot` did not return

    def stop(self) -> None:
        """Interrupt a call of `shot` or `pair` that runs in another thread.

        The interrupted call soon raises an error. Call `resume` before the next call of `shot` or `pair`.
        """
        self._stopping = True

    def resume(self) -> None:
        """Undo `stop`, so that images can be taken again."""
        self._stopping = False

    def measure_settling(self, switches: int, watch_s: float) -> Settling:
        """Measure the settling times, and use them from now on.

        After the lights are switched on or off, frames may still show the previous state of the lights for a short
        time. This time is the settling time.

        Args:
            switches: Number of switches of the lights in each direction, off to on and on to off.
            watch_s: Time for which frames are collected after the first switch in each direction (s).

        Returns:
            The settling times.

        Raises:
            NoContrastError: The lights do not change the image.
            LightError: In each of three attempts, the image was still changing in the last frames that were collected
                after the lights were switched.
        """
        for _ in range(_ATTEMPTS - 1):
            with contextlib.suppress(LightError):
                return self._measured(switches, watch_s)
        return self._measured(switches, watch_s)

    def _measured(self, switches: int, watch_s: float) -> Settling:
        """Measure the settling times once. A movement or a delay of the computer can spoil the measurement."""
        self._lit = None
        period_s = self._period_s()
        self._watched("visual", watch_s)
        on, off = [self._watched("tactile", watch_s)], [self._watched("visual", watch_s)]
        found = self._settled(on, off, period_s, watch_s)
        shorter_s = min(3 * max(found.visual_s, found.tactile_s) + 3 * period_s, watch_s)
        for number in range(1, switches):
            phase_s = period_s * (_PHASE * number % 1)  # the collection of frames ends just after a frame
            time.sleep(phase_s)
            on.append(self._watched("tactile", shorter_s))
            time.sleep(phase_s)
            off.append(self._watched("visual", shorter_s))
        found = self._settled(on, off, period_s, shorter_s)
        self._begin(found, off[-1].thumbnails[-1], on[-1].thumbnails[-1])
        return found

    def _begin(self, settling: Settling, dark: Thumbnail, lit: Thumbnail) -> None:
        """Use settling times from now on, and store a visual and a tactile image to compare later frames with."""
        self._settling = settling
        check_contrast(difference(dark, lit))
        self._effect, self._looks = lit - dark, {"visual": dark, "tactile": lit}

    def see_both(self, settling: Settling) -> None:
        """Use known settling times from now on, and take a visual image (lights off) and a tactile image (lights on).

        Later frames are compared with these two images to find out whether the lights are off or on.

        Args:
            settling: Settling times. After each switch of the lights, frames are discarded for the settling time.

        Raises:
            NoContrastError: The lights do not change the image.
        """
        lit = self._watched("tactile", 2 * settling.tactile_s).thumbnails[-1]
        dark = self._watched("visual", 2 * settling.visual_s).thumbnails[-1]
        self._begin(settling, dark, lit)

    def _settled(self, on: list[Switch], off: list[Switch], period_s: float, watch_s: float) -> Settling:
        found = settling(on, off, period_s)
        slowest_s = max(found.visual_s, found.tactile_s)
        if slowest_s > watch_s - period_s:
            raise LightError(
                f"the image was still changing about {slowest_s:.2f} s after the lights were switched, and the "
                f"measurement ended after {watch_s:.2f} s: keep the scene at rest and lock the "
                "camera's exposure. If the lights are slow, pass their settling times as "
                "STS(settling=Settling(visual_s, tactile_s))."
            )
        return found

    def pair(self, deadline: float) -> Pair:
        """Take a visual and a tactile image. The frames of both images arrive after the start of this call.

        The method begins with the stream for which the lights are already set. The lights are therefore switched only
        once for a pair, unless a connection is lost.

        Args:
            deadline: Time on the clock `time.monotonic` at which the wait for frames ends (s). If the LED controller is
                lost during the call, the deadline is extended by the duration of the reconnection.

        Returns:
            The two images.

        Raises:
            LightError, LedError, CameraError: `STS.read` lists the causes of these errors.
        """
        first = self.stream
        second: Stream = "tactile" if first == "visual" else "visual"
        while True:
            lost_s = self._lost_s
            one = self.shot(first, deadline, after_s=time.monotonic(), then=second)
            deadline, lost_s = deadline + self._lost_s - lost_s, self._lost_s
            two = self.shot(second, deadline)
            if one.epoch == two.epoch and one.before.boot == two.before.boot:
                return Pair(one, two) if first == "visual" else Pair(two, one)
            deadline += self._lost_s - lost_s

    def shot(self, stream: Stream, deadline: float, *, after_s: float = 0.0, then: Stream | None = None) -> Shot:
        """Take an image of one stream.

        If the lights are not set for `stream`, they are switched first. After the frame has arrived, the controller is
        asked for the state of the lights. Its answer must confirm that the lights have not changed since they were set
        for `stream`. The lights are then set for the stream `then`, if it is given.

        Args:
            stream: Stream of the image, "visual" (lights off) or "tactile" (lights on).
            deadline: Time on the clock `time.monotonic` at which the wait for frames ends (s). If the LED controller is
                lost during the call, the deadline is extended by the duration of the reconnection.
            after_s: Earliest arrival time of the frame on the same clock (s).
            then: Stream for which the lights are set after the frame. None: the lights do not change.

        Returns:
            The image.

        Raises:
            LightError, LedError, CameraError: `STS.read` lists the causes of these errors.
        """
        while True:
            try:
                if self._doubtful:
                    # Late frames may show two switches of the lights. After a frame that shows the lights of the other
                    # stream, all later frames can show only one switch.
                    self._frame("visual" if stream == "tactile" else "tactile", deadline, 0.0)
                    self._doubtful = False
                before, frame = self._frame(stream, deadline, after_s)
                until_s = self._proof(before, then)
            except (DisconnectedError, LedTimeoutError):
                began_s = time.monotonic()
                self._lit, self._doubtful = None, True
                self._leds.reconnect(limit_s=self._reconnect_s)
                reconnected_s = time.monotonic() - began_s
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
        lit, checked_s = self._switched(stream), 0.0
        assert self._settling is not None, "call measure_settling or see_both first"
        settled_s = self._settling.visual_s if stream == "visual" else self._settling.tactile_s
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
            if self._departed >= 2 and late_s >= 0 and not spoilt and not frame.delayed:
                return lit, frame
            self.discarded += 1
            if self._departed == 0 and late_s >= 0 and time.monotonic() >= checked_s + _CHECK_S:
                if not self._leds.ping().unchanged_since(lit):  # the watchdog or a restart has turned the lights off
                    lit = self._set(stream)
                elif frame.time_s > lit.acknowledged_s + settled_s + _AGAIN_S:
                    # The scene may have changed at the switch. The repeated switch is compared with a newer frame.
                    self._watched("tactile" if stream == "visual" else "visual", settled_s)
                    lit = self._set(stream)
                checked_s = time.monotonic()
        raise LightError("stop() interrupted the wait for a frame: call resume() before you take the next image.")

    def _light_error(self, stream: Stream) -> LightError:
        remedy = "check that the LEDs light up, that the camera's exposure is locked, and that enough frames arrive"
        if self._previous is not None and self._previous.black:
            remedy = "the frames are black now. Check the camera, or connect again if the scene has become dark"
        return LightError(
            f"no frame of {self._camera.config.name} could be proven to show the lights of the {stream} stream in time "
            f"({self.discarded} frames were discarded since the connection): {remedy}."
        )

    def _shows(self, frame: Captured, stream: Stream) -> bool:
        """Return whether a frame shows the last switch: the median value changes by more than half of the effect.

        The frame is compared with the last frame before the switch. If the lights before the switch are unknown, the
        frame is compared with the last image of the other stream.
        """
        if self._effect is None:
            return True
        before = self._looks["tactile" if stream == "visual" else "visual"]
        if self._reference is not None:
            before = self._reference
        change = self._effect if stream == "tactile" else -self._effect
        return switched_share(thumbnail(frame.image), before, change) > _DEPARTED

    def _repeats(self, frame: Captured) -> bool:
        """Return whether a frame repeats the one before. With `frozen_after_s=None`, repetitions are allowed."""
        return frame.repeats > 0 and self._camera.config.frozen_after_s is not None

    def _in_order(self, frame: Captured) -> bool:
        """Return whether a frame directly follows the previous one."""
        last = self._previous
        return last is not None and (frame.epoch, frame.sequence) == (last.epoch, last.sequence + 1)

    def _switched(self, stream: Stream) -> Lit:
        """Set the lights of a stream unless they are set already, and return the controller's answer to the switch."""
        if self._lit is None or self.stream != stream:
            self._set(stream)
        assert self._lit is not None
        return self._lit

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
        if self._camera.set_exposure(exposure) is None:
            raise CameraError(
                f"the driver of {self._camera.config.name} does not support a manual exposure, so the exposure cannot "
                f"be set to {exposure:g}: pass exposures=None to STS."
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

    def _period_s(self) -> float:
        """Return the time between two frames (s). Waits for enough frames to measure it."""
        while True:
            rate = self._camera.statistics.rate
            if rate is not None:
                return 1 / rate
            self._camera.async_read()
