"""From the two ends of the light to one frame of the camera: exposure, leakage, vignetting, noise, JPEG. NumPy only."""

import dataclasses
import math
from typing import NamedTuple

import cv2
import numpy as np

_FULL = 65535  # uint16 value of the linear light 1
# Random numbers beyond those of one frame. The noise of each frame begins at another one of them
_SPARE = 1 << 20
_STRIP = 1 << 18  # values that are processed at once, so that they stay in the processor's cache


@dataclasses.dataclass(frozen=True)
class Imperfections:
    """The differences between the twin's camera and lights and ideal ones. All defaults are our choice."""

    exposure_s: float = 0.012  # s, time during which the camera integrates the light of one frame
    lag_s: float = 0.04  # s, from the end of the exposure to the delivery of the frame. Assumed range: 0.015 to 0.12
    jitter_s: float = 0.0  # s, largest random addition to the lag
    rise_s: float = 0.0005  # s, time constant of the LEDs
    leakage: float = 0.005  # share of the tactile light that remains when the LEDs are off
    vignetting: float = 0.25  # share of the light that the lens loses in the corners, as the square of the distance
    read_noise: float = 0.0015  # standard deviation of the noise in the dark, as a share of full-scale linear light
    full_well: float = 8000.0  # electrons of a pixel at full scale. Shot noise is the square root of the electrons
    jpeg_quality: int = 92  # of OpenCV's encoder, 1 to 100

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ValueError: A field is out of range. The message names it.
        """
        for name in ("exposure_s", "full_well"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be positive and finite, got {getattr(self, name)}")
        for name in ("lag_s", "jitter_s", "rise_s", "read_noise"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be >= 0 and finite, got {getattr(self, name)}")
        for name in ("leakage", "vignetting"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} must be a share from 0 to 1, got {getattr(self, name)}")
        if self.jpeg_quality not in range(1, 101):
            raise ValueError(f"jpeg_quality must be in 1..100, got {self.jpeg_quality}")


class Ends(NamedTuple):
    """One scene under both ends of the light, in linear light, as uint16 of shape (height, width, 3)."""

    visual: np.ndarray  # LEDs off
    tactile: np.ndarray  # LEDs at full power


class Warp(NamedTuple):
    """The way from the rendered view to the camera's raw view. `lens_warp` makes it of a lens."""

    maps: tuple[np.ndarray, np.ndarray]  # of `cv2.remap`, of the raw size times a whole number of samples
    size: tuple[int, int]  # (height, width) of the raw view, pixels

    def apply(self, image: np.ndarray) -> np.ndarray:
        """The raw view of an image in linear light. It is dark where it shows more than the image."""
        sampled = cv2.remap(image, *self.maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
        return cv2.resize(sampled, self.size[::-1], interpolation=cv2.INTER_AREA)


class Blender:
    """Makes frames of the two ends of a scene.

    `ends` takes the time of a few frames and is called once for each pose. `frame` is called for each frame, by one
    thread at a time.
    """

    def __init__(self, imperfections: Imperfections, *, exposure: float = 1.0, warp: Warp | None = None, seed: int = 0):
        """Prepare the tables.

        Args:
            imperfections: Of these, `Blender` applies leakage, vignetting and noise.
            exposure: Exposure of the visual stream over that of the tactile one, `Room.exposure` of the sensor.
            warp: From the rendered view to the camera's raw view. Default: they are the same.
            seed: Of the noise.
        """
        if not 0 < exposure < math.inf:
            raise ValueError(f"exposure must be positive and finite, got {exposure}")
        self._imperfections = imperfections
        self._exposure = exposure
        self._warp = warp
        self._rng = np.random.default_rng(seed)
        self._noise = np.zeros(0, np.float32)
        self._begin = 0
        self._step = (
            2 * int(self._rng.integers(_SPARE // 2)) + 1
        )  # odd, so that it passes all places before a repetition
        values = np.arange(_FULL + 1) / _FULL
        self._to_linear = np.round(_FULL * _linear(values)).astype(np.uint16)
        self._to_srgb = np.round(255 * _srgb(values)).astype(np.uint8)
        variance = imperfections.read_noise**2 + values / imperfections.full_well
        self._deviation = (_FULL * np.sqrt(variance)).astype(np.float32)

    def ends(self, visual: np.ndarray, tactile: np.ndarray) -> Ends:
        """Convert both ends to linear light, and apply the lens and its vignetting.

        Args:
            visual: Image with the LEDs off, sRGB in [0, 1], (height, width, 3), `Frame.visual`.
            tactile: Image with the LEDs at full power, `Frame.tactile`.
        """
        return Ends(self._end(visual), self._end(tactile))

    def blend(self, ends: Ends, light: float) -> np.ndarray:
        """The frame without noise, uint8 RGB. It equals `sts_jax.expose` without leakage, vignetting and warp.

        Args:
            ends: Of the scene.
            light: Mean share of the LEDs' power during the exposure, 0 to 1.
        """
        return self._to_srgb[self._mixed(ends, light)]

    def frame(self, ends: Ends, light: float) -> np.ndarray:
        """The frame with noise, uint8 RGB. See `blend` for the arguments."""
        linear = self._mixed(ends, light).reshape(-1)
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

    def _mixed(self, ends: Ends, light: float) -> np.ndarray:
        """The blend of `sts_jax.expose` in linear light, uint16."""
        if not 0 <= light <= 1:
            raise ValueError(f"light must be a share from 0 to 1, got {light}")
        light = self._imperfections.leakage + (1 - self._imperfections.leakage) * light
        bright = light * self._exposure
        share = bright / (1 - light + bright)
        return cv2.addWeighted(ends.visual, 1 - share, ends.tactile, share, 0)

    def _end(self, image: np.ndarray) -> np.ndarray:
        image = np.asarray(image)
        if image.ndim != 3 or image.shape[2] != 3:
            raise ValueError(f"image must have the shape (height, width, 3), got {image.shape}")
        linear = self._to_linear[np.round(np.clip(image, 0, 1) * _FULL).astype(np.uint16)]
        if self._warp is not None:
            linear = self._warp.apply(linear)
        if self._imperfections.vignetting:
            height, width = linear.shape[:2]
            rows, columns = (np.linspace(-1, 1, n, dtype=np.float32) if n > 1 else np.zeros(1) for n in (height, width))
            aspect = width / height
            squared = (rows[:, None] ** 2 + (aspect * columns[None]) ** 2) / (1 + aspect**2)
            linear = np.round(linear * (1 - self._imperfections.vignetting * squared[..., None])).astype(np.uint16)
        return np.ascontiguousarray(linear)


def encode(image: np.ndarray, quality: int) -> bytes:
    """The JPEG of a uint8 RGB image."""
    done, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise ValueError(f"OpenCV cannot encode an image of shape {image.shape} and type {image.dtype}")
    return data.tobytes()


def decode(data: bytes) -> np.ndarray:
    """The uint8 RGB image of a JPEG."""
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise ValueError(f"{len(data)} bytes are not a JPEG image")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def _linear(srgb: np.ndarray) -> np.ndarray:
    """Linear light of sRGB values (IEC 61966-2-1)."""
    return np.where(srgb > 0.04045, ((srgb + 0.055) / 1.055) ** 2.4, srgb / 12.92)


def _srgb(linear: np.ndarray) -> np.ndarray:
    """sRGB of linear light (IEC 61966-2-1)."""
    return np.where(linear > 0.0031308, 1.055 * linear ** (1 / 2.4) - 0.055, 12.92 * linear)
