"""`Recorder` writes both streams of a sensor to a folder, and `Replay` plays them back through the sensor's methods.

    recording.json         the sensor (`Origin`), the encoding, and the settling times of the lights
    visual.mkv             images without light, as a video that other programs can play
    tactile.mkv            images with light
    frames.jsonl           one line for each image: its stream, its times, and the proof of light
    sensor.json            only if a sensor file was given: a copy, with its background images
    manifest.json          checksums of the files above, written at the end

The manifest of an interrupted recording does not list the videos. Such a recording ends with the last line of
frames.jsonl whose image is in a video.
"""

import collections
import contextlib
import dataclasses
import datetime
import itertools
import json
import math
import os
import statistics
import time
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Literal

import av
import numpy as np

from sts_jax import storage
from sts_jax.hardware import protocol
from sts_jax.hardware.leds import Lit
from sts_jax.hardware.proof import Pair, Settling, Shot, Stream
from sts_jax.hardware.sensor_file import Device, copy_sensor, sensor_file
from sts_jax.hardware.session import Origin, shot_facts, shot_of
from sts_jax.storage import DamagedFileError

HEAD, FRAMES = "recording.json", "frames.jsonl"
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


class Recorder:
    """Writes the images of a sensor to a folder. `Replay` plays the recording back.

    ```python
    with hardware.STS.from_file("bench") as sensor:
        with hardware.Recorder("runs/monday", hardware.Origin.of(sensor), file="bench") as recorder:
            for shot in sensor.stream():
                recorder.add(shot)
    ```

    If the process is killed, the newest image of each stream is lost. A power failure can lose the last seconds.

    Attributes:
        folder: Folder of the recording.
        counts: Number of recorded images of each stream.
    """

    def __init__(
        self,
        folder: str | os.PathLike,
        origin: Origin,
        *,
        settling: Settling | None = None,
        encoding: Encoding = "ffv1",
        file: str | os.PathLike | None = None,
    ):
        """Create the folder.

        Args:
            folder: Folder of the recording, which must be empty or missing.
            origin: Identity of the sensor.
            settling: Settling times of the lights, which are stored with the recording. None: not stored.
            encoding: "ffv1" is lossless. "mjpeg" is faster and needs about a quarter of the space.
            file: Path of the sensor file or of its folder, which is copied into the recording. None: no copy.
        """
        self.folder = Path(folder)
        self.counts = {"visual": 0, "tactile": 0}
        self._size = origin.height, origin.width
        self._encoding = encoding
        self._start_s: float | None = None  # time of the first image (s)
        self._videos: dict[str, tuple[av.container.OutputContainer, av.VideoStream]] = {}
        self._open = True
        if self.folder.exists() and (not self.folder.is_dir() or any(self.folder.iterdir())):
            raise FileExistsError(f"{self.folder} is not an empty folder: give the name of a new folder.")
        self.folder.mkdir(parents=True, exist_ok=True)
        self._copied = {} if file is None else copy_sensor(file, self.folder)
        head = {
            "encoding": encoding,
            "origin": dataclasses.asdict(origin),
            "settling": None if settling is None else dataclasses.asdict(settling),
            "begun": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        }
        storage.write_json(self.folder / HEAD, head)
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
            container, video = self._videos.get(shot.stream) or self._video(shot.stream)
            frame = av.VideoFrame.from_ndarray(shot.image, format="rgb24").reformat(format=video.pix_fmt)
            frame.pts = round(1000 * (shot.time_s - self._start_s))
            container.mux(video.encode(frame))
            self._lines.write((json.dumps({"stream": shot.stream, **shot_facts(shot)}) + "\n").encode())
        except OSError as error:
            self._end()
            raise OSError(
                f"cannot record to {self.folder}: {error.strerror}. {storage.remedy(error)}, and make a new recording. "
                "All images before are kept."
            ) from error
        self.counts[shot.stream] += 1

    def _video(self, stream: Stream) -> tuple[av.container.OutputContainer, av.VideoStream]:
        """Begin the video of a stream."""
        container = av.open(str(self.folder / f"{stream}.mkv"), "w", format="matroska", options=_PER_IMAGE)
        pixels, options = _CODECS[self._encoding]
        video = container.add_stream(self._encoding, options=options)
        video.height, video.width = self._size
        video.pix_fmt, video.time_base = pixels, Fraction(1, 1000)
        video.codec_context.time_base = video.time_base
        self._videos[stream] = container, video
        return self._videos[stream]

    def _end(self) -> None:
        """Close the files."""
        self._open = False
        self._lines.close()
        while self._videos:
            with contextlib.suppress(OSError):
                self._videos.popitem()[1][0].close()

    def close(self) -> None:
        """Close the files, and write the manifest. Closing twice is allowed."""
        if not self._open:
            return
        try:
            for container, video in self._videos.values():
                container.mux(video.encode())
                container.close()
        finally:
            self._end()
        written = {path.name for path in self.folder.iterdir()} - {storage.MANIFEST} - self._copied.keys()
        files = {**self._copied, **storage.checksums(self.folder, sorted(written))}
        storage.write_manifest(self.folder, files)

    def __enter__(self) -> "Recorder":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Replay:
    """A recording of visual and tactile images, which is read with methods of a connected sensor (`STS`).

    ```python
    with hardware.Replay("runs/monday") as sensor:
        pair = sensor.read()
    ```

    An image that arrived 2 s after the beginning of the recording becomes available 2 s after `connect`, or after 1 s
    with `speed=2`. A program that reads too slowly misses images, as with a sensor. The times in each `Shot` are times
    of the replay on the clock `time.monotonic`.

    Attributes:
        skipped: Number of images since `connect` that were left out because the program read too slowly.
    """

    def __init__(
        self,
        source: str | os.PathLike | tuple[str | os.PathLike, str | os.PathLike],
        *,
        speed: float | None = 1.0,
        loop: bool = False,
    ):
        """Open a recording, and compare its checksums.

        Args:
            source: Folder of a recording, or the visual and the tactile video of another program. Frames of these
                videos with the same number form a pair, and their times of the proof of light are NaN.
            speed: Seconds of the recording that are played per second, > 0. None: as fast as the program reads,
                without missing images.
            loop: If True, the replay continues from the beginning after the end of the recording, with a larger
                `Shot.epoch`.
        """
        if speed is not None and not (speed > 0 and math.isfinite(speed)):
            raise ValueError(f"speed must be > 0 and finite, or None, got {speed}")
        self._speed, self._loop = speed, loop
        self._folder: Path | None = None
        if isinstance(source, tuple):
            self._name = " and ".join(map(str, source))
            self._videos: dict[Stream, Path] = {"visual": Path(source[0]), "tactile": Path(source[1])}
            self._stills = _unproven(self._videos)
        else:
            self._folder = sensor_file(source).parent
            self._name = str(self._folder)
            self._videos = {"visual": self._folder / "visual.mkv", "tactile": self._folder / "tactile.mkv"}
            self._stills = _recorded(self._folder, self._videos)
        if not self._stills:
            raise ValueError(f"{self._name} has no image: make a new recording.")
        self._shots: Iterator[Shot] | None = None
        self.skipped = 0

    @property
    def device(self) -> Device | None:
        """The recorded sensor, or None if the recording has no `sensor.json`."""
        if self._folder is None or not sensor_file(self._folder).exists():
            return None
        return Device.load(self._folder)

    def connect(self) -> "Replay":
        """Start the replay, or start it again from the beginning."""
        self.skipped = 0
        self._shots = self._play(time.monotonic())
        return self

    def stream(self) -> Iterator[Shot]:
        """Iterate over the images in the order of the recording. Each step waits until its image is available."""
        if self._shots is None:
            raise RuntimeError(f"the replay of {self._name} is not connected: call connect() first.")
        return self._shots

    def read(self) -> Pair:
        """Wait for a visual and a tactile image that become available after the call.

        A pair consists of successive images between which neither the camera nor the controller was connected again.
        With `speed=None`, it is the next pair. At the end of the recording, `EOFError` is raised.
        """
        called_s, last = time.monotonic(), None
        for shot in itertools.islice(self.stream(), 2 * len(self._stills)):
            if self._speed is not None and shot.time_s < called_s:
                continue
            connection = shot.epoch, shot.before.boot
            if last is not None and last.stream != shot.stream and connection == (last.epoch, last.before.boot):
                return Pair(last, shot) if shot.stream == "tactile" else Pair(shot, last)
            last = shot
        raise EOFError(f"{self._name} has no further pair of images: call connect() to start again, or use loop=True.")

    def __enter__(self) -> "Replay":
        return self if self._shots is not None else self.connect()

    def __exit__(self, *_: object) -> None:
        self._shots = None

    def _play(self, start_s: float) -> Iterator[Shot]:
        """The images, from a time on the clock `time.monotonic` (s)."""
        speed, first_s = self._speed or 1.0, self._stills[0].time_s
        steps = [b.time_s - a.time_s for a, b in itertools.pairwise(self._stills) if b.time_s > a.time_s]
        lap_s = self._stills[-1].time_s - first_s + (statistics.median(steps) if steps else 0.0)
        epochs = 1 + self._stills[-1].epoch - self._stills[0].epoch
        for lap in itertools.count() if self._loop else range(1):
            frames = {stream: _frames(path) for stream, path in self._videos.items()}
            for still in self._stills:
                frame = next(frames[still.stream])
                due_s = start_s + (lap * lap_s + still.time_s - first_s) / speed
                if self._speed is not None:
                    if time.monotonic() > due_s + _LATE_S:
                        self.skipped += 1
                        continue
                    time.sleep(max(due_s - time.monotonic(), 0.0))
                image = frame.to_ndarray(format="rgb24")
                image.flags.writeable = False
                before, shift_s = still.before, due_s - still.time_s / speed
                yield dataclasses.replace(
                    still,
                    image=image,
                    time_s=due_s,
                    epoch=still.epoch + lap * epochs,
                    before=dataclasses.replace(
                        before,
                        sent_s=before.sent_s / speed + shift_s,
                        acknowledged_s=before.acknowledged_s / speed + shift_s,
                    ),
                    until_s=still.until_s / speed + shift_s,
                )


