"""The printed ChArUco board, and the calibration of a fisheye lens and its pose in the sensor from images of it."""

import dataclasses
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8
from PIL import Image
from scipy import optimize
from scipy.spatial.transform import Rotation

from sts_jax import storage
from sts_jax._checked import checked
from sts_jax.hardware.lens import Lens, distort_angle, rectification
from sts_jax.optics import Camera, full_window

FEWEST_IMAGES = 6  # least number of usable images
FEWEST_CORNERS = 12  # least number of corners in a usable image
LEAST_TILT = math.radians(15)  # least angle between the two boards that differ most (rad)
MOST_TILT_ON_PAD = math.radians(30)  # largest angle between the board on the pad and the image (rad)

_PAGE = (210, 297)  # width and height of A4 (mm)
_FRAME = 150  # side of the printed frame, which is that of the gel pad (mm)
_RULER = 100  # length of the printed ruler (mm)
_PIXELS_PER_MM = 10

_STARTS = np.radians(np.arange(60, 221, 10))  # fields of view across the diagonal that the first estimate tries (rad)
_WIDEST = math.radians(80)  # corners beyond this angle are not used in the first estimate of a pose (rad)
# Weights of k1 to k4 as additional residuals of the fit (pixels per unit of k). They act as a prior with mean 0, which
# is needed because the corners do not determine k beyond their largest angle. If the corners have errors of 0.1 pixels,
# the prior's standard deviations are 0.2, 0.1, 0.05 and 0.02. In the equidistant, stereographic, equisolid and
# orthographic projections, k1 to k4 have absolute values of at most 0.17, 0.01, 0.001 and 0.0001.
_PRIOR = np.array([0.5, 1.0, 2.0, 5.0])

_RESOLUTION = 480, 640  # height and width of the view at which it is checked (pixels)
_EXTRAPOLATION = math.radians(3)  # largest angle by which the view may exceed the corners of all boards (rad)
# Share of the image's width and height that belongs to each outer part. A lens of 160 degrees shows the border of the
# view there, and a board on the pad does not reach it.
_OUTER = 0.2
_ROWS = "top", "middle", "bottom"
_COLUMNS = "left", "centre", "right"
PARTS = tuple(f"{row} {column}" for row in _ROWS for column in _COLUMNS)

_SHARP = "Check that `board` is the printed board, sharp, evenly lit, not overexposed, and mostly in view"


class CalibrationError(ValueError):
    """A lens cannot be calibrated, or does not show the whole pad. The message states the remedy."""


@dataclasses.dataclass(frozen=True)
class Board:
    """A ChArUco board: a chessboard with an ArUco marker in each white square.

    The frame of the board has its origin at the centre. On the printed side, x points to the right, y points downwards,
    and z points into the paper.
    """

    columns: int = 9  # number of squares in a row, at least 4
    rows: int = 9  # number of squares in a column, at least 4
    square: float = 0.016  # side of a square (m)
    marker: float = 0.012  # side of a marker (m)
    dictionary: str = "DICT_4X4_50"  # name of one of OpenCV's predefined dictionaries of markers

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 4:
            raise ValueError(f"columns and rows must be >= 4, got {self.columns} and {self.rows}")
        if not 0 < self.marker < self.square < 1:
            raise ValueError(f"0 < marker < square < 1 m must hold, got marker={self.marker} and square={self.square}")
        if not self.dictionary.startswith("DICT_") or not hasattr(cv2.aruco, self.dictionary):
            raise ValueError(f"dictionary must be one of OpenCV's, such as 'DICT_4X4_50', got {self.dictionary!r}")
        needed, available = self.columns * self.rows // 2, len(self._markers().bytesList)
        if needed > available:
            raise ValueError(f"the board needs {needed} markers, but the dictionary {self.dictionary} has {available}")

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the board (m)."""
        return self.columns * self.square, self.rows * self.square

    @property
    def corners(self) -> Float[np.ndarray, "n 3"]:
        """Positions of the inner corners of the chessboard in the board's frame (m), row by row."""
        middle = np.array([*self.size, 0.0]) / 2
        return np.asarray(self.opencv().getChessboardCorners(), np.float64) - middle

    def opencv(self) -> "cv2.aruco.CharucoBoard":
        """Return the same board as an OpenCV object, whose frame has its origin at the top left corner."""
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.square, self.marker, self._markers())

    def _markers(self) -> "cv2.aruco.Dictionary":
        return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))


