"""`Recorder` writes both streams of a sensor to a folder, and `Replay` plays them back through the sensor's methods.

    visual.mkv             images without light, as a video that other programs can play
    tactile.mkv            images with light
    frames.jsonl           one line for each image: its stream, its times, and the proof of light
    sensor.json            only if a sensor file was given: a copy, with its background images
    manifest.json          the sensor (`Origin`) and the encoding, and at the end checksums of the files above

The manifest of an interrupted recording does not list the videos. Such a recording ends with the last line of
frames.jsonl whose image is in a video.
"""

import contextlib
import dataclasses
import json
import math
import os
import time
import zlib
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Literal

import av
import numpy as np

from sts_jax import storage
from sts_jax.hardware.sensor_file import Device, copy_sensor, sensor_file
from sts_jax.hardware.session import Origin, shot_facts, shot_of
from sts_jax.hardware.sts import Pair, Shot, Stream
from sts_jax.storage import DamagedFileError

FRAMES = "frames.jsonl"
Encoding = Literal["ffv1", "mjpeg"]

# Pixel format and options of each codec. FFV1 with Golomb codes, which are faster, motion JPEG at its best quality.
_CODECS = {
    "ffv1": ("bgr0", {"coder": "0", "slices": "4"}),
    "mjpeg": ("yuvj444p", {"qmin": "1", "qmax": "1"}),
}
_PER_IMAGE = {"cluster_time_limit": "0", "flush_packets": "1"}  # Matroska in parts of one image, each written at once
_AGAIN = "copy the recording again, or make a new one"
# Largest delay at which `stream` still returns an image (s). The buffer of a real sensor's camera holds 8 frames, which
# are about as much at 30 frames per second.
_LATE_S = 0.25
_NO_IMAGE = np.zeros((0, 0, 3), np.uint8)


@dataclasses.dataclass(frozen=True)
class _Facts:
    """The facts in the manifest of a recording."""

    encoding: Encoding
    origin: Origin


