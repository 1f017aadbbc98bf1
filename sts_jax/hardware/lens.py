"""The model of a real sensor's fisheye lens, and the conversion between real images and simulated pinhole images.

Pixel coordinates are (column, row). The coordinates of a pixel's centre are whole numbers. A *raw* image comes from the
real camera. A *rectified* image shows the view of the simulated pinhole camera. A raw pixel and a rectified pixel
correspond if their rays meet the gel's outer face (z = 0 in the sensor frame) at the same point.
"""

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Protocol, SupportsFloat, runtime_checkable

import cv2
import numpy as np
from numpy.typing import NDArray

MOST_ANGLE = math.pi  # angle of a ray that points backwards along the optical axis (rad)
_MARGIN = 16  # distance beyond the image's border at which coordinates are clipped (pixels)
_BAND = 256  # number of rows of a map that are computed at once
_GRAZING = 1e-6  # smallest cosine of the angle between a ray and the pad's normal for which they intersect
_PROBES = 64  # least number of points along the longer side at which the density of a map is measured
_TABLE = 2048  # number of angles in the table that gives the inversion its start values


@runtime_checkable
class Pinhole(Protocol):
    """The pinhole camera that defines the sensor's view, such as `sts_jax.Sensor().camera`."""

    @property
    def distance(self) -> SupportsFloat:
        """Distance from the pinhole to the gel's outer face (m)."""

    @property
    def fov(self) -> SupportsFloat:
        """Vertical field of view (rad)."""

    @property
    def aspect(self) -> SupportsFloat:
        """Width of the view divided by its height."""


