"""`Session`: a folder to which trajectories of the real sensor are added. A background thread writes the files."""

import collections
import contextlib
import dataclasses
import shutil
import threading
import urllib.parse
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

from sts_jax import storage
from sts_jax.hardware import protocol, recordings
from sts_jax.hardware.camera import CameraConfig, device_path, stable_path
from sts_jax.hardware.guide import End
from sts_jax.hardware.proof import Pair, Settling
from sts_jax.hardware.sts import STS

_JOBS_OF_TRAJECTORY = 3  # two pairs and the confirmation
_QUEUE = 2 * _JOBS_OF_TRAJECTORY  # largest number of jobs that may wait
_RETRY_S = 1.0  # wait after a failed attempt to write (s)


class SessionError(OSError):
    """Raised if a session cannot be written or cannot accept more changes. The message states cause and remedy."""


@dataclasses.dataclass(frozen=True)
class Origin:
    """The identity of the sensor with which a session is recorded. The session stores the identity in `session.json`.

    All images of a session have the same origin.
    """

    camera: str  # path in /dev/v4l/by-id, or URL without user name, password and port
    leds: str  # serial number of the LED controller
    width: int  # width of the images (pixels)
    height: int  # height of the images (pixels)
    levels: protocol.Levels  # duty cycles of the four LED channels in the tactile stream, 0 to 255

    @classmethod
    def of(cls, sensor: STS) -> "Origin":
        """Return the identity of a sensor: the camera, the LED controller, the image size and the LED duty cycles.

        Args:
            sensor: Connected sensor. The method reads one frame to find the image size.

        Raises:
            CameraError: The camera sends no frame.
            CameraNotConnectedError: The sensor is not connected.
        """
        height, width = sensor.camera.async_read().image.shape[:2]
        return cls(_name(sensor.camera.config), sensor.leds.serial_number, width, height, sensor.levels)


def _name(config: CameraConfig) -> str:
    """A name of a camera that stays the same if the camera is replugged or its server uses another network port."""
    if config.kind == "stream":
        url = urllib.parse.urlsplit(str(config.source))
        return urllib.parse.urlunsplit((url.scheme, url.hostname or "", url.path, url.query, ""))
    if config.kind == "device":
        return str(stable_path(device_path(config.target)))
    return config.name


@dataclasses.dataclass(frozen=True)
class _Job:
    """A change of the session that the background thread writes to disk."""

    name: str  # description for messages
    run: Callable[[], None]  # function that writes the change
    confirms: int | None = None  # number of the trajectory that the change confirms, if any


