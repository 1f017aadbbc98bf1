"""A sensor's devices without a sensor: a controller on a pseudo-terminal and a camera that sees its lights.

Each frame shows the mean light of its exposure, and its number in a corner. The peer logs that light for each
number, so that a test can judge images without the host's labels.
"""

import threading
import time

import cv2
import numpy as np
from camera_server import SIZE, MotionJpeg, draw, jpeg
from led_peer import Peer

from sts_jax.hardware import Stage

DARK, LIT = 70, 210  # grey values without and with the lights
CORNER = 32  # pixels, side of the corner with the number


class Lights:
    """The levels of a controller over time."""

    def __init__(self, controller):
        self._controller, self._apply = controller, controller._apply
        self._changes = [(0.0, 0.0)]  # time (s) and share of the light from then on
        self._lock = threading.Lock()
        controller._apply = self._changed

    def _changed(self, levels):
        with self._lock:
            self._apply(levels)
            self._changes.append((time.monotonic(), sum(levels) / 1020))

    def shares(self, start_s, end_s):
        """The shares of the light that occur in an interval, and their mean."""
        with self._lock:
            changes = list(self._changes)
        found, mean = [], 0.0
        for (begin_s, share), (stop_s, _) in zip(changes, [*changes[1:], (end_s + 1, 0.0)], strict=True):
            overlap_s = min(stop_s, end_s) - max(begin_s, start_s)
            if overlap_s > 0:
                found.append(share)
                mean += share * overlap_s / (end_s - start_s)
        return found, mean


class SeenLights(MotionJpeg):
    """The camera. A frame that is sent at t was exposed from t - lag_s - exposure_s to t - lag_s."""

    def __init__(self, lights, *, fps, lag_s, exposure_s):
        self.lights, self.lag_s, self.exposure_s = lights, lag_s, exposure_s
        self.shown = {}  # the shares of light in each frame
        self.blind = False  # whether the lights change nothing
        self.numbered = True
        self.moving = False
        self.spot = None  # column, row and radius of a dark object (pixels)
        self.noise = 0.0  # standard deviation of each pixel
        self._random = np.random.default_rng(0)
        super().__init__(fps=fps)

    def _frame(self):
        if self.mode in ("black", "small", "damaged"):
            return super()._frame()
        end_s = time.monotonic() - self.lag_s
        shares, mean = self.lights.shares(end_s - self.exposure_s, end_s)
        self.shown[self.number] = shares
        image = np.full((SIZE[1], SIZE[0], 3), DARK if self.blind else DARK + mean * (LIT - DARK), np.uint8)
        if self.numbered:
            image[:CORNER, :CORNER] = 0.3 * draw(self.number, (CORNER, CORNER)) + 110  # faint, the scene is at rest
        if self.moving:
            cv2.circle(image, (20 + 7 * self.number % 100, SIZE[1] // 2), 16, (0, 0, 0), -1)
        spot = self.spot
        if spot is not None:
            cv2.circle(image, spot[:2], spot[2], (30, 30, 30), -1)
        if self.noise:
            image = np.clip(image + self._random.normal(0, self.noise, image.shape), 0, 255).astype(np.uint8)
        return jpeg(image)


class Player:
    """Plays the person who places and releases objects in front of a peer, as the instructions ask for.

    Trajectory n starts at `start(n)` and ends at `end(n)`.
    """

    def __init__(self, peer):
        self.peer, self.count = peer, 0
        peer.camera.numbered, peer.camera.noise = False, 1.0

    @staticmethod
    def start(number):
        return 50, 40 + 10 * number, 10

    @staticmethod
    def end(number):
        return 100, 80 - 10 * number, 10

    def follow(self, stage):
        """Do what a stage asks for."""
        camera = self.peer.camera
        if stage is Stage.CLEAR:
            camera.spot = None
        elif stage is Stage.PLACE:
            camera.spot = self.start(self.count)
        elif stage is Stage.RELEASE and camera.spot == self.start(self.count):
            threading.Thread(target=self._move, args=(self.start(self.count), self.end(self.count))).start()
            self.count += 1

    def _move(self, here, there):
        for share in np.linspace(0, 1, 8):
            self.peer.camera.spot = tuple(int(v) for v in np.round(here + share * np.subtract(there, here)))
            time.sleep(0.03)

    @staticmethod
    def place_of(image):
        """Column and row of the object in an image, or None."""
        dark = (image.mean(-1) < 50).nonzero()
        return (round(float(dark[1].mean())), round(float(dark[0].mean()))) if len(dark[0]) > 100 else None


class SensorPeer:
    """Both devices. `url` and `path` are what a host connects to."""

    def __init__(self, path, *, fps=60, lag_s=0.03, exposure_s=0.012):
        self.leds = Peer(path)
        self.leds._now_s = time.monotonic  # the watchdog's clock is real
        self.leds.controller = type(self.leds.controller)(now_s=time.monotonic())
        self.camera = SeenLights(Lights(self.leds.controller), fps=fps, lag_s=lag_s, exposure_s=exposure_s)
        self.path, self.url = str(path), self.camera.url

    def stop(self):
        self.camera.stop()
        self.leds.vanish()
