"""A sensor's devices without a sensor: a controller on a pseudo-terminal and a camera that sees its lights.

Each frame shows the mean light of its exposure, and its number in a corner. The peer logs that light for each
number, so that images are judged without the host's labels.
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

DARK, LIT = 70, 210  # grey values without and with the lights
CORNER = 32  # pixels, side of the corner with the number


class Lights:
    """The levels of the controllers that are plugged in, over time."""

    def __init__(self) -> None:
        self._changes = [(0.0, 0.0)]  # time (s) and share of the light from then on
        self._lock = threading.Lock()

    def changed(self, levels: protocol.Levels) -> None:
        """Log the levels that apply from now on."""
        with self._lock:
            self._changes.append((time.monotonic(), sum(levels) / 1020))

    def shares(self, start_s: float, end_s: float) -> tuple[list[float], float]:
        """The shares of the light that occur in an interval, and their mean."""
        with self._lock:
            changes = self._changes[-1000:]
        found: list[float] = []
        mean = 0.0
        for (begin_s, share), (stop_s, _) in zip(changes, [*changes[1:], (end_s + 1, 0.0)], strict=True):
            overlap_s = min(stop_s, end_s) - max(begin_s, start_s)
            if overlap_s > 0:
                found.append(share)
                mean += share * overlap_s / (end_s - start_s)
        return found, mean

    def off_after(self, time_s: float) -> float | None:
        """The time after which the lights have been off since, at least a given time. None: they are on."""
        with self._lock:
            since_s, share = self._changes[-1]
        return max(since_s, time_s) if share == 0 else None


class SeenController(EmulatedController):
    """A controller whose lights a camera sees."""

    def __init__(self, lights: Lights, **options: object):
        super().__init__(**options)  # type: ignore[arg-type]
        self._lights = lights
        lights.changed(self.levels)

    def _apply(self, levels: protocol.Levels) -> None:
        super()._apply(levels)
        self._lights.changed(levels)


@dataclasses.dataclass(frozen=True)
class Exposure:
    """One frame as the camera took it."""

    shares: list[float]  # shares of the light that occurred during it. A frame of one light has one
    mean: float  # their mean
    start_s: float  # on `time.monotonic`
    end_s: float


class SeenLights(MotionJpeg):
    """The camera. A frame that is sent at t was exposed from t - lag_s - exposure_s to t - lag_s."""

    def __init__(
        self, lights: Lights, *, fps: float, lag_s: float, exposure_s: float, size: tuple[int, int] = SIZE
    ) -> None:
        self.lights, self.lag_s, self.exposure_s = lights, lag_s, exposure_s
        self.log: dict[int, Exposure] = {}  # by the number of the frame
        self.blind = False  # whether the lights change nothing
        self.numbered = True
        self.moving = False
        self.spot: tuple[int, int, int] | None = None  # column, row and radius of a dark object (pixels)
        self.noise = 0.0  # standard deviation of each pixel
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
            image[:CORNER, :CORNER] = 0.3 * draw(self.number, (CORNER, CORNER)) + 110  # faint, the scene is at rest
        if self.moving:
            cv2.circle(image, (20 + 7 * self.number % 100, height // 2), 16, (0, 0, 0), -1)
        spot = self.spot
        if spot is not None:
            cv2.circle(image, spot[:2], spot[2], (30, 30, 30), -1)
        if self.noise:
            image = np.clip(image + self._random.normal(0, self.noise, image.shape), 0, 255).astype(np.uint8)
        return jpeg(image)

    def exposure_of(self, image: Image) -> Exposure | None:
        """The log of the frame that an image shows, or None if the camera has not taken such a frame."""
        if image.shape[1::-1] != self.size or image.max() < DARK / 2:
            return None
        return self.log.get(number_of(image[:CORNER, :CORNER]))


class SensorPeer:
    """Both devices. A host connects to the camera at `url` and to the controller at `path`."""

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
        """Plug the controller in, which boots. The watchdog's clock is real."""
        self._boots += 1
        self.leds = Peer(path, clock=time.monotonic, make=functools.partial(SeenController, self.lights))
        self.leds.controller.boot = self._boots

    def unplug(self) -> None:
        """Unplug the controller, whose lights go off."""
        self.leds.vanish()
        self.lights.changed(protocol.DARK)

    def judged(self, image: Image, *, lit: bool) -> bool:
        """Whether the camera has taken an image, with its lights on, or off, during all of its exposure."""
        found = self.camera.exposure_of(image)
        return found is not None and found.shares == [1.0 if lit else 0.0]

    def stop(self) -> None:
        """Unplug both devices."""
        self.camera.stop()
        self.leds.vanish()

    def shown(self) -> dict[int, Shown]:
        """The light of each frame, by `key` of its image."""
        return {number: Shown(number, exposure.mean) for number, exposure in self.camera.log.items()}


def key(image: Image) -> int:
    """The number of the frame that an image shows, from its corner."""
    return number_of(image[:CORNER, :CORNER])
