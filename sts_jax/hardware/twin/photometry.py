"""Brightness of the LEDs over time, and camera frames: blends of two images with vignetting, noise and JPEG."""

import bisect
import dataclasses
import math
import sys
from typing import NamedTuple

import cv2
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8, UInt16

from sts_jax._checked import checked
from sts_jax.hardware import protocol
from sts_jax.hardware.lens import Lens, distorted
from sts_jax.optics import to_linear, to_srgb
from sts_jax.sensor import Sensor

_RISEN = 30.0  # time constants after which the target counts as reached, because exp(-30) is 1e-13
_CHANGES = 4096  # remembered changes of the levels. A frame is made at most a few changes after its exposure
_FULL = 65535  # uint16 value of full-scale linear light
# Drawing noise for every frame is too slow, so one array of random numbers serves all frames. The array is longer than
# a frame by this number, and each frame starts at another position in it.
_SPARE = 1 << 20
_STRIP = 1 << 18  # number of values that are processed at once, so that they stay in the processor's cache
_MOST_SAMPLES = 3  # largest number of samples per raw pixel along each axis


class Light(NamedTuple):
    """The mean, smallest and largest brightness of the LEDs in an interval, as shares of their full power, 0 to 1."""

    light: float
    lowest: float
    highest: float


class _Change(NamedTuple):
    """A change of the levels. From here to the next change, the brightness goes from `share` to `target`."""

    time_s: float  # time of the change (s)
    share: float  # share of the full power at this time
    target: float  # share of the full power of the new levels


class LightHistory:
    """The brightness of the LEDs over time, as a share of their full power. Not thread-safe.

    After a change of the levels at t0, the share approaches the mean of the four levels, a:
    s(t) = a + (s0 - a) exp(-(t - t0) / tau).
    The LEDs are dimmed by pulses at 31 kHz, far shorter than an exposure, so only the mean of the pulses matters.
    """

    def __init__(self, rise_s: float = 0.0):
        """Start with the lights off, and with the time constant tau, `rise_s` (s). At 0, they follow at once."""
        self._rise_s = rise_s
        self._changes = [_Change(-math.inf, 0.0, 0.0)]

    def set(self, time_s: float, levels: protocol.Levels) -> None:
        """Record a change of the LED levels (0 to 255) at a time (s) that is not before the last change."""
        last, target = self._changes[-1], sum(levels) / (255 * len(levels))
        assert time_s >= last.time_s
        if target != last.target:
            self._changes.append(_Change(time_s, self._share(last, time_s), target))
            del self._changes[:-_CHANGES]

    def over(self, start_s: float, end_s: float) -> Light:
        """Return the exact mean, the smallest and the largest brightness between two times (s)."""
        first = bisect.bisect_right(self._changes, start_s, key=lambda change: change.time_s) - 1
        integral, shares = 0.0, []
        for i in range(first, len(self._changes)):
            change = self._changes[i]
            begin = max(start_s, change.time_s)
            end = min(end_s, self._changes[i + 1].time_s) if i + 1 < len(self._changes) else end_s
            if begin >= end:
                break
            low, high = self._share(change, begin), self._share(change, end)
            # The integral of (s0 - a) exp(-(t - t0) / tau) over the interval is tau times its decrease.
            integral += change.target * (end - begin) + self._rise_s * (low - high)
            shares += [low, high]
        lowest, highest = min(shares), max(shares)
        return Light(min(max(integral / (end_s - start_s), lowest), highest), lowest, highest)

    def _share(self, change: _Change, time_s: float) -> float:
        if change.share == change.target or time_s - change.time_s >= _RISEN * self._rise_s:
            return change.target
        return change.target + (change.share - change.target) * math.exp((change.time_s - time_s) / self._rise_s)


@dataclasses.dataclass(frozen=True)
class Imperfections:
    """Deviations of a simulated camera and simulated lights from ideal ones. The defaults are assumed, not measured."""

    exposure_s: float = 0.012  # time during which the camera integrates the light of one frame (s)
    # time from the end of the exposure to the delivery of the frame (s). We assume 0.015 to 0.12 s for real cameras
    lag_s: float = 0.04
    jitter_s: float = 0.0  # largest random addition to the lag (s)
    rise_s: float = 0.0005  # time constant with which the LEDs approach a new level (s)
    leakage: float = 0.005  # share of the LEDs' full light that remains when they are off
    # share of the light that the lens loses in the corners. The loss grows with the square of the distance from the
    # image's centre
    vignetting: float = 0.25
    read_noise: float = 0.0015  # standard deviation of the noise in the dark, as a share of full-scale linear light
    # number of electrons of a pixel at full scale. The standard deviation of the shot noise is the square root of the
    # number of electrons
    full_well: float = 8000.0
    jpeg_quality: int = 92  # quality of OpenCV's JPEG encoder, 1 to 100

    def __post_init__(self) -> None:
        most = {"leakage": 1.0, "vignetting": 1.0, "jpeg_quality": 100}
        for name, value in dataclasses.asdict(self).items():
            if not 0 <= value <= most.get(name, sys.float_info.max):
                raise ValueError(f"{name} must be finite and in [0, {most.get(name, math.inf)}], got {value}")
        if 0 in (self.exposure_s, self.full_well, self.jpeg_quality):
            raise ValueError(f"exposure_s, full_well and jpeg_quality must be > 0, got {self}")


