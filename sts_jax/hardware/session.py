"""Sessions: folders of trajectories that were recorded with one real sensor.

    manifest.json                      the sensor (`Origin`)
    trajectories/00012/initial/        the pair of the held object: visual.png, tactile.png, and a manifest.json with
                                       the times and the proof of light
    trajectories/00012/final/          the pair of the object at rest: the same files
    trajectories/00012/manifest.json   written by the confirmation: number, note, and checksums of all files above
    discarded/00013/                   a trajectory that was discarded

The folder of a pair appears when all its files are on disk. A trajectory with a `manifest.json` is confirmed.
"""

import contextlib
import dataclasses
import datetime
import os
import shutil
import time
import urllib.parse
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
from jaxtyping import Int, UInt8

from sts_jax import storage
from sts_jax.hardware import protocol
from sts_jax.hardware.leds import Lit
from sts_jax.hardware.sts import STS, Pair, Shot, Stream
from sts_jax.storage import MANIFEST, DamagedFileError, Finite

_TRAJECTORIES, _DISCARDED = "trajectories", "discarded"
_STREAMS: tuple[Stream, Stream] = ("visual", "tactile")
# Filters and Huffman codes only, because full deflate is slower and does not make noisy images smaller.
_PNG = (cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY)

End = Literal["initial", "final"]  # "initial": the pair of the held object, "final": the pair of the object at rest
Standing = Literal["confirmed", "unconfirmed", "incomplete", "discarded"]
Image = UInt8[np.ndarray, "height width 3"]

_ENDS: tuple[End, End] = ("initial", "final")


@dataclasses.dataclass(frozen=True)
class Origin:
    """The identity of a sensor. All images of a session have the same origin."""

    camera: str  # path in /dev/v4l/by-id, or URL without user name, password and port
    leds: str  # serial number of the LED controller
    width: int  # width of the images (pixels)
    height: int  # height of the images (pixels)
    levels: protocol.Levels  # duty cycles of the four LED channels in the tactile stream, 0 to 255

    @classmethod
    def of(cls, sensor: STS) -> "Origin":
        """The identity of a connected sensor. Reads one frame to find the image size."""
        height, width = sensor.camera.async_read().image.shape[:2]
        return cls(_name(sensor.camera.source), sensor.leds.serial_number, width, height, sensor.levels)


@dataclasses.dataclass(frozen=True)
class _ShotFacts:
    """The values of `shot_facts`."""

    taken: str
    time_s: Finite
    sequence: int
    epoch: int
    before: Lit
    until_s: Finite

    def __post_init__(self) -> None:
        datetime.datetime.fromisoformat(self.taken)


@dataclasses.dataclass(frozen=True)
class _PairFacts:
    """The facts in the manifest of a pair."""

    visual: _ShotFacts
    tactile: _ShotFacts


@dataclasses.dataclass(frozen=True)
class _Confirmation:
    """The facts in the manifest of a confirmed trajectory."""

    number: int
    origin: str
    confirmed: str
    note: str


def _name(source: str) -> str:
    """A name of a camera that stays the same if its server uses another network port."""
    if "://" not in source:
        return source
    url = urllib.parse.urlsplit(source)
    return urllib.parse.urlunsplit((url.scheme, url.hostname or "", url.path, url.query, ""))


@dataclasses.dataclass(frozen=True, eq=False)
class RecordedTrajectory:
    """A confirmed trajectory: its number, the raw images of the held object and of the object at rest, and the note."""

    number: int
    initial: Pair
    final: Pair
    note: str


class RecordedImages(NamedTuple):
    """RGB images of n recorded trajectories, with the axis (initial, final), and the trajectories' numbers."""

    visual: UInt8[np.ndarray, "n 2 height width 3"]
    tactile: UInt8[np.ndarray, "n 2 height width 3"]
    number: Int[np.ndarray, "n"]


class Entry(NamedTuple):
    """A trajectory in the result of `list_recordings`."""

    number: int
    standing: Standing  # "unconfirmed": both pairs exist. "incomplete": a pair is missing
    taken: str | None  # date and time of the initial visual image, ISO 8601, UTC. None: there is none
    note: str  # text that was stored with the confirmation, may be empty