@dataclasses.dataclass(frozen=True)
class FoundCorners:
    """The corners of a board that were found in an image."""

    numbers: Int[np.ndarray, "n"]  # row of each corner in `Board.corners`
    pixels: Float[np.ndarray, "n 2"]  # raw pixel coordinates (column, row) of each corner


def board_image(board: Board = Board()) -> UInt8[np.ndarray, "2970 2100"]:
    """Draw an A4 page with 10 pixels per mm: the board, a frame of the pad's size to cut along, and a ruler of 100 mm.

    The middle of the board is that of the frame, and its dimensions are printed as text.
    """
    width, height = (round(1000 * side * _PIXELS_PER_MM) for side in board.size)
    size = " x ".join(f"{1000 * side:g} mm" for side in board.size)
    frame = _FRAME * _PIXELS_PER_MM
    if max(width, height) > frame:
        raise ValueError(f"the board is {size}, but must fit in the frame of {_FRAME} mm: use smaller squares")
    page = np.full((_PAGE[1] * _PIXELS_PER_MM, _PAGE[0] * _PIXELS_PER_MM), 255, np.uint8)
    left, top = (page.shape[1] - frame) // 2, 10 * _PIXELS_PER_MM
    cv2.rectangle(page, (left - 1, top - 1), (left + frame, top + frame), 160, 1)
    x, y = left + (frame - width) // 2, top + (frame - height) // 2
    page[y : y + height, x : x + width] = board.opencv().generateImage((width, height))
    row = top + frame + 10 * _PIXELS_PER_MM
    for line in (
        f"{board.columns} x {board.rows} squares of {1000 * board.square:g} mm, markers of {1000 * board.marker:g} mm "
        f"({board.dictionary})",
        f"Board {size}, grey frame {_FRAME} mm x {_FRAME} mm",
        f"Print at 100 %. The line below is {_RULER} mm long.",
    ):
        cv2.putText(page, line, (left, row), cv2.FONT_HERSHEY_SIMPLEX, 1.2, 0, 2, cv2.LINE_AA)
        row += 7 * _PIXELS_PER_MM
    right = left + _RULER * _PIXELS_PER_MM - 1
    cv2.rectangle(page, (left, row), (right, row + 4), 0, -1)
    for end in (left, right):
        cv2.line(page, (end, row - 20), (end, row + 24), 0, 1)
    return page


def save_board(path: str | os.PathLike, board: Board = Board()) -> None:
    """Save the page of `board_image` as .pdf or .png, whose print at 100 % has the true size."""
    kind = Path(path).suffix.lower().removeprefix(".")
    if kind not in ("pdf", "png"):
        raise ValueError(f"path must end in .pdf or .png, got {path}")
    page, dots_per_inch = Image.fromarray(board_image(board)), 25.4 * _PIXELS_PER_MM
    options = {"resolution": dots_per_inch} if kind == "pdf" else {"dpi": (dots_per_inch, dots_per_inch)}
    storage.write_whole(Path(path), lambda temporary: page.save(temporary, kind, **options))


