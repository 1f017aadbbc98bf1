"""`Session`: pairs of images are written by a thread as they happen, and nothing confirmed is lost."""

import collections
import contextlib
import dataclasses
import shutil
import threading
import urllib.parse
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

from sts_jax import _files
from sts_jax.hardware import devices, protocol, recordings
from sts_jax.hardware.camera_config import CameraConfig
from sts_jax.hardware.guide import End
from sts_jax.hardware.settling import Settling
from sts_jax.hardware.shots import Pair
from sts_jax.hardware.sts import STS

_JOBS_OF_TRAJECTORY = 3  # two pairs and the confirmation
_QUEUE = 2 * _JOBS_OF_TRAJECTORY  # jobs that may wait
_RETRY_S = 1.0  # between attempts to write while the disk is full


class SessionError(OSError):
    """A session cannot be written. The message lists the changes that are not on disk, the cause and the remedy."""


@dataclasses.dataclass(frozen=True)
class Origin:
    """The sensor of a session. A session holds images of one sensor only."""

    camera: str  # path in /dev/v4l/by-id, or URL without user name, password and port
    leds: str  # serial number of the LED controller
    width: int  # of the images (pixels)
    height: int  # of the images (pixels)
    levels: protocol.Levels  # duty cycles of the channels in the tactile stream, 0 to 255

    @classmethod
    def of(cls, sensor: STS) -> "Origin":
        """The origin of a connected sensor. Waits for a frame, from which the size is taken."""
        height, width = sensor.camera.async_read().image.shape[:2]
        return cls(_name(sensor.camera.config), sensor.leds.serial_number, width, height, sensor.levels)


def _name(config: CameraConfig) -> str:
    """A name of a camera that stays when it is replugged, or when a server on this computer gets another port."""
    if config.kind == "stream":
        url = urllib.parse.urlsplit(str(config.source))
        return urllib.parse.urlunsplit((url.scheme, url.hostname or "", url.path, url.query, ""))
    if config.kind == "device":
        return str(devices.stable_path(devices.device_path(config.target)))
    return config.name


@dataclasses.dataclass(frozen=True)
class _Job:
    """Something that the thread writes."""

    name: str  # for messages
    run: Callable[[], None]
    confirms: int | None = None  # the trajectory that it confirms


