"""Trajectories of the real sensor on disk: their format, reading, and review.

A session is a folder:

    session.json                       the sensor, and the version of the format
    trajectories/00012/initial/        visual.png, tactile.png and pair.json
    trajectories/00012/final/          likewise
    trajectories/00012/confirmed.json  written last. A trajectory without it does not count
    discarded/00013/                   a trajectory that was discarded

A folder `initial` or `final` appears at once, when all its files are on disk. `confirmed.json` holds the checksums of
both `pair.json`, which hold those of the images.
"""

import contextlib
import dataclasses
import datetime
import hashlib
import json
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
from jaxtyping import UInt8

from sts_jax import _files
from sts_jax._files import TornFileError
from sts_jax.hardware.guide import End
from sts_jax.hardware.leds import Lit
from sts_jax.hardware.settling import Settling
from sts_jax.hardware.shots import Pair, Shot, Stream

FORMAT = 1  # of the files of a session, incremented when older files can no longer be read
SESSION, CONFIRMED, PAIR = "session.json", "confirmed.json", "pair.json"
TRAJECTORIES, DISCARDED = "trajectories", "discarded"
_ENDS: tuple[End, End] = ("initial", "final")
_STREAMS: tuple[Stream, Stream] = ("visual", "tactile")
# Filtered and Huffman coded: as small as deflate for images with noise, and fast enough.
_PNG = (cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY)

Standing = Literal["confirmed", "unconfirmed", "incomplete", "discarded"]
Image = UInt8[np.ndarray, "height width 3"]


@dataclasses.dataclass(frozen=True, eq=False)
class RecordedTrajectory:
    """The two ends of a trajectory as they were collected."""

    number: int
    initial: Pair  # while the object was held
    final: Pair  # when it rested
    confirmed: str  # date and time of the confirmation, ISO 8601, UTC
    note: str


class Entry(NamedTuple):
    """A trajectory in the listing of a session."""

    number: int
    standing: Standing  # "unconfirmed": both pairs are there. "incomplete": a pair is missing
    taken: str | None  # date and time of the first image, ISO 8601, UTC, None: there is no pair
    note: str


class Images(NamedTuple):
    """The images of all confirmed trajectories, in the order of their numbers."""

    initial_visual: UInt8[np.ndarray, "n height width 3"]
    initial_tactile: UInt8[np.ndarray, "n height width 3"]
    final_visual: UInt8[np.ndarray, "n height width 3"]
    final_tactile: UInt8[np.ndarray, "n height width 3"]


class Recordings:
    """The confirmed trajectories of a session. Images are read, and their checksums compared, when they are used.

    ```python
    for trajectory in hardware.load_recordings("runs/real/dataset"):
        trajectory.initial.visual.image, trajectory.final.tactile.image
    ```
    """

    def __init__(self, folder: str | os.PathLike):
        """Use `load_recordings`."""
        self.folder = Path(folder)
        self.session = read_session(self.folder)
        self.numbers = tuple(e.number for e in list_recordings(self.folder) if e.standing == "confirmed")

    def __len__(self) -> int:
        return len(self.numbers)

    @property
    def identity(self) -> str:
        """SHA-256 of the checksums of all confirmed trajectories. It changes if one is added, discarded or replaced."""
        files = {number: trajectory_folder(self.folder, number) / CONFIRMED for number in self.numbers}
        return _files.digest({str(number): _files.sha256(file) for number, file in files.items()})

    def __getitem__(self, index: int) -> RecordedTrajectory:
        """The trajectory at an index, which is not its number.

        Raises:
            TornFileError: A file is missing or damaged.
        """
        return read_trajectory(self.folder, self.numbers[index])

    def __iter__(self) -> Iterator[RecordedTrajectory]:
        return (read_trajectory(self.folder, number) for number in self.numbers)

    def images(self, convert: Callable[[Image], Image] = lambda image: image) -> Images:
        """All images as arrays.

        500 trajectories of 1640 x 1232 need 12 GB, so reduce the images by `convert` there.

        Args:
            convert: Applied to each raw image, such as a rectification or a reduction. All results need the same shape.

        Raises:
            TornFileError: A file is missing or damaged.
            ValueError: There is no confirmed trajectory.
        """
        if not self.numbers:
            raise ValueError(f"{self.folder} has no confirmed trajectory: collect some, or confirm them in the review.")
        rows = [
            [convert(shot.image) for pair in (t.initial, t.final) for shot in (pair.visual, pair.tactile)] for t in self
        ]
        return Images(*(np.stack(column) for column in zip(*rows, strict=True)))

    def __repr__(self) -> str:
        return f"Recordings({str(self.folder)!r}, {len(self)} trajectories)"


