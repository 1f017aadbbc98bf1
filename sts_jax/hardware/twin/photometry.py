"""Blends two images of a scene, LEDs off and LEDs on, into a camera frame with vignetting, noise and JPEG encoding."""

import dataclasses
import math
from typing import NamedTuple

import cv2
import numpy as np

_FULL = 65535  # uint16 value of full-scale linear light
# Drawing noise for every frame is too slow, so one array of random numbers serves all frames. The array is longer than
# a frame by this number, and each frame starts at another position in it.
_SPARE = 1 << 20
_LONGEST = 65500  # pixels, longest side of an image that OpenCV's JPEG encoder accepts
_JPEG = b"\xff\xd8\xff"  # first bytes of a JPEG image
_STRIP = 1 << 18  # number of values that are processed at once, so that they stay in the processor's cache


@dataclasses.dataclass(frozen=True)
class Imperfections:
    """Deviations of a simulated camera and simulated lights from ideal ones, such as noise and delays.

    The default values are assumed, not measured.
    """

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
        """Check the fields.

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
            raise ValueError(f"jpeg_quality must be a whole number from 1 to 100, got {self.jpeg_quality}")


class Ends(NamedTuple):
    """Two images of a scene: with the LEDs off, and with the LEDs at full power.

    The two images are in linear light, uint16 of shape (height, width, 3), where 65535 is full scale. `Blender.blend`
    mixes the two images to an image at any brightness of the LEDs.
    """

    visual: np.ndarray  # image with the LEDs off
    tactile: np.ndarray  # image with the LEDs at full power


class Warp(NamedTuple):
    """The mapping from a rendered image to the raw image of a camera with lens distortion. `lens_warp` makes it."""

    maps: tuple[np.ndarray, np.ndarray]  # maps for `cv2.remap`, with n x n samples per raw pixel, which are averaged
    size: tuple[int, int]  # (height, width) of the raw image (pixels)

    def apply(self, image: np.ndarray) -> np.ndarray:
        """Convert a rendered image to the raw image.

        Args:
            image: Rendered image in linear light, shape (height, width, 3).

        Returns:
            Raw image of the same data type as `image`, shape (h, w, 3), where (h, w) is the field `size`. Raw
            pixels that show no part of `image` are 0.
        """
        sampled = cv2.remap(image, *self.maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
        return cv2.resize(sampled, self.size[::-1], interpolation=cv2.INTER_AREA)


class Blender:
    """Makes camera frames from two images of a scene: one with the LEDs off, and one with the LEDs at full power.

    First, call `ends` with both images. This takes as long as making a few frames, so do it only once for each pose of
    the object. Then call `frame` for each frame. Only one thread at a time may call `frame`.
    """

    def __init__(self, imperfections: Imperfections, *, exposure: float = 1.0, warp: Warp | None = None, seed: int = 0):
        """Prepare the lookup tables.

        Args:
            imperfections: Deviations of the camera. `Blender` uses `leakage`, `vignetting`, `read_noise` and
                `full_well`.
            exposure: Exposure of the visual stream divided by the exposure of the tactile stream, > 0. The field
                `room.exposure` of a `Sensor` contains this ratio.
            warp: Lens distortion. Default: none.
            seed: Seed of the noise.

        Raises:
            ValueError: `exposure` is not positive and finite.
        """
        if not 0 < exposure < math.inf:
            raise ValueError(f"exposure must be positive and finite, got {exposure}")
        self._imperfections = imperfections
        self._exposure = exposure
        self._warp = warp
        self._rng = np.random.default_rng(seed)
        self._noise = np.zeros(0, np.float32)
        self._begin = 0
        # _SPARE is a power of 2. An odd step therefore visits all start positions before it repeats one.
        self._step = 2 * int(self._rng.integers(_SPARE // 2)) + 1
        values = np.arange(_FULL + 1) / _FULL
        self._to_linear = np.round(_FULL * _linear(values)).astype(np.uint16)
        self._to_srgb = np.round(255 * _srgb(values)).astype(np.uint8)
        variance = imperfections.read_noise**2 + values / imperfections.full_well
        self._deviation = (_FULL * np.sqrt(variance)).astype(np.float32)

    def ends(self, visual: np.ndarray, tactile: np.ndarray) -> Ends:
        """Convert both images of a scene to linear light, and apply the lens distortion and the vignetting.

        Args:
            visual: Image with the LEDs off (`Frame.visual`), sRGB in [0, 1], shape (height, width, 3).
            tactile: Image with the LEDs at full power (`Frame.tactile`), of the same form.

        Returns:
            The pair of converted images, which is an argument of `blend` and of `frame`.

        Raises:
            ValueError: The shape of an image is not (height, width, 3).
        """
        return Ends(self._end(visual), self._end(tactile))

    def blend(self, ends: Ends, light: float) -> np.ndarray:
        """Make a camera frame without noise, as a mixture of an image with LEDs off and an image with LEDs on.

        If `Imperfections.leakage` and `Imperfections.vignetting` are 0 and there is no lens distortion, the frame
        equals the image of `sts_jax.expose` up to rounding.

        Args:
            ends: Images of the scene, as `Blender.ends` returns them.
            light: Mean brightness of the LEDs during the exposure, as a share of their full power, 0 to 1.

        Returns:
            Frame, uint8 RGB of shape (height, width, 3).

        Raises:
            ValueError: `light` is out of range.
        """
        return self._to_srgb[self._mixed(ends, light)]

    def frame(self, ends: Ends, light: float) -> np.ndarray:
        """Make a camera frame with noise, as a mixture of an image with LEDs off and an image with LEDs on.

        Args:
            ends: Images of the scene, as `Blender.ends` returns them.
            light: Mean brightness of the LEDs during the exposure, as a share of their full power, 0 to 1.

        Returns:
            Frame, uint8 RGB of shape (height, width, 3).

        Raises:
            ValueError: `light` is out of range.
        """
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
        """Blend both images by the equation of `sts_jax.expose`, in linear light, uint16."""
        if not 0 <= light <= 1:
            raise ValueError(f"light must be a share of the LEDs' full power from 0 to 1, got {light}")
        light = self._imperfections.leakage + (1 - self._imperfections.leakage) * light
        bright = light * self._exposure
        share = bright / (1 - light + bright)
        return cv2.addWeighted(ends.visual, 1 - share, ends.tactile, share, 0)

    def _end(self, image: np.ndarray) -> np.ndarray:
        """Convert one sRGB image to linear light, uint16, and apply the lens distortion and the vignetting."""
        image = np.asarray(image)
        if image.ndim != 3 or image.shape[2] != 3:
            raise ValueError(f"visual and tactile must have shape (height, width, 3), but one has shape {image.shape}")
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
    """Encode an image as JPEG, and return the bytes of the file.

    Args:
        image: Image, uint8 RGB of shape (height, width, 3).
        quality: Quality of OpenCV's encoder, 1 to 100.

    Raises:
        ValueError: The image has another type or shape, no pixels, or a side of more than 65500 pixels.
    """
    fits = image.dtype == np.uint8 and image.ndim == 3 and image.shape[2] == 3
    if not fits or not all(1 <= side <= _LONGEST for side in image.shape[:2]):
        raise ValueError(
            f"image must be uint8 of shape (height, width, 3), with a height and a width from 1 to {_LONGEST} pixels, "
            f"got {image.dtype} of shape {image.shape}"
        )
    _, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
    return data.tobytes()


def decode(data: bytes) -> np.ndarray:
    """Decode a JPEG image, and return it as uint8 RGB of shape (height, width, 3).

    Raises:
        ValueError: The bytes are not a JPEG image.
    """
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data.startswith(_JPEG) else None
    if image is None:
        raise ValueError(f"data must be a JPEG image, but its {len(data)} bytes cannot be decoded")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def _linear(srgb: np.ndarray) -> np.ndarray:
    """Convert sRGB values in [0, 1] to linear light (IEC 61966-2-1)."""
    return np.where(srgb > 0.04045, ((srgb + 0.055) / 1.055) ** 2.4, srgb / 12.92)


def _srgb(linear: np.ndarray) -> np.ndarray:
    """Convert linear light in [0, 1] to sRGB values (IEC 61966-2-1)."""
    return np.where(linear > 0.0031308, 1.055 * linear ** (1 / 2.4) - 0.055, 12.92 * linear)
