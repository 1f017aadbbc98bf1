"""Reading, confirming and discarding the recorded trajectories of the real sensor.

A session is a folder of trajectories that were recorded with one sensor. A trajectory consists of two pairs of images.
The pair `initial` shows the held object, and the pair `final` shows the object at rest:

    session.json                       the identity of the sensor, and the version of the format
    trajectories/00012/initial/        visual.png, tactile.png and pair.json
    trajectories/00012/final/          the same files
    trajectories/00012/confirmed.json  written last. A trajectory without this file is not confirmed
    discarded/00013/                   a trajectory that was discarded

A folder `initial` or `final` appears only when all its files are on disk. `confirmed.json` contains the checksums of
the two `pair.json`, and each `pair.json` contains the checksums of its images.
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

from sts_jax import storage
from sts_jax.hardware.guide import End
from sts_jax.hardware.leds import Lit
from sts_jax.hardware.proof import Pair, Settling, Shot, Stream
from sts_jax.storage import DamagedFileError

FORMAT = 1  # version of the format of a session. Incremented when older files can no longer be read
SESSION, CONFIRMED, PAIR = "session.json", "confirmed.json", "pair.json"
TRAJECTORIES, DISCARDED = "trajectories", "discarded"
_ENDS: tuple[End, End] = ("initial", "final")
_STREAMS: tuple[Stream, Stream] = ("visual", "tactile")
# Filters and Huffman codes only, because full deflate is slower and does not make noisy images smaller.
_PNG = (cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY)

Standing = Literal["confirmed", "unconfirmed", "incomplete", "discarded"]
Image = UInt8[np.ndarray, "height width 3"]


@dataclasses.dataclass(frozen=True, eq=False)
class RecordedTrajectory:
    """A recorded trajectory that the user has confirmed: the raw images at its beginning and at its end."""

    number: int  # number of the trajectory in its session
    initial: Pair  # images of the held object
    final: Pair  # images of the object at rest
    confirmed: str  # date and time of the confirmation, ISO 8601, UTC
    note: str  # text that was stored with the confirmation, may be empty


class Entry(NamedTuple):
    """A trajectory in the result of `list_recordings`: its number, state, time and note.

    The field `standing` holds the state of the trajectory: "confirmed", "unconfirmed" (the initial and the final pair
    of images exist), "incomplete" (at least one of the two pairs is missing) or "discarded".
    """

    number: int  # number of the trajectory in its session
    standing: Standing  # "unconfirmed": both pairs exist. "incomplete": a pair is missing
    taken: str | None  # date and time of the initial visual image, ISO 8601, UTC. None: there is none
    note: str  # text that was stored with the confirmation, may be empty


class Images(NamedTuple):
    """RGB images of all trajectories that a user confirmed, ordered by the numbers of the trajectories."""

    initial_visual: UInt8[np.ndarray, "n height width 3"]
    initial_tactile: UInt8[np.ndarray, "n height width 3"]
    final_visual: UInt8[np.ndarray, "n height width 3"]
    final_tactile: UInt8[np.ndarray, "n height width 3"]


class Recordings:
    """All confirmed trajectories of a session, as a sequence of `RecordedTrajectory` objects.

    ```python
    for trajectory in hardware.load_recordings("runs/real/dataset"):
        trajectory.initial.visual.image, trajectory.final.tactile.image
    ```

    Each access to a trajectory reads its files from disk and compares their checksums with the recorded ones. A
    difference raises a `DamagedFileError`. `load_recordings` reads the numbers of the trajectories once. Later changes
    of the session do not change the attribute `numbers`.

    Attributes:
        folder: Folder of the session.
        session: Content of `session.json`: the fields of `Origin`, and the version of the format.
        numbers: Numbers of the confirmed trajectories.
    """

    def __init__(self, folder: str | os.PathLike):
        """Do not call this constructor. Use `load_recordings` instead."""
        self.folder = Path(folder)
        self.session = read_session(self.folder)
        self.numbers = tuple(e.number for e in list_recordings(self.folder) if e.standing == "confirmed")

    def __len__(self) -> int:
        return len(self.numbers)

    @property
    def identity(self) -> str:
        """SHA-256 checksum of the confirmed trajectories.

        If a trajectory is confirmed, discarded or replaced, the result of the next `load_recordings` has another
        checksum.

        Raises:
            FileNotFoundError: A trajectory was discarded after these recordings were loaded.
        """
        files = {number: trajectory_folder(self.folder, number) / CONFIRMED for number in self.numbers}
        return storage.digest({str(number): storage.sha256(file) for number, file in files.items()})

    def __getitem__(self, index: int) -> RecordedTrajectory:
        """Read the trajectory at an index of `numbers`. The index differs from the trajectory's number.

        Raises:
            IndexError: The index is out of range.
            FileNotFoundError: The trajectory has been discarded meanwhile.
            DamagedFileError: A file of the trajectory is missing or damaged.
        """
        return read_trajectory(self.folder, self.numbers[index])

    def __iter__(self) -> Iterator[RecordedTrajectory]:
        return (read_trajectory(self.folder, number) for number in self.numbers)

    def images(self, convert: Callable[[Image], Image] = lambda image: image) -> Images:
        """Read the images of all confirmed trajectories into arrays.

        The raw images (1640 x 1232 pixels) of 500 trajectories need 12 GB of memory. Use `convert` to make the images
        smaller.

        Args:
            convert: Function that is applied to each raw image, for example to rectify or to resize it. All results
                must have the same shape. The default returns the raw image.

        Returns:
            The initial visual, initial tactile, final visual and final tactile images, in this order.

        Raises:
            FileNotFoundError: A trajectory was discarded after these recordings were loaded.
            DamagedFileError: A file is missing or damaged.
            ValueError: The session has no trajectory that a user confirmed.
        """
        if not self.numbers:
            raise ValueError(
                f"{self.folder} has no confirmed trajectory: collect trajectories, or confirm existing ones with "
                "`python -m experiments.real review --confirm NUMBER`."
            )
        rows = [
            [convert(shot.image) for pair in (t.initial, t.final) for shot in (pair.visual, pair.tactile)] for t in self
        ]
        return Images(*(np.stack(column) for column in zip(*rows, strict=True)))

    def __repr__(self) -> str:
        return f"Recordings({str(self.folder)!r}, {len(self)} trajectories)"


def load_recordings(folder: str | os.PathLike) -> Recordings:
    """Return the confirmed trajectories of a session.

    A session is a folder of trajectories that were recorded with one sensor. The user confirms each good trajectory
    with `Session.confirm` or `confirm_recording`. The images of a trajectory are read when the trajectory is accessed.
    This function does not lock the session, so another process may add trajectories to it.

    Args:
        folder: Folder of the session, which contains `session.json`.

    Returns:
        The confirmed trajectories, in the order of their numbers.

    Raises:
        FileNotFoundError: There is no session in the folder.
        DamagedFileError: `session.json` is damaged.
        ValueError: The session was written in another version of the format.
    """
    return Recordings(folder)


def read_session(folder: Path) -> dict[str, Any]:
    """Return the content of `session.json` in a session's folder. See `load_recordings` for the exceptions."""
    path = folder / SESSION
    try:
        content = storage.read_json(path, "restore it from a backup")
    except FileNotFoundError:
        raise FileNotFoundError(
            f"{folder} holds no session ({SESSION} is missing): give the folder of a session."
        ) from None
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        found = content.get("format") if isinstance(content, dict) else None
        raise ValueError(
            f"{path} has format {found!r}, but this version of sts_jax reads format {FORMAT}. Read it with the version "
            "of sts_jax that wrote it."
        )
    return content


