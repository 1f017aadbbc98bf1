"""`Replay`: a recording of both streams that is read like a sensor."""

import bisect
import itertools
import math
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType

from sts_jax.hardware.camera_errors import CameraError, CameraNotConnectedError, EndOfVideoError, StaleFrameError
from sts_jax.hardware.films import Film, RecordedFilm, Still, VideoFilm
from sts_jax.hardware.leds import Lit
from sts_jax.hardware.sensor_file import Device, sensor_file
from sts_jax.hardware.shots import LightError, Pair, Shot, Stream
from sts_jax.hardware.sts import first_still, stream_order

_LATE_S = 0.25  # s by which an image may be late. The buffer of a sensor's camera holds as much at 30 frames a second


class Replay:
    """A recording that is read with the methods of `STS`.

    ```python
    with hardware.Replay("runs/monday") as sensor:
        pair = sensor.read()
    ```

    Images come at the times at which they came from the sensor. Whoever reads too slowly misses images, as at a sensor,
    and `skipped` counts them. With `speed=None` every image is returned, as fast as it is read. The times of a `Shot`
    are those of the recording, shifted to the clock `time.monotonic` and divided by the speed.

    The lights cannot be switched, so the order of the streams is that of the recording. One thread may use a replay at
    a time.
    """

    def __init__(
        self,
        source: str | os.PathLike | tuple[str | os.PathLike, str | os.PathLike],
        *,
        speed: float | None = 1.0,
        loop: bool = False,
        fps: float | None = None,
    ):
        """Keep the configuration. `connect` opens the files.

        Args:
            source: Folder of a recording, which `Recorder` wrote, or two video files of equal length: the visual and
                the tactile stream, whose frames of equal number belong together. Nothing proves their light, so
                `before` and `until_s` of their images have NaN as times.
            speed: Recorded seconds in a second. None: as fast as it is read, and without loss.
            loop: Start again at the end. `Shot.epoch` counts on. Without it, the end raises `EndOfVideoError`.
            fps: Frames per second of the videos. None: by the header of the visual one.

        Raises:
            ValueError: The speed is not positive, or `fps` is given for a recording.
        """
        if speed is not None and not (speed > 0 and math.isfinite(speed)):
            raise ValueError(f"speed must be > 0 and finite, or None, got {speed}")
        if fps is not None and not isinstance(source, tuple):
            raise ValueError(f"fps is {fps}, but a recording has its own times: leave it out.")
        self._source, self._fps = source, fps
        self._speed, self._loop = speed, loop
        self._name = " and ".join(map(str, source)) if isinstance(source, tuple) else str(source)
        self._film: Film | None = None
        self.skipped = 0  # images that were not returned because they came too late to the reader

    @classmethod
    def from_file(cls, path: str | os.PathLike, *, speed: float | None = 1.0, loop: bool = False) -> "Replay":
        """The recording that belongs to a sensor file, as `STS.from_file`.

        Args:
            path: Path of the copy of the sensor file in a recording, or of the recording.
            speed: As in `Replay`.
            loop: As in `Replay`.

        Returns:
            The replay, which is not connected yet.
        """
        return cls(sensor_file(path).parent, speed=speed, loop=loop)

    @property
    def device(self) -> Device | None:
        """The content of the sensor file that was recorded with the images, or None if there is none.

        Raises:
            SensorFileError: The file is damaged.
        """
        if isinstance(self._source, tuple) or not sensor_file(self._source).exists():
            return None
        return Device.load(self._source)

    def connect(self, warmup_s: float = 0.0) -> "Replay":
        """Open the files, and start the clock of the replay.

        Args:
            warmup_s: Time before the first image (s).

        Returns:
            This replay.

        Raises:
            FileNotFoundError: There is no recording, or a file of it is missing.
            TornFileError: A file of the recording is damaged or truncated.
            CameraError: A video cannot be read.
            ValueError: The recording is empty or of another format, or two videos have different lengths.
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
        self._length_s = self._times_s[-1] + steps[len(steps) // 2]  # of a lap
        self._epochs = 1 + max(still.epoch for still in stills) - min(still.epoch for still in stills)
        self._position = 0  # number of the next image, counted on over all laps
        self._newest: tuple[int, int] | None = None  # numbers of the newest pair of `async_read` and `read_latest`
        self._fresh = False  # whether `async_read` has not returned it yet
        self.skipped = 0
        self._film, self._start_s = film, time.monotonic() + warmup_s
        return self

    def disconnect(self) -> None:
        """Close the files. Without a connection, it does nothing."""
        film, self._film = self._film, None
        if film is not None:
            film.close()

    def read(self, timeout_ms: float | None = None) -> Pair:
        """Return the next pair whose two images come after the call. With `speed=None`: the next pair.

        Args:
            timeout_ms: Longest wait (ms), None: until it comes.

        Raises:
            LightError: No pair comes in time.
            EndOfVideoError: There are no more pairs.
            CameraError: The recording has images of one stream only.
        """
        self._opened()
        limit_s = _limit_s(timeout_ms)
        if self._speed is not None:
            now_s = time.monotonic()
            self._position = max(self._position, self._first(lambda number: self._due_s(number) >= now_s))
        return self._waited(self._pair_from(self._position), limit_s)

    def async_read(self, timeout_ms: float | None = None) -> Pair:
        """Return the newest pair that has come and was not returned yet, or wait for the next one.

        Args and errors are those of `read`.
        """
        self._opened()
        limit_s = _limit_s(timeout_ms)
        self._look()
        pair = self._newest if self._fresh and self._newest is not None else self._pair_from(self._position)
        return self._waited(pair, limit_s)

    def read_latest(self, max_age_ms: float = 500.0) -> Pair:
        """Return the newest pair that has come, without waiting. The same pair may be returned several times.

        Args:
            max_age_ms: Largest allowed time since the older of its images has come (ms).

        Raises:
            StaleFrameError: The newest pair is older, or there is none yet.
            EndOfVideoError: The newest pair is older, and there are no more.
            CameraError: The recording has images of one stream only.
        """
        if not max_age_ms > 0:
            raise ValueError(f"max_age_ms must be > 0, got {max_age_ms}")
        self._opened()
        self._look()
        if self._newest is None:
            raise StaleFrameError("no pair has come yet: call async_read() to wait for the first one.")
        age_ms = 0.0 if self._speed is None else 1000 * (time.monotonic() - self._due_s(self._newest[0]))
        if age_ms > max_age_ms:
            self._pair_from(self._position)  # raises an error at the end
            raise StaleFrameError(
                f"the newest pair is {age_ms:.0f} ms old, but at most {max_age_ms:g} ms are allowed: raise max_age_ms, "
                "or call read()."
            )
        return self._pair(*self._newest)

    def stream(self, duty: float | None = None, *, dwell: int = 1) -> Iterator[Shot]:
        """The images one after the other.

        Args:
            duty: Share of tactile images, 0 to 1, as in `STS.stream`. Recorded images between those of the wanted
                stream are left out. None: all images in their order.
            dwell: As in `STS.stream`. Without effect if `duty` is None.

        Raises:
            ValueError: An argument is out of range.
            EndOfVideoError: There are no more images.
            CameraError: The recording has no images of a stream that is asked for.
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
        """Wait until nothing moves in the visual stream, as `STS.wait_until_still`. Times are those of the recording.

        Raises:
            NotStillError: Something still moves.
            EndOfVideoError: The recording ends before.
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
        if self._film is None:
            raise CameraNotConnectedError(f"the replay of {self._name} is not connected: call connect() first.")
        return self._film

    def _due_s(self, number: int) -> float:
        """The time at which an image comes."""
        lap, index = divmod(number, len(self._times_s))
        return self._start_s + (lap * self._length_s + self._times_s[index]) / (self._speed or 1.0)

    def _first(self, fits: Callable[[int], bool]) -> int:
        """The number of the first image of the whole replay, in laps without end, that fits a rising condition."""
        end = 1
        while not fits(end - 1):
            end *= 2
        return bisect.bisect_left(range(end), True, key=fits)

    def _images(self, streams: Iterator[Stream | None]) -> Iterator[Shot]:
        """The next images of these streams. None: of any."""
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
        count = len(self._times_s)
        if not self._loop and number >= count:
            raise EndOfVideoError(
                f"{self._name} has ended after {count} images: connect again to replay it from its start, or give "
                "loop=True."
            )

    def _pair_from(self, number: int) -> tuple[int, int]:
        """The numbers of the first pair whose images have at least this number.

        Raises:
            EndOfVideoError: There is none.
            CameraError: The recording has no pair.
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
        return CameraError(
            f"{self._name} has {' and '.join(sorted(self._streams))} images only, in an order without pairs: read them "
            "with stream(), or record both streams."
        )

    def _look(self) -> None:
        """Find the newest pair that has come."""
        if self._speed is None:
            return
        now_s = time.monotonic()
        count = len(self._times_s)
        while True:
            # Far behind, all pairs but those of the last lap are left out
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
        """Wait for a pair, and return it."""
        wait_s = 0.0 if self._speed is None else self._due_s(pair[1]) - time.monotonic()
        if wait_s > limit_s:
            raise LightError(
                f"the next pair of {self._name} comes in {wait_s:.2f} s, but timeout_ms is {1000 * limit_s:g}: wait "
                "longer. The recording has a gap here."
            )
        self._newest, self._fresh, self._position = pair, False, max(self._position, pair[1] + 1)
        return self._pair(*pair)

    def _pair(self, first: int, second: int) -> Pair:
        one, two = self._shot(first), self._shot(second)
        return Pair(one, two) if one.stream == "visual" else Pair(two, one)

    def _shot(self, number: int) -> Shot:
        """Wait until an image comes, and read it."""
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
    """The indices of successive pairs: an image, and the next one of the other stream under the same connection."""
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
    if timeout_ms is None:
        return math.inf
    if not timeout_ms > 0:
        raise ValueError(f"timeout_ms must be > 0, got {timeout_ms}")
    return timeout_ms / 1000