@dataclasses.dataclass(frozen=True)
class Lens:
    r"""A fisheye lens in the Kannala-Brandt model (OpenCV's `cv2.fisheye`), with the camera's pose in the sensor.

    The sensor frame has its origin at the centre of the gel's outer face, and its z-axis points out of the sensor. A
    point p of the sensor frame is at q = R p + t in the camera frame. R is the rotation matrix of the rotation vector
    `rotation`, and t is `translation`. The optical axis is the z-axis of the camera frame. Let a be the angle between q
    and the optical axis (rad), and let k_1 to k_4 be the elements of `k`. The point appears in the camera's image at
    the pixel

        (column, row) = (fx d q_x / r + cx, fy d q_y / r + cy),
        r = sqrt(q_x^2 + q_y^2),
        d = a + k_1 a^3 + k_2 a^5 + k_3 a^7 + k_4 a^9.

    Raises:
        ValueError: A field is out of range. Or the pad is not in front of the camera. Or the camera is outside of the
            sensor: the z coordinate of the camera in the sensor frame is not negative.
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
        for name in ("width", "height"):
            value = getattr(self, name)
            if not isinstance(value, int) or isinstance(value, bool) or value < 1:
                raise ValueError(f"{name} must be an int >= 1, got {value!r}")
        for name in ("fx", "fy", "cx", "cy"):
            value = getattr(self, name)
            if not _is_number(value):
                raise ValueError(f"{name} must be a finite int or float, got {value!r}")
        for name, length in (("k", 4), ("rotation", 3), ("translation", 3)):
            value = getattr(self, name)
            if not isinstance(value, tuple) or len(value) != length or not all(map(_is_number, value)):
                raise ValueError(f"{name} must be a tuple of {length} finite ints or floats, got {value!r}")
        for name in ("fx", "fy"):
            if getattr(self, name) <= 0:
                raise ValueError(f"{name} must be > 0, got {getattr(self, name)}")
        if self.translation[2] <= 0:
            raise ValueError(
                f"translation[2] must be > 0 m, so that the pad is in front of the camera, got translation = "
                f"{self.translation} m"
            )
        if self.center[2] >= 0:
            raise ValueError(
                f"rotation {self.rotation} and translation {self.translation} place the camera at "
                f"{tuple(round(float(c), 4) for c in self.center)} m in the sensor frame, but the camera must lie "
                "inside the sensor, where z is negative. Check that rotation and translation describe the "
                "transformation from the sensor frame to the camera frame."
            )

    @classmethod
    def ideal(
        cls,
        width: int,
        height: int,
        *,
        field_of_view: float = math.radians(160),
        distance: float = 0.1,
    ) -> "Lens":
        """Return an equidistant lens whose optical axis is perpendicular to the pad and meets the centre of the pad.

        In an equidistant lens, the distance of a pixel from the centre of the image is proportional to the angle
        between the pixel's ray and the optical axis.

        Args:
            width: Width of the raw image (pixels).
            height: Height of the raw image (pixels).
            field_of_view: Field of view across the image's diagonal, in (0, 2 pi] (rad). The default is 160 degrees,
                as in the sensor of the paper (Rezaei-Shoshtari et al. 2021).
            distance: Distance from the camera to the gel's outer face (m). The default is the value in the code of the
                paper (Rezaei-Shoshtari et al. 2021).

        Raises:
            ValueError: An argument is out of range.
        """
        if not 0 < field_of_view <= 2 * MOST_ANGLE:
            raise ValueError(f"field_of_view must be in (0, 2 pi] rad, got {field_of_view}")
        focal = math.hypot(width, height) / field_of_view
        return cls(
            width=width,
            height=height,
            fx=focal,
            fy=focal,
            cx=(width - 1) / 2,
            cy=(height - 1) / 2,
            k=(0.0, 0.0, 0.0, 0.0),
            rotation=(0.0, 0.0, 0.0),
            translation=(0.0, 0.0, distance),
        )

    @property
    def matrix(self) -> NDArray[np.float64]:
        """Rotation matrix R from the sensor frame to the camera frame, shape (3, 3)."""
        return rotation_matrix(self.rotation)

    @property
    def center(self) -> NDArray[np.float64]:
        """Position of the camera in the sensor frame (m), shape (3,)."""
        return -self.matrix.T @ np.asarray(self.translation)

    @property
    def largest_angle(self) -> float:
        """Largest angle from the optical axis at which the lens model is valid (rad), at most pi.

        Up to this angle, the pixel of a ray moves away from the optical axis as the angle of the ray grows. Beyond it,
        the polynomial of the model decreases, and two different angles would be projected to the same pixel. No real
        lens behaves like this.
        """
        return _largest_angle(self.k)


def rotation_matrix(vector: tuple[float, float, float]) -> NDArray[np.float64]:
    """Convert a rotation vector (axis times angle, rad) to a rotation matrix, shape (3, 3)."""
    angle = math.hypot(*vector)
    if angle == 0:
        return np.eye(3)
    x, y, z = (component / angle for component in vector)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def project(lens: Lens, points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Project points in the sensor frame to raw pixels, which are pixels of the camera's unchanged image.

    Args:
        lens: The lens and the pose of the camera.
        points: Points in the sensor frame (m), shape (..., 3).

    Returns:
        Raw pixel coordinates (column, row), shape (..., 2). They may lie outside of the image. They are NaN for points
        at larger angles from the optical axis than `Lens.largest_angle`.

    Raises:
        ValueError: The last axis of `points` does not have length 3.
    """
    points = np.asarray(points, np.float64)
    if points.shape[-1:] != (3,):
        raise ValueError(f"points must have shape (..., 3), got {points.shape}")
    return project_camera(lens, points @ lens.matrix.T + np.asarray(lens.translation))


