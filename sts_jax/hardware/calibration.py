"""Calibration of a fisheye lens and of the camera's pose in the sensor, from images of a printed ChArUco board."""

import dataclasses
import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import optimize
from scipy.spatial.transform import Rotation

from sts_jax.hardware.board import Board, FoundCorners, find_board
from sts_jax.hardware.lens import Lens, distort_angle

FEWEST_IMAGES = 6  # least number of usable images
FEWEST_CORNERS = 12  # least number of corners in a usable image
LEAST_TILT = math.radians(15)  # least angle between the two boards that differ most (rad)
MOST_TILT_ON_PAD = math.radians(30)  # largest angle between the board on the pad and the image (rad)

_STARTS = np.radians(np.arange(60, 221, 10))  # fields of view across the diagonal that the first estimate tries (rad)
_WIDEST = math.radians(80)  # corners beyond this angle are not used in the first estimate of a pose (rad)
# Weights of k1 to k4 as additional residuals of the fit (pixels per unit of k). They act as a prior with mean 0, which
# is needed because the corners do not determine k beyond their largest angle. If the corners have errors of 0.1 pixels,
# the prior's standard deviations are 0.2, 0.1, 0.05 and 0.02. In the equidistant, stereographic, equisolid and
# orthographic projections, k1 to k4 have absolute values of at most 0.17, 0.01, 0.001 and 0.0001.
_PRIOR = np.array([0.5, 1.0, 2.0, 5.0])


class CalibrationError(ValueError):
    """Raised if a lens cannot be calibrated, or does not show the whole pad. The message states the remedy."""


@dataclasses.dataclass(frozen=True)
class Calibration:
    """A calibrated lens, and measures of the quality of the calibration."""

    lens: Lens
    errors: tuple[float | None, ...]  # root mean square of each image's reprojection errors (pixels), None: not used
    corners: tuple[int, ...]  # number of corners found in each image
    largest_angle: float  # largest angle of a corner from the optical axis, beyond which the lens is extrapolated (rad)


def calibrate(
    images: Sequence[NDArray[np.uint8]],
    board: Board = Board(),
    *,
    on_pad: int = 0,
    largest_error: float = 1.0,
) -> Calibration:
    """Calibrate a lens and the camera's pose in the sensor from images of a board.

    In one image, the board must lie on the outer face of the gel pad, with the printed side towards the camera. The
    board must be centred on the pad, with its edges parallel to the edges of the pad. Any edge of the board may be at
    the top of the image. Among the other images, the distance, position and tilt of the board must vary.

    The calibration fits the parameters of the lens and the pose of the board in each image. For each corner, it
    compares the pixel at which the corner was found with the pixel to which the fitted lens projects the corner. The
    distance between these two pixels is the reprojection error. The fit minimises a soft L1 loss of the differences
    in column and row between these pixels. A weak prior keeps the coefficients `Lens.k` small.

    Args:
        images: Raw images of one camera, all of the same size, shape (height, width, 3) for RGB or (height, width) for
            grey, uint8. At least 6 of the images must each show at least 12 corners of the board.
        board: The printed board.
        on_pad: Index in `images` of the image in which the board lies on the pad.
        largest_error: Largest allowed root mean square of the reprojection errors of an image (pixels).

    Returns:
        The lens with the camera's pose relative to the pad, and the root mean square of the reprojection errors of each
        image.

    Raises:
        CalibrationError: Too few images show at least 12 corners of the board, the board has nearly the same tilt in
            all images, or the reprojection errors of an image exceed `largest_error`. This error is also raised if, in
            the image with the index `on_pad`, fewer than 12 corners are found, the plane of the board is tilted against
            the image plane by more than 30 degrees, or the edges of the board are rotated against the edges of the
            image by more than 30 degrees.
        ValueError: The images have different sizes or are not uint8, or `on_pad` is not the index of an image.
    """
    height, width = _common_size(images)
    found = [find_board(image, board) for image in images]
    return fit_lens(found, (width, height), board, on_pad=on_pad, largest_error=largest_error)


