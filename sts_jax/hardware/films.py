"""`Film`: recorded visual and tactile images, from a folder that `Recorder` wrote or from two video files."""

import abc
import json
import math
import os
import zlib
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import cv2
import numpy as np
from jaxtyping import UInt8

from sts_jax import storage
from sts_jax.hardware import protocol
from sts_jax.hardware.camera import CameraConfig, CameraOpenError
from sts_jax.hardware.leds import Lit
from sts_jax.hardware.opencv import Capture
from sts_jax.hardware.proof import Stream
from sts_jax.hardware.recorder import FORMAT, FRAMES, HEAD, video_name
from sts_jax.storage import DamagedFileError

_AGAIN = "copy the recording again"
_RATE = 30.0  # frames per second of a video whose header states no rate
_UNEQUAL = 1  # largest difference between the lengths of two videos (frames)

Image = UInt8[np.ndarray, "height width 3"]


class Still(NamedTuple):
    """The description of a recorded image, without its pixels.

    The times of all images of a recording are on the same clock, whose zero is arbitrary.
    """

    stream: Stream
    time_s: float  # arrival of the frame (s)
    sequence: int  # number of the frame
    epoch: int  # number of the camera's connection
    before: Lit  # the controller's answer to the switch of the lights before the frame
    until_s: float  # time until which the lights are proven to be unchanged (s)


class Film(abc.ABC):
    """Base class for reading the images of a recording, which are numbered in the order of their times."""

    stills: tuple[Still, ...]  # descriptions of the images, in the order of their times

    @abc.abstractmethod
    def image(self, index: int) -> Image:
        """Return the RGB pixels of an image. Reading in the order of time is fastest.

        Args:
            index: Position of the image in `Film.stills`, the descriptions of all images.
        """

    @abc.abstractmethod
    def close(self) -> None:
        """Close the video files. Afterwards, `image` cannot be called. Closing twice is allowed."""


class _Place(NamedTuple):
    """The place of an encoded image in its video file."""

    offset: int  # position of the first byte
    size: int  # number of bytes
    crc32: int  # checksum of the bytes


