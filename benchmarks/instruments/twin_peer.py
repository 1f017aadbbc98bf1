"""A digital twin that replaces a real sensor in a benchmark.

The twin logs the brightness of its LEDs during each frame. A benchmark can therefore check whether the LEDs were on or
off in an image, independently of `hardware.STS`.
"""

import zlib
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from benchmarks.instruments.peers import Shown
from experiments.shared.device import TwinConfig, make_twin
from sts_jax.hardware import twin
from sts_jax.hardware.twin import photometry

_START = b"\xff\xd8\xff"  # first bytes of a JPEG image


class TwinPeer:
    """A digital twin with a camera at the address `url` and an LED controller at a serial port."""

    def __init__(self, path: Path, *, fps: float, lag_s: float, exposure_s: float, size: tuple[int, int]) -> None:
        """Render the first images, and start the camera and the controller."""
        self._log, self._record = path.with_suffix(".jsonl"), path.with_suffix(".mjpeg")
        imperfections = twin.Imperfections(exposure_s=exposure_s, lag_s=lag_s)
        self.twin = make_twin(
            TwinConfig(size[::-1], rate=fps, imperfections=imperfections, log=self._log, record=self._record)
        )
        self._served = twin.Served(self.twin, link=path)
        self.url = self._served.camera

    def move(self) -> None:
        """Release the object if it is held. Otherwise, hold it in its next pose."""
        self.twin.command("release" if self.twin.state.phase == twin.Phase.HELD else "hold")

    def stop(self) -> None:
        """Stop the twin, its camera and its LED controller."""
        self._served.close()
        self.twin.close()

    def shown(self) -> dict[int, Shown]:
        """Read the frame numbers and the brightness of the LEDs from the twin's log."""
        _, *parts = self._record.read_bytes().split(_START)
        frames = zip(parts, twin.read_log(self._log), strict=True)
        return {key(photometry.decode(_START + part)): Shown(frame.index, frame.light) for part, frame in frames}


def key(image: UInt8[np.ndarray, "height width 3"]) -> int:
    """Compute the checksum of an image's pixels. Frames differ in their noise, so their checksums differ too."""
    return zlib.crc32(image.tobytes())