def fit_lens(
    found: Sequence[FoundCorners],
    size: tuple[int, int],
    board: Board = Board(),
    *,
    on_pad: int = 0,
    largest_error: float = 1.0,
) -> Calibration:
    """Calibrate a lens as `calibrate` does, but from the results of `find_board` instead of images.

    Args:
        found: Corners of the board in each image, from `find_board`.
        size: Width and height of the raw images (pixels).
        board: The printed board.
        on_pad: Index in `found` of the image in which the board lies on the sensor's gel pad.
        largest_error: Largest allowed root mean square of the reprojection errors of an image (pixels).

    Returns:
        The lens with the camera's pose relative to the pad, and the root mean square of the reprojection errors of each
        image.

    Raises:
        CalibrationError: Too few images show at least 12 corners of the board, the board has nearly the same tilt in
            all images, or the reprojection errors of an image exceed `largest_error`. This error is also raised if, in
            the image with the index `on_pad`, fewer than 12 corners are found, the plane of the board is tilted against
            the image plane by more than 30 degrees, or the edges of the board are rotated against the edges of the
            image by more than 30 degrees.
        ValueError: `on_pad` is not the index of an image.
    """
    width, height = size
    if not 0 <= on_pad < max(1, len(found)):
        raise ValueError(
            f"on_pad must be the index of an image, counted from 0, got {on_pad} (number of images: {len(found)})"
        )
    if len(found) < FEWEST_IMAGES:
        raise CalibrationError(
            f"a calibration needs at least {FEWEST_IMAGES} images of the board in different poses, but only "
            f"{len(found)} images are given. Take more images."
        )
    counts = tuple(len(corners.numbers) for corners in found)
    used = _usable(counts, on_pad)
    views = _Views.of([found[i] for i in used], board)
    start = _first_estimate(views, width, height)
    fit = _fitted(views, start)
    root_mean_squares = [
        math.sqrt(float(np.mean(np.sum(fit.residuals[views.image == i] ** 2, axis=-1)))) for i in range(len(used))
    ]
    errors: list[float | None] = [None] * len(found)
    for i, error in zip(used, root_mean_squares, strict=True):
        errors[i] = error
    _check_errors(errors, largest_error)
    _check_tilts(fit.poses)
    rotation, translation = _pose_on_pad(fit.poses[used.index(on_pad)], on_pad)
    lens = Lens(width, height, *fit.focal, *fit.center, fit.k, rotation, translation)
    return Calibration(lens, tuple(errors), counts, fit.largest_angle)


@dataclasses.dataclass(frozen=True)
class _Views:
    """The corners of all usable images, concatenated."""

    image: NDArray[np.int64]  # index of each corner's image among the usable images, shape (n,)
    points: NDArray[np.float64]  # position of each corner in the board's frame (m), shape (n, 3)
    pixels: NDArray[np.float64]  # raw pixel coordinates of each corner, shape (n, 2)
    number: int  # number of usable images

    @classmethod
    def of(cls, found: list[FoundCorners], board: Board) -> "_Views":
        corners = board.corners
        return cls(
            image=np.repeat(np.arange(len(found)), [len(f.numbers) for f in found]),
            points=np.concatenate([corners[f.numbers] for f in found]),
            pixels=np.concatenate([f.pixels for f in found]),
            number=len(found),
        )


@dataclasses.dataclass(frozen=True)
class _Fit:
    """A lens and the pose of the board in each image, with the residuals of the corners."""

    focal: tuple[float, float]  # fx and fy (pixels per radian)
    center: tuple[float, float]  # cx and cy (pixels)
    k: tuple[float, float, float, float]  # k1 to k4 of the lens
    poses: NDArray[np.float64]  # rotation vector (rad) and translation (m) from board to camera, shape (images, 6)
    residuals: NDArray[np.float64]  # projections minus found corners (pixels), shape (n, 2)
    largest_angle: float  # largest angle of a corner from the optical axis (rad)

    @property
    def unknowns(self) -> NDArray[np.float64]:
        """Focal lengths, centre, k and the poses of m images as one vector, shape (8 + 6 m,)."""
        return np.concatenate([self.focal, self.center, self.k, self.poses.ravel()])

    @classmethod
    def of(cls, views: _Views, unknowns: NDArray[np.float64]) -> "_Fit":
        """Project the corners with the lens and the poses in `unknowns`, and compute the residuals."""
        fx, fy, cx, cy, k1, k2, k3, k4 = unknowns[:8].tolist()
        poses = unknowns[8:].reshape(-1, 6)
        matrices = Rotation.from_rotvec(poses[:, :3]).as_matrix()[views.image]
        points = np.einsum("nij,nj->ni", matrices, views.points) + poses[views.image, 3:]
        radius = np.hypot(points[:, 0], points[:, 1])
        angle = np.arctan2(radius, points[:, 2])
        k = (k1, k2, k3, k4)
        seen = points[:, :2] * (distort_angle(k, angle) / np.maximum(radius, 1e-12))[:, None]
        residuals = seen * np.array([fx, fy]) + np.array([cx, cy]) - views.pixels
        return cls((fx, fy), (cx, cy), k, poses, residuals, float(angle.max()))