class Recorder(contextlib.AbstractContextManager["Recorder"]):
    """Writes the images of a sensor to a folder. `Replay` plays the recording back.

    If the process is killed, the newest image of each stream is lost. A power failure can lose the last seconds.
    """

    def __init__(
        self,
        folder: str | os.PathLike,
        origin: Origin,
        *,
        encoding: Encoding = "ffv1",
        file: str | os.PathLike | None = None,
    ):
        """Create the folder, which must be empty or missing.

        Args:
            encoding: "ffv1" is lossless. "mjpeg" is faster and needs about a quarter of the space.
            file: Path of the sensor file or of its folder, which is copied into the recording. None: no copy.
        """
        self.folder = Path(folder)
        self.counts = {"visual": 0, "tactile": 0}  # number of recorded images of each stream
        self._size = origin.height, origin.width
        self._encoding = encoding
        self._start_s: float | None = None  # time of the first image (s)
        self._videos: dict[Stream, tuple[av.container.OutputContainer, av.VideoStream]] = {}
        self._last: dict[Stream, int] = {}  # time of the last image of each video (ms)
        self._open = True
        if self.folder.exists() and (not self.folder.is_dir() or any(self.folder.iterdir())):
            raise FileExistsError(f"{self.folder} is not an empty folder: give the name of a new folder.")
        copied = {} if file is None else copy_sensor(file, self.folder)
        facts = {"encoding": encoding, "origin": dataclasses.asdict(origin)}
        self._manifest = storage.write_manifest(self.folder, copied, facts)
        self._lines = (self.folder / FRAMES).open("ab", buffering=0)

    def add(self, shot: Shot) -> None:
        """Write an image, which must be later than all images before. An error of the disk ends the recording."""
        if not self._open:
            raise ValueError(f"the recording in {self.folder} has ended: make a new one.")
        if shot.image.shape != (*self._size, 3):
            raise ValueError(
                f"the {shot.stream} image has shape {shot.image.shape}, but all images of this recording must have "
                f"shape {(*self._size, 3)}: make a new recording for images of another size."
            )
        self._start_s = shot.time_s if self._start_s is None else self._start_s
        try:
            container, video = self._videos.get(shot.stream) or self._begin(shot.stream)
            frame = av.VideoFrame.from_ndarray(shot.image, format="rgb24").reformat(format=video.pix_fmt)
            # Encoders need increasing times. Those of `FRAMES` are exact.
            frame.pts = max(round(1000 * (shot.time_s - self._start_s)), self._last.get(shot.stream, -1) + 1)
            self._last[shot.stream] = frame.pts
            container.mux(video.encode(frame))
            pixels = zlib.crc32(shot.image.tobytes()) if self._encoding == "ffv1" else None
            facts = {"stream": shot.stream, **shot_facts(shot), "pixels": pixels}
            self._lines.write((json.dumps({**facts, "checksum": storage.digest(facts)}) + "\n").encode())
        except OSError as error:
            self._end()
            raise OSError(
                f"cannot record to {self.folder}: {error.strerror}. {storage.remedy(error)}, and make a new recording. "
                "All images before are kept."
            ) from error
        self.counts[shot.stream] += 1

    def _begin(self, stream: Stream) -> tuple[av.container.OutputContainer, av.VideoStream]:
        container = av.open(str(self.folder / f"{stream}.mkv"), "w", format="matroska", options=_PER_IMAGE)
        pixels, options = _CODECS[self._encoding]
        video = container.add_stream(self._encoding, options=options)
        video.height, video.width = self._size
        video.pix_fmt, video.time_base = pixels, Fraction(1, 1000)
        video.codec_context.time_base = video.time_base
        self._videos[stream] = container, video
        return self._videos[stream]

    def _end(self) -> None:
        self._open = False
        self._lines.close()
        while self._videos:
            with contextlib.suppress(OSError):
                self._videos.popitem()[1][0].close()

    def close(self) -> None:
        """Close the files, and write the manifest. Closing twice is allowed."""
        if not self._open:
            return
        names = [FRAMES, *(f"{stream}.mkv" for stream in self._videos)]
        try:
            for container, video in self._videos.values():
                container.mux(video.encode())
                container.close()
        finally:
            self._end()
        files = {**self._manifest.files, **storage.checksums(self.folder, names)}
        storage.write_manifest(self.folder, files, self._manifest.facts)

    def __exit__(self, *_: object) -> None:
        self.close()


