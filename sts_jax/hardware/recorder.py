"""Recording both streams of a sensor, one image at a time, into files that other programs read too.

A recording is a folder:

    recording.json    format, encoding, and the devices
    visual.mkv        the images without light, in a Matroska file
    tactile.mkv       the images with the light
    frames.jsonl      one line for each image: time, proof of its light, and its place in the video file
    sensor.json       a copy of the sensor file and of its backgrounds, if there is one

An image is written before its line. After an interruption at any moment, all lines but an unfinished last one are of
complete images.
"""

import dataclasses
import datetime
import json
import os
import shutil
import time
import zlib
from pathlib import Path
from types import TracebackType
from typing import Any

import cv2

from sts_jax import _files
from sts_jax.hardware import matroska
from sts_jax.hardware.recordings import encoded
from sts_jax.hardware.sensor_file import Device, sensor_file
from sts_jax.hardware.session import Origin
from sts_jax.hardware.settling import Settling
from sts_jax.hardware.shots import Shot

FORMAT = 1  # of the files of a recording, incremented when older files can no longer be read
HEAD, FRAMES = "recording.json", "frames.jsonl"

_QUALITY = (cv2.IMWRITE_JPEG_QUALITY, 95, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)


def video_name(stream: str) -> str:
    """The file of a stream in the folder of a recording."""
    return f"{stream}.mkv"


class Recorder:
    """Writes the images of a sensor to a folder, which `Replay` plays back.

    ```python
    with hardware.STS.from_file("bench") as sensor:
        with hardware.Recorder("runs/monday", hardware.Origin.of(sensor), file="bench") as recorder:
            for shot in sensor.stream():
                recorder.add(shot)
    ```

    When `add` returns, the image is in its file, also if the process is killed afterwards. A power failure can lose the
    last seconds, which the operating system has not written to the disk yet.
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
        """Make the folder.

        Args:
            folder: A new or an empty folder.
            origin: The sensor.
            settling: Its settling times, kept for the reader.
            encoding: "png" is lossless. "jpeg" (quality 95, full colour resolution) needs about a fifth of the space.
            file: The sensor file, of which a copy is kept with the recording. None: there is none.

        Raises:
            FileExistsError: The folder is not empty.
            ValueError: The encoding is unknown.
            SensorFileError: The sensor file is damaged.
            OSError: The folder cannot be written to.
        """
        if encoding not in matroska.CODECS:
            raise ValueError(f"encoding must be one of {', '.join(matroska.CODECS)}, got {encoding!r}")
        self.folder = Path(folder)
        self.counts = {"visual": 0, "tactile": 0}  # images on disk
        self._encoding = encoding
        self._start_s: float | None = None  # time of the first image (s)
        self._size = origin.height, origin.width
        self._files: dict[str, int] = {}  # open file descriptors, by name
        if self.folder.exists() and (not self.folder.is_dir() or any(self.folder.iterdir())):
            raise FileExistsError(f"{self.folder} is not an empty folder: give the name of a new one.")
        self.folder.mkdir(parents=True, exist_ok=True)
        if file is not None:
            _copy_sensor(sensor_file(file), self.folder)
        _files.write_json(
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
        """Write an image.

        Args:
            shot: An image that is later than the ones before.

        Raises:
            ValueError: The image has another size than those of the sensor.
            OSError: The disk is full or the folder is not writable. Everything that was added before is kept.
        """
        height, width = self._size
        if shot.image.shape != (height, width, 3):
            raise ValueError(
                f"the {shot.stream} image has shape {shot.image.shape}, but those of the recording have "
                f"{(height, width, 3)}: make a new recording for another size."
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
        if self._encoding == "png":
            return encoded(shot.image)
        return cv2.imencode(".jpg", cv2.cvtColor(shot.image, cv2.COLOR_RGB2BGR), _QUALITY)[1].tobytes()

    def _append(self, name: str, data: bytes, head: bytes = b"") -> int:
        """Append to a file, which begins with `head`, and return its new size. An error leaves the file as it was."""
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
                f"cannot write {path}: {error}. {_files.remedy(error)}. Everything that was recorded before is kept."
            ) from error
        return before + len(data)


def _copy_sensor(file: Path, folder: Path) -> None:
    """Copy a sensor file and its backgrounds."""
    device = Device.load(file)
    for background in (device.background_visual, device.background_tactile):
        if background is not None:
            shutil.copyfile(file.with_name(background.name), folder / background.name)
    shutil.copyfile(file, folder / "sensor.json")
