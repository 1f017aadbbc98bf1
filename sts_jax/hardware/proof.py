"""`ProvenFrames`: switches the lights, and takes frames that are proven to be of one light."""

import contextlib
import time

import numpy as np

from sts_jax.hardware import protocol
from sts_jax.hardware.camera import Camera
from sts_jax.hardware.camera_errors import CameraError, CameraLostError
from sts_jax.hardware.frames import Captured
from sts_jax.hardware.leds import Leds, Lit
from sts_jax.hardware.ports import DisconnectedError, LedTimeoutError
from sts_jax.hardware.settling import Settling, Switch, Thumbnail, check_contrast, difference, settling, thumbnail
from sts_jax.hardware.shots import LightError, Pair, Shot, Stream

_DEPARTED = 0.5  # of the contrast, by which a frame must differ from the last one before the switch
_AGAIN_S = 1.0  # s, after which a switch that does not show is repeated
_ATTEMPTS = 3  # to measure the settling
_PHASE = 0.618  # of a period, by which the phase of the measured switches advances
_CHECK_S = 0.1  # s, least time between two questions to the controller while frames show another light
_GRACE_S = 0.2  # s, by which a wait for the camera may exceed a limit, so that the cause of a delay is the one reported


class ProvenFrames:
    """The lights and the frames of a connected sensor.

    The state is that of the last switch: the controller's answer to it, the last frame before it, and the number of
    frames that have shown it. One thread may use it at a time, except `stop`.
    """

    def __init__(
        self,
        camera: Camera,
        leds: Leds,
        *,
        levels: protocol.Levels,
        exposures: tuple[float, float] | None,
        timeout_s: float,
        reconnect_s: float,
    ):
        """Keep the devices, which are open. `measure_settling` or `see_both` must precede the first image.

        Args:
            camera: The camera.
            leds: The LED controller.
            levels: As in `STS`.
            exposures: As in `STS`.
            timeout_s: Longest wait for one frame while the settling is measured (s).
            reconnect_s: As in `STS`.
        """
        self._camera, self._leds = camera, leds
        self._levels, self._exposures = levels, exposures
        self._timeout_s, self._reconnect_s = timeout_s, reconnect_s
        self._settling: Settling | None = None  # in use
        self._lit: Lit | None = None  # the last answer of the controller about lights that this object has set
        self._contrast: float | None = None  # of images without and with the light, of 255
        self._looks: dict[Stream, Thumbnail] = {}  # of the last image of each stream
        self._black: dict[Stream, bool] = {}  # whether this image was black
        self._previous: Captured | None = None  # the last frame of the camera
        self._reference: Thumbnail | None = None  # of the last frame before the switch
        self._departed = 0  # successive frames since the switch that show the new light, 2 and more: all are of it
        self._doubtful = False  # whether the lights may have switched without an answer, so late frames may show it
        self._stopping = False  # whether the thread that takes images is to end
        self.stream: Stream = "visual"  # whose light is on
        self.discarded = 0  # frames that could not be proven to be of one light

    def stop(self) -> None:
        """Make a call of another thread that is under way end soon, with an error. `resume` must follow."""
        self._stopping = True

    def resume(self) -> None:
        """Allow images after `stop`."""
        self._stopping = False

    def measure_settling(self, switches: int, watch_s: float) -> Settling:
        """Measure the settling times, and use them. See `STS.measure_settling`."""
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
        self._begin(found, off[-1].thumbnails[-1], on[-1].thumbnails[-1])
        return found

    def _begin(self, settling: Settling, dark: Thumbnail, lit: Thumbnail) -> None:
        """Use settling times, and keep images without and with the light, with which later ones are compared."""
        self._settling = settling
        self._contrast = difference(dark, lit)
        check_contrast(self._contrast)
        self._looks = {"visual": dark, "tactile": lit}

    def see_both(self, settling: Settling) -> None:
        """Use settling times that are known. Takes an image of each light, with which later ones are compared."""
        lit = self._watched("tactile", 2 * settling.tactile_s).thumbnails[-1]
        dark = self._watched("visual", 2 * settling.visual_s).thumbnails[-1]
        self._begin(settling, dark, lit)

    def _settled(self, on: list[Switch], off: list[Switch], period_s: float, watch_s: float) -> Settling:
        found = settling(on, off, period_s)
        slowest_s = max(found.visual_s, found.tactile_s)
        if slowest_s > watch_s - period_s:
            raise LightError(
                f"the image still changes {slowest_s:.2f} s after a switch: keep the scene at rest, lock the camera's "
                f"exposure, or watch for longer than {watch_s:.2f} s."
            )
        return found

    def pair(self, deadline: float) -> Pair:
        """An image of each stream. Both arrive after the call. The stream whose light is on comes first."""
        first = self.stream
        second: Stream = "tactile" if first == "visual" else "visual"
        while True:
            one = self.shot(first, deadline, after_s=time.monotonic(), then=second)
            two = self.shot(second, deadline)
            if one.epoch == two.epoch and one.before.boot == two.before.boot:
                return Pair(one, two) if first == "visual" else Pair(two, one)

    def shot(self, stream: Stream, deadline: float, *, after_s: float = 0.0, then: Stream | None = None) -> Shot:
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
                self._leds.reconnect(limit_s=self._reconnect_s)
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
            if self._departed >= 2 and late_s >= 0 and not spoilt and not frame.held_back:
                return lit, frame
            self.discarded += 1
            if self._departed == 0 and late_s >= 0 and time.monotonic() >= checked_s + _CHECK_S:
                if not self._leds.ping().unchanged_since(lit):  # the controller has turned its lights off
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
        """Set the exposure before the lights, so that the settling covers both."""
        if self._camera.set_exposure(exposure) is None:
            raise CameraError(
                f"the driver of {self._camera.config.name} does not let the exposure be set to {exposure:g}: give "
                "exposures=None."
            )

    def _proof(self, before: Lit, then: Stream | None) -> float | None:
        """The time until which the lights are proven to be unchanged, or None if they changed. May switch them."""
        if then == self.stream:
            then = None
        # The watchdog turns the lights off as a switch to the visual stream does, and the counter of changes would not
        # tell one from the other.
        if then is None or self.stream == "tactile":
            after = self._leds.ping()
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