def confirm_recording(folder: str | os.PathLike, number: int, note: str = "") -> None:
    """Confirm a trajectory, so that `load_recordings` includes it.

    Call this function only while no `Session` is open in the folder.

    Args:
        folder: Folder of the session.
        number: Number of the trajectory.
        note: Text that is stored with the trajectory.

    Raises:
        LockedError: Another process or an open session is using the folder.
        FileNotFoundError: There is no such session or trajectory, or the trajectory lacks its initial or final images.
        DamagedFileError: `session.json` is damaged.
        ValueError: The session has another version of the format.
    """
    with _locked(folder) as session:
        confirm_trajectory(session, number, note)


def discard_recording(folder: str | os.PathLike, number: int) -> None:
    """Discard a trajectory, so that `load_recordings` leaves it out. Its files move to the folder `discarded`.

    Nothing is deleted. `restore_recording` undoes the change.

    Args:
        folder: Folder of the session.
        number: Number of the trajectory.

    Raises:
        LockedError: Another process or an open session is using the folder.
        FileNotFoundError: There is no such session or trajectory.
        FileExistsError: There is a discarded trajectory of the same number.
        DamagedFileError: `session.json` is damaged.
        ValueError: The session has another version of the format.
    """
    with _locked(folder) as session:
        discard_trajectory(session, number)


def restore_recording(folder: str | os.PathLike, number: int) -> None:
    """Restore a discarded trajectory. If it was confirmed before it was discarded, it is confirmed again.

    Args:
        folder: Folder of the session.
        number: Number of the trajectory.

    Raises:
        LockedError: Another process or an open session is using the folder.
        FileNotFoundError: There is no such session or discarded trajectory.
        FileExistsError: There is another trajectory of the same number.
        DamagedFileError: `session.json` is damaged.
        ValueError: The session has another version of the format.
    """
    with _locked(folder) as session:
        restore_trajectory(session, number)


