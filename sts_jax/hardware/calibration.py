"""Calibration of a fisheye camera and of the pad's position from pictures of a printed ChArUco board."""

import dataclasses
import math
import os
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy import optimize
from scipy.spatial.transform import Rotation

from sts_jax import _files
from sts_jax.hardware.lens import Lens, distort_angle

FEWEST_IMAGES = 6
FEWEST_CORNERS = 12  # of a usable image
LEAST_TILT = math.radians(15)  # between the two most different boards
MOST_TILT_ON_PAD = math.radians(30)  # of the pad against the image

_STARTS = np.radians(np.arange(60, 221, 10))  # rad, fields of view across the diagonal from which the fit may start
_WIDEST = math.radians(80)  # rad, corners beyond it do not take part in the first estimate of a pose
# Pixels per unit of k. Without it, k is arbitrary beyond the corners' largest angle. With an error of 0.1 pixels of the
# corners, the standard deviations are 0.2, 0.1, 0.05 and 0.02. The equidistant, stereographic, equisolid and
# orthographic projections have absolute values of at most 0.17, 0.01, 0.001 and 0.0001.
_PRIOR = np.array([0.5, 1.0, 2.0, 5.0])
_PAGE = (210, 297)  # mm, A4
_PIXELS_PER_MM = 10
_RULER = 100  # mm


class CalibrationError(ValueError):
    """The images do not determine the lens. The message names the images and the remedy."""


@dataclasses.dataclass(frozen=True)
class Board:
    """A ChArUco board: a chessboard with a marker in each white square.

    Its frame has the origin at the board's centre, x to the right and y to the bottom of the print, z into the paper.

    Raises:
        ValueError: a value is out of range.
    """

    columns: int = 9  # squares
    rows: int = 9  # squares
    square: float = 0.016  # m, side of a square
    marker: float = 0.012  # m, side of a marker
    dictionary: str = "DICT_4X4_50"  # name of OpenCV's set of markers

    def __post_init__(self) -> None:
        for name in ("columns", "rows"):
            if getattr(self, name) < 4:
                raise ValueError(f"{name} must be >= 4, got {getattr(self, name)}")
        if not 0 < self.marker < self.square < 1:
            raise ValueError(f"0 < marker < square < 1 m must hold, got {self.marker} and {self.square}")
        if not self.dictionary.startswith("DICT_") or not hasattr(cv2.aruco, self.dictionary):
            raise ValueError(f"dictionary must be a name of OpenCV such as 'DICT_4X4_50', got {self.dictionary!r}")
        known = len(self._markers().bytesList)
        if self.columns * self.rows // 2 > known:
            raise ValueError(
                f"a board of {self.columns}x{self.rows} squares needs {self.columns * self.rows // 2} markers, but "
                f"{self.dictionary} has {known}. Choose a larger dictionary or fewer squares."
            )

    @property
    def size(self) -> tuple[float, float]:
        """Width and height (m)."""
        return self.columns * self.square, self.rows * self.square

    @property
    def corners(self) -> NDArray[np.float64]:
        """The inner corners of the chessboard in the board's frame (m), shape (n, 3)."""
        middle = np.array([*self.size, 0.0]) / 2
        return np.asarray(self.opencv().getChessboardCorners(), np.float64) - middle

    def opencv(self) -> "cv2.aruco.CharucoBoard":
        """The board of OpenCV, whose origin is the top left corner."""
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.square, self.marker, self._markers())

    def _markers(self) -> "cv2.aruco.Dictionary":
        return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))


@dataclasses.dataclass(frozen=True)
class FoundCorners:
    """The corners of a board that an image shows."""

    numbers: NDArray[np.int64]  # (n,) rows of `Board.corners`
    pixels: NDArray[np.float64]  # (n, 2) raw pixel coordinates


@dataclasses.dataclass(frozen=True)
class Calibration:
    """A calibrated lens, and the evidence for it."""

    lens: Lens
    errors: tuple[float | None, ...]  # pixels, root mean square of each image's reprojection errors, None: not used
    corners: tuple[int, ...]  # number of corners found in each image
    largest_angle: float  # rad, of all corners from the optical axis. Beyond it, the lens is extrapolated


