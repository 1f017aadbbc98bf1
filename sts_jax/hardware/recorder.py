"""`Recorder`: writes the images of both streams of a sensor into video files, one image at a time.

A recording is a folder:

    recording.json    version of the format, encoding, and identity of the sensor
    visual.mkv        images without light, as a Matroska video that other programs can play
    tactile.mkv       images with light, as a Matroska video
    frames.jsonl      one line for each image: its time, its position in the video file, and the start and the end of a
                      time interval that contains the exposure, and in which the lights did not change
    sensor.json       only if a sensor file was given: a copy of this file. Its background images are copied too

Each image is written before its line in frames.jsonl. After an interruption at any time, each complete line therefore
refers to a complete image.
"""

import dataclasses
import datetime
import json
import os
import time
import zlib
from pathlib import Path
from types import TracebackType
from typing import Any

import cv2

from sts_jax import storage
from sts_jax.hardware import matroska
from sts_jax.hardware.proof import Settling, Shot
from sts_jax.hardware.sensor_file import copy_sensor
from sts_jax.hardware.session import Origin

FORMAT = 1  # version of the format of a recording. Incremented when older files can no longer be read
HEAD, FRAMES = "recording.json", "frames.jsonl"

_QUALITY = (cv2.IMWRITE_JPEG_QUALITY, 95, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)


def video_name(stream: str) -> str:
    """Return the file name of the video of a stream. `stream` is "visual" or "tactile"."""
    return f"{stream}.mkv"


class Recorder:
    """Writes the images of a sensor to a folder. `Replay` plays the recording back.

    ```python
    with hardware.STS.from_file("bench") as sensor:
        with hardware.Recorder("runs/monday", hardware.Origin.of(sensor), file="bench") as recorder:
            for shot in sensor.stream():
                recorder.add(shot)
    ```

    In this example, "bench" is the folder of the sensor file, and "runs/monday" is the new folder of the recording.

    When `add` returns, the image is in its file and survives if the process is killed. A power failure can lose the
    images of the last seconds, because the operating system writes them to the disk with a delay.

    Attributes:
        folder: Folder of the recording.
        counts: Number of recorded images of each stream, a dictionary with the keys "visual" and "tactile".
    """

    def __init__(
        self,
        folder: str | os.PathLike,
        origin: Origin,
        *,
        settling: Settling | None = None,
        encoding: str = "png",
        file: str | os.PathLike | None = None,
    ):
        """Create the folder and write `recording.json`.

        Args:
            folder: Folder of the recording. A missing folder is created. An existing folder must be empty.
            origin: Identity of the sensor.
            settling: Settling times of the sensor's lights, which are stored with the recording. None: not stored.
            encoding: "png" is lossless. "jpeg" (quality 95, full colour resolution) needs about a fifth of the space.
            file: Path of the sensor file or of its folder. The file is copied into the recording. None: no copy.

        Raises:
            FileExistsError: The folder is not empty.
            ValueError: The encoding is unknown.
            FileNotFoundError: There is no such sensor file.
            SensorFileError: The sensor file is damaged.
            OSError: The folder cannot be written to.
        """
        if encoding not in matroska.CODECS:
            raise ValueError(f"encoding must be one of {', '.join(matroska.CODECS)}, got {encoding!r}")
        self.folder = Path(folder)
        self.counts = {"visual": 0, "tactile": 0}
        self._encoding = encoding
        self._start_s: float | None = None  # time of the first image (s)
        self._size = origin.height, origin.width
        self._files: dict[str, int] = {}  # open file descriptors, by name
        if self.folder.exists() and (not self.folder.is_dir() or any(self.folder.iterdir())):
            raise FileExistsError(f"{self.folder} is not an empty folder: give the name of a new folder.")
        self.folder.mkdir(parents=True, exist_ok=True)
        if file is not None:
            copy_sensor(file, self.folder)
        storage.write_json(
            self.folder / HEAD,
            {
                "format": FORMAT,
                "encoding": encoding,
                **dataclasses.asdict(origin),
                "settling": None if settling is None else dataclasses.asdict(settling),
                "begun": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
            },
        )

    def add(self, shot: Shot) -> None:
        """Write an image to the video file of its stream.

        Args:
            shot: Image to write. It must be later than all images that were added before.

        Raises:
            ValueError: The image does not have the height and width in the argument `origin` of the constructor.
            OSError: The disk is full or the folder is not writable. All images that were added before are kept.
        """
        height, width = self._size
        if shot.image.shape != (height, width, 3):
            raise ValueError(
                f"the {shot.stream} image has shape {shot.image.shape}, but all images of this recording must have "
                f"shape {(height, width, 3)}: make a new recording for images of another size."
            )
        self._start_s = shot.time_s if self._start_s is None else self._start_s
        name, image = video_name(shot.stream), self._encoded(shot)
        data = matroska.cluster(max(round(1000 * (shot.time_s - self._start_s)), 0), image)
        end = self._append(name, data, head=matroska.header(width, height, self._encoding))
        taken_s = time.time() - (time.monotonic() - shot.time_s)
        line: dict[str, Any] = {
            "stream": shot.stream,
            "taken": datetime.datetime.fromtimestamp(taken_s, datetime.UTC).isoformat(timespec="milliseconds"),
            "time_s": shot.time_s,
            "sequence": shot.sequence,
            "epoch": shot.epoch,
            "before": dataclasses.asdict(shot.before),
            "until_s": shot.until_s,
            "offset": end - len(image),
            "bytes": len(image),
            "crc32": zlib.crc32(image),
        }
        self._append(FRAMES, (json.dumps(line) + "\n").encode())
        self.counts[shot.stream] += 1

    def close(self) -> None:
        """Close the files. Closing twice is allowed."""
        while self._files:
            os.close(self._files.popitem()[1])

    def __enter__(self) -> "Recorder":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _encoded(self, shot: Shot) -> bytes:
        """Encode the image as PNG or JPEG."""
        if self._encoding == "png":
            return cv2.imencode(".png", cv2.cvtColor(shot.image, cv2.COLOR_RGB2BGR))[1].tobytes()
        return cv2.imencode(".jpg", cv2.cvtColor(shot.image, cv2.COLOR_RGB2BGR), _QUALITY)[1].tobytes()

    def _append(self, name: str, data: bytes, head: bytes = b"") -> int:
        """Append data to a file. If writing fails, the file is unchanged.

        Args:
            name: Name of the file in the folder.
            data: Data to append.
            head: Data that is written first if the file is empty.

        Returns:
            New size of the file (bytes).
        """
        path = self.folder / name
        try:
            if name not in self._files:
                self._files[name] = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
            file = self._files[name]
            before = os.fstat(file).st_size
            data = data if before else head + data
            try:
                rest = memoryview(data)
                while rest:
                    rest = rest[os.write(file, rest) :]
            except OSError:
                os.ftruncate(file, before)
                raise
        except OSError as error:
            raise OSError(
                f"cannot write {path}: {error.strerror or error}. {storage.remedy(error)}. Everything that was "
                "recorded before is kept."
            ) from error
        return before + len(data)