class Session:
    """A folder to which trajectories are added.

    ```python
    with Session.open("runs/real/dataset", Origin.of(sensor)) as session:
        session.check_ready()
        number = session.begin()
        session.save(number, "initial", sensor.read())
        ...
        session.save(number, "final", sensor.read())
        session.confirm(number)
        session.flush()  # optional, `close` does it too
    ```

    A thread writes, so `save` and `confirm` return at once. What counts in `confirmed` is on disk, also after a loss of
    power. If the disk is full, the thread tries again every second, and `problem` states it. Pairs wait in memory, of
    two trajectories at most. `check_ready` therefore stands before each trajectory.
    """

    def __init__(self, folder: Path, lock: contextlib.ExitStack, settling: Settling | None):
        """Use `Session.open`."""
        self.folder = folder
        self._lock, self._settling = lock, settling
        self._next = recordings.next_recording(folder)
        entries = recordings.list_recordings(folder)
        self._confirmed = {entry.number for entry in entries if entry.standing == "confirmed"}
        content = recordings.read_session(folder)
        self._raw_bytes = 4 * 3 * content["width"] * content["height"]  # of a trajectory
        self._changed = threading.Condition()
        self._saved: set[tuple[int, End]] = set()  # pairs that were accepted
        self._jobs: collections.deque[_Job] = collections.deque()  # the first one is being written
        self._error: Exception | None = None  # of the last attempt
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="writer of the session", daemon=True)
        self._thread.start()

    @classmethod
    def open(cls, folder: str | Path, origin: Origin, *, settling: Settling | None = None) -> "Session":
        """Start a session, or continue one with the next number.

        Args:
            folder: Folder of the session. It is locked until `close`.
            origin: The sensor. An existing session must be of the same one.
            settling: Settling times that prove the lights, which are stored with each pair.

        Raises:
            LockedError: Another process collects into the folder.
            ValueError: The session is of another sensor. The message names both values.
            TornFileError: `session.json` is damaged.
            OSError: The folder cannot be written to.
        """
        folder = Path(folder)
        with contextlib.ExitStack() as stack:
            stack.enter_context(_files.lock(folder))
            _files.claim(
                folder / recordings.SESSION,
                {"format": recordings.FORMAT, **dataclasses.asdict(origin)},
            )
            for kind in (recordings.TRAJECTORIES, recordings.DISCARDED):
                (folder / kind).mkdir(exist_ok=True)
            # Left by a process that was killed.
            for rest in (*folder.glob(".*.partial"), *folder.glob(f"{recordings.TRAJECTORIES}/*/.*.partial")):
                shutil.rmtree(rest, ignore_errors=True) if rest.is_dir() else rest.unlink(missing_ok=True)
            _files.flush_folder(folder)
            return cls(folder, stack.pop_all(), settling)

    @property
    def confirmed(self) -> int:
        """Number of confirmed trajectories that are on disk, those that were moved to `discarded` excepted."""
        with self._changed:
            return len(self._confirmed)

    @property
    def waiting(self) -> int:
        """Number of pairs, confirmations and other changes that are not on disk yet."""
        with self._changed:
            return len(self._jobs)

    @property
    def problem(self) -> str | None:
        """Why nothing can be written at present, or None."""
        with self._changed:
            return None if self._error is None else f"{self._error} The session itself tries again every second."

    def check_ready(self) -> None:
        """Raise an error unless a whole trajectory can be accepted now.

        Raises:
            SessionError: Writing fails, too much is waiting, or the disk has too little space.
        """
        if (problem := self.problem) is not None:
            raise SessionError(f"{self.waiting} changes are not on disk yet, but in memory: {problem}")
        if (waiting := self.waiting) > _QUEUE - _JOBS_OF_TRAJECTORY:
            raise SessionError(f"the disk is too slow: {waiting} changes are not on disk yet. Wait until they are.")
        free = shutil.disk_usage(self.folder).free
        if free < self._raw_bytes * 2:  # also for the trajectory that may be waiting
            raise SessionError(
                f"only {free / 1e6:.0f} MB are free in {self.folder}, and two trajectories need up to "
                f"{2 * self._raw_bytes / 1e6:.0f} MB: free some disk space."
            )

    def begin(self) -> int:
        """The number of a new trajectory."""
        number, self._next = self._next, self._next + 1
        return number

    def save(self, number: int, end: End, pair: Pair) -> None:
        """Write a pair in the background.

        Raises:
            SessionError: Too much is waiting. The pair was not accepted.
        """
        folder = recordings.trajectory_folder(self.folder, number)

        def write() -> None:
            if not (folder / end).exists():
                _files.write_folder(folder / end, recordings.encoded_pair(pair, self._settling))
            _files.flush_folder(folder)
            _files.flush_folder(folder.parent)

        self._add(_Job(f"the {end} pair of trajectory {number}", write))
        self._saved.add((number, end))

    def confirm(self, number: int, note: str = "") -> None:
        """Mark a trajectory as good, after both pairs were saved. The mark is written in the background.

        Raises:
            SessionError: Too much is waiting. The confirmation was not accepted.
            ValueError: A pair was not saved.
        """
        ends: tuple[End, End] = ("initial", "final")
        if missing := [end for end in ends if (number, end) not in self._saved]:
            raise ValueError(
                f"trajectory {number} cannot be confirmed before save() of its {' and '.join(missing)} pair"
            )
        write = lambda: recordings.confirm_trajectory(self.folder, number, note)  # noqa: E731
        self._add(_Job(f"the confirmation of trajectory {number}", write, number))

    def discard(self, number: int) -> None:
        """Move a trajectory to `discarded`, in the background. If nothing of it was saved, nothing happens.

        Raises:
            SessionError: Too much is waiting. The change was not accepted.
        """

        def move() -> None:
            with contextlib.suppress(FileNotFoundError):
                recordings.discard_trajectory(self.folder, number)
            with self._changed:
                self._confirmed.discard(number)

        self._add(_Job(f"the move of trajectory {number} to {recordings.DISCARDED}", move))

    def flush(self, timeout_s: float = 30.0) -> None:
        """Wait until everything is on disk.

        Raises:
            SessionError: Writing took too long. The message names the changes that are not on disk.
        """
        with self._changed:
            if self._changed.wait_for(lambda: not self._jobs, timeout_s):
                return
            names = ", ".join(job.name for job in self._jobs)
            cause = self._error or "the disk is too slow."
        raise SessionError(f"these changes were not on disk after {timeout_s:g} s: {names}. Cause: {cause}")

    def close(self, timeout_s: float = 30.0) -> None:
        """Write everything and release the folder.

        Raises:
            SessionError: As in `flush`. What is missing is lost.
        """
        try:
            self.flush(timeout_s)
        finally:
            with self._changed:
                self._closing = True
                self._changed.notify_all()
            self._thread.join(2 * _RETRY_S)
            self._lock.close()

    def __enter__(self) -> "Session":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _add(self, job: _Job) -> None:
        with self._changed:
            if self._closing:
                raise SessionError("the session is closed: open it again.")
            if len(self._jobs) >= _QUEUE:
                raise SessionError(
                    f"{len(self._jobs)} changes are not on disk yet, so {job.name} was not accepted: call "
                    "check_ready() before each trajectory."
                )
            self._jobs.append(job)
            self._changed.notify_all()

    def _run(self) -> None:
        """Write the jobs in order, each until it succeeds."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._jobs or self._closing)
                if self._closing:  # `close` has waited
                    return
                job = self._jobs[0]
            error: Exception | None = None
            try:
                job.run()
            except Exception as failed:
                error = failed
            with self._changed:
                self._error = error
                if error is None:
                    self._jobs.popleft()
                    if job.confirms is not None:
                        self._confirmed.add(job.confirms)
                else:
                    self._changed.wait_for(lambda: self._closing, _RETRY_S)
                self._changed.notify_all()
