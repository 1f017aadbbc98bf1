"""A person who places and releases objects, played for a peer of the sensor's devices."""

import threading
import time

import numpy as np

from sts_jax.hardware import Stage


class Player:
    """Plays the person who places and releases objects in front of a peer, as the instructions ask for.

    Trajectory n starts at `start(n)` and ends at `end(n)`.
    """

    def __init__(self, peer):
        self.peer, self.count = peer, 0
        peer.camera.numbered = False

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