def _first_estimate(views: _Views, width: int, height: int) -> _Fit:
    """The equidistant lens of the field of view in `_STARTS` that fits best, with a pose of the board in each image."""
    best: _Fit | None = None
    for field_of_view in _STARTS:
        focal, middle = math.hypot(width, height) / field_of_view, ((width - 1) / 2, (height - 1) / 2)
        offset = (views.pixels - middle) / focal
        angle = np.hypot(*offset.T)
        usable = angle < _WIDEST
        plane = offset * (np.tan(np.minimum(angle, _WIDEST)) / np.maximum(angle, 1e-12))[:, None]
        poses = []
        for i in range(views.number):
            rows = usable & (views.image == i)
            if np.count_nonzero(rows) < FEWEST_CORNERS // 2:
                break
            solved, rotation, translation = cv2.solvePnP(
                views.points[rows], plane[rows], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
            )
            if not solved:
                break
            poses.append(np.concatenate([rotation.ravel(), translation.ravel()]))
        if len(poses) == views.number:
            fit = _Fit.of(views, np.concatenate([[focal, focal, *middle, 0, 0, 0, 0], *poses]))
            if best is None or np.abs(fit.residuals).mean() < np.abs(best.residuals).mean():
                best = fit
    if best is None:
        raise CalibrationError(
            "the pose of the board cannot be computed from the corners that were found in the images. Check that "
            "`board` and the printed board have the same numbers of squares and the same dictionary. Take images that "
            "show more of the board."
        )
    return best


def _fitted(views: _Views, start: _Fit) -> _Fit:
    """Minimise the residuals of the corners and of the prior, beginning at `start`."""

    def residuals(unknowns: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.concatenate([_Fit.of(views, unknowns).residuals.ravel(), _PRIOR * unknowns[4:8]])

    result = optimize.least_squares(residuals, start.unknowns, x_scale="jac", loss="soft_l1", max_nfev=200)
    return _Fit.of(views, result.x)


def _common_size(images: Sequence[NDArray[np.uint8]]) -> tuple[int, int]:
    """Height and width of the images, or an error if they have different sizes or another type."""
    if not images:
        raise CalibrationError(
            f"`images` is empty. Take at least {FEWEST_IMAGES} images of the board in different poses."
        )
    for i, image in enumerate(images):
        if image.dtype != np.uint8 or not (image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)):
            raise ValueError(
                f"image {i} must be uint8 of shape (height, width) or (height, width, 3), got {image.dtype} of shape "
                f"{image.shape}. Read the image with `Camera.read` or from a PNG file."
            )
    sizes = {image.shape[:2] for image in images}
    if len(sizes) > 1:
        names = ", ".join(f"{w}x{h}" for h, w in sorted(sizes))
        raise ValueError(
            f"all images must have the same size, got the sizes {names} (width x height in pixels). Take all images "
            "with the same camera settings."
        )
    height, width = images[0].shape[:2]
    return height, width


