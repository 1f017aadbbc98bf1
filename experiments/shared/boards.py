"""Pictures of the calibration board: take them with a sensor, keep them in a folder, and calibrate the lens."""

import bisect
import dataclasses
import io
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image, UnidentifiedImageError

from sts_jax import hardware, optics, storage
from sts_jax.hardware.calibration import FEWEST_CORNERS, FEWEST_IMAGES, PARTS

STILL = 1.0  # largest median movement of the corners between two frames of a board that is held still (pixels)
_FIRST = "000.png"  # picture of the board on the pad
_LAY = "Lay the board on the pad, print to the camera, edges on edges."
_HOLD = "Hold the board above the pad, tilted by 20 to 40 degrees, each time at another place."

Say = Callable[[str], None]


def wait(text: str, every: float | None) -> str:
    """Show an instruction, then wait for the Enter key or for a number of seconds.

    Args:
        text: Instruction for the person.
        every: Time to wait (s). None: wait for the Enter key.

    Returns:
        The text that was typed before Enter, in lower case. It is empty if `every` is given.

    Raises:
        ValueError: `every` is None, but there is no keyboard.
    """
    if every is not None:
        print(f"{text} Continues in {every:g} s.", flush=True)
        time.sleep(every)
        return ""
    try:
        return input(f"{text} Then press Enter. ").strip().lower()
    except EOFError:
        raise ValueError(
            "the Enter key cannot be read, because the standard input has ended: give --every SECONDS to wait for a "
            "fixed time instead. To run without live pictures of the board, give --board-images FOLDER or --ideal-lens "
            "DEGREES in addition to --every"
        ) from None


@dataclasses.dataclass(frozen=True)
class Pictures:
    """The pictures of the calibration board in a folder, in the order of their names.

    In the first picture, the board lies on the pad.
    """

    folder: Path  # folder of the PNG files
    board: hardware.Board  # geometry of the printed board
    size: tuple[int, int]  # width and height of the pictures (pixels)
    names: tuple[str, ...] = ()  # file names
    found: tuple[hardware.FoundCorners, ...] = ()  # corners of the board in each picture

    @classmethod
    def read(cls, folder: Path, board: hardware.Board, size: tuple[int, int]) -> "Pictures":
        """Read all PNG files of a folder, and find the board in each.

        Args:
            folder: Folder of the PNG files.
            board: Geometry of the printed board.
            size: Width and height that the pictures must have (pixels).

        Raises:
            ValueError: A picture has another size or cannot be read.
        """
        pictures = cls(folder, board, size)
        for path in sorted(folder.glob("*.png")):
            try:
                with Image.open(path) as picture:
                    image = np.asarray(picture.convert("RGB"))
            except (OSError, UnidentifiedImageError) as error:
                raise ValueError(f"{path} cannot be read ({error}): delete this picture, or take it again") from error
            if image.shape[1::-1] != size:
                raise ValueError(
                    f"{path} has {image.shape[1]} x {image.shape[0]} pixels, but --width is {size[0]} and --height is "
                    f"{size[1]}: set these options to the size of the pictures, or take the pictures again"
                )
            pictures = pictures.with_one(path.name, hardware.find_board(image, board))
        return pictures

    def with_one(self, name: str, found: hardware.FoundCorners) -> "Pictures":
        """Return these pictures and one more, in the order of their names.

        Args:
            name: File name of the new picture.
            found: Corners of the board in the new picture.
        """
        place = bisect.bisect(self.names, name)
        names, there = (*self.names[:place], name, *self.names[place:]), self.found
        return dataclasses.replace(self, names=names, found=(*there[:place], found, *there[place:]))

    def describe(self) -> str:
        """Return a text with the number of covered parts of the image (`PARTS`) and the names of the uncovered parts.

        A part is covered if at least one picture shows a corner of the board in this part.
        """
        there = hardware.covered(self.found, self.size)
        missing = [part for part in PARTS if part not in there]
        return f"{len(there)} of {len(PARTS)} parts of the image covered" + (
            f", not yet {', '.join(missing)}" if missing else ""
        )

    def fit(self, pinhole: optics.Camera) -> hardware.Calibration:
        """Calibrate the lens, and check that the lens and the pictures cover the view of the sensor.

        The view is the part of the gel's outer face that rectified images show.

        Args:
            pinhole: Pinhole camera that defines the view of the sensor.

        Raises:
            CalibrationError: The pictures do not determine the lens, or the lens or the pictures do not cover the view.
        """
        try:
            calibration = hardware.fit_lens(self.found, self.size, self.board)
            hardware.check_view(calibration.lens, pinhole, calibration.largest_angle)
        except hardware.CalibrationError as error:
            numbers = "" if not self.names else f" Image 0 is {self.names[0]}. Images are numbered in order of names."
            raise hardware.CalibrationError(
                f"the calibration with the pictures in {self.folder} failed: {error}{numbers}"
            ) from error
        return calibration


