"""`Replay`: plays back recorded visual and tactile images through the same methods as a connected sensor."""

import bisect
import itertools
import math
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType

from sts_jax.hardware.camera import CameraError, CameraNotConnectedError, EndOfVideoError, StaleFrameError
from sts_jax.hardware.films import Film, RecordedFilm, Still, VideoFilm
from sts_jax.hardware.leds import Lit
from sts_jax.hardware.proof import LightError, Pair, Shot, Stream
from sts_jax.hardware.sensor_file import Device, sensor_file
from sts_jax.hardware.sts import first_still, stream_order

# Largest delay at which `stream` still returns an image (s). The buffer of a real sensor's camera holds 8 frames, which
# are about as much at 30 frames per second.
_LATE_S = 0.25


class Replay:
    """A recording of visual and tactile images, which is read with the same methods as a connected sensor (`STS`).

    ```python
    with hardware.Replay("runs/monday") as sensor:
        pair = sensor.read()
    ```

    The replay imitates the timing of the sensor. An image that arrived 2 s after the beginning of the recording becomes
    available 2 s after `connect`. With `speed=2`, it becomes available after 1 s. A program that reads too slowly
    misses images, as with a sensor. With `speed=None`, the replay waits for the program instead, and `stream` returns
    every image.

    The times in each returned `Shot` are times of the replay on the clock `time.monotonic`, not the recorded times. The
    time between two images of the replay is the time between them in the recording, divided by `speed`. A replay cannot
    switch lights, so it returns visual and tactile images in the order of the recording. Only one thread at a time may
    use a replay.

    Attributes:
        skipped: Number of images since `connect` that `stream`, `async_read` and `read_latest` left out because the
            program read too slowly.
    """

    def __init__(
        self,
        source: str | os.PathLike | tuple[str | os.PathLike, str | os.PathLike],
        *,
        speed: float | None = 1.0,
        loop: bool = False,
        fps: float | None = None,
    ):
        """Store the configuration. `connect` opens the files.

        Args:
            source: Folder of a recording that `Recorder` wrote, or the paths of two video files, the visual stream
                first. Frames of the two videos with the same number form a pair, so the videos must have the same
                length (a difference of one frame is allowed). Video files do not store when the lights changed, so
                all times in `Shot.before` and `Shot.until_s` are NaN.
            speed: Seconds of the recording that are played per second, > 0. None: as fast as the program reads,
                without missing images.
            loop: If True, the replay continues from the beginning after the end of the recording. In each repetition,
                `Shot.epoch` (number of the camera's connection) is larger than before. If False, reading beyond the end
                raises `EndOfVideoError`.
            fps: Frame rate of the two videos (frames per second). None: the rate in the header of the visual video.

        Raises:
            ValueError: `speed` is not positive and finite, or `fps` is given for a recording.
        """
        if speed is not None and not (speed > 0 and math.isfinite(speed)):
            raise ValueError(f"speed must be > 0 and finite, or None, got {speed}")
        if fps is not None and not isinstance(source, tuple):
            raise ValueError(
                f"fps is {fps}, but it must be None for a recording, whose folder contains the time of each image: "
                "leave out fps."
            )
        self._source, self._fps = source, fps
        self._speed, self._loop = speed, loop
        self._name = " and ".join(map(str, source)) if isinstance(source, tuple) else str(source)
        self._film: Film | None = None
        self.skipped = 0

    @classmethod
    def from_file(cls, path: str | os.PathLike, *, speed: float | None = 1.0, loop: bool = False) -> "Replay":
        """Create a replay of a recording. A program can call this method instead of `STS.from_file`.

        Args:
            path: Path of the recording's folder, or of the file `sensor.json` in this folder.
            speed: Seconds of the recording that are played per second, > 0. None: as fast as the program reads.
            loop: If True, the replay continues from the beginning after the end of the recording.

        Returns:
            The replay, which is not connected yet.

        Raises:
            ValueError: `speed` is not positive and finite.
        """
        return cls(sensor_file(path).parent, speed=speed, loop=loop)

    @property
    def device(self) -> Device | None:
        """The description of the recorded sensor, from the file `sensor.json` in the recording's folder.

        None if the recording has no such file.

        Raises:
            SensorFileError: The file is damaged, incomplete or of another version. Or a background image is missing or
                damaged.
        """
        if isinstance(self._source, tuple) or not sensor_file(self._source).exists():
            return None
        return Device.load(self._source)

    def connect(self, warmup_s: float = 0.0) -> "Replay":
        """Open the files and start the replay, or start it again from the beginning.

        Args:
            warmup_s: Time before the first image becomes available (s).

        Returns:
            This replay.

        Raises:
            FileNotFoundError: There is no recording, or one of its files is missing.
            DamagedFileError: A file of the recording is damaged or truncated.
            CameraError: A video cannot be read.
            ValueError: `warmup_s` is negative or not finite, or the recording is empty or has another version of the
                format. A replay of two video files also raises this error if the lengths of the videos differ by more
                than one frame, if the constructor argument `fps` is not positive and finite, or if a path names a
                camera device instead of a file.
        """
        if not 0 <= warmup_s < math.inf:
            raise ValueError(f"warmup_s must be >= 0 and finite, got {warmup_s}")
        self.disconnect()
        source = self._source
        film = VideoFilm(*source, self._fps) if isinstance(source, tuple) else RecordedFilm(Path(source))
        stills = film.stills
        self._streams = {still.stream for still in stills}
        self._pairs = _paired(stills)
        self._times_s = [still.time_s - stills[0].time_s for still in stills]
        steps = sorted(b - a for a, b in itertools.pairwise(self._times_s) if b > a) or [0.0]
        # A lap is one run through the recording. With `loop`, the numbers of images continue over all laps.
        self._length_s = self._times_s[-1] + steps[len(steps) // 2]  # duration of a lap (s)
        self._epochs = 1 + max(still.epoch for still in stills) - min(still.epoch for still in stills)
        self._position = 0  # number of the next image
        self._newest: tuple[int, int] | None = None  # numbers of the newest pair of `async_read` and `read_latest`
        self._fresh = False  # True until `async_read` has returned the newest pair
        self.skipped = 0
        self._film, self._start_s = film, time.monotonic() + warmup_s
        return self

    def disconnect(self) -> None:
        """Close the files. If the replay is not connected, nothing happens."""
        film, self._film = self._film, None
        if film is not None:
            film.close()

    def read(self, timeout_ms: float | None = None) -> Pair:
        """Wait for a visual and a tactile image that both become available after the call, and return this pair.

        With `speed=None`, return the pair that follows the last returned pair, without waiting.

        Args:
            timeout_ms: Longest wait (ms). None: no limit.

        Returns:
            The pair.

        Raises:
            ValueError: `timeout_ms` is not positive.
            CameraNotConnectedError: The replay is not connected.
            LightError: No pair becomes available within `timeout_ms`.
            EndOfVideoError: The recording has no more pairs.
            CameraError: The recording contains no pair, for example because it has images of one stream only.
            DamagedFileError: An image of the recording is damaged.
        """
        self._opened()
        limit_s = _limit_s(timeout_ms)
        if self._speed is not None:
            now_s = time.monotonic()
            self._position = max(self._position, self._first(lambda number: self._due_s(number) >= now_s))
        return self._waited(self._pair_from(self._position), limit_s)

    def async_read(self, timeout_ms: float | None = None) -> Pair:
        """Return the newest available pair that this method has not returned yet, or wait for the next one.

        A pair consists of a visual and a tactile image. With `speed=None`, return the pair that follows the last
        returned pair, without waiting.

        Args:
            timeout_ms: Longest wait (ms). None: no limit.

        Returns:
            The pair.

        Raises:
            ValueError: `timeout_ms` is not positive.
            CameraNotConnectedError: The replay is not connected.
            LightError: No pair becomes available within `timeout_ms`.
            EndOfVideoError: The recording has no more pairs.
            CameraError: The recording contains no pair, for example because it has images of one stream only.
            DamagedFileError: An image of the recording is damaged.
        """
        self._opened()
        limit_s = _limit_s(timeout_ms)
        self._look()
        pair = self._newest if self._fresh and self._newest is not None else self._pair_from(self._position)
        return self._waited(pair, limit_s)

    def read_latest(self, max_age_ms: float = 500.0) -> Pair:
        """Return the newest available pair of a visual and a tactile image, without waiting.

        The same pair may be returned several times.

        Args:
            max_age_ms: Largest allowed time since the older image of the pair became available (ms). With
                `speed=None`, it has no effect.

        Returns:
            The pair. With `speed=None`, it is the pair that `read` or `async_read` returned last.

        Raises:
            ValueError: `max_age_ms` is not positive.
            CameraNotConnectedError: The replay is not connected.
            StaleFrameError: No pair is available yet. Or the newest pair is older than `max_age_ms`, and more pairs
                follow.
            EndOfVideoError: The newest pair is older than `max_age_ms`, and no more pairs follow.
            CameraError: `speed` is a number, and the recording contains no pair, for example because it has images of
                one stream only.
            DamagedFileError: An image of the recording is damaged.
        """
        if not max_age_ms > 0:
            raise ValueError(f"max_age_ms must be > 0, got {max_age_ms}")
        self._opened()
        self._look()
        if self._newest is None:
            raise StaleFrameError(
                "no pair of a visual and a tactile image is available yet: call async_read() to wait for the first "
                "pair."
            )
        age_ms = 0.0 if self._speed is None else 1000 * (time.monotonic() - self._due_s(self._newest[0]))
        if age_ms > max_age_ms:
            self._pair_from(self._position)  # raises `EndOfVideoError` if there are no more pairs
            raise StaleFrameError(
                f"the newest pair of images is {age_ms:.0f} ms old, but at most {max_age_ms:g} ms are allowed: raise "
                "max_age_ms, or call read()."
            )
        return self._pair(*self._newest)

    def stream(self, duty: float | None = None, *, dwell: int = 1) -> Iterator[Shot]:
        """Iterate over the images in the order of the recording.

        Args:
            duty: Share of tactile images, 0 to 1. `duty` and `dwell` determine whether the next returned image is
                visual or tactile, as in `STS.stream`. Recorded images of the other kind are skipped. None: no image
                is skipped because of its kind.
            dwell: Number of successive images of the same kind, >= 1. It has no effect if `duty` is None.

        Returns:
            An iterator of images. Each step waits until its image is available. At the end of the recording, it raises
            `EndOfVideoError`.

        Raises:
            ValueError: An argument is out of range.
            CameraNotConnectedError: The replay is not connected.
            CameraError: The recording has only visual or only tactile images, but `duty` requires the other kind.
        """
        self._opened()
        if duty is None:
            return self._images(itertools.repeat(None))
        order = stream_order(duty, dwell)
        for stream, share in (("visual", 1 - duty), ("tactile", duty)):
            if share > 0 and stream not in self._streams:
                raise self._one_sided()
        return self._images(order)

    def wait_until_still(self, timeout_s: float = 10.0, *, window_s: float = 0.5) -> Shot:
        """Wait until nothing moves in the visual stream. `STS.wait_until_still` describes the criterion.

        Args:
            timeout_s: Time after the first image of this call at which the method gives up, in seconds of the
                recording.
            window_s: Time during which nothing may move, in seconds of the recording.

        Returns:
            The image at the end of the first `window_s` seconds without movement.

        Raises:
            NotStillError: There was no period of `window_s` without movement within `timeout_s`.
            EndOfVideoError: The recording ends before such a period is complete.
            CameraNotConnectedError: The replay is not connected.
            CameraError: The recording has no visual images.
        """
        scale = self._speed or 1.0
        return first_still(self.stream(0.0), timeout_s / scale, window_s / scale)

    def __enter__(self) -> "Replay":
        return self if self._film is not None else self.connect()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.disconnect()

    def __repr__(self) -> str:
        return f"Replay({self._name!r}, {'connected' if self._film is not None else 'not connected'})"

    def _opened(self) -> Film:
        """The open recording, or an error if the replay is not connected."""
        if self._film is None:
            raise CameraNotConnectedError(f"the replay of {self._name} is not connected: call connect() first.")
        return self._film

    def _due_s(self, number: int) -> float:
        """The time at which an image becomes available (s, `time.monotonic`)."""
        lap, index = divmod(number, len(self._times_s))
        return self._start_s + (lap * self._length_s + self._times_s[index]) / (self._speed or 1.0)

    def _first(self, fits: Callable[[int], bool]) -> int:
        """The number of the first image that fits a condition, if the recording repeats endlessly.

        Args:
            fits: Condition on the number of an image. All later images must fit it too.
        """
        end = 1
        while not fits(end - 1):
            end *= 2
        return bisect.bisect_left(range(end), True, key=fits)

    def _images(self, streams: Iterator[Stream | None]) -> Iterator[Shot]:
        """The next image of each of these streams. None: the next image of any stream."""
        for wanted in streams:
            stills = self._opened().stills
            while True:
                self._check_end(self._position)
                number, self._position = self._position, self._position + 1
                if wanted not in (None, stills[number % len(stills)].stream):
                    continue
                if self._speed is None or time.monotonic() <= self._due_s(number) + _LATE_S:
                    break
                self.skipped += 1
            yield self._shot(number)

    def _check_end(self, number: int) -> None:
        """Raise `EndOfVideoError` if there is no image of this number."""
        count = len(self._times_s)
        if not self._loop and number >= count:
            raise EndOfVideoError(
                f"the replay of {self._name} has ended after {count} images: call connect() to start it again, or "
                "create the replay with loop=True."
            )

    def _pair_from(self, number: int) -> tuple[int, int]:
        """The numbers of both images of the first pair that begins at this number or later.

        Raises:
            EndOfVideoError: There is no such pair.
            CameraError: The recording contains no pair.
        """
        if not self._pairs:
            raise self._one_sided()
        count = len(self._times_s)
        lap, index = divmod(number, count)
        place = bisect.bisect_left(self._pairs, (index, 0))
        if place == len(self._pairs):
            lap, place = lap + 1, 0
            self._check_end(lap * count)
        self._check_end(lap * count + self._pairs[place][1])
        first, second = self._pairs[place]
        return lap * count + first, lap * count + second

    def _one_sided(self) -> CameraError:
        if len(self._streams) == 2:
            return CameraError(
                f"{self._name} has images of both streams, but the camera or the LED controller was connected again "
                "between them, so they form no pairs: read them with stream(), or record again."
            )
        return CameraError(
            f"{self._name} has {' and '.join(sorted(self._streams))} images only, which form no pairs: read them with "
            "stream(), or record both streams."
        )

    def _look(self) -> None:
        """Update `_newest` to the newest pair that is available."""
        if self._speed is None:
            return
        now_s = time.monotonic()
        count = len(self._times_s)
        while True:
            # A reader that is many laps behind skips them at once, without a search for each pair.
            passed = int(max(now_s - self._due_s(self._position), 0) * self._speed / self._length_s) - 1
            self._position += max(passed, 0) * count if self._loop else 0
            try:
                pair = self._pair_from(self._position)
            except EndOfVideoError:
                return
            if self._due_s(pair[1]) > now_s:
                return
            self.skipped += 2 * self._fresh
            self._newest, self._fresh, self._position = pair, True, pair[1] + 1

    def _waited(self, pair: tuple[int, int], limit_s: float) -> Pair:
        """Wait for the pair with these numbers of images, and return the pair."""
        wait_s = 0.0 if self._speed is None else self._due_s(pair[1]) - time.monotonic()
        if wait_s > limit_s:
            raise LightError(
                f"{self._name}: the next pair of a visual and a tactile image becomes available in "
                f"{1000 * wait_s:.0f} ms, but timeout_ms is {1000 * limit_s:g}: raise timeout_ms. The recording may "
                "have a gap here."
            )
        self._newest, self._fresh, self._position = pair, False, max(self._position, pair[1] + 1)
        return self._pair(*pair)

    def _pair(self, first: int, second: int) -> Pair:
        one, two = self._shot(first), self._shot(second)
        return Pair(one, two) if one.stream == "visual" else Pair(two, one)

    def _shot(self, number: int) -> Shot:
        """Wait until the image of a number is available, and read it."""
        film = self._opened()
        lap, index = divmod(number, len(film.stills))
        still, due_s = film.stills[index], self._due_s(number)
        if self._speed is not None:
            time.sleep(max(due_s - time.monotonic(), 0.0))
        image = film.image(index)
        image.flags.writeable = False

        def moved(time_s: float) -> float:
            return due_s + (time_s - still.time_s) / (self._speed or 1.0)

        before = still.before
        return Shot(
            image=image,
            stream=still.stream,
            time_s=due_s,
            sequence=still.sequence,
            epoch=still.epoch + lap * self._epochs,
            before=Lit(before.levels, before.counter, before.boot, moved(before.sent_s), moved(before.acknowledged_s)),
            until_s=moved(still.until_s),
        )


def _paired(stills: tuple[Still, ...]) -> list[tuple[int, int]]:
    """The indices of the images of each pair: two successive images of different streams, from the same connection."""
    pairs, first = [], 0
    for index, still in enumerate(stills):
        one = stills[first]
        joined = (still.epoch, still.before.boot) == (one.epoch, one.before.boot)
        if joined and still.stream != one.stream:
            pairs.append((first, index))
            first = index + 1
        else:
            first = index
    return pairs


def _limit_s(timeout_ms: float | None) -> float:
    """The limit in seconds, infinite for None."""
    if timeout_ms is None:
        return math.inf
    if not timeout_ms > 0:
        raise ValueError(f"timeout_ms must be > 0, got {timeout_ms}")
    return timeout_ms / 1000