class Session(contextlib.AbstractContextManager["Session"]):
    """A folder to which trajectories are added.

    When `save`, `confirm` or `discard` returns, the change is on disk and survives a loss of power. If it raises an
    OSError, for example because the disk is full, nothing has changed, and the call can be repeated.
    """

    def __init__(self, folder: str | os.PathLike, origin: Origin | None = None):
        """Start a session, or continue one, which must exist without an `origin`. It is locked until `close`."""
        self.folder = Path(folder)
        if origin is None:
            _read_origin(self.folder)
        with contextlib.ExitStack() as stack:
            stack.enter_context(storage.lock(self.folder))
            self._origin = _prepare(self.folder, origin)
            self._lock = stack.pop_all()
        self._next = next_recording(folder)
        self._confirmed = {entry.number for entry in list_recordings(folder) if entry.standing == "confirmed"}

    @property
    def confirmed(self) -> int:
        """Number of confirmed trajectories."""
        return len(self._confirmed)

    def check_ready(self) -> None:
        """Raise an OSError unless there is enough space for a whole trajectory."""
        free = shutil.disk_usage(self.folder).free
        needed = 4 * 3 * self._origin.width * self._origin.height  # uncompressed size of a trajectory's images
        if free < needed:
            raise OSError(
                f"cannot start a new trajectory, because only {free / 1e6:.0f} MB are free in {self.folder}, but at "
                f"least {needed / 1e6:.0f} MB must be free: free some disk space."
            )

    def begin(self) -> int:
        """Reserve a number for a new trajectory and return it. Numbers are never used twice."""
        number, self._next = self._next, self._next + 1
        return number

    def save(self, number: int, end: End, pair: Pair) -> None:
        """Write a pair of images: "initial" of the held object, or "final" of the object at rest."""
        facts: dict[str, Any] = {shot.stream: shot_facts(shot) for shot in (pair.visual, pair.tactile)}
        folder = _trajectory(self.folder, number)
        storage.write_folder(folder / end, encoded_pair(pair), facts)
        storage.flush_folder(folder.parent)

    def confirm(self, number: int, note: str = "") -> None:
        """Confirm a trajectory whose pairs were saved, so that `load_recordings` includes it. The note is stored."""
        path = _trajectory(self.folder, number)
        if number in self._confirmed:
            raise FileExistsError(f"trajectory {number} is confirmed already, with its note and date.")
        files = {}
        for end in _ENDS:
            pair = storage.read_manifest(path / end, _remedy(number), _PairFacts)
            if pair is None:
                raise FileNotFoundError(
                    f"trajectory {number} cannot be confirmed, because it has no {end} pair of images ({path / end}): "
                    "discard it, or give the number of another trajectory."
                )
            # The checksums from the time when the images were written, so that later damage is found.
            files.update({f"{end}/{name}": checksum for name, checksum in pair.files.items()})
        files.update(storage.checksums(path, [f"{end}/{MANIFEST}" for end in _ENDS]))
        now = datetime.datetime.now(datetime.UTC).isoformat(timespec="milliseconds")
        origin = storage.digest(dataclasses.asdict(self._origin))
        storage.write_manifest(path, files, {"number": number, "origin": origin, "confirmed": now, "note": note})
        storage.flush_folder(path)
        self._confirmed.add(number)

    def discard(self, number: int) -> None:
        """Move a trajectory to the folder `discarded`, so that `load_recordings` leaves it out. Nothing is deleted."""
        _move(_trajectory(self.folder, number), _trajectory(self.folder, number, _DISCARDED))
        self._confirmed.discard(number)

    def restore(self, number: int) -> None:
        """Restore a discarded trajectory. If it was confirmed before it was discarded, it is confirmed again."""
        path = _trajectory(self.folder, number)
        _move(_trajectory(self.folder, number, _DISCARDED), path)
        if (path / MANIFEST).exists():
            self._confirmed.add(number)

    def close(self) -> None:
        """Unlock the folder."""
        self._lock.close()

    def __exit__(self, *_: object) -> None:
        self.close()


