"""The fisheye lens of a real sensor, and the conversion between its raw images and the simulated sensor's view.

Pixel coordinates are (column, row), whole numbers at the centres of pixels. A raw and a rectified pixel correspond if
their rays meet the gel's outer face (z = 0 in the sensor frame) at the same point. The argument `pinhole` is the
`Sensor.camera` that defines the view. A `resolution` of another aspect takes the largest centred part of the view.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, UInt, UInt8
from scipy.spatial.transform import Rotation

from sts_jax._checked import checked
from sts_jax.optics import Camera, full_window

_MARGIN = 16  # distance beyond the image's border at which coordinates are clipped (pixels)
_BAND = 256  # number of rows of a map that are computed at once, which limits the memory
_GRAZING = 1e-6  # smallest cosine of the angle between a ray and the pad's normal for which they intersect
_PROBES = 64  # least number of points along the longer side at which the density of a map is measured
_TABLE = 8192  # number of angles in the table that inverts the model of the lens

Maps = tuple[np.ndarray, np.ndarray]  # fixed-point maps for `cv2.remap`
Raw = UInt8[np.ndarray, "rows columns *channels"]


@dataclasses.dataclass(frozen=True)
class Lens:
    r"""A fisheye lens in the Kannala-Brandt model (OpenCV's `cv2.fisheye`), with the camera's pose in the sensor.

    A point p of the sensor frame is at q = R p + t in the camera frame, whose z-axis is the optical axis. R is the
    matrix of `rotation`, t is `translation`, a is the angle between q and the optical axis. The point appears at

        (column, row) = (fx d q_x / r + cx, fy d q_y / r + cy),
        r = sqrt(q_x^2 + q_y^2),
        d = a + k_1 a^3 + k_2 a^5 + k_3 a^7 + k_4 a^9.
    """

    width: int  # width of the raw images (pixels)
    height: int  # height of the raw images (pixels)
    fx: float  # horizontal focal length on the optical axis (pixels per radian)
    fy: float  # vertical focal length on the optical axis (pixels per radian)
    cx: float  # column of the optical axis (pixels)
    cy: float  # row of the optical axis (pixels)
    k: tuple[float, float, float, float]  # coefficients k_1 to k_4 of the equation
    rotation: tuple[float, float, float]  # rotation vector from the sensor frame to the camera frame (rad)
    translation: tuple[float, float, float]  # centre of the gel's outer face in the camera frame (m)

    def __post_init__(self) -> None:
        if min(self.width, self.height, self.fx, self.fy) <= 0:
            raise ValueError(f"width, height, fx and fy must be > 0, got {self}")
        if not np.isfinite([self.fx, self.fy, self.cx, self.cy, *self.k, *self.rotation, *self.translation]).all():
            raise ValueError(f"all numbers of a lens must be finite, got {self}")
        if self.translation[2] <= 0 or self.center[2] >= 0:
            raise ValueError(
                f"rotation and translation must be those from the sensor frame to the camera frame, with the camera "
                f"inside the sensor (z < 0) and the pad before it, got {self.rotation} and {self.translation}"
            )

    @classmethod
    def ideal(
        cls, width: int, height: int, *, field_of_view: float = math.radians(160), distance: float = 0.1
    ) -> "Lens":
        """Return an equidistant lens whose optical axis is perpendicular to the pad and meets the centre of the pad.

        The defaults are those of the paper's sensor and code (Rezaei-Shoshtari et al. 2021).

        Args:
            field_of_view: Field of view across the diagonal of an image of `width` x `height` pixels (rad).
            distance: Distance from the camera to the gel's outer face (m).
        """
        if not 0 < field_of_view <= 2 * math.pi:
            raise ValueError(f"field_of_view must be in (0, 2 pi] rad, got {field_of_view}")
        focal = math.hypot(width, height) / field_of_view
        middle = (width - 1) / 2, (height - 1) / 2
        return cls(width, height, focal, focal, *middle, (0.0,) * 4, (0.0,) * 3, (0.0, 0.0, distance))

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """Rotation matrix R from the sensor frame to the camera frame."""
        return Rotation.from_rotvec(self.rotation).as_matrix()

    @property
    def center(self) -> Float[np.ndarray, "3"]:
        """Position of the camera in the sensor frame (m)."""
        return -self.matrix.T @ np.asarray(self.translation)

    @functools.cached_property
    def largest_angle(self) -> float:
        """Largest angle from the optical axis at which the model is valid (rad), at most pi: beyond it, d(a) falls."""
        roots = np.roots([9 * self.k[3], 7 * self.k[2], 5 * self.k[1], 3 * self.k[0], 1.0])  # of the derivative
        real = roots[(np.abs(roots.imag) < 1e-9 * np.maximum(1, np.abs(roots))) & (roots.real > 0)].real
        return min([math.pi, *np.sqrt(real).tolist()])


@checked
def project(lens: Lens, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2"]:
    """Project points in the sensor frame (m) to raw pixels. NaN at larger angles than `Lens.largest_angle`."""
    return project_camera(lens, points @ lens.matrix.T + np.asarray(lens.translation))


def project_camera(lens: Lens, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2"]:
    """Project points in the camera frame (m) to raw pixels. NaN at larger angles than `Lens.largest_angle`."""
    radius = np.hypot(points[..., 0], points[..., 1])
    angle = np.arctan2(radius, points[..., 2])
    distorted_angle = np.where(angle <= lens.largest_angle, distort_angle(lens.k, angle), np.nan)
    ratio = distorted_angle / np.where(radius > 0, radius, 1)
    return np.stack([lens.fx * ratio * points[..., 0] + lens.cx, lens.fy * ratio * points[..., 1] + lens.cy], axis=-1)


def directions(lens: Lens, pixels: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 3"]:
    """Unit vectors of the rays of raw pixels in the camera frame, NaN beyond the lens. Inverse of `project_camera`."""
    x, y = (pixels[..., 0] - lens.cx) / lens.fx, (pixels[..., 1] - lens.cy) / lens.fy
    radius = np.hypot(x, y)
    angle = _undistort_angle(lens, radius)
    ratio = np.sin(angle) / np.where(radius > 0, radius, 1)
    return np.stack([ratio * x, ratio * y, np.cos(angle)], axis=-1)


@checked
def rectification(lens: Lens, pinhole: Camera, resolution: tuple[int, int]) -> Float[np.ndarray, "height width 2"]:
    """Raw pixel of each rectified pixel, as float32. Some lie outside of the raw image if the view exceeds it."""
    left, top, width, height = np.asarray(full_window(pinhole, resolution), np.float64)
    rows, columns = resolution
    x = left + (np.arange(columns) + 0.5) / columns * width
    y = top + (np.arange(rows) + 0.5) / rows * height
    pixels = _over_grid(x, y, lambda face: project(lens, np.concatenate([face, np.zeros_like(face[..., :1])], axis=-1)))
    if np.isnan(pixels).any():
        raise ValueError(
            f"the model of the lens is valid up to {math.degrees(lens.largest_angle):.1f} degrees from the optical "
            "axis, which is less than the sensor's view: calibrate the lens again, with the board in the view's corners"
        )
    return pixels


@checked
def rectified(
    lens: Lens, pinhole: Camera, image: Raw, resolution: tuple[int, int]
) -> UInt8[np.ndarray, "height width *channels"]:
    """Convert a raw image of the real camera to the view of the simulated pinhole camera.

    Each rectified pixel is the mean of samples that are at most about one raw pixel apart, so small images show no
    aliasing. Parts of the view that the camera does not see are black.
    """
    if image.shape[:2] != (lens.height, lens.width):
        raise ValueError(
            f"the image has {image.shape[1]}x{image.shape[0]} pixels, but the lens was calibrated with images of "
            f"{lens.width}x{lens.height} pixels: set the camera to this size, or calibrate the lens again"
        )
    return _remapped(image, _rectifying_maps(lens, _plain(pinhole), resolution), resolution, 0)


def distortion(
    lens: Lens, pinhole: Camera, resolution: tuple[int, int], samples: int = 1
) -> Float[np.ndarray, "rows columns 2"]:
    """Rectified pixel of each raw pixel, or of `samples` x `samples` points of it, as float32.

    The pixels lie outside of the rectified image for rays outside of the view. They are NaN for rays that do not meet
    the plane of the gel's outer face, or that are beyond `Lens.largest_angle`.
    """
    left, top, width, height = np.asarray(full_window(pinhole, resolution), np.float64)
    scale = np.array([resolution[1] / width, resolution[0] / height])
    x = (np.arange(lens.width * samples) + 0.5) / samples - 0.5
    y = (np.arange(lens.height * samples) + 0.5) / samples - 0.5

    def rectified_pixels(raw: np.ndarray) -> np.ndarray:
        rays = directions(lens, raw) @ lens.matrix  # in the sensor frame
        outwards = np.where(rays[..., 2] > _GRAZING, rays[..., 2], np.nan)
        on_face = lens.center[:2] - lens.center[2] / outwards[..., None] * rays[..., :2]
        return (on_face - np.array([left, top])) * scale - 0.5

    return _over_grid(x, y, rectified_pixels)


@checked
def distorted(
    lens: Lens,
    pinhole: Camera,
    image: UInt[np.ndarray, "height width *channels"],
    *,
    outside: float | tuple[float, float, float],
    most_samples: int | None = None,
) -> UInt[np.ndarray, "rows columns *channels"]:
    """Convert a rectified image to the raw image that the real camera would take of it. Inverse of `rectified`.

    Args:
        outside: Grey value or RGB colour of the raw pixels outside of the view.
        most_samples: Limit of the samples per raw pixel in each direction. None: as many as avoid aliasing.
    """
    maps = _distorting_maps(lens, _plain(pinhole), image.shape[:2], most_samples)
    colour = (outside,) * 4 if isinstance(outside, int | float) else outside
    return _remapped(image, maps, (lens.height, lens.width), colour)


def _over_grid(x: np.ndarray, y: np.ndarray, values: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """The values of a function of points (rows, columns, 2) on a grid, band by band, as float32."""
    bands = (np.stack(np.meshgrid(x, y[first : first + _BAND]), axis=-1) for first in range(0, len(y), _BAND))
    return np.concatenate([values(points).astype(np.float32) for points in bands])


def _plain(pinhole: Camera) -> Camera:
    """The camera with Python numbers, as a hashable key for the cached maps."""
    return Camera(*(float(getattr(pinhole, field.name)) for field in dataclasses.fields(Camera)))


@functools.lru_cache(maxsize=8)
def _rectifying_maps(lens: Lens, pinhole: Camera, resolution: tuple[int, int]) -> Maps:
    """Raw pixel of each sample of each rectified pixel."""
    probes = math.ceil(_PROBES / max(resolution))  # points per pixel, so that small images are probed densely enough
    probed = rectification(lens, pinhole, (resolution[0] * probes, resolution[1] * probes))
    samples = _samples(probed, (lens.height, lens.width), probes)
    fine = resolution[0] * samples, resolution[1] * samples
    return _fixed_point(rectification(lens, pinhole, fine), (lens.height, lens.width))


@functools.lru_cache(maxsize=2)
def _distorting_maps(lens: Lens, pinhole: Camera, resolution: tuple[int, int], most_samples: int | None) -> Maps:
    """Rectified pixel of each sample of each raw pixel."""
    samples = _samples(distortion(lens, pinhole, resolution), resolution, 1)
    samples = samples if most_samples is None else min(samples, most_samples)
    return _fixed_point(distortion(lens, pinhole, resolution, samples), resolution)


def _samples(coordinates: np.ndarray, size: tuple[int, int], probes: int) -> int:
    """The number of samples per pixel and direction with which a map skips no pixel of a source image (height, width).

    `coordinates`, (rows, columns, 2), has `probes` x `probes` points of each pixel.
    """
    inside = (coordinates > -0.5) & (coordinates < np.array(size[::-1]) - 0.5)
    coordinates = np.where(inside.all(axis=-1, keepdims=True), coordinates, np.nan)
    steps = [np.hypot(*np.moveaxis(np.diff(coordinates, axis=axis), -1, 0)) for axis in (0, 1)]
    largest = max((float(np.nanmax(step)) for step in steps if np.isfinite(step).any()), default=1.0)
    return max(1, math.ceil(largest * probes))


def _fixed_point(coordinates: np.ndarray, size: tuple[int, int]) -> Maps:
    """Convert a map to OpenCV's fast format with steps of 1/32 pixel. NaN becomes a pixel outside."""
    limits = np.array(size[::-1], np.float32) + _MARGIN
    clipped = np.clip(np.nan_to_num(coordinates, nan=-_MARGIN), -_MARGIN, limits).astype(np.float32)
    whole, fraction = cv2.convertMaps(clipped, None, cv2.CV_16SC2)
    return whole, fraction


def _remapped(image: np.ndarray, maps: Maps, resolution: tuple[int, int], outside: object) -> np.ndarray:
    """Sample an image, and average the samples of each pixel."""
    image = cv2.remap(image, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=outside)
    return image if image.shape[:2] == resolution else cv2.resize(image, resolution[::-1], interpolation=cv2.INTER_AREA)


def distort_angle(k: Sequence[float], angle: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Evaluate d(a) of the lens model, in units of the focal length."""
    square = angle * angle
    return angle * (1 + square * (k[0] + square * (k[1] + square * (k[2] + square * k[3]))))


def _undistort_angle(lens: Lens, distorted_angle: np.ndarray) -> np.ndarray:
    """Invert `distort_angle` by interpolation in a table, within 1e-4 pixels. NaN beyond the largest angle."""
    angles = np.linspace(0, lens.largest_angle, _TABLE)
    return np.interp(distorted_angle, distort_angle(lens.k, angles), angles, right=np.nan)


class SensorView(NamedTuple):
    """A rectified visual image and a rectified tactile image: the inputs `visual` and `tactile` of a `Predictor`."""

    visual: Float[np.ndarray, "height width 3"]  # RGB, float32 in [0, 1]
    tactile: Float[np.ndarray, "height width 3"]  # RGB, float32 in [0, 1]


def sensor_view(
    lens: Lens,
    pinhole: Camera,
    visual: UInt8[np.ndarray, "rows columns 3"],
    tactile: UInt8[np.ndarray, "rows columns 3"],
    resolution: tuple[int, int] = (64, 64),
) -> SensorView:
    """Rectify a raw visual image and a raw tactile image, such as `pair.visual.image` and `pair.tactile.image`."""
    views = [rectified(lens, pinhole, image, resolution).astype(np.float32) / 255 for image in (visual, tactile)]
    return SensorView(*views)


def relit(view: SensorView, background: SensorView, empty: SensorView) -> SensorView:
    """Adapt brightness and colours to the sensor on which a model was trained: `view * empty / background`.

    A model regards every difference from its own empty pad as part of an object, such as the vignetting of another
    camera. The result is clipped to [0, 1].

    `background` is the same sensor's empty pad. `empty` is that of the training, `SensorView(**predictor.empty)`.
    """
    streams = zip(view, background, empty, strict=True)
    return SensorView(*(np.clip(image * to / np.maximum(of, 1 / 255), 0, 1) for image, of, to in streams))