class Ends(NamedTuple):
    """The images of a scene with the LEDs off and at full power, in linear light with 65535 as full scale."""

    visual: UInt16[np.ndarray, "height width 3"]  # image with the LEDs off
    tactile: UInt16[np.ndarray, "height width 3"]  # image with the LEDs at full power


class Blender:
    """The response of the camera: makes frames from the images of a scene with the LEDs off and at full power.

    `ends` converts both images once for each pose of the object. `frame` then makes frames, in one thread at a time.
    """

    def __init__(
        self, imperfections: Imperfections, *, sensor: Sensor | None = None, lens: Lens | None = None, seed: int = 0
    ):
        """Prepare the lookup tables. Without a lens, the frames are rectified.

        `sensor` has the exposure and the view of the scene's images. Default: `Sensor()`.
        """
        sensor = Sensor() if sensor is None else sensor
        self._imperfections, self._lens, self._pinhole = imperfections, lens, sensor.camera
        self._exposure = float(sensor.room.exposure)
        self._rng = np.random.default_rng(seed)
        self._noise = np.zeros(0, np.float32)
        self._begin = 0
        # _SPARE is a power of 2. An odd step therefore visits all start positions before it repeats one.
        self._step = 2 * int(self._rng.integers(_SPARE // 2)) + 1
        values = np.arange(_FULL + 1) / _FULL
        self._to_linear = np.round(_FULL * np.asarray(to_linear(jnp.asarray(values, jnp.float32)))).astype(np.uint16)
        self._to_srgb = np.round(255 * np.asarray(to_srgb(jnp.asarray(values, jnp.float32)))).astype(np.uint8)
        variance = imperfections.read_noise**2 + values / imperfections.full_well
        self._deviation = (_FULL * np.sqrt(variance)).astype(np.float32)

    @checked
    def ends(self, visual: Float[np.ndarray, "height width 3"], tactile: Float[np.ndarray, "height width 3"]) -> Ends:
        """Convert the sRGB images of `Frame`, in [0, 1], to linear light, with lens distortion and vignetting."""
        return Ends(self._end(visual), self._end(tactile))

    def frame(self, ends: Ends, light: float) -> UInt8[np.ndarray, "height width 3"]:
        """Make a frame with noise at a mean brightness of the LEDs, 0 to 1.

        Without imperfections and lens, it equals the image of `sts_jax.expose` up to rounding.
        """
        light = self._imperfections.leakage + (1 - self._imperfections.leakage) * light
        bright = light * self._exposure
        share = bright / (1 - light + bright)
        linear = cv2.addWeighted(ends.visual, 1 - share, ends.tactile, share, 0).reshape(-1)
        if len(self._noise) < linear.size:
            self._noise = self._rng.standard_normal(linear.size + _SPARE, np.float32)
        self._begin = (self._begin + self._step) % _SPARE
        noise = self._noise[self._begin :]
        out = np.empty(linear.shape, np.uint8)
        for begin in range(0, linear.size, _STRIP):
            part = linear[begin : begin + _STRIP]
            noisy = self._deviation.take(part)
            noisy *= noise[begin : begin + part.size]
            noisy += part
            np.clip(noisy, 0, _FULL, out=noisy)
            self._to_srgb.take(noisy.astype(np.uint16), out=out[begin : begin + part.size])
        return out.reshape(ends.visual.shape)

    def _end(self, image: np.ndarray) -> np.ndarray:
        """Convert one sRGB image to linear light, uint16, and apply the lens distortion and the vignetting."""
        linear = self._to_linear[np.round(np.clip(image, 0, 1) * _FULL).astype(np.uint16)]
        if self._lens is not None:
            linear = distorted(self._lens, self._pinhole, linear, outside=0, most_samples=_MOST_SAMPLES)
        if self._imperfections.vignetting:
            height, width = linear.shape[:2]
            rows, columns = (np.linspace(-1, 1, n, dtype=np.float32) if n > 1 else np.zeros(1) for n in (height, width))
            aspect = width / height
            squared = (rows[:, None] ** 2 + (aspect * columns[None]) ** 2) / (1 + aspect**2)
            linear = np.round(linear * (1 - self._imperfections.vignetting * squared[..., None])).astype(np.uint16)
        return np.ascontiguousarray(linear)


def encode(image: UInt8[np.ndarray, "height width 3"], quality: int) -> bytes:
    """Encode an RGB image as a JPEG file with OpenCV's quality, 1 to 100."""
    _, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
    return data.tobytes()


def decode(data: bytes) -> UInt8[np.ndarray, "height width 3"]:
    """Decode a JPEG file to an RGB image."""
    return cv2.cvtColor(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