def _prepare(folder: Path, origin: Origin | None) -> Origin:
    """Write the manifest of a session, or compare it."""
    if origin is not None and not (folder / MANIFEST).exists():
        storage.write_manifest(folder, {}, dataclasses.asdict(origin))
    recorded = _read_origin(folder)
    if changes := storage.differences(dataclasses.asdict(recorded), dataclasses.asdict(origin or recorded)):
        raise ValueError(f"{folder} was recorded with {changes}: choose another folder.")
    for kind in (_TRAJECTORIES, _DISCARDED):
        (folder / kind).mkdir(exist_ok=True)
    storage.flush_folder(folder)
    return recorded


def _read_origin(folder: Path) -> Origin:
    manifest = storage.read_manifest(folder, "restore it from a backup, or give the folder of a session", Origin)
    if manifest is None:
        raise FileNotFoundError(f"{folder} holds no session ({MANIFEST} is missing): give the folder of a session.")
    return storage.decode(Origin, manifest.facts, "origin")


def _trajectory(folder: Path, number: int, kind: str = _TRAJECTORIES) -> Path:
    return folder / kind / f"{number:05d}"


def _numbered(folder: Path) -> Iterator[tuple[str, int, Path]]:
    """The kind ("trajectories" or "discarded"), the number and the folder of each trajectory."""
    for kind in (_TRAJECTORIES, _DISCARDED):
        for path in (folder / kind).glob("[0-9]*"):
            if path.name.isdecimal() and path.is_dir():
                yield kind, int(path.name), path


def _move(source: Path, target: Path) -> None:
    if not source.is_dir():
        raise FileNotFoundError(f"{source} does not exist: list the trajectories with list_recordings().")
    if target.exists():
        raise FileExistsError(f"{source} cannot be moved to {target}, which exists already: remove one of the two.")
    source.rename(target)
    storage.flush_folder(target.parent)
    storage.flush_folder(source.parent)


def _remedy(number: int) -> str:
    return f"restore the file from a backup, or discard trajectory {number}"


def list_recordings(folder: str | os.PathLike) -> list[Entry]:
    """List all trajectories of a session, unconfirmed and discarded ones included, ordered by number."""
    _read_origin(Path(folder))
    entries = [_entry(path, number, discarded=kind == _DISCARDED) for kind, number, path in _numbered(Path(folder))]
    return sorted(entries, key=lambda entry: entry.number)


def _entry(path: Path, number: int, *, discarded: bool) -> Entry:
    taken, note = None, ""
    with contextlib.suppress(OSError):  # reading the trajectory later raises an error that names a damaged file
        if (initial := storage.read_manifest(path / "initial", "", _PairFacts)) is not None:
            taken = initial.facts["visual"]["taken"]
        if (confirmation := storage.read_manifest(path, "", _Confirmation)) is not None:
            note = confirmation.facts["note"]
    standing: Standing = "discarded"
    if not discarded:
        complete = all((path / end).exists() for end in _ENDS)
        standing = "confirmed" if (path / MANIFEST).exists() else "unconfirmed" if complete else "incomplete"
    return Entry(number, standing, taken, note)


def next_recording(folder: str | os.PathLike) -> int:
    """The number of a session's next trajectory: the highest number plus 1, or 0 without trajectories."""
    return max((number for _, number, _ in _numbered(Path(folder))), default=-1) + 1


def load_recordings(folder: str | os.PathLike) -> "Recordings":
    """The confirmed trajectories of the session in a folder. Another process may add trajectories meanwhile."""
    return Recordings(folder)