def take(pictures: Pictures, sensor: hardware.STS, number: int, every: float | None, say: Say = print) -> Pictures:
    """Take pictures until the board was found in enough of them. Pictures in which it was not found are discarded.

    Each picture that is kept is immediately written to `pictures.folder`.

    Args:
        pictures: Pictures of an earlier run, which count towards `number`. If the picture of the board on the pad,
            `000.png`, is not among them, it is taken first.
        sensor: Connected sensor.
        number: Number of pictures in which the board must be found.
        every: Time to wait before each picture (s). None: wait for the Enter key.
        say: Function that receives one line of text for each picture.

    Returns:
        All pictures that were kept. There are fewer than `number` if the person typed `done`.

    Raises:
        OSError: A picture cannot be written.
        ValueError: `every` is None, and there is no keyboard.
    """
    while len(pictures.names) < number:
        enough = len(pictures.names) >= FEWEST_IMAGES
        lay = _FIRST not in pictures.names
        if lay:
            text = _LAY
        else:
            text = f"{_HOLD} {'Type `done` if there are enough pictures.' if enough and every is None else ''}".rstrip()
        typed = wait(text, every)
        if typed == "done" and enough and not lay:
            break
        image, found, problem = _picture(sensor, pictures.board)
        if problem:
            say(f"  picture not kept: {problem}")
            continue
        last = max((int(Path(name).stem) for name in pictures.names if Path(name).stem.isdecimal()), default=0)
        name = _FIRST if lay else f"{last + 1:03d}.png"
        _write(pictures.folder / name, image)
        pictures = pictures.with_one(name, found)
        say(f"  {name}: {len(found.numbers)} corners, {len(pictures.names)} of {number}, {pictures.describe()}")
    return pictures


def _picture(
    sensor: hardware.STS, board: hardware.Board
) -> tuple[UInt8[np.ndarray, "height width 3"], hardware.FoundCorners, str]:
    """Take a picture with the lights off. Returns it, its corners, and why it cannot be used (or an empty text)."""
    next(sensor.stream(0.0))  # turns the lights off
    first = hardware.find_board(sensor.camera.read().image, board)
    image = sensor.camera.read().image
    found = hardware.find_board(image, board)
    if len(found.numbers) < FEWEST_CORNERS:
        return image, found, f"{len(found.numbers)} corners of the board were found, but {FEWEST_CORNERS} are needed"
    _, before, after = np.intersect1d(first.numbers, found.numbers, return_indices=True)
    moved = np.hypot(*(found.pixels[after] - first.pixels[before]).T) if len(before) else np.array([np.inf])
    if np.median(moved) > STILL:
        return image, found, "the board moved while the picture was taken: hold it still"
    return image, found, ""


def _write(path: Path, image: UInt8[np.ndarray, "height width 3"]) -> None:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "PNG", compress_level=3)
    storage.write_bytes(path, buffer.getvalue())
