"""Writes the live display of `experiments.live` as a picture or a video."""

import time
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont

from experiments.shared import drawing
from experiments.shared.live import Seen

VIDEOS = (".mp4", ".mkv", ".avi")

_SIDE = 240  # side of an image (pixels)
_GAP = 8  # distance between two images (pixels)
_HEAD = 24  # height of the titles (pixels)
_TEXT = 220  # width of the text (pixels)
_TITLES = ("visual, now", "tactile, now", "visual, predicted at rest", "tactile, predicted at rest")
_BAR = "#3f51b5"
_CODEC = cv2.VideoWriter.fourcc(*"mp4v")
_RATE = 10.0  # panels per second of a video
_EVERY_S = 1.0  # time between two panels that are kept for a picture (s)
_ROWS = 6  # largest number of panels of a picture, which are chosen evenly from those that were kept


def panel(seen: Seen) -> UInt8[np.ndarray, "height width 3"]:
    """Draw one snapshot of the live display as an RGB image.

    Such an image is called a panel. A panel shows the live images, the predicted images, the outcome probabilities, the
    prediction rate and the latency. All panels have the same size.
    """
    found = seen.predicted
    images = [seen.visual, seen.tactile, *([] if found is None else [found.visual, found.tactile])]
    sheet = Image.new("RGB", (4 * (_SIDE + _GAP) + _TEXT, _HEAD + _SIDE + _GAP), "white")
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(size=14)
    for column, (title, image) in enumerate(zip(_TITLES, images, strict=False)):
        left = column * (_SIDE + _GAP)
        pen.text((left + 2, 3), title, fill="black", font=font)
        small = cv2.resize(image, (_SIDE, _SIDE), interpolation=cv2.INTER_AREA)
        sheet.paste(Image.fromarray(small), (left, _HEAD))
    left, top = 4 * (_SIDE + _GAP), _HEAD
    for line in lines(seen):
        pen.text((left, top), line, fill="black", font=font)
        top += 20
    for name, chance in [] if found is None else found.outcomes:
        pen.text((left, top + 4), f"{name}  {chance:.0%}", fill="black", font=font)
        pen.rectangle((left, top + 24, left + 200, top + 32), outline="#bbb")
        pen.rectangle((left, top + 24, left + round(200 * chance), top + 32), fill=_BAR)
        top += 36
    return np.asarray(sheet)


def lines(seen: Seen) -> list[str]:
    """The prediction rate, the latency, the contact state and the remark on the image source, as lines of text."""
    found = seen.predicted
    latency = "" if seen.latency_s is None else f"latency {1000 * seen.latency_s:.0f} ms"
    known = found is not None and found.contact is not None
    touch = "contact unknown" if not known else "contact" if found and found.contact else "no contact"
    if found is not None and found.occupied is False:
        touch = "nothing on the pad"
    return [line for line in (f"{seen.rate:.1f} predictions/s", latency, touch, *seen.note.split(", ")) if line]


class PanelFile:
    """A file that shows the live display at several times, as a video or as a picture.

    An image of the display at one time is called a panel (function `panel`). A video has 10 panels per second. A
    picture has up to six panels, one below the other.
    """

    def __init__(self, path: Path):
        """Check the path.

        Args:
            path: Path of the file. Its suffix selects a picture or a video.

        Raises:
            ValueError: The suffix is neither a picture suffix nor a video suffix.
            OSError: The file cannot be written.
        """
        self._path = path
        self._is_video = path.suffix.lower() in VIDEOS
        if self._is_video:
            drawing.make_folder(path.parent)
        elif path.suffix.lower() in drawing.PICTURES:
            drawing.check_picture(path)
        else:
            known = ", ".join((*drawing.PICTURES, *VIDEOS))
            raise ValueError(f"--save is {path}, but its suffix must be one of {known}")
        self._panels: list[np.ndarray] = []  # panels of which the picture shows some
        self._writer: cv2.VideoWriter | None = None
        self._next_s = -float("inf")  # time at which the next panel is due (s)

    def add(self, seen: Seen) -> None:
        """If a panel is due, draw it and add it to the video or picture. A panel is an image of the display.

        A panel is due every 0.1 s for a video, and every second for a picture. Nothing is drawn while `seen.rate`
        (predictions per second) is 0. `close` writes the picture.

        Raises:
            OSError: The video cannot be written.
        """
        now_s = time.monotonic()
        if now_s < self._next_s or seen.rate == 0:
            return
        period_s = 1 / _RATE if self._is_video else _EVERY_S
        late = self._next_s < now_s - 1
        image, self._next_s = panel(seen), (now_s if late else self._next_s) + period_s
        if not self._is_video:
            self._panels.append(image)
            return
        if self._writer is None:
            height, width = image.shape[:2]
            self._writer = cv2.VideoWriter(str(self._path), _CODEC, _RATE, (width, height))
            if not self._writer.isOpened():
                raise OSError(f"OpenCV cannot write a video to {self._path}: give another path with --save")
        self._writer.write(cv2.cvtColor(image, cv2.COLOR_RGB2BGR))

    def close(self) -> bool:
        """Write the picture, or complete the video. Returns False if there was no panel to write."""
        if self._writer is not None:
            self._writer.release()
        elif self._panels:
            chosen = np.unique(np.linspace(0, len(self._panels) - 1, _ROWS).round().astype(int))
            picture = Image.fromarray(np.vstack([self._panels[index] for index in chosen]))
            drawing.write_picture(self._path, picture)
        return self._writer is not None or bool(self._panels)