class Recordings:
    """The confirmed trajectories of a session, as a sequence of `RecordedTrajectory`, from `load_recordings`.

    Each access to a trajectory reads its files and compares their checksums. The numbers are read once.
    """

    def __init__(self, folder: str | os.PathLike):
        self.folder = Path(folder)
        self.origin = _read_origin(self.folder)  # the sensor
        self.numbers = tuple(e.number for e in list_recordings(self.folder) if e.standing == "confirmed")

    @property
    def identity(self) -> str:
        """SHA-256 that changes when a trajectory is confirmed, discarded or replaced."""
        files = {str(number): _trajectory(self.folder, number) / MANIFEST for number in self.numbers}
        return storage.digest({number: storage.sha256(file) for number, file in files.items()})

    def __len__(self) -> int:
        return len(self.numbers)

    def __iter__(self) -> Iterator[RecordedTrajectory]:
        return (self[index] for index in range(len(self)))

    def __getitem__(self, index: int) -> RecordedTrajectory:
        number = self.numbers[index]
        path, remedy = _trajectory(self.folder, number), _remedy(number)
        manifest = storage.read_manifest(path, remedy, _Confirmation)
        if manifest is None:
            raise FileNotFoundError(f"trajectory {number} of {self.folder} is not confirmed any more: load it again.")
        facts = manifest.facts
        if (facts["number"], facts["origin"]) != (number, storage.digest(dataclasses.asdict(self.origin))):
            raise DamagedFileError(
                f"{path} belongs to trajectory {facts['number']} or to a session of another sensor: move it back, "
                f"or discard trajectory {number}."
            )
        storage.verify(path, manifest, remedy)
        size = self.origin.height, self.origin.width
        initial, final = (_read_pair(path / end, size, remedy) for end in _ENDS)
        return RecordedTrajectory(number, initial, final, facts["note"])

    def images(
        self,
        convert: Callable[[Image], Image] = lambda image: image,
        progress: Callable[[int, int], None] = lambda done, total: None,
    ) -> RecordedImages:
        """Read the images of all trajectories into arrays. 500 trajectories of 1640 x 1232 pixels need 12 GB.

        Args:
            convert: Function that is applied to each raw image, such as `rectified` with the lens of the sensor.
            progress: Called after each trajectory with the numbers of trajectories done so far and in all.
        """
        if not self.numbers:
            raise ValueError(
                f"{self.folder} has no confirmed trajectory: collect trajectories, or confirm existing ones with "
                "`python -m experiments.real review --confirm NUMBER`."
            )
        visual, tactile = [], []
        for done, trajectory in enumerate(self, 1):
            ends = trajectory.initial, trajectory.final
            visual.append([convert(pair.visual.image) for pair in ends])
            tactile.append([convert(pair.tactile.image) for pair in ends])
            progress(done, len(self))
        return RecordedImages(np.array(visual), np.array(tactile), np.array(self.numbers))


def _read_pair(path: Path, size: tuple[int, int], remedy: str) -> Pair:
    manifest = storage.read_manifest(path, remedy, _PairFacts)
    assert manifest is not None  # the manifest of the trajectory lists it
    shots = []
    for stream in _STREAMS:
        image = cv2.imread(str(path / f"{stream}.png"), cv2.IMREAD_COLOR_RGB)
        if image is None or image.shape[:2] != size:
            raise DamagedFileError(f"{path / f'{stream}.png'} is no image of {size[1]} x {size[0]} pixels: {remedy}.")
        image.flags.writeable = False
        shots.append(shot_of(image, stream, manifest.facts[stream]))
    return Pair(*shots)


def encoded_pair(pair: Pair) -> dict[str, bytes]:
    """Encode the images of a pair as `visual.png` and `tactile.png`."""
    return {
        f"{shot.stream}.png": cv2.imencode(".png", cv2.cvtColor(shot.image, cv2.COLOR_RGB2BGR), _PNG)[1].tobytes()
        for shot in (pair.visual, pair.tactile)
    }


def shot_facts(shot: Shot) -> dict[str, Any]:
    """The JSON values of an image: its times, its number, and the proof of light."""
    taken_s = time.time() - (time.monotonic() - shot.time_s)
    return {
        "taken": datetime.datetime.fromtimestamp(taken_s, datetime.UTC).isoformat(timespec="milliseconds"),
        "time_s": shot.time_s,
        "sequence": shot.sequence,
        "epoch": shot.epoch,
        "before": dataclasses.asdict(shot.before),
        "until_s": shot.until_s,
    }


def shot_of(image: Image, stream: Stream, facts: dict[str, Any]) -> Shot:
    """The image with the values that `shot_facts` returned."""
    read = storage.decode(_ShotFacts, facts, stream)
    return Shot(image, stream, read.time_s, read.sequence, read.epoch, read.before, read.until_s)