def _recorded(folder: Path, videos: dict[Stream, Path]) -> list[Shot]:
    """The images of a recording, without their pixels."""
    if not (folder / HEAD).exists():
        raise FileNotFoundError(
            f"{folder} holds no recording ({HEAD} is missing): give the folder of a recording, or two videos."
        )
    manifest = storage.read_manifest(folder, _AGAIN)
    if manifest is not None:
        storage.verify(folder, manifest, _AGAIN)
    # An interrupted program leaves an incomplete last line, and lines whose images are not in the videos yet.
    left = collections.Counter({stream: _count(path) for stream, path in videos.items()})
    stills = []
    for number, line in enumerate((folder / FRAMES).read_bytes().split(b"\n")[:-1], 1):
        try:
            facts = json.loads(line)
            still = shot_of(_NO_IMAGE, facts["stream"], facts)
        except (ValueError, KeyError, TypeError) as error:
            raise DamagedFileError(f"{folder / FRAMES}, line {number}, is damaged ({error}): {_AGAIN}.") from error
        left[still.stream] -= 1
        if left[still.stream] >= 0:
            stills.append(still)
    return stills


def _unproven(videos: dict[Stream, Path]) -> list[Shot]:
    """The images of two videos without times of the light, without their pixels."""
    try:
        times = {stream: sorted(_times(path)) for stream, path in videos.items()}
    except EOFError as error:
        raise ValueError(f"a video is truncated ({error}): copy it again.") from error
    counts = {stream: len(seen) for stream, seen in times.items()}
    if abs(counts["visual"] - counts["tactile"]) > 1:
        raise ValueError(
            f"the visual video has {counts['visual']} frames, but the tactile video has {counts['tactile']}: cut both "
            "to the same period of time, so that frames with the same number show the same moment."
        )
    lit = {
        stream: Lit(levels, 0, 0, math.nan, math.nan)
        for stream, levels in (("visual", protocol.DARK), ("tactile", (255,) * 4))
    }
    return [
        Shot(_NO_IMAGE, stream, time_s, number, 0, lit[stream], math.nan)
        for number, time_s in enumerate(times["visual"][: min(counts.values())])
        for stream in videos
    ]


def _times(path: Path) -> list[float]:
    """The times of the frames of a video (s), in the order of the file."""
    with av.open(str(path)) as container:
        return [
            float((packet.pts or 0) * (packet.time_base or 0)) for packet in container.demux(video=0) if packet.size
        ]


def _count(path: Path) -> int:
    """The number of frames of a video, whose program may have been interrupted before the first frame."""
    try:
        return len(_times(path))
    except (FileNotFoundError, EOFError):
        return 0


def _frames(path: Path) -> Iterator[av.VideoFrame]:
    with av.open(str(path)) as container:
        yield from container.decode(video=0)