def load_recordings(folder: str | os.PathLike) -> Recordings:
    """Open the confirmed trajectories of a session for reading. Another process may collect meanwhile.

    Raises:
        FileNotFoundError: There is no session in the folder.
        TornFileError: `session.json` is damaged.
        ValueError: The session was written by another version of the format.
    """
    return Recordings(folder)


def read_session(folder: Path) -> dict[str, Any]:
    """The content of `session.json`."""
    path = folder / SESSION
    try:
        content = _files.read_json(path, "restore it from a backup")
    except FileNotFoundError:
        raise FileNotFoundError(f"{folder} holds no session ({SESSION} is missing): give the folder of one.") from None
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        found = content.get("format") if isinstance(content, dict) else None
        raise ValueError(f"{path} has format {found!r}, but this version of sts_jax reads format {FORMAT}.")
    return content


def confirm_recording(folder: str | os.PathLike, number: int, note: str = "") -> None:
    """Confirm a trajectory after the session, so that it counts.

    Raises:
        LockedError: Another process collects into the folder.
        FileNotFoundError: There is no such session or trajectory, or a pair is missing.
    """
    with _locked(folder) as session:
        confirm_trajectory(session, number, note)


def discard_recording(folder: str | os.PathLike, number: int) -> None:
    """Move a trajectory to the folder `discarded`. Nothing is deleted.

    Raises:
        LockedError: Another process collects into the folder.
        FileNotFoundError: There is no such session or trajectory.
    """
    with _locked(folder) as session:
        discard_trajectory(session, number)


def restore_recording(folder: str | os.PathLike, number: int) -> None:
    """Move a trajectory back from the folder `discarded`. It counts again if it was confirmed.

    Raises:
        LockedError: Another process collects into the folder.
        FileNotFoundError: There is no such session or discarded trajectory.
    """
    with _locked(folder) as session:
        restore_trajectory(session, number)


@contextlib.contextmanager
def _locked(folder: str | os.PathLike) -> Iterator[Path]:
    path = Path(folder)
    read_session(path)
    with _files.lock(path):
        yield path


def trajectory_folder(folder: Path, number: int, *, discarded: bool = False) -> Path:
    """The folder of a trajectory."""
    return folder / (DISCARDED if discarded else TRAJECTORIES) / f"{number:05d}"


def list_recordings(folder: str | os.PathLike) -> list[Entry]:
    """All trajectories of a session, by number.

    Raises:
        FileNotFoundError: There is no session in the folder.
    """
    folder = Path(folder)
    read_session(folder)
    entries = [_entry(path, number, discarded=kind == DISCARDED) for kind, number, path in _numbered(folder)]
    return sorted(entries, key=lambda entry: entry.number)


def next_recording(folder: str | os.PathLike) -> int:
    """The number of a session's next trajectory, after all that were ever given. 0 if there is no session yet."""
    return max((number for _, number, _ in _numbered(Path(folder))), default=-1) + 1


def _numbered(folder: Path) -> Iterator[tuple[str, int, Path]]:
    for kind in (TRAJECTORIES, DISCARDED):
        for path in (folder / kind).glob("[0-9]*"):
            if path.name.isdecimal() and path.is_dir():
                yield kind, int(path.name), path


def _entry(path: Path, number: int, *, discarded: bool) -> Entry:
    ends = [path / end / PAIR for end in _ENDS]
    taken, note = None, ""
    try:
        taken = json.loads(ends[0].read_bytes())["visual"]["taken"]
        note = json.loads((path / CONFIRMED).read_bytes())["note"]
    except (OSError, ValueError, KeyError, TypeError):
        pass  # reading the trajectory names the damage
    standing: Standing = "discarded"
    if not discarded:
        complete = all(end.exists() for end in ends)
        standing = "confirmed" if (path / CONFIRMED).exists() else "unconfirmed" if complete else "incomplete"
    return Entry(number, standing, taken, note)


def encoded_pair(pair: Pair, settling: Settling | None) -> dict[str, bytes]:
    """The files of a pair, by name."""
    files: dict[str, bytes] = {}
    content: dict[str, Any] = {
        "format": FORMAT,
        "settling": None if settling is None else dataclasses.asdict(settling),
    }
    for shot in (pair.visual, pair.tactile):
        data = encoded(shot.image)
        files[f"{shot.stream}.png"] = data
        values = {f.name: getattr(shot, f.name) for f in dataclasses.fields(shot) if f.name not in ("image", "stream")}
        taken_s = time.time() - (time.monotonic() - shot.time_s)
        content[shot.stream] = {
            "sha256": hashlib.sha256(data).hexdigest(),
            "shape": list(shot.image.shape),
            "taken": datetime.datetime.fromtimestamp(taken_s, datetime.UTC).isoformat(timespec="milliseconds"),
            **values,
            "before": dataclasses.asdict(shot.before),
        }
    files[PAIR] = (json.dumps(content, indent=2) + "\n").encode()
    return files


