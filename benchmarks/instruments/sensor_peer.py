"""An emulated sensor: an LED controller on a pseudo-terminal, and a camera that sees the controller's lights.

The grey value of a frame increases linearly with the mean light during its exposure. A corner of the frame shows the
frame's number. The camera logs the light by frame number, so a benchmark can check the light of an image independently
of `hardware.STS`.
"""

import dataclasses
import functools
import threading
import time
from pathlib import Path

import cv2
import numpy as np

from benchmarks.instruments.camera_server import SIZE, Image, MotionJpeg, draw, jpeg, number_of
from benchmarks.instruments.led_peer import Peer
from benchmarks.instruments.shown import Shown
from sts_jax.hardware import protocol
from sts_jax.hardware.emulation import EmulatedController

DARK, LIT = 70, 210  # grey values of a frame with the lights off and fully on
CORNER = 32  # pixels, side of the corner that shows the number


class Lights:
    """A log of the light level of the emulated sensor over time, as a share of the full power."""

    def __init__(self) -> None:
        self._changes = [(0.0, 0.0)]  # each change: its time (s) and the share of the light from then on
        self._lock = threading.Lock()

    def changed(self, levels: protocol.Levels) -> None:
        """Log that the four channels have these levels, 0 to 255, from now on."""
        with self._lock:
            self._changes.append((time.monotonic(), sum(levels) / 1020))

    def shares(self, start_s: float, end_s: float) -> tuple[list[float], float]:
        """Return the levels of the emulated light during an interval.

        Args:
            start_s: Start of the interval on `time.monotonic` (s).
            end_s: End of the interval (s).

        Returns:
            The successive levels of the light as shares of the full power, and the mean level over the interval.
        """
        with self._lock:
            changes = self._changes[-1000:]
        found: list[float] = []
        mean = 0.0
        for (begin_s, share), (stop_s, _) in zip(changes, [*changes[1:], (end_s + 1, 0.0)], strict=True):
            overlap_s = min(stop_s, end_s) - max(begin_s, start_s)
            if overlap_s > 0:
                if found[-1:] != [share]:
                    found.append(share)
                mean += share * overlap_s / (end_s - start_s)
        return found, mean

    def off_after(self, time_s: float) -> float | None:
        """Return the time at which the lights were last switched off, or `time_s` if `time_s` is later.
        Return None if the lights are on now. All times are in seconds on `time.monotonic`.
        """
        with self._lock:
            since_s, share = self._changes[-1]
        return max(since_s, time_s) if share == 0 else None


class SeenController(EmulatedController):
    """An emulated LED controller that passes the brightness of its LEDs on to the emulated camera."""

    def __init__(self, lights: Lights, **options: object):
        super().__init__(**options)  # type: ignore[arg-type]
        self._lights = lights
        lights.changed(self.levels)

    def _apply(self, levels: protocol.Levels) -> None:
        super()._apply(levels)
        self._lights.changed(levels)


@dataclasses.dataclass(frozen=True)
class Exposure:
    """The start and end of the exposure of one frame, and the light during the exposure."""

    shares: list[float]  # successive shares of the light during the exposure, only one if the light was constant
    mean: float  # mean share over the exposure
    start_s: float  # start of the exposure on `time.monotonic`
    end_s: float  # end of the exposure on `time.monotonic`