def board_image(board: Board = Board(), *, outline: tuple[float, float] = (0.15, 0.15)) -> NDArray[np.uint8]:
    """A page of A4 with the board, its dimensions, a frame to cut along, and a ruler of 100 mm.

    Args:
        board: the board.
        outline: width and height of the frame around the board (m). If it equals the pad, the sheet lies in the middle
            of the pad when their edges match.

    Returns:
        Grey image with 10 pixels per mm, shape (2970, 2100).

    Raises:
        ValueError: the board does not fit into the frame, or the frame does not fit on the page.
    """
    frame = [round(1000 * side * _PIXELS_PER_MM) for side in outline]
    pixels = [round(1000 * side * _PIXELS_PER_MM) for side in board.size]
    limits = [(_PAGE[0] - 10) * _PIXELS_PER_MM, (_PAGE[1] - 60) * _PIXELS_PER_MM]
    if any(p > f for p, f in zip(pixels, frame, strict=True)):
        raise ValueError(f"the board of {_mm(board.size)} does not fit into the outline of {_mm(outline)}")
    if any(f > limit for f, limit in zip(frame, limits, strict=True)):
        raise ValueError(f"the outline of {_mm(outline)} must be at most {_PAGE[0] - 10} mm x {_PAGE[1] - 60} mm")
    page = np.full((_PAGE[1] * _PIXELS_PER_MM, _PAGE[0] * _PIXELS_PER_MM), 255, np.uint8)
    left, top = (page.shape[1] - frame[0]) // 2, 10 * _PIXELS_PER_MM
    cv2.rectangle(page, (left - 1, top - 1), (left + frame[0], top + frame[1]), 160, 1)
    x, y = left + (frame[0] - pixels[0]) // 2, top + (frame[1] - pixels[1]) // 2
    page[y : y + pixels[1], x : x + pixels[0]] = board.opencv().generateImage((pixels[0], pixels[1]))
    row = top + frame[1] + 10 * _PIXELS_PER_MM
    for line in (
        f"{board.columns} x {board.rows} squares of {1000 * board.square:g} mm, markers of {1000 * board.marker:g} mm "
        f"({board.dictionary})",
        f"Board {_mm(board.size)}, grey frame {_mm(outline)}",
        f"Print at 100 %. The line below is {_RULER} mm long.",
    ):
        cv2.putText(page, line, (left, row), cv2.FONT_HERSHEY_SIMPLEX, 1.2, 0, 2, cv2.LINE_AA)
        row += 7 * _PIXELS_PER_MM
    cv2.rectangle(page, (left, row), (left + _RULER * _PIXELS_PER_MM - 1, row + 4), 0, -1)
    for end in (left, left + _RULER * _PIXELS_PER_MM - 1):
        cv2.line(page, (end, row - 20), (end, row + 24), 0, 1)
    return page


def save_board(
    path: str | os.PathLike,
    board: Board = Board(),
    *,
    outline: tuple[float, float] = (0.15, 0.15),
) -> None:
    """Write `board_image` to a file that prints at its true size.

    Args:
        path: path of a PDF or PNG file.
        board: the board.
        outline: see `board_image`.

    Raises:
        ValueError: the path ends in neither .pdf nor .png, or see `board_image`.
        OSError: the file cannot be written.
    """
    path = Path(path)
    kind = path.suffix.lower()
    if kind not in (".pdf", ".png"):
        raise ValueError(f"the board can be written as .pdf or .png, got {path}")
    page = Image.fromarray(board_image(board, outline=outline))
    dots_per_inch = 25.4 * _PIXELS_PER_MM

    def write(temporary: Path) -> None:
        if kind == ".pdf":
            page.save(temporary, "PDF", resolution=dots_per_inch)
        else:
            page.save(temporary, "PNG", dpi=(dots_per_inch, dots_per_inch))

    _files.write_whole(path, write)