def encoded(image: Image) -> bytes:
    """An RGB image as PNG."""
    done, data = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), _PNG)
    if not done:
        raise ValueError(f"an image of shape {image.shape} cannot be encoded as PNG")
    return data.tobytes()


def confirm_trajectory(folder: Path, number: int, note: str = "") -> None:
    """Mark a trajectory as good. It counts from then on. The caller holds the lock of the session.

    Raises:
        FileNotFoundError: A pair is missing.
        OSError: The file cannot be written.
    """
    path = trajectory_folder(folder, number)
    sums: dict[str, str] = {end: _pair_sum(path, end) for end in _ENDS}
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="milliseconds")
    content = {"format": FORMAT, "number": number, "confirmed": now, "note": note, **sums}
    _files.write_json(path / CONFIRMED, {**content, "checksum": _files.digest(content)})
    _files.flush_folder(path)


def _pair_sum(path: Path, end: str) -> str:
    file = path / end / PAIR
    if not file.exists():
        raise FileNotFoundError(f"trajectory {path.name} has no {end} pair, so it cannot be confirmed: discard it.")
    return _files.sha256(file)


def discard_trajectory(folder: Path, number: int) -> None:
    """Move a trajectory to `discarded`. Nothing is deleted. The caller holds the lock of the session.

    Raises:
        FileNotFoundError: There is no such trajectory.
        OSError: The folder cannot be moved.
    """
    _move(trajectory_folder(folder, number), trajectory_folder(folder, number, discarded=True))


def restore_trajectory(folder: Path, number: int) -> None:
    """Move a trajectory back from `discarded`. It counts again if it was confirmed. The caller holds the lock.

    Raises:
        FileNotFoundError: There is no such trajectory.
        OSError: The folder cannot be moved.
    """
    _move(trajectory_folder(folder, number, discarded=True), trajectory_folder(folder, number))


def _move(source: Path, target: Path) -> None:
    if not source.is_dir():
        raise FileNotFoundError(f"{source} does not exist: list the trajectories to see their numbers.")
    if target.exists():
        raise FileExistsError(f"{target} exists: rename one of them and {source}, so that no number occurs twice.")
    target.parent.mkdir(parents=True, exist_ok=True)
    source.rename(target)
    for path in (target.parent, source.parent):
        _files.flush_folder(path)


def read_trajectory(folder: Path, number: int) -> RecordedTrajectory:
    """Read a confirmed trajectory and compare all checksums.

    Raises:
        FileNotFoundError: There is no such confirmed trajectory.
        TornFileError: A file is missing or damaged.
    """
    path = trajectory_folder(folder, number)
    file = path / CONFIRMED
    if not file.exists():
        raise FileNotFoundError(f"{folder} has no confirmed trajectory {number}: list the trajectories.")
    content = _files.read_json(file, _remedy(number))
    checksum = content.pop("checksum", None) if isinstance(content, dict) else None
    if checksum != _files.digest(content):
        raise TornFileError(f"{file} is damaged, because its checksum differs: {_remedy(number)}.")
    if content["number"] != number:
        raise TornFileError(f"{file} is of trajectory {content['number']}: rename the folder, or discard it.")
    initial, final = (read_pair(path / end, number, content[end]) for end in _ENDS)
    return RecordedTrajectory(number, initial, final, content["confirmed"], content["note"])


def read_pair(path: Path, number: int, checksum: str | None = None) -> Pair:
    """Read a pair and compare its checksums.

    Args:
        path: The folder of the pair.
        number: The trajectory, for messages.
        checksum: SHA-256 of `pair.json`. None: not compared.

    Raises:
        TornFileError: A file is missing or damaged.
    """
    content = json.loads(_checked(path / PAIR, checksum, number))
    shots = {}
    for stream in _STREAMS:
        values = {name: value for name, value in content[stream].items() if name not in ("sha256", "taken", "shape")}
        lit = Lit(**{**values.pop("before"), "levels": tuple(content[stream]["before"]["levels"])})
        data = _checked(path / f"{stream}.png", content[stream]["sha256"], number)
        image = cv2.cvtColor(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
        image.flags.writeable = False
        shots[stream] = Shot(image=image, stream=stream, before=lit, **values)
    return Pair(shots["visual"], shots["tactile"])


def _checked(path: Path, checksum: str | None, number: int) -> bytes:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise TornFileError(f"{path} cannot be read ({error}): {_remedy(number)}.") from error
    if checksum is not None and hashlib.sha256(data).hexdigest() != checksum:
        raise TornFileError(f"{path} is damaged, because its checksum differs: {_remedy(number)}.")
    return data


def _remedy(number: int) -> str:
    return f"restore it from a backup, or discard trajectory {number}"