@checked
def find_board(image: UInt8[np.ndarray, "rows columns *channels"], board: Board = Board()) -> FoundCorners:
    """Find the corners of a board in a raw RGB or grey image. If the board is not found, the arrays are empty."""
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image
    parameters = cv2.aruco.DetectorParameters()
    parameters.adaptiveThreshWinSizeMax = max(23, 3 + gray.shape[1] // 160 * 10)  # markers grow with the image
    detector = cv2.aruco.CharucoDetector(board.opencv(), cv2.aruco.CharucoParameters(), parameters)
    pixels, numbers, _, _ = detector.detectBoard(gray)
    if pixels is None or numbers is None:
        return FoundCorners(np.zeros(0, np.int64), np.zeros((0, 2)))
    return FoundCorners(numbers.reshape(-1).astype(np.int64), pixels.reshape(-1, 2).astype(np.float64))


@dataclasses.dataclass(frozen=True)
class Calibration:
    """A calibrated lens, and measures of the quality of the calibration."""

    lens: Lens
    errors: tuple[float | None, ...]  # root mean square of each image's reprojection errors (pixels), None: not used
    corners: tuple[int, ...]  # number of corners found in each image
    largest_angle: float  # largest angle of a corner from the optical axis, beyond which the lens is extrapolated (rad)


def fit_lens(
    corners: Sequence[FoundCorners],
    size: tuple[int, int],
    board: Board = Board(),
    *,
    on_pad: int = 0,
    largest_error: float = 1.0,
) -> Calibration:
    """Calibrate a lens and the camera's pose in the sensor from the corners of a board in raw images.

    The fit minimises a soft L1 loss of the distances between the found corners and their projections. In the image
    `on_pad`, the board lies on the outer face of the gel pad, with the print towards the camera, centred, and with its
    edges parallel to those of the pad (in any of the four orientations). Among the other images, the distance, position
    and tilt of the board vary.

    Args:
        corners: Results of `find_board` for at least 6 raw images that show 12 corners of the board.
        size: Width and height of the raw images (pixels).
        largest_error: Largest allowed root mean square of the reprojection errors of an image (pixels).

    Raises:
        CalibrationError: The images do not determine the lens. The message names the images.
    """
    width, height = size
    if not 0 <= on_pad < max(1, len(corners)):
        raise ValueError(f"on_pad must be the index of an image, got {on_pad} (number of images: {len(corners)})")
    counts = tuple(len(found.numbers) for found in corners)
    used = _usable(counts, on_pad)
    views = _Views(
        image=np.repeat(np.arange(len(used)), [counts[i] for i in used]),
        points=board.corners[np.concatenate([corners[i].numbers for i in used])],
        pixels=np.concatenate([corners[i].pixels for i in used]),
    )

    def loss(unknowns: np.ndarray) -> np.ndarray:
        return np.concatenate([views.residuals(unknowns)[0].ravel(), _PRIOR * unknowns[4:8]])

    start = _first_estimate(views, width, height)
    fit = optimize.least_squares(loss, start, x_scale="jac", loss="soft_l1", max_nfev=200).x
    residuals, angle = views.residuals(fit)
    errors: list[float | None] = [None] * len(corners)
    for row, i in enumerate(used):
        errors[i] = math.sqrt(float(np.mean(np.sum(residuals[views.image == row] ** 2, axis=-1))))
    _check_errors(errors, largest_error)
    poses = fit[8:].reshape(-1, 6)
    _check_tilts(poses)
    fx, fy, cx, cy, k1, k2, k3, k4 = fit[:8].tolist()
    lens = Lens(width, height, fx, fy, cx, cy, (k1, k2, k3, k4), *_pose_on_pad(poses[used.index(on_pad)], on_pad))
    return Calibration(lens, tuple(errors), counts, float(angle.max()))


class _Views(NamedTuple):
    """The n corners of all usable images, concatenated."""

    image: np.ndarray  # index of each corner's image among the usable images, shape (n,)
    points: np.ndarray  # position of each corner in the board's frame (m), shape (n, 3)
    pixels: np.ndarray  # raw pixel coordinates of each corner, shape (n, 2)

    def residuals(self, unknowns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Projections minus found corners (pixels), shape (n, 2), and angles from the optical axis (rad), shape (n,).

        The unknowns, shape (8 + 6 images,), are fx, fy, cx, cy, k1 to k4 and, for each image, rotation vector and
        translation (m) from board to camera.
        """
        poses = unknowns[8:].reshape(-1, 6)
        matrices = Rotation.from_rotvec(poses[:, :3]).as_matrix()[self.image]
        points = np.einsum("nij,nj->ni", matrices, self.points) + poses[self.image, 3:]
        radius = np.hypot(points[:, 0], points[:, 1])
        angle = np.arctan2(radius, points[:, 2])
        seen = points[:, :2] * (distort_angle(unknowns[4:8].tolist(), angle) / np.maximum(radius, 1e-12))[:, None]
        return seen * unknowns[:2] + unknowns[2:4] - self.pixels, angle


def _first_estimate(views: _Views, width: int, height: int) -> np.ndarray:
    """The equidistant lens of `_STARTS` that fits best, with the pose of the board in each image, as unknowns."""
    best, smallest = np.zeros(0), math.inf
    for field_of_view in _STARTS:
        focal, middle = math.hypot(width, height) / field_of_view, ((width - 1) / 2, (height - 1) / 2)
        offset = (views.pixels - middle) / focal
        angle = np.hypot(*offset.T)
        plane = offset * (np.tan(np.minimum(angle, _WIDEST)) / np.maximum(angle, 1e-12))[:, None]
        unknowns = [np.array([focal, focal, *middle, 0, 0, 0, 0])]
        for i in np.unique(views.image):
            rows = (angle < _WIDEST) & (views.image == i)
            if np.count_nonzero(rows) < FEWEST_CORNERS // 2:
                break
            solved, rotation, translation = cv2.solvePnP(
                views.points[rows], plane[rows], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
            )
            if not solved:
                break
            unknowns += [rotation.ravel(), translation.ravel()]
        else:
            estimate = np.concatenate(unknowns)
            error = float(np.abs(views.residuals(estimate)[0]).mean())
            best, smallest = min((best, smallest), (estimate, error), key=lambda candidate: candidate[1])
    if not best.size:
        raise CalibrationError(f"the pose of the board cannot be computed from the corners that were found: {_SHARP}")
    return best


def _usable(counts: tuple[int, ...], on_pad: int) -> list[int]:
    """The indices of the images with enough corners. Raises an error if they are too few or `on_pad` is missing."""
    used = [i for i, count in enumerate(counts) if count >= FEWEST_CORNERS]
    poor = ", ".join(f"{i} ({count} corners)" for i, count in enumerate(counts) if count < FEWEST_CORNERS) or "none"
    if len(used) < FEWEST_IMAGES or on_pad not in used:
        raise CalibrationError(
            f"{len(used)} of {len(counts)} images show at least {FEWEST_CORNERS} corners of the board, but "
            f"{FEWEST_IMAGES} must, with image {on_pad} of the board on the pad. Too few corners: {poor}. {_SHARP}"
        )
    return used


def _check_errors(errors: list[float | None], largest: float) -> None:
    bad = [f"{i} ({error:.2f} pixels)" for i, error in enumerate(errors) if error is not None and error > largest]
    if bad:
        raise CalibrationError(
            f"the reprojection error exceeds {largest:g} pixels in images {', '.join(bad)}: leave them out, or check "
            "that the board is flat, that its squares have the size `Board.square`, and that the focus did not change"
        )


def _check_tilts(poses: np.ndarray) -> None:
    normals = Rotation.from_rotvec(poses[:, :3]).as_matrix()[:, :, 2]
    spread = math.acos(float(np.clip((normals @ normals.T).min(), -1, 1)))
    if spread < LEAST_TILT:
        raise CalibrationError(
            f"the tilts of the board differ by only {math.degrees(spread):.0f} degrees, which does not determine the "
            "focal length: tilt the board by 20 to 40 degrees, each time in another direction"
        )


def _pose_on_pad(pose: np.ndarray, index: int) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Rotation vector and translation from the sensor frame to the camera frame, from those of the board on the pad.

    The sensor frame is the board's frame, turned by a multiple of 90 degrees so that x points to the image's right.
    """
    board = Rotation.from_rotvec(pose[:3])
    turns = [board * Rotation.from_euler("z", quarter * math.pi / 2) for quarter in range(4)]
    sensor = max(turns, key=lambda turn: turn.as_matrix()[0, 0])
    tilt = math.acos(float(np.clip(sensor.as_matrix()[2, 2], -1, 1)))
    twist = math.atan2(sensor.as_matrix()[1, 0], sensor.as_matrix()[0, 0])
    if max(tilt, abs(twist)) > MOST_TILT_ON_PAD:
        raise CalibrationError(
            f"the board of image {index} is tilted by {math.degrees(tilt):.0f} and turned by {math.degrees(twist):.0f} "
            f"degrees, so it does not lie on the pad: set on_pad, or mount the camera parallel to the pad and its edges"
        )
    (x, y, z), (tx, ty, tz) = sensor.as_rotvec().tolist(), pose[3:].tolist()
    return (x, y, z), (tx, ty, tz)


def view_angle(lens: Lens, pinhole: Camera) -> float:
    """Largest angle from the optical axis of the real camera to a corner of the sensor's view (rad)."""
    left, top, width, height = np.asarray(full_window(pinhole, _RESOLUTION), np.float64)
    corners = np.array([(x, y, 0.0) for x in (left, left + width) for y in (top, top + height)])
    seen = corners @ lens.matrix.T + np.asarray(lens.translation)
    return float(np.arctan2(np.hypot(seen[:, 0], seen[:, 1]), seen[:, 2]).max())


def check_view(lens: Lens, pinhole: Camera, largest_angle: float | None = None) -> None:
    """Check that the camera sees the whole view and that the calibration images cover the corners of the view.

    The view may exceed `largest_angle` (rad), from `Calibration`, by 3 degrees.
    """
    needed = view_angle(lens, pinhole)
    if largest_angle is not None and needed > largest_angle + _EXTRAPOLATION:
        raise CalibrationError(
            f"the sensor's view reaches {math.degrees(needed):.1f} degrees from the optical axis, but the boards only "
            f"{math.degrees(largest_angle):.1f} degrees: take more images with the board in the corners of the image"
        )
    try:
        pixels = rectification(lens, pinhole, _RESOLUTION)
    except ValueError as error:
        raise CalibrationError(str(error)) from error
    size = np.array([lens.width, lens.height])
    outside = np.any((pixels < -0.5) | (pixels > size - 0.5), axis=-1)
    if outside.any():
        blocks = [b for rows in np.array_split(outside, 3) for b in np.array_split(rows, 3, axis=1)]
        parts = ", ".join(part for part, block in zip(PARTS, blocks, strict=True) if block.any())
        raise CalibrationError(
            f"{outside.mean():.2%} of the sensor's view ({parts}) lies outside of the raw image: mount the camera "
            "under the centre of the pad and parallel to it, or use a lens with a larger field of view"
        )


def covered(corners: Sequence[FoundCorners], size: tuple[int, int]) -> tuple[str, ...]:
    """Return the parts of raw images (width, height), such as "top left", in which any corner of the board was found.

    Of the 3 x 3 parts, the outer rows and columns have 20 % of the image's height and width.
    """
    pixels = np.concatenate([np.zeros((0, 2)), *(found.pixels for found in corners)])
    thirds = np.digitize((pixels + 0.5) / np.asarray(size), [_OUTER, 1 - _OUTER])
    present = {f"{_ROWS[row]} {_COLUMNS[column]}" for column, row in thirds}
    return tuple(part for part in PARTS if part in present)