def find_board(image: NDArray[np.uint8], board: Board = Board()) -> FoundCorners:
    """Find the corners of a board in a raw image.

    Args:
        image: raw image, RGB or grey, uint8.
        board: the printed board.

    Returns:
        The corners that were found, or none.
    """
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image
    parameters = cv2.aruco.DetectorParameters()
    parameters.adaptiveThreshWinSizeMax = max(23, 3 + gray.shape[1] // 160 * 10)  # markers grow with the image
    detector = cv2.aruco.CharucoDetector(board.opencv(), cv2.aruco.CharucoParameters(), parameters)
    pixels, numbers, _, _ = detector.detectBoard(gray)
    if pixels is None or numbers is None:
        return FoundCorners(np.zeros(0, np.int64), np.zeros((0, 2)))
    return FoundCorners(numbers.reshape(-1).astype(np.int64), pixels.reshape(-1, 2).astype(np.float64))


def calibrate(
    images: Sequence[NDArray[np.uint8]],
    board: Board = Board(),
    *,
    on_pad: int = 0,
    largest_error: float = 1.0,
) -> Calibration:
    """Calibrate a lens and its place in the sensor from images of a board.

    In one image the board lies on the gel's outer face with its print towards the camera, centred on the pad and with
    its edges parallel to the pad's. Which of its edges is at the top does not matter. In the other images the board has
    different distances, places and tilts.

    The fit minimises the sum of squared distances (with a soft L1 loss) between the corners that were found and their
    projections, over the lens and one pose of the board per image.

    Args:
        images: raw images of one camera, RGB or grey, uint8, all of one size.
        board: the printed board.
        on_pad: index of the image in which the board lies on the pad.
        largest_error: largest root mean square of the reprojection errors of an image (pixels).

    Returns:
        The lens, whose pose is that of the pad, and the errors of each image.

    Raises:
        CalibrationError: too few images show the board, the board on the pad is not found or not parallel to the image,
            the boards are too similar, or the error of an image is too large.
        ValueError: the images have different sizes or are not uint8, or `on_pad` is no index of an image.
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
    """The part of `calibrate` that follows `find_board`, for corners that were found while the images were taken.

    Args:
        found: the corners of each image.
        size: width and height of the raw images (pixels).
        board: see `calibrate`.
        on_pad: see `calibrate`.
        largest_error: see `calibrate`.

    Returns:
        See `calibrate`.

    Raises:
        CalibrationError: see `calibrate`.
        ValueError: `on_pad` is no index of an image.
    """
    width, height = size
    if not 0 <= on_pad < max(1, len(found)):
        raise ValueError(f"on_pad must be the index of one of the {len(found)} images, got {on_pad}")
    if len(found) < FEWEST_IMAGES:
        raise CalibrationError(
            f"a calibration needs at least {FEWEST_IMAGES} images of the board in different poses, got {len(found)}."
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
    """The corners of all usable images in one list."""

    image: NDArray[np.int64]  # (n,) index of the usable image
    points: NDArray[np.float64]  # (n, 3) board frame (m)
    pixels: NDArray[np.float64]  # (n, 2)
    number: int  # usable images

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
    """A lens and the poses of the boards, as the unknowns of the fit."""

    focal: tuple[float, float]  # pixels per radian
    center: tuple[float, float]  # pixels
    k: tuple[float, float, float, float]
    poses: NDArray[np.float64]  # (images, 6) rotation vector and translation from the board to the camera
    residuals: NDArray[np.float64]  # (n, 2) pixels
    largest_angle: float  # rad

    @property
    def unknowns(self) -> NDArray[np.float64]:
        return np.concatenate([self.focal, self.center, self.k, self.poses.ravel()])

    @classmethod
    def of(cls, views: _Views, unknowns: NDArray[np.float64]) -> "_Fit":
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
    """The best equidistant lens among those of several fields of view, with a pose for each board."""
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
            "no pose of the boards fits their corners. Check that the board's numbers of squares and its dictionary "
            "are those of the print, and take images with more of the board in view."
        )
    return best


def _fitted(views: _Views, start: _Fit) -> _Fit:
    def residuals(unknowns: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.concatenate([_Fit.of(views, unknowns).residuals.ravel(), _PRIOR * unknowns[4:8]])

    result = optimize.least_squares(residuals, start.unknowns, x_scale="jac", loss="soft_l1", max_nfev=200)
    return _Fit.of(views, result.x)


def _common_size(images: Sequence[NDArray[np.uint8]]) -> tuple[int, int]:
    """Height and width of all images."""
    if not images:
        raise CalibrationError("there are no images. Take some with the board in different poses.")
    for i, image in enumerate(images):
        if image.dtype != np.uint8 or not (image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)):
            raise ValueError(
                f"image {i} must be uint8, grey or RGB, but it is {image.dtype} of shape {image.shape}. Read it with "
                "`Camera.read` or from a PNG file."
            )
    sizes = {image.shape[:2] for image in images}
    if len(sizes) > 1:
        names = ", ".join(f"{w}x{h}" for h, w in sorted(sizes))
        raise ValueError(f"the images must have one size, got {names}. Take all of them with the same settings.")
    height, width = images[0].shape[:2]
    return height, width


def _usable(counts: tuple[int, ...], on_pad: int) -> list[int]:
    """The images that show enough of the board, among them that of the board on the pad."""
    used = [i for i, count in enumerate(counts) if count >= FEWEST_CORNERS]
    missing = [i for i, count in enumerate(counts) if count == 0]
    few = [f"{i} ({count} corners)" for i, count in enumerate(counts) if 0 < count < FEWEST_CORNERS]
    lacking = ""
    if missing:
        lacking += f" The board was not found in {_listed(missing)}."
    if few:
        lacking += f" Fewer than {FEWEST_CORNERS} corners were found in {_listed(few)}."
    remedy = (
        " Check that the board is the printed one, that it is sharp, evenly lit and not overexposed, and that most of "
        "it is in view."
    )
    if on_pad not in used:
        raise CalibrationError(
            f"image {on_pad}, in which the board lies on the pad, shows {counts[on_pad]} of its corners, but "
            f"{FEWEST_CORNERS} are needed.{lacking}{remedy}"
        )
    if len(used) < FEWEST_IMAGES:
        raise CalibrationError(
            f"only {len(used)} of {len(counts)} images show enough of the board, but {FEWEST_IMAGES} are needed."
            f"{lacking}{remedy}"
        )
    return used


def _check_errors(errors: list[float | None], largest: float) -> None:
    bad = [f"{i} ({error:.2f} pixels)" for i, error in enumerate(errors) if error is not None and error > largest]
    if bad:
        raise CalibrationError(
            f"the reprojection error is larger than {largest:g} pixels in {_listed(bad)}. If these are few, leave them "
            "out: the board moved or the image is blurred. If they are most, check that the board is flat, that its "
            "squares measure what `Board.square` states, and that focus and image size did not change in between."
        )


def _check_tilts(poses: NDArray[np.float64]) -> None:
    normals = Rotation.from_rotvec(poses[:, :3]).as_matrix()[:, :, 2]
    spread = math.acos(float(np.clip((normals @ normals.T).min(), -1, 1)))
    if spread < LEAST_TILT:
        raise CalibrationError(
            f"the boards of all images are parallel within {math.degrees(spread):.0f} degrees, so the focal length is "
            f"not determined. Hold the board with tilts of 20 to 40 degrees to different sides in some images."
        )


def _pose_on_pad(
    pose: NDArray[np.float64], index: int
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """The sensor frame is that of the board on the pad, turned by quarters until x points to the image's right."""
    board = Rotation.from_rotvec(pose[:3])
    turns = [board * Rotation.from_euler("z", quarter * math.pi / 2) for quarter in range(4)]
    sensor = max(turns, key=lambda turn: turn.as_matrix()[0, 0])
    tilt = math.acos(float(np.clip(sensor.as_matrix()[2, 2], -1, 1)))
    twist = math.atan2(sensor.as_matrix()[1, 0], sensor.as_matrix()[0, 0])
    for angle, words in ((tilt, "tilted against"), (abs(twist), "turned in")):
        if angle > MOST_TILT_ON_PAD:
            raise CalibrationError(
                f"the board of image {index} is {words} the image plane by {math.degrees(angle):.0f} degrees, but on "
                f"the pad it must be parallel to the image's edges within {math.degrees(MOST_TILT_ON_PAD):.0f} "
                "degrees. Choose the image in which the board lies on the pad (`on_pad`), or mount the camera straight."
            )
    (x, y, z), (tx, ty, tz) = sensor.as_rotvec().tolist(), pose[3:].tolist()
    return (x, y, z), (tx, ty, tz)


def _listed(names: Sequence[object]) -> str:
    return f"image{'s' if len(names) > 1 else ''} {', '.join(map(str, names))}"


def _mm(size: Sequence[float]) -> str:
    return " x ".join(f"{1000 * side:g} mm" for side in size)