class RecordedFilm(Film):
    """The images of a folder that `Recorder` has written."""

    def __init__(self, folder: Path):
        """Open a recording, and check that its video files contain all images that `frames.jsonl` lists.

        Args:
            folder: Folder of the recording.

        Raises:
            FileNotFoundError: The folder contains no recording, or a file of the recording is missing.
            OSError: A file cannot be read.
            DamagedFileError: A file is damaged or truncated.
            ValueError: The recording has no image, or has another version of the format.
        """
        self._folder = folder
        self._check_head()
        found = _lines(folder / FRAMES)
        self.stills = tuple(still for still, _ in found)
        self._places = tuple(place for _, place in found)
        self._files: dict[str, BinaryIO] = {}
        try:
            for stream in sorted({still.stream for still in self.stills}):
                self._open(stream)
        except BaseException:
            self.close()
            raise

    def _check_head(self) -> None:
        path = self._folder / HEAD
        try:
            head = storage.read_json(path, _AGAIN)
        except (FileNotFoundError, NotADirectoryError):
            raise FileNotFoundError(
                f"{self._folder} holds no recording ({HEAD} is missing): give the folder of a recording, or two videos."
            ) from None
        if not isinstance(head, dict) or head.get("format") != FORMAT:
            found = head.get("format") if isinstance(head, dict) else None
            raise ValueError(
                f"{path} has format {found!r}, but this version of sts_jax reads format {FORMAT}. Use the "
                "version that wrote the recording, or make a new recording."
            )

    def _open(self, stream: str) -> None:
        """Open the video file of a stream, and check that it contains all images that `frames.jsonl` lists."""
        path = self._folder / video_name(stream)
        places = [place for still, place in zip(self.stills, self._places, strict=True) if still.stream == stream]
        try:
            self._files[stream] = path.open("rb")
        except OSError as error:
            raise type(error)(
                f"{path} cannot be read ({error}). Number of images that {FRAMES} lists for this video: {len(places)}. "
                "Check the video, or copy the recording again."
            ) from error
        size = path.stat().st_size
        there = sum(place.offset + place.size <= size for place in places)
        if there < len(places):
            raise DamagedFileError(
                f"{path} is truncated: it has {there} of the {len(places)} images that {FRAMES} lists for the {stream} "
                f"stream. {_AGAIN.capitalize()}, or delete the lines of the missing images from {FRAMES}. They are the "
                f"last lines with stream {stream!r} (number of lines: {len(places) - there})."
            )

    def image(self, index: int) -> Image:
        """Return the RGB pixels of an image.

        Args:
            index: Position of the image in `Film.stills`, the descriptions of all images.

        Raises:
            DamagedFileError: The image is damaged.
        """
        still, place = self.stills[index], self._places[index]
        file = self._files[still.stream]
        file.seek(place.offset)
        data = file.read(place.size)
        if zlib.crc32(data) != place.crc32:
            raise DamagedFileError(
                f"image {index + 1} of {self._folder} is damaged, because its checksum differs from the one in "
                f"{FRAMES}: {_AGAIN}, or remove line {index + 1} of {FRAMES}."
            )
        image = cv2.cvtColor(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
        return np.asarray(image)

    def close(self) -> None:
        """Close the video files. Afterwards, `image` cannot be called. Closing twice is allowed."""
        while self._files:
            self._files.popitem()[1].close()


def _lines(path: Path) -> list[tuple[Still, _Place]]:
    """Read the lines of a `frames.jsonl` file, one for each image.

    A last line without a newline was interrupted while it was written, and is ignored.
    """
    try:
        lines = path.read_bytes().split(b"\n")[:-1]
    except OSError as error:
        raise type(error)(f"{path} cannot be read ({error}): {_AGAIN}.") from error
    found: list[tuple[Still, _Place]] = []
    for number, line in enumerate(lines, 1):
        try:
            values = json.loads(line)
            found.append((_still(values), _Place(values["offset"], values["bytes"], values["crc32"])))
        except (ValueError, KeyError, TypeError) as error:
            raise DamagedFileError(
                f"{path}, line {number}, is damaged ({type(error).__name__}: {error}): {_AGAIN}, or remove this line."
            ) from error
        if number > 1 and found[-1][0].time_s < found[-2][0].time_s:
            raise DamagedFileError(f"{path}, line {number}, has an earlier time than the line before: {_AGAIN}.")
    if not found:
        raise ValueError(f"{path} lists no image: make a new recording.")
    return found


def _still(values: dict[str, Any]) -> Still:
    if values["stream"] not in ("visual", "tactile"):
        raise ValueError(f"stream must be 'visual' or 'tactile', got {values['stream']!r}")
    lit = storage.decode(Lit, values["before"], "before")
    still = Still(
        values["stream"], float(values["time_s"]), values["sequence"], values["epoch"], lit, float(values["until_s"])
    )
    if not math.isfinite(still.time_s):
        raise ValueError(f"time_s must be finite, got {still.time_s}")
    return still


class VideoFilm(Film):
    """The images of two video files, one file for the visual stream and one for the tactile stream.

    Frames with the same number have the same time. A video file does not record when the lights were switched.
    In each `Still` (the description of an image), `until_s`, `before.sent_s` and `before.acknowledged_s` are therefore
    NaN.
    """

    def __init__(self, visual: str | os.PathLike, tactile: str | os.PathLike, fps: float | None = None):
        """Open both videos.

        Args:
            visual: Path of the video of the visual stream.
            tactile: Path of the video of the tactile stream. The numbers of frames of the two videos may differ by at
                most one.
            fps: Frames per second of both videos. None: the rate that the header of the visual video states.

        Raises:
            CameraError: A file is missing, damaged or not a video.
            ValueError: The numbers of frames differ by more than one, `fps` is not positive and finite, or a path
                names a device or a network stream.
        """
        if fps is not None and not (fps > 0 and math.isfinite(fps)):
            raise ValueError(f"fps must be > 0 and finite, got {fps}")
        self._videos: dict[Stream, _Video] = {}
        try:
            self._videos["visual"] = _Video(visual)
            self._videos["tactile"] = _Video(tactile)
            counts = {stream: video.count for stream, video in self._videos.items()}
            if abs(counts["visual"] - counts["tactile"]) > _UNEQUAL:
                raise ValueError(
                    f"{visual} has {counts['visual']} frames, but {tactile} has {counts['tactile']}: cut both to the "
                    "same period of time, so that frames with the same number show the same moment."
                )
        except BaseException:
            self.close()
            raise
        period_s = 1 / (fps or self._videos["visual"].rate or _RATE)
        unproven: dict[Stream, Lit] = {
            "visual": Lit(protocol.DARK, 0, 0, math.nan, math.nan),
            "tactile": Lit((255, 255, 255, 255), 0, 0, math.nan, math.nan),
        }
        self.stills = tuple(
            Still(stream, number * period_s, number, 0, lit, math.nan)
            for number in range(min(counts.values()))
            for stream, lit in unproven.items()
        )

    def image(self, index: int) -> Image:
        """Return the RGB pixels of an image.

        Reading in the order of time is fastest. To read an earlier image, the video is opened again.

        Args:
            index: Position of the image in `Film.stills`, the descriptions of all images.

        Raises:
            CameraOpenError: The video is truncated or damaged.
        """
        still = self.stills[index]
        return self._videos[still.stream].frame(still.sequence)

    def close(self) -> None:
        """Close the video files. Afterwards, `image` cannot be called. Closing twice is allowed."""
        while self._videos:
            self._videos.popitem()[1].capture.release()


class _Video:
    """A video file that is read forwards. To go back, the file is opened again."""

    def __init__(self, path: str | os.PathLike):
        self._config = CameraConfig(Path(path), None, None)
        if self._config.kind != "file":
            raise ValueError(f"{path} is the name of a camera, but it must be the path of a video file.")
        self._reopen()
        assert self.capture.frame_count is not None  # `Capture` raises an error for a file without a number of frames
        self.count, self.rate = self.capture.frame_count, self.capture.rate

    def _reopen(self) -> None:
        self.capture = Capture(self._config)
        self._next = 0  # number of the frame that is read next
        self._last: tuple[int, Image] | None = None

    def frame(self, number: int) -> Image:
        if self._last is not None and self._last[0] == number:
            return self._last[1]
        if number < self._next:
            self.capture.release()
            self._reopen()
        while self._next <= number:
            if not self.capture.grab():
                raise self._truncated()
            self._next += 1
        image = self.capture.retrieve()
        if image is None:
            raise self._truncated()
        self._last = number, image
        return image

    def _truncated(self) -> CameraOpenError:
        return CameraOpenError(
            f"{self._config.name} ends or is damaged at frame {self._next}, but its header states {self.count} frames: "
            "copy or record it again, or cut both videos before this frame."
        )