def _usable(counts: tuple[int, ...], on_pad: int) -> list[int]:
    """The indices of the images with enough corners. Raises an error if they are too few or `on_pad` is missing."""
    used = [i for i, count in enumerate(counts) if count >= FEWEST_CORNERS]
    missing = [i for i, count in enumerate(counts) if count == 0]
    few = [f"{i} ({count} corners)" for i, count in enumerate(counts) if 0 < count < FEWEST_CORNERS]
    lacking = ""
    if missing:
        lacking += f" The board was not found in {_listed(missing)}."
    if few:
        lacking += f" Fewer than {FEWEST_CORNERS} corners were found in {_listed(few)}."
    remedy = (
        " Check that `board` describes the printed board, that the board is sharp, evenly lit and not overexposed, and "
        "that most of it is in view."
    )
    if on_pad not in used:
        raise CalibrationError(
            f"on_pad is {on_pad}, so image {on_pad} must show at least {FEWEST_CORNERS} corners of the board, but it "
            f"shows {counts[on_pad]}.{lacking}{remedy}"
        )
    if len(used) < FEWEST_IMAGES:
        raise CalibrationError(
            f"only {len(used)} of {len(counts)} images show at least {FEWEST_CORNERS} corners of the board, but at "
            f"least {FEWEST_IMAGES} such images are needed.{lacking}{remedy}"
        )
    return used


def _check_errors(errors: list[float | None], largest: float) -> None:
    """Raise an error if the reprojection error of an image is too large."""
    bad = [f"{i} ({error:.2f} pixels)" for i, error in enumerate(errors) if error is not None and error > largest]
    if bad:
        raise CalibrationError(
            f"largest_error is {largest:g} (pixels), but the root mean square of the reprojection errors is larger in "
            f"{_listed(bad)}. If only a few images are listed, leave them out: they may be blurred, or the board may "
            "have moved. If most images are listed, check that the board is flat, that its squares have the size "
            "`Board.square`, and that focus and image size were the same for all images."
        )


def _check_tilts(poses: NDArray[np.float64]) -> None:
    """Raise an error if the boards are nearly parallel in all images."""
    normals = Rotation.from_rotvec(poses[:, :3]).as_matrix()[:, :, 2]
    spread = math.acos(float(np.clip((normals @ normals.T).min(), -1, 1)))
    if spread < LEAST_TILT:
        raise CalibrationError(
            "the largest difference between the tilts of the board in any two images is "
            f"{math.degrees(spread):.0f} degrees, but at least {math.degrees(LEAST_TILT):.0f} degrees are needed to "
            "compute the focal length. Tilt the board by 20 to 40 degrees in some images, each time in a different "
            "direction."
        )


def _pose_on_pad(
    pose: NDArray[np.float64], index: int
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """The rotation vector and the translation from the sensor frame to the camera frame.

    The sensor frame is the frame of the board on the pad, turned by a multiple of 90 degrees so that x points to the
    right of the image.

    Args:
        pose: Rotation vector (rad) and translation (m) from the board on the pad to the camera, shape (6,).
        index: Index of the image, for error messages.
    """
    board = Rotation.from_rotvec(pose[:3])
    turns = [board * Rotation.from_euler("z", quarter * math.pi / 2) for quarter in range(4)]
    sensor = max(turns, key=lambda turn: turn.as_matrix()[0, 0])
    tilt = math.acos(float(np.clip(sensor.as_matrix()[2, 2], -1, 1)))
    twist = math.atan2(sensor.as_matrix()[1, 0], sensor.as_matrix()[0, 0])
    for angle, words in ((tilt, "tilted against"), (abs(twist), "rotated in")):
        if angle > MOST_TILT_ON_PAD:
            raise CalibrationError(
                f"the board of image {index} is {words} the image plane by {math.degrees(angle):.0f} degrees, but at "
                f"most {math.degrees(MOST_TILT_ON_PAD):.0f} degrees are allowed for a board on the pad. Set `on_pad` "
                "to the index of the image in which the board lies on the pad, or mount the camera so that the "
                "image plane is parallel to the pad and the edges of the pad are horizontal and vertical in the image."
            )
    (x, y, z), (tx, ty, tz) = sensor.as_rotvec().tolist(), pose[3:].tolist()
    return (x, y, z), (tx, ty, tz)


def _listed(names: Sequence[object]) -> str:
    """A text such as "images 2, 5"."""
    return f"image{'s' if len(names) > 1 else ''} {', '.join(map(str, names))}"