class SeenLights(MotionJpeg):
    """An emulated camera that sees `lights`.

    A frame that is sent at time t was exposed from t - lag_s - exposure_s to t - lag_s.

    Args:
        lights: The light over time.
        fps: Frames per second.
        lag_s: Time from the end of the exposure to the sending (s).
        exposure_s: Exposure time (s).
        size: Width and height of the frames (pixels).
    """

    def __init__(
        self, lights: Lights, *, fps: float, lag_s: float, exposure_s: float, size: tuple[int, int] = SIZE
    ) -> None:
        self.lights, self.lag_s, self.exposure_s = lights, lag_s, exposure_s
        self.log: dict[int, Exposure] = {}  # exposure of each frame, by the number of the frame
        self.blind = False  # True: frames do not show the light
        self.numbered = True  # True: frames show their number
        self.moving = False  # True: a black disc moves through the frames
        self.spot: tuple[int, int, int] | None = None  # column, row and radius of a dark object (pixels)
        self.noise = 0.0  # standard deviation of the noise of each pixel (of 255)
        self._random = np.random.default_rng(0)
        super().__init__(fps=fps, size=size)

    def _frame(self) -> bytes:
        if self.mode in ("black", "small", "damaged"):
            return super()._frame()
        end_s = time.monotonic() - self.lag_s
        shares, mean = self.lights.shares(end_s - self.exposure_s, end_s)
        self.log[self.number] = Exposure(shares, mean, end_s - self.exposure_s, end_s)
        width, height = self.size
        image = np.full((height, width, 3), DARK if self.blind else DARK + mean * (LIT - DARK), np.uint8)
        if self.numbered:
            # The blocks are faint, because changes of strong blocks would count as motion of the scene.
            image[:CORNER, :CORNER] = 0.3 * draw(self.number, (CORNER, CORNER)) + 110
        if self.moving:
            cv2.circle(image, (20 + 7 * self.number % 100, height // 2), 16, (0, 0, 0), -1)
        spot = self.spot
        if spot is not None:
            cv2.circle(image, spot[:2], spot[2], (30, 30, 30), -1)
        if self.noise:
            image = np.clip(image + self._random.normal(0, self.noise, image.shape), 0, 255).astype(np.uint8)
        return jpeg(image)

    def exposure_of(self, image: Image) -> Exposure | None:
        """Look up the time and the light of an image's exposure by the frame number that a corner of the image shows.

        Return None if the camera has not taken such an image.
        """
        if image.shape[1::-1] != self.size or image.max() < DARK / 2:
            return None
        return self.log.get(number_of(image[:CORNER, :CORNER]))


class SensorPeer:
    """An emulated camera at the address `url`, and an emulated controller at the port `path`.

    Args:
        path: Path at which a symbolic link to the controller's port is created.
        fps: Frames per second of the camera.
        lag_s: Time from the end of an exposure to the sending of the frame (s).
        exposure_s: Exposure time (s).
        size: Width and height of the frames (pixels).
    """

    def __init__(
        self,
        path: Path,
        *,
        fps: float = 60,
        lag_s: float = 0.03,
        exposure_s: float = 0.012,
        size: tuple[int, int] = SIZE,
    ):
        self.lights = Lights()
        self._boots = 0
        self.path = str(path)
        self.plug_in(path)
        self.camera = SeenLights(self.lights, fps=fps, lag_s=lag_s, exposure_s=exposure_s, size=size)

    @property
    def url(self) -> str:
        """The address of the camera."""
        return self.camera.url

    def plug_in(self, path: Path) -> None:
        """Plug the controller in at the port `path`, so that the controller boots.

        The clock of this controller runs at the true speed, so its watchdog acts after the requested period. The
        default clock of `Peer` is a hundred times slower.
        """
        self._boots += 1
        self.leds = Peer(path, clock=time.monotonic, make=functools.partial(SeenController, self.lights))
        self.leds.controller.boot = self._boots

    def unplug(self) -> None:
        """Unplug the controller. Its lights go off."""
        self.leds.vanish()
        self.lights.changed(protocol.DARK)

    def judged(self, image: Image, *, lit: bool) -> bool:
        """Return whether the lights had the given state during the whole exposure of an image.

        Args:
            image: Image from the emulated camera. The result is False if the camera's log has no exposure for it.
            lit: True for lights at full power, False for lights that are off.
        """
        found = self.camera.exposure_of(image)
        return found is not None and found.shares == [1.0 if lit else 0.0]

    def stop(self) -> None:
        """Unplug the emulated camera and the emulated LED controller."""
        self.camera.stop()
        self.leds.vanish()

    def shown(self) -> dict[int, Shown]:
        """Return the mean light during the exposure of each frame that the emulated camera has logged.

        The result maps the number of each frame to the light. The function `key` reads the number from an image.
        """
        return {number: Shown(number, exposure.mean) for number, exposure in self.camera.log.items()}


def key(image: Image) -> int:
    """Read the number of a frame from the corner of its image."""
    return number_of(image[:CORNER, :CORNER])
