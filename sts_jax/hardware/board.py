"""ChArUco board for the calibration of a lens: dimensions of the board, page to print, and detection in images."""

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sts_jax import storage

_PAGE = (210, 297)  # width and height of A4 (mm)
_PIXELS_PER_MM = 10
_RULER = 100  # length of the printed ruler (mm)


@dataclasses.dataclass(frozen=True)
class Board:
    """A ChArUco board: a chessboard with an ArUco marker in each white square.

    The frame of the board has its origin at the centre of the board. If you look at the printed side, x points to the
    right, y points downwards, and z points into the paper.

    Raises:
        ValueError: An argument is out of range.
    """

    columns: int = 9  # number of squares in a row, at least 4
    rows: int = 9  # number of squares in a column, at least 4
    square: float = 0.016  # side of a square (m)
    marker: float = 0.012  # side of a marker (m)
    dictionary: str = "DICT_4X4_50"  # name of one of OpenCV's predefined dictionaries of markers

    def __post_init__(self) -> None:
        for name in ("columns", "rows"):
            if getattr(self, name) < 4:
                raise ValueError(f"{name} must be >= 4, got {getattr(self, name)}")
        if not 0 < self.marker < self.square < 1:
            raise ValueError(
                f"a board must have 0 < marker < square < 1 m, got marker={self.marker} and square={self.square}"
            )
        if not self.dictionary.startswith("DICT_") or not hasattr(cv2.aruco, self.dictionary):
            raise ValueError(
                f"dictionary must be the name of one of OpenCV's predefined dictionaries, such as 'DICT_4X4_50', got "
                f"{self.dictionary!r}"
            )
        known = len(self._markers().bytesList)
        if self.columns * self.rows // 2 > known:
            raise ValueError(
                f"a board of {self.columns}x{self.rows} squares needs {self.columns * self.rows // 2} markers, but "
                f"{self.dictionary} has {known}. Choose a larger dictionary or fewer squares."
            )

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the board (m)."""
        return self.columns * self.square, self.rows * self.square

    @property
    def corners(self) -> NDArray[np.float64]:
        """Positions of the n inner corners of the chessboard in the board's frame (m), shape (n, 3), row by row."""
        middle = np.array([*self.size, 0.0]) / 2
        return np.asarray(self.opencv().getChessboardCorners(), np.float64) - middle

    def opencv(self) -> "cv2.aruco.CharucoBoard":
        """Return the same board as an OpenCV object.

        OpenCV's frame of the board has its origin at the top left corner. The frame of this class has its origin at
        the centre. The axes of both frames have the same directions.
        """
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.square, self.marker, self._markers())

    def _markers(self) -> "cv2.aruco.Dictionary":
        return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))


@dataclasses.dataclass(frozen=True)
class FoundCorners:
    """The corners of a board that were found in an image."""

    numbers: NDArray[np.int64]  # row of each corner in `Board.corners`, shape (n,)
    pixels: NDArray[np.float64]  # raw pixel coordinates (column, row) of each corner, shape (n, 2)


def board_image(board: Board = Board(), *, outline: tuple[float, float] = (0.15, 0.15)) -> NDArray[np.uint8]:
    """Draw an A4 page with the board, a frame around the board, a text with all dimensions, and a ruler of 100 mm.

    Print the page, and cut it along the frame.

    Args:
        board: The board to draw.
        outline: Width and height of the frame around the board (m). Use the width and height of the sensor's gel pad,
            so that the cut sheet covers the pad exactly and the board is in the middle of the pad.

    Returns:
        Grey image with 10 pixels per mm, shape (2970, 2100), uint8.

    Raises:
        ValueError: The board does not fit into the frame, or the frame does not fit on the page.
    """
    frame = [round(1000 * side * _PIXELS_PER_MM) for side in outline]
    pixels = [round(1000 * side * _PIXELS_PER_MM) for side in board.size]
    limits = [(_PAGE[0] - 10) * _PIXELS_PER_MM, (_PAGE[1] - 60) * _PIXELS_PER_MM]
    if any(p > f for p, f in zip(pixels, frame, strict=True)):
        raise ValueError(
            f"the board of {_mm(board.size)} does not fit into outline={_mm(outline)}: use smaller or fewer squares, "
            "or a larger outline"
        )
    if any(f > limit for f, limit in zip(frame, limits, strict=True)):
        raise ValueError(
            f"the frame around the board has the size outline={_mm(outline)}, but it must be at most "
            f"{_PAGE[0] - 10} mm x {_PAGE[1] - 60} mm to fit on the A4 page: use a smaller outline"
        )
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
    """Save the page that `board_image` draws.

    The file also contains the resolution of the page, so that a print at 100 % has the true size.

    Args:
        path: Path of the file, ending in .pdf or .png.
        board: The board to draw.
        outline: Width and height of the frame around the board (m), usually the size of the sensor's gel pad.

    Raises:
        ValueError: The path does not end in .pdf or .png, the board does not fit into the frame, or the frame does not
            fit on the page.
        OSError: The file cannot be written.
    """
    path = Path(path)
    kind = path.suffix.lower()
    if kind not in (".pdf", ".png"):
        raise ValueError(f"path must end in .pdf or .png, got {path}")
    page = Image.fromarray(board_image(board, outline=outline))
    dots_per_inch = 25.4 * _PIXELS_PER_MM

    def write(temporary: Path) -> None:
        if kind == ".pdf":
            page.save(temporary, "PDF", resolution=dots_per_inch)
        else:
            page.save(temporary, "PNG", dpi=(dots_per_inch, dots_per_inch))

    storage.write_whole(path, write)


def find_board(image: NDArray[np.uint8], board: Board = Board()) -> FoundCorners:
    """Find the corners of a board in a raw image, which comes from the camera without any changes.

    Args:
        image: Raw image, shape (height, width, 3) for RGB or (height, width) for grey, uint8.
        board: The printed board.

    Returns:
        The corners that were found. If the board is not found, the arrays of the result are empty.
    """
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image
    parameters = cv2.aruco.DetectorParameters()
    parameters.adaptiveThreshWinSizeMax = max(23, 3 + gray.shape[1] // 160 * 10)  # markers grow with the image
    detector = cv2.aruco.CharucoDetector(board.opencv(), cv2.aruco.CharucoParameters(), parameters)
    pixels, numbers, _, _ = detector.detectBoard(gray)
    if pixels is None or numbers is None:
        return FoundCorners(np.zeros(0, np.int64), np.zeros((0, 2)))
    return FoundCorners(numbers.reshape(-1).astype(np.int64), pixels.reshape(-1, 2).astype(np.float64))


def _mm(size: Sequence[float]) -> str:
    """A size in m as a text such as "150 mm x 150 mm"."""
    return " x ".join(f"{1000 * side:g} mm" for side in size)