@contextlib.contextmanager
def _locked(folder: str | os.PathLike) -> Iterator[Path]:
    """Check that a folder is a session, and lock it."""
    path = Path(folder)
    read_session(path)
    with storage.lock(path):
        yield path


def trajectory_folder(folder: Path, number: int, *, discarded: bool = False) -> Path:
    """Return the path of a trajectory's folder.

    Args:
        folder: Folder of the session.
        number: Number of the trajectory.
        discarded: If True, return the path that the trajectory has after it was discarded.
    """
    return folder / (DISCARDED if discarded else TRAJECTORIES) / f"{number:05d}"


def list_recordings(folder: str | os.PathLike) -> list[Entry]:
    """List all trajectories of a session, including unconfirmed and discarded trajectories.

    Args:
        folder: Folder of the session.

    Returns:
        One entry for each trajectory, ordered by number.

    Raises:
        FileNotFoundError: There is no session in the folder.
        DamagedFileError: `session.json` is damaged.
        ValueError: The session has another version of the format.
    """
    folder = Path(folder)
    read_session(folder)
    entries = [_entry(path, number, discarded=kind == DISCARDED) for kind, number, path in _numbered(folder)]
    return sorted(entries, key=lambda entry: entry.number)


def next_recording(folder: str | os.PathLike) -> int:
    """Return the number of the next trajectory of a session.

    Args:
        folder: Folder of the session.

    Returns:
        The highest trajectory number in the session, plus 1. Discarded trajectories count too. If there is no
        trajectory or no session, the result is 0.
    """
    return max((number for _, number, _ in _numbered(Path(folder))), default=-1) + 1


def _numbered(folder: Path) -> Iterator[tuple[str, int, Path]]:
    """The kind ("trajectories" or "discarded"), the number and the folder of each trajectory."""
    for kind in (TRAJECTORIES, DISCARDED):
        for path in (folder / kind).glob("[0-9]*"):
            if path.name.isdecimal() and path.is_dir():
                yield kind, int(path.name), path


def _entry(path: Path, number: int, *, discarded: bool) -> Entry:
    """The entry of the trajectory in a folder. Damaged files are ignored here."""
    ends = [path / end / PAIR for end in _ENDS]
    taken, note = None, ""
    try:
        taken = json.loads(ends[0].read_bytes())["visual"]["taken"]
        note = json.loads((path / CONFIRMED).read_bytes())["note"]
    except (OSError, ValueError, KeyError, TypeError):
        pass  # reading the trajectory later raises an error that names the damaged file
    standing: Standing = "discarded"
    if not discarded:
        complete = all(end.exists() for end in ends)
        standing = "confirmed" if (path / CONFIRMED).exists() else "unconfirmed" if complete else "incomplete"
    return Entry(number, standing, taken, note)


def encoded_pair(pair: Pair, settling: Settling | None) -> dict[str, bytes]:
    """Encode a pair of images as the files `visual.png`, `tactile.png` and `pair.json`.

    Args:
        pair: The two images, each with the start and the end of a time interval in which the lights did not
            change.
        settling: Settling times of the sensor's lights, which are stored in `pair.json`. None: not stored.

    Returns:
        Content of each file, by file name.
    """
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
    """Encode an RGB image as PNG."""
    done, data = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), _PNG)
    if not done:
        raise ValueError(
            f"OpenCV cannot encode an image of type {image.dtype} and shape {image.shape} as PNG: use an image of type "
            "uint8 and shape (height, width, 3)"
        )
    return data.tobytes()


def confirm_trajectory(folder: Path, number: int, note: str = "") -> None:
    """Write the file `confirmed.json` of a trajectory, so that `load_recordings` includes the trajectory.

    This function does not lock the folder of the session. The caller must hold the lock.

    Args:
        folder: Folder of the session.
        number: Number of the trajectory.
        note: Text that is stored with the trajectory.

    Raises:
        FileNotFoundError: The trajectory does not exist, or its initial or final pair of images is missing.
        OSError: The file cannot be written.
    """
    path = trajectory_folder(folder, number)
    sums: dict[str, str] = {end: _pair_sum(path, end) for end in _ENDS}
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="milliseconds")
    content = {"format": FORMAT, "number": number, "confirmed": now, "note": note, **sums}
    storage.write_json(path / CONFIRMED, {**content, "checksum": storage.digest(content)})
    storage.flush_folder(path)