def project_camera(lens: Lens, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Project points in the camera frame to raw pixels, as `project` does for points in the sensor frame.

    Args:
        lens: The lens.
        points: Points in the camera frame (m), shape (..., 3).

    Returns:
        Raw pixel coordinates (column, row), shape (..., 2). They are NaN for points at larger angles from the optical
        axis than `Lens.largest_angle`.
    """
    radius = np.hypot(points[..., 0], points[..., 1])
    angle = np.arctan2(radius, points[..., 2])
    distorted_angle = np.where(angle <= lens.largest_angle, distort_angle(lens.k, angle), np.nan)
    ratio = distorted_angle / np.where(radius > 0, radius, 1)
    return np.stack([lens.fx * ratio * points[..., 0] + lens.cx, lens.fy * ratio * points[..., 1] + lens.cy], axis=-1)


def directions(lens: Lens, pixels: NDArray[np.floating]) -> NDArray[np.float64]:
    """Compute the direction of each pixel's ray in the camera frame. This is the inverse of `project_camera`.

    Args:
        lens: The lens.
        pixels: Pixel coordinates (column, row) in the raw image of the camera, shape (..., 2).

    Returns:
        Unit vectors in the camera frame, shape (..., 3). They are NaN for pixels beyond the range of the lens model,
        which ends at the angle `Lens.largest_angle` from the optical axis.
    """
    pixels = np.asarray(pixels, np.float64)
    x, y = (pixels[..., 0] - lens.cx) / lens.fx, (pixels[..., 1] - lens.cy) / lens.fy
    radius = np.hypot(x, y)
    angle = _undistort_angle(lens.k, radius)
    ratio = np.sin(angle) / np.where(radius > 0, radius, 1)
    return np.stack([ratio * x, ratio * y, np.cos(angle)], axis=-1)


def rectification(lens: Lens, pinhole: Pinhole, resolution: tuple[int, int]) -> NDArray[np.float32]:
    """Compute the raw pixel that corresponds to each pixel of the rectified image.

    The raw image comes from the real camera. The rectified image shows the view of the simulated pinhole camera. Two
    pixels correspond if their rays meet the gel's outer face at the same point.

    Args:
        lens: The lens and the pose of the real camera.
        pinhole: The simulated pinhole camera that defines the view, such as `Sensor.camera`.
        resolution: Height and width of the rectified image (pixels). If the aspect ratio of the view is different, the
            view is cropped around its centre.

    Returns:
        Raw pixel coordinates (column, row) of each rectified pixel, shape (height, width, 2). Some lie outside of the
        raw image if the camera does not see the whole view.

    Raises:
        ValueError: The view contains rays at larger angles than `Lens.largest_angle`, or `resolution` or `pinhole` is
            out of range.
    """
    left, top, width, height = window(pinhole, resolution)
    rows, columns = resolution
    x = left + (np.arange(columns) + 0.5) / columns * width
    y = top + (np.arange(rows) + 0.5) / rows * height
    pixels = np.empty((rows, columns, 2), np.float32)
    for band in _bands(rows):
        grid_x, grid_y = np.meshgrid(x, y[band])
        pixels[band] = project(lens, np.stack([grid_x, grid_y, np.zeros_like(grid_x)], axis=-1))
    if np.isnan(pixels).any():
        raise ValueError(
            f"the model of the lens is valid up to {math.degrees(lens.largest_angle):.1f} degrees from the optical "
            f"axis, but {np.isnan(pixels[..., 0]).sum()} of {rows * columns} points of the sensor's view lie at larger "
            "angles. Calibrate the lens again, with images of the calibration board in the corners of the view."
        )
    return pixels


def rectified(lens: Lens, pinhole: Pinhole, image: NDArray[np.uint8], resolution: tuple[int, int]) -> NDArray[np.uint8]:
    """Rectify a raw image: convert the image of the real camera to the view of the simulated pinhole camera.

    Each rectified pixel is the mean of one or more samples of the raw image. Neighbouring samples are at most about one
    raw pixel apart, so small images show no aliasing. Computing the positions of the samples is slow. They are cached
    for the eight most recent combinations of `lens`, `pinhole` and `resolution`.

    Args:
        lens: The lens and the pose of the real camera.
        pinhole: The simulated pinhole camera that defines the view, such as `Sensor.camera`.
        image: Raw image, shape (lens.height, lens.width) or (lens.height, lens.width, channels), uint8.
        resolution: Height and width of the rectified image (pixels). If the aspect ratio of the view is different, the
            view is cropped around its centre.

    Returns:
        Rectified image, shape (height, width) or (height, width, channels), uint8. Parts of the view that the camera
        does not see are black.

    Raises:
        ValueError: The image is not uint8, or its size is not `lens.height` x `lens.width`. Or the view contains rays
            at larger angles than `Lens.largest_angle`. Or `resolution` or `pinhole` is out of range.
    """
    _check_image(image)
    if image.shape[:2] != (lens.height, lens.width):
        raise ValueError(
            f"the image has {image.shape[1]}x{image.shape[0]} pixels, but the lens was calibrated with images of "
            f"{lens.width}x{lens.height} pixels. Set the camera to {lens.width}x{lens.height} pixels, or calibrate the "
            f"lens again with images of {image.shape[1]}x{image.shape[0]} pixels."
        )
    maps = _rectifying_maps(lens, _Values.of(pinhole), _checked(resolution))
    sampled = cv2.remap(image, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    return _averaged(sampled, resolution)


def distortion(lens: Lens, pinhole: Pinhole, resolution: tuple[int, int]) -> NDArray[np.float32]:
    """Compute the rectified pixel that corresponds to each raw pixel. This is the inverse of `rectification`.

    The raw image comes from the real camera. The rectified image shows the view of the simulated pinhole camera. Two
    pixels correspond if their rays meet the gel's outer face at the same point.

    Args:
        lens: The lens and the pose of the real camera.
        pinhole: The simulated pinhole camera that defines the view, such as `Sensor.camera`.
        resolution: Height and width of the rectified image (pixels). If the aspect ratio of the view is different, the
            view is cropped around its centre.

    Returns:
        Rectified pixel coordinates (column, row) of each raw pixel, shape (lens.height, lens.width, 2). They lie
        outside of the rectified image for raw pixels outside of the view. They are NaN for raw pixels whose ray does
        not meet the plane of the gel's outer face. They are also NaN for raw pixels beyond the range of the lens model,
        which ends at the angle `Lens.largest_angle` from the optical axis.

    Raises:
        ValueError: `resolution` or `pinhole` is out of range.
    """
    return _view_pixels(lens, _Values.of(pinhole), _checked(resolution), 1)


def distorted(
    lens: Lens,
    pinhole: Pinhole,
    image: NDArray[np.uint8],
    *,
    outside: float | tuple[float, float, float],
    samples: int | None = None,
) -> NDArray[np.uint8]:
    """Convert a rectified image to the raw image of the same scene. This is the inverse of `rectified`.

    The rectified image shows the view of the simulated pinhole camera. The raw image is the image that the real camera
    would take. Each raw pixel is the mean of samples of the rectified image. Computing the positions of the samples is
    slow. They are cached for the two most recent combinations of `lens`, `pinhole`, image size and `samples`.

    Args:
        lens: The lens and the pose of the real camera.
        pinhole: The simulated pinhole camera that defines the view, such as `Sensor.camera`.
        image: Rectified image of any size, shape (height, width) or (height, width, channels), uint8. If the
            image and the view have the same aspect ratio, the image must show the whole view, as an image of
            `sts_jax.sense` does. Otherwise, the view is cropped around its centre to the aspect ratio of the
            image, and the image must show this cropped view.
        outside: Grey value or RGB colour of the raw pixels outside of the view, 0 to 255.
        samples: Number of samples per raw pixel in each direction. Fewer samples are faster. None: as many samples as
            needed to avoid aliasing.

    Returns:
        Raw image, shape (lens.height, lens.width) or (lens.height, lens.width, channels), uint8.

    Raises:
        ValueError: The image is not uint8, `samples` is below 1, or `pinhole` does not have distance > 0, 0 < fov < pi
            and aspect > 0.
    """
    _check_image(image)
    if samples is not None and samples < 1:
        raise ValueError(f"samples must be >= 1 or None, got {samples}")
    rows, columns = image.shape[:2]
    maps = _distorting_maps(lens, _Values.of(pinhole), (rows, columns), samples)
    colour = (outside,) * 4 if isinstance(outside, int | float) else tuple(outside)
    sampled = cv2.remap(image, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=colour)
    return _averaged(sampled, (lens.height, lens.width))


def window(pinhole: Pinhole, resolution: tuple[int, int]) -> tuple[float, float, float, float]:
    """Return the rectangle of the gel's outer face that a rectified image shows.

    This function is equivalent to `sts_jax.optics.full_window`, but uses NumPy instead of JAX.

    Args:
        pinhole: The simulated pinhole camera that defines the view, such as `Sensor.camera`.
        resolution: Height and width of the rectified image (pixels). If the aspect ratio of the view is different, the
            view is cropped around its centre.

    Returns:
        x of the left edge, y of the top edge, width and height of the rectangle in the sensor frame (m).

    Raises:
        ValueError: `resolution` or `pinhole` is out of range.
    """
    rows, columns = _checked(resolution)
    values = _Values.of(pinhole)
    height = 2 * values.distance * math.tan(values.fov / 2)
    width = min(height * values.aspect, height * columns / rows)
    height = width * rows / columns
    return -width / 2, -height / 2, width, height


@dataclasses.dataclass(frozen=True)
class _Values:
    """The numbers of a pinhole as a hashable key for the cached maps."""

    distance: float
    fov: float
    aspect: float

    @classmethod
    def of(cls, pinhole: Pinhole) -> "_Values":
        values = cls(float(pinhole.distance), float(pinhole.fov), float(pinhole.aspect))
        if not values.distance > 0 or not 0 < values.fov < math.pi or not values.aspect > 0:
            raise ValueError(
                f"pinhole must have distance > 0, fov in (0, pi) and aspect > 0, got distance={values.distance}, "
                f"fov={values.fov}, aspect={values.aspect}"
            )
        return values


@functools.lru_cache(maxsize=8)
def _rectifying_maps(lens: Lens, pinhole: _Values, resolution: tuple[int, int]) -> tuple[NDArray, NDArray]:
    """The OpenCV maps for `rectified`: the raw pixel of each sample of each rectified pixel."""
    probes = math.ceil(_PROBES / max(resolution))  # points per pixel, so that small images are probed densely enough
    probed = rectification(lens, pinhole, (resolution[0] * probes, resolution[1] * probes))
    samples = _samples(probed, (lens.height, lens.width), probes)
    fine = resolution[0] * samples, resolution[1] * samples
    return _converted(rectification(lens, pinhole, fine), (lens.height, lens.width))


@functools.lru_cache(maxsize=2)
def _distorting_maps(
    lens: Lens, pinhole: _Values, resolution: tuple[int, int], samples: int | None
) -> tuple[NDArray, NDArray]:
    """The OpenCV maps for `distorted`: the rectified pixel of each sample of each raw pixel."""
    if samples is None:
        samples = _samples(_view_pixels(lens, pinhole, resolution, 1), resolution, 1)
    return _converted(_view_pixels(lens, pinhole, resolution, samples), resolution)


def _view_pixels(lens: Lens, pinhole: _Values, resolution: tuple[int, int], samples: int) -> NDArray[np.float32]:
    """The result of `distortion` at `samples` x `samples` points of every raw pixel."""
    left, top, width, height = window(pinhole, resolution)
    scale = np.array([resolution[1] / width, resolution[0] / height])
    x = (np.arange(lens.width * samples) + 0.5) / samples - 0.5
    y = (np.arange(lens.height * samples) + 0.5) / samples - 0.5
    pixels = np.empty((len(y), len(x), 2), np.float32)
    for band in _bands(len(y)):
        rays = directions(lens, np.stack(np.meshgrid(x, y[band]), axis=-1)) @ lens.matrix  # in the sensor frame
        outwards = np.where(rays[..., 2] > _GRAZING, rays[..., 2], np.nan)
        on_face = lens.center[:2] - lens.center[2] / outwards[..., None] * rays[..., :2]
        pixels[band] = (on_face - np.array([left, top])) * scale - 0.5
    return pixels


def _bands(rows: int) -> list[slice]:
    """Slices of `_BAND` rows. Computing a large map slice by slice limits the memory."""
    return [slice(first, first + _BAND) for first in range(0, rows, _BAND)]


def _samples(coordinates: NDArray[np.float32], size: tuple[int, int], probes: int) -> int:
    """The number of samples per pixel in each direction with which a map skips no pixel of the source image.

    Args:
        coordinates: Coordinates in the source image, at `probes` x `probes` points of each pixel of the result, shape
            (rows, columns, 2).
        size: Height and width of the source image (pixels).
        probes: Number of points per pixel in each direction.
    """
    inside = (coordinates > -0.5) & (coordinates < np.array(size[::-1]) - 0.5)
    coordinates = np.where(inside.all(axis=-1, keepdims=True), coordinates, np.nan)
    steps = [np.hypot(*np.moveaxis(np.diff(coordinates, axis=axis), -1, 0)) for axis in (0, 1)]
    largest = max((float(np.nanmax(step)) for step in steps if np.isfinite(step).any()), default=1.0)
    return max(1, math.ceil(largest * probes))


def _converted(coordinates: NDArray[np.float32], size: tuple[int, int]) -> tuple[NDArray, NDArray]:
    """Convert a map to OpenCV's fast fixed-point format with steps of 1/32 pixel. NaN becomes a pixel outside."""
    limits = np.array(size[::-1], np.float32) + _MARGIN
    clipped = np.clip(np.nan_to_num(coordinates, nan=-_MARGIN), -_MARGIN, limits).astype(np.float32)
    whole, fraction = cv2.convertMaps(clipped, None, cv2.CV_16SC2)
    return whole, fraction


def _averaged(image: NDArray, resolution: tuple[int, int]) -> NDArray:
    """Average the samples of each pixel."""
    if image.shape[:2] == resolution:
        return image
    return cv2.resize(image, resolution[::-1], interpolation=cv2.INTER_AREA)


def distort_angle(k: Sequence[float], angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Evaluate the polynomial d(a) = a + k_1 a^3 + k_2 a^5 + k_3 a^7 + k_4 a^9 of the lens model.

    Args:
        k: Coefficients k_1 to k_4 of the lens.
        angle: Angles a from the optical axis (rad), of any shape.

    Returns:
        Distances d from the pixel of the optical axis, in units of the focal length, in the shape of `angle`.
    """
    square = angle * angle
    return angle * (1 + square * (k[0] + square * (k[1] + square * (k[2] + square * k[3]))))


def _undistort_angle(k: tuple[float, ...], distorted_angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Invert `distort_angle` by Newton's method, which starts from a table. NaN beyond the largest angle."""
    largest = _largest_angle(k)
    known = np.linspace(0, largest, _TABLE)
    table = distort_angle(k, known)
    angle = np.interp(distorted_angle, table, known)
    for _ in range(3):
        square = angle * angle
        slope = 1 + square * (3 * k[0] + square * (5 * k[1] + square * (7 * k[2] + square * 9 * k[3])))
        step = (distort_angle(k, angle) - distorted_angle) / np.maximum(slope, 1e-6)
        angle = np.clip(angle - np.clip(step, -largest / _TABLE, largest / _TABLE), 0, largest)
    return np.where(distorted_angle <= table[-1], angle, np.nan)


@functools.lru_cache(maxsize=32)
def _largest_angle(k: tuple[float, ...]) -> float:
    """The smallest positive root of the derivative of `distort_angle`, at most pi."""
    roots = np.roots([9 * k[3], 7 * k[2], 5 * k[1], 3 * k[0], 1.0])
    real = roots[(np.abs(roots.imag) < 1e-9 * np.maximum(1, np.abs(roots))) & (roots.real > 0)].real
    return min([MOST_ANGLE, *np.sqrt(real).tolist()])


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _checked(resolution: tuple[int, int]) -> tuple[int, int]:
    """The resolution as two integers, or a `ValueError`."""
    if len(resolution) != 2 or not all(isinstance(n, int | np.integer) and n >= 1 for n in resolution):
        raise ValueError(f"resolution must be two integers >= 1 (height and width in pixels), got {resolution!r}")
    return int(resolution[0]), int(resolution[1])


def _check_image(image: NDArray) -> None:
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8 or image.ndim not in (2, 3):
        found = f"{image.dtype} of shape {image.shape}" if isinstance(image, np.ndarray) else type(image).__name__
        raise ValueError(
            f"image must be a uint8 NumPy array of shape (height, width) or (height, width, channels), got {found}"
        )