class Replay:
    """A recording of visual and tactile images, which is read with methods of a connected sensor (`STS`).

    An image that arrived 2 s after the beginning of the recording becomes available 2 s after `connect`, or after 1 s
    with `speed=2`. A program that reads too slowly misses images, as with a sensor. The times in each `Shot` are times
    of the replay on the clock `time.monotonic`.
    """

    def __init__(self, folder: str | os.PathLike, *, speed: float | None = 1.0):
        """Open a recording, and compare its checksums.

        Args:
            speed: Seconds of the recording that are played per second, > 0. None: as fast as the program reads,
                without missing images.
        """
        if speed is not None and not (speed > 0 and math.isfinite(speed)):
            raise ValueError(f"speed must be > 0 and finite, or None, got {speed}")
        self.folder, self._speed = Path(folder), speed
        self._stills = _recorded(self.folder)
        if not self._stills:
            raise ValueError(f"{self.folder} has no image: make a new recording.")
        self.device = Device.load(folder) if sensor_file(folder).exists() else None  # None: without a `sensor.json`
        self._shots: Iterator[Shot] | None = None
        self.skipped = 0  # images that were left out because the program read too slowly

    def connect(self) -> "Replay":
        """Start the replay, or start it again from the beginning."""
        self._shots = self._play(time.monotonic())
        return self

    def stream(self) -> Iterator[Shot]:
        """Iterate over the images in the order of the recording. Each step waits until its image is available."""
        if self._shots is None:
            raise RuntimeError(f"the replay of {self.folder} is not connected: call connect() first.")
        return self._shots

    def read(self) -> Pair:
        """Wait for a visual and a tactile image that become available after the call.

        A pair consists of successive images between which neither the camera nor the controller was connected again.
        With `speed=None`, it is the next pair. At the end of the recording, `EOFError` is raised.
        """
        called_s, last = time.monotonic(), None
        for shot in self.stream():
            if self._speed is not None and shot.time_s < called_s:
                continue
            connection = shot.epoch, shot.before.boot
            if last is not None and last.stream != shot.stream and connection == (last.epoch, last.before.boot):
                return Pair(last, shot) if shot.stream == "tactile" else Pair(shot, last)
            last = shot
        raise EOFError(f"{self.folder} has no further pair of images: call connect() to start again.")

    def __enter__(self) -> "Replay":
        return self if self._shots is not None else self.connect()

    def __exit__(self, *_: object) -> None:
        self._shots = None

    def _play(self, start_s: float) -> Iterator[Shot]:
        """The images, from a time on the clock `time.monotonic` (s)."""
        speed, first_s = self._speed or 1.0, self._stills[0][0].time_s
        frames = {stream: _frames(self.folder / f"{stream}.mkv") for stream in ("visual", "tactile")}
        for still, pixels in self._stills:
            frame = next(frames[still.stream])
            due_s = start_s + (still.time_s - first_s) / speed
            if self._speed is not None:
                if time.monotonic() > due_s + _LATE_S:
                    self.skipped += 1
                    continue
                time.sleep(max(due_s - time.monotonic(), 0.0))
            image = frame.to_ndarray(format="rgb24")
            if pixels not in (None, zlib.crc32(image.tobytes())):
                raise DamagedFileError(f"{self.folder / f'{still.stream}.mkv'} has a damaged image: {_AGAIN}.")
            image.flags.writeable = False
            before, shift_s = still.before, due_s - still.time_s / speed
            sent_s, acknowledged_s = (time_s / speed + shift_s for time_s in (before.sent_s, before.acknowledged_s))
            before = dataclasses.replace(before, sent_s=sent_s, acknowledged_s=acknowledged_s)
            until_s = still.until_s / speed + shift_s
            yield dataclasses.replace(still, image=image, time_s=due_s, before=before, until_s=until_s)


def _recorded(folder: Path) -> list[tuple[Shot, int | None]]:
    """The images of a recording, without their pixels, and the CRC-32 of their pixels in a lossless video."""
    manifest = storage.read_manifest(folder, _AGAIN, _Facts)
    if manifest is None:
        raise FileNotFoundError(f"{folder} holds no recording: give the folder of a recording.")
    storage.verify(folder, manifest, _AGAIN)
    # An interrupted program leaves an incomplete last line, and lines whose images are not in the videos yet.
    size = manifest.facts["origin"]["width"], manifest.facts["origin"]["height"]
    left = {stream: _count(folder / f"{stream}.mkv", size) for stream in ("visual", "tactile")}
    stills = []
    for number, line in enumerate((folder / FRAMES).read_bytes().split(b"\n")[:-1], 1):
        try:
            facts = dict(json.loads(line))
            checksum, stream = facts.pop("checksum", None), facts["stream"]  # older recordings have no checksum
            if checksum not in (None, storage.digest(facts)) or stream not in ("visual", "tactile"):
                raise ValueError(f"its checksum differs, or {stream!r} is no stream")
            del facts["stream"]
            pixels = facts.pop("pixels", None)
            still = shot_of(_NO_IMAGE, stream, facts)
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise DamagedFileError(f"{folder / FRAMES}, line {number}, is damaged ({error}): {_AGAIN}.") from error
        left[still.stream] -= 1
        if left[still.stream] >= 0:
            stills.append((still, pixels))
    return stills


def _count(path: Path, size: tuple[int, int]) -> int:
    """The number of frames of a video, whose program may have been interrupted before the first frame."""
    try:
        with av.open(str(path)) as container:
            video = container.streams.video[0]
            if (video.width, video.height) != size:
                raise DamagedFileError(f"{path} has {video.width} x {video.height} pixels, not {size}: {_AGAIN}.")
            return sum(packet.size > 0 for packet in container.demux(video=0))
    except (FileNotFoundError, EOFError):
        return 0


def _frames(path: Path) -> Iterator[av.VideoFrame]:
    with av.open(str(path)) as container:
        yield from container.decode(video=0)