def _pair_sum(path: Path, end: str) -> str:
    """The SHA-256 of the file `pair.json` of a pair."""
    file = path / end / PAIR
    if not file.exists():
        raise FileNotFoundError(
            f"trajectory {path.name} cannot be confirmed, because it has no {end} pair of images ({file} does not "
            "exist): discard the trajectory, or give the number of another trajectory."
        )
    return storage.sha256(file)


def discard_trajectory(folder: Path, number: int) -> None:
    """Move a trajectory to the folder `discarded`. Nothing is deleted. The caller must have locked the session.

    Args:
        folder: Folder of the session.
        number: Number of the trajectory.

    Raises:
        FileNotFoundError: There is no such trajectory.
        FileExistsError: There is a discarded trajectory of the same number.
        OSError: The folder cannot be moved.
    """
    _move(trajectory_folder(folder, number), trajectory_folder(folder, number, discarded=True))


def restore_trajectory(folder: Path, number: int) -> None:
    """Move a trajectory back from the folder `discarded`. The caller must have locked the session.

    Args:
        folder: Folder of the session.
        number: Number of the trajectory.

    Raises:
        FileNotFoundError: There is no such discarded trajectory.
        FileExistsError: There is another trajectory of the same number.
        OSError: The folder cannot be moved.
    """
    _move(trajectory_folder(folder, number, discarded=True), trajectory_folder(folder, number))


def _move(source: Path, target: Path) -> None:
    if not source.is_dir():
        raise FileNotFoundError(
            f"trajectory folder {source} does not exist: list the trajectories with list_recordings()."
        )
    if target.exists():
        raise FileExistsError(
            f"{source} cannot be moved to {target}, which exists already: rename one of the two folders to an "
            "unused number. If the renamed trajectory was confirmed, confirm it again with confirm_recording()."
        )
    target.parent.mkdir(parents=True, exist_ok=True)
    source.rename(target)
    for path in (target.parent, source.parent):
        storage.flush_folder(path)


def read_trajectory(folder: Path, number: int) -> RecordedTrajectory:
    """Read a confirmed trajectory, and compare the checksums of its files with the recorded ones.

    Args:
        folder: Folder of the session.
        number: Number of the trajectory.

    Raises:
        FileNotFoundError: There is no such confirmed trajectory.
        DamagedFileError: A file is missing or damaged.
    """
    path = trajectory_folder(folder, number)
    file = path / CONFIRMED
    if not file.exists():
        raise FileNotFoundError(
            f"{folder} has no confirmed trajectory {number}: list the trajectories with list_recordings()."
        )
    content = storage.read_json(file, _remedy(number))
    checksum = content.pop("checksum", None) if isinstance(content, dict) else None
    if checksum != storage.digest(content):
        raise DamagedFileError(f"{file} is damaged (its checksum does not match its content): {_remedy(number)}.")
    if content["number"] != number:
        raise DamagedFileError(
            f"{file} belongs to trajectory {content['number']}, but lies in the folder of trajectory {number}: rename "
            f"this folder to {content['number']:05d}, or discard trajectory {number} with discard_recording()."
        )
    initial, final = (read_pair(path / end, number, content[end]) for end in _ENDS)
    return RecordedTrajectory(number, initial, final, content["confirmed"], content["note"])


def read_pair(path: Path, number: int, checksum: str | None = None) -> Pair:
    """Read a visual and a tactile image, and compare their checksums with those in `pair.json`.

    Args:
        path: Folder that contains the two images and `pair.json`.
        number: Number of the trajectory, for error messages.
        checksum: Expected SHA-256 of `pair.json`. None: not compared.

    Raises:
        DamagedFileError: A file is missing or damaged.
    """
    content = json.loads(_checked(path / PAIR, checksum, number))
    shots = {}
    for stream in _STREAMS:
        values = {name: value for name, value in content[stream].items() if name not in ("sha256", "taken", "shape")}
        lit = storage.decode(Lit, values.pop("before"), f"{stream}.before")
        data = _checked(path / f"{stream}.png", content[stream]["sha256"], number)
        image = cv2.cvtColor(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
        image.flags.writeable = False
        shots[stream] = Shot(image=image, stream=stream, before=lit, **values)
    return Pair(shots["visual"], shots["tactile"])


def _checked(path: Path, checksum: str | None, number: int) -> bytes:
    """Read a file and compare its checksum, unless that is None."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DamagedFileError(f"{path} cannot be read ({error}): {_remedy(number)}.") from error
    if checksum is not None and hashlib.sha256(data).hexdigest() != checksum:
        raise DamagedFileError(f"{path} is damaged (its checksum differs from the recorded one): {_remedy(number)}.")
    return data


def _remedy(number: int) -> str:
    """The remedy for a damaged trajectory, for error messages."""
    return f"restore the file from a backup, or discard trajectory {number} with discard_recording()"