class Session:
    """A folder to which trajectories are added.

    A trajectory consists of an initial pair of images, in which an object is held on the pad, and a final pair, in
    which the released object is at rest. Each pair consists of a visual image, taken with the lights off, and a tactile
    image, taken with the lights on.

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

    A background thread writes the files, so `save` and `confirm` return at once. The property `confirmed` counts
    only trajectories that are on disk. These trajectories survive a loss of power. If writing fails, for example
    because the disk is full, the thread tries again every second, and `problem` describes the error.

    Changes (pairs of images, confirmations and discards) wait in memory until they are on disk. At most 6 changes can
    wait, which is enough for two trajectories. If 6 changes wait, `save`, `confirm` and `discard` raise a
    `SessionError`. To avoid this error, call `check_ready` before each trajectory. It raises a `SessionError` unless
    the session can accept all changes of the trajectory.
    """

    def __init__(self, folder: Path, lock: contextlib.ExitStack, settling: Settling | None):
        """Do not call this constructor. Use `Session.open` instead."""
        self.folder = folder
        self._lock, self._settling = lock, settling
        self._next = recordings.next_recording(folder)
        entries = recordings.list_recordings(folder)
        self._confirmed = {entry.number for entry in entries if entry.standing == "confirmed"}
        content = recordings.read_session(folder)
        self._raw_bytes = 4 * 3 * content["width"] * content["height"]  # uncompressed size of a trajectory's images
        self._changed = threading.Condition()
        self._saved: set[tuple[int, End]] = set()  # pairs that were accepted
        self._jobs: collections.deque[_Job] = collections.deque()  # the first one is being written
        self._error: Exception | None = None  # error of the last attempt to write
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="writer of the session", daemon=True)
        self._thread.start()

    @classmethod
    def open(cls, folder: str | Path, origin: Origin, *, settling: Settling | None = None) -> "Session":
        """Start a new session, or continue an existing one.

        Args:
            folder: Folder of the session. The folder is locked until `close`.
            origin: Identity of the sensor. An existing session must have the same origin.
            settling: Settling times of the sensor's lights. The times are stored with each pair of images. None:
                not stored.

        Returns:
            The open session. Its next trajectory gets the largest existing number plus 1, or 0 if there are no
            trajectories. The numbers of discarded trajectories count as existing.

        Raises:
            LockedError: Another process or another open session is using the folder.
            ValueError: The existing session has another origin. The message contains the differing values.
            DamagedFileError: `session.json` is damaged.
            OSError: The folder cannot be written to.
        """
        folder = Path(folder)
        with contextlib.ExitStack() as stack:
            stack.enter_context(storage.lock(folder))
            storage.claim(
                folder / recordings.SESSION,
                {"format": recordings.FORMAT, **dataclasses.asdict(origin)},
            )
            for kind in (recordings.TRAJECTORIES, recordings.DISCARDED):
                (folder / kind).mkdir(exist_ok=True)
            # A process that was killed leaves partial files.
            for rest in (*folder.glob(".*.partial"), *folder.glob(f"{recordings.TRAJECTORIES}/*/.*.partial")):
                shutil.rmtree(rest, ignore_errors=True) if rest.is_dir() else rest.unlink(missing_ok=True)
            storage.flush_folder(folder)
            return cls(folder, stack.pop_all(), settling)

    @property
    def confirmed(self) -> int:
        """Number of confirmed trajectories that are on disk. Discarded trajectories do not count."""
        with self._changed:
            return len(self._confirmed)

    @property
    def waiting(self) -> int:
        """Number of changes that are not on disk yet, such as confirmations and new pairs of images."""
        with self._changed:
            return len(self._jobs)

    @property
    def problem(self) -> str | None:
        """Message of the error that prevents writing at present. None if there is no such error."""
        with self._changed:
            if self._error is None:
                return None
            return f"{str(self._error).rstrip('.')}. The session tries to write again every second."

    def check_ready(self) -> None:
        """Raise an error unless the session can accept a whole trajectory now.

        Raises:
            SessionError: The last attempt to write failed, or more than 3 changes (image pairs, confirmations and
                discards) are not on disk yet, or the disk has too little free space.
        """
        if (problem := self.problem) is not None:
            raise SessionError(
                "cannot start a new trajectory, because the last attempt to write failed. Number of changes that are "
                f"not on disk yet: {self.waiting}. Error: {problem}"
            )
        if (waiting := self.waiting) > _QUEUE - _JOBS_OF_TRAJECTORY:
            raise SessionError(
                f"cannot start a new trajectory, because the disk is too slow: {waiting} changes are not on disk yet, "
                f"but at most {_QUEUE - _JOBS_OF_TRAJECTORY} are allowed. Wait until they are written, for example "
                "with flush()."
            )
        free = shutil.disk_usage(self.folder).free
        if free < self._raw_bytes * 2:  # for the new trajectory and for one that may wait
            raise SessionError(
                f"cannot start a new trajectory, because only {free / 1e6:.0f} MB are free in {self.folder}, but at "
                f"least {2 * self._raw_bytes / 1e6:.0f} MB must be free: free some disk space."
            )

    def begin(self) -> int:
        """Reserve a number for a new trajectory and return it."""
        number, self._next = self._next, self._next + 1
        return number

    def save(self, number: int, end: End, pair: Pair) -> None:
        """Write a pair of images to disk in the background.

        Args:
            number: Number of the trajectory, from `begin`.
            end: "initial" if the images show the object while it is held, "final" if they show the object at rest after
                its release.
            pair: The visual and the tactile image.

        Raises:
            SessionError: The session is closed, or its queue is full because 6 changes (image pairs, confirmations and
                discards) are not on disk yet. The pair will not be written.
        """
        folder = recordings.trajectory_folder(self.folder, number)

        def write() -> None:
            if not (folder / end).exists():
                storage.write_folder(folder / end, recordings.encoded_pair(pair, self._settling))
            storage.flush_folder(folder)
            storage.flush_folder(folder.parent)

        self._add(_Job(f"the {end} pair of trajectory {number}", write))
        self._saved.add((number, end))

    def confirm(self, number: int, note: str = "") -> None:
        """Confirm a trajectory in the background. `load_recordings` reads only confirmed trajectories.

        Args:
            number: Number of the trajectory, from `begin`. The initial and the final image pair of this trajectory must
                have been passed to `save`.
            note: Text that is stored with the trajectory.

        Raises:
            SessionError: The session is closed, or its queue is full because 6 changes (image pairs, confirmations and
                discards) are not on disk yet. In both cases, the trajectory is not confirmed.
            ValueError: The initial or the final image pair of the trajectory was not passed to `save` of this
                `Session`.
        """
        ends: tuple[End, End] = ("initial", "final")
        if missing := [end for end in ends if (number, end) not in self._saved]:
            raise ValueError(
                f"trajectory {number} cannot be confirmed yet: call save() with the {' and the '.join(missing)} image "
                "pair of this trajectory before confirm()"
            )
        write = lambda: recordings.confirm_trajectory(self.folder, number, note)  # noqa: E731
        self._add(_Job(f"the confirmation of trajectory {number}", write, number))

    def discard(self, number: int) -> None:
        """Move a trajectory to the folder `discarded`, in a background thread. Nothing is deleted.

        Args:
            number: Number of the trajectory. If no image pair of this trajectory was saved, nothing happens.

        Raises:
            SessionError: The session is closed, or its queue is full because 6 changes (image pairs, confirmations and
                discards) are not on disk yet. The trajectory is not discarded.
        """

        def move() -> None:
            with contextlib.suppress(FileNotFoundError):
                recordings.discard_trajectory(self.folder, number)
            with self._changed:
                self._confirmed.discard(number)

        self._add(_Job(f"the move of trajectory {number} to {recordings.DISCARDED}", move))

    def flush(self, timeout_s: float = 30.0) -> None:
        """Wait until all changes are on disk.

        Args:
            timeout_s: Longest wait (s).

        Raises:
            SessionError: After `timeout_s`, some changes are not on disk. The message lists them and gives the cause.
        """
        with self._changed:
            if self._changed.wait_for(lambda: not self._jobs, timeout_s):
                return
            names = ", ".join(job.name for job in self._jobs)
            cause = self._error or "the disk is too slow. Pass a longer timeout_s."
        raise SessionError(
            f"these changes were not on disk after {timeout_s:g} s: {names}. They are lost if the session closes "
            f"before they are written. Cause: {cause}"
        )

    def close(self, timeout_s: float = 30.0) -> None:
        """Wait until all changes are on disk, end the background thread, and unlock the folder.

        Args:
            timeout_s: Longest wait for the changes (s).

        Raises:
            SessionError: After `timeout_s`, some changes are not on disk. They are lost. The message lists them and
                gives the cause.
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
        """Append a job to the queue of the background thread."""
        with self._changed:
            if self._closing:
                raise SessionError(f"the session of {self.folder} is closed: open it again with Session.open().")
            if len(self._jobs) >= _QUEUE:
                raise SessionError(
                    f"{job.name} was not accepted, because {len(self._jobs)} changes are not on disk yet: wait with "
                    "flush() and try again. To avoid this error, call check_ready() before each trajectory."
                )
            self._jobs.append(job)
            self._changed.notify_all()

    def _run(self) -> None:
        """Write the jobs in order, each until it succeeds."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._jobs or self._closing)
                if self._closing:  # `close` has already waited for the jobs
                    return
                job = self._jobs[0]
            error: Exception | None = None
            try:
                job.run()
            except Exception as failed:  # kept in `self._error` for the caller, and the job is tried again
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
