"""Atomic writing of files and folders, reading of files with helpful errors, manifests, and locks on folders."""

import contextlib
import dataclasses
import errno
import functools
import hashlib
import io
import json
import os
import platform
import secrets
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeVar

import filelock
import numpy as np
import pydantic
from pydantic_core import ErrorDetails

Fields = TypeVar("Fields")  # a dataclass
Finite = Annotated[float, pydantic.Field(allow_inf_nan=False)]


class DamagedFileError(OSError):
    """A file that exists but is incomplete or damaged. The message names the file and the remedy."""


class LockedError(RuntimeError):
    """A folder is already locked, by another process or by this one."""


def write_whole(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file atomically. An interruption leaves either the complete new file or the previous state.

    Missing folders are created. An OSError names the file and the remedy. Other errors of `write` are raised unchanged.

    Args:
        write: Function that writes the content to the path of a temporary file, which is then renamed to `path`.
    """
    _write({path: write}, path)


def write_together(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write files of a folder in their order, each atomically. On a full disk, all of them keep their content."""
    _write({folder / name: functools.partial(Path.write_bytes, data=data) for name, data in files.items()}, folder)


def _write(writers: Mapping[Path, Callable[[Path], object]], name: Path) -> None:
    """Write all files under temporary names, then rename them. `name` names them in error messages."""
    # A process on another host that shares the folder may have the same number.
    mark = f"{os.getpid()}-{secrets.token_hex(4)}"
    temporary = {path: path.with_name(f".{path.name}.{mark}.partial") for path in writers}
    try:
        for path, write in writers.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            write(temporary[path])
            with temporary[path].open("rb") as file:
                os.fsync(file.fileno())
        for path in writers:
            temporary[path].replace(path)
    except OSError as error:
        raise OSError(
            f"cannot write {name}: {error.strerror or error}. {remedy(error)}, then start again. All finished results "
            "are kept."
        ) from error
    finally:
        with contextlib.suppress(OSError):
            for path in writers:
                temporary[path].unlink(missing_ok=True)


_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_FORBIDDEN = (errno.EACCES, errno.EPERM, errno.EROFS)
_IN_THE_WAY = (errno.EISDIR, errno.ENOTDIR, errno.EEXIST, errno.ENOTEMPTY)


def remedy(error: Exception) -> str:
    """The remedy for a failed write, by the `errno` of its error."""
    number = getattr(error, "errno", None)
    if number in _FULL:
        return "Free some disk space"
    if number in _FORBIDDEN:
        return "Check the permissions"
    if number in _IN_THE_WAY:
        return "Remove the file or folder that is in the way, or choose another path"
    return "Free some disk space or check the permissions"


def write_bytes(path: Path, data: bytes) -> None:
    """Write bytes to a file atomically."""
    write_whole(path, lambda temporary: temporary.write_bytes(data))


def write_json(path: Path, content: Any) -> None:
    """Write an object, such as a dictionary or a list, to a JSON file atomically."""
    write_bytes(path, json_bytes(content))


def json_bytes(content: Any) -> bytes:
    """The content of a JSON file, indented."""
    return (json.dumps(content, indent=2, default=_plain) + "\n").encode()


def _plain(number: Any) -> Any:
    if isinstance(number, np.generic):
        return number.item()
    raise TypeError(f"a {type(number).__name__} cannot be written as JSON")


def read_json(path: Path, remedy: str) -> Any:
    """Read a JSON file.

    Args:
        remedy: Text at the end of the error message, with the remedy for a damaged file.
    """
    try:
        return json.loads(path.read_bytes().decode())
    except FileNotFoundError:
        raise
    except (OSError, ValueError, RecursionError) as error:  # ValueError: invalid UTF-8 or JSON, or too many digits
        raise DamagedFileError(f"{path} cannot be read as JSON ({error}): {remedy}.") from error


def decode(kind: type[Fields], values: Any, name: str) -> Fields:
    """Make an instance of a dataclass from JSON values, and check the types of the values.

    A list becomes a tuple. A whole number becomes a float if the type of its field is float. A JSON object becomes an
    instance of a nested dataclass. A missing field takes its default.

    Args:
        kind: The dataclass. The types of its fields are numbers, strings, tuples, dataclasses, and unions of these.
        values: The fields by name, such as the result of `json.loads` or `dataclasses.asdict`.
        name: Name of the values in error messages, such as "device".

    Raises:
        ValueError: A field is missing, unknown or of a wrong type, or the dataclass refuses a value.
    """
    try:
        return _adapter(kind).validate_json(json.dumps(values), strict=True, extra="forbid")
    except pydantic.ValidationError as error:
        raise ValueError(_first_fault(error.errors()[0], name)) from error


_adapter: Callable[[Any], pydantic.TypeAdapter[Any]] = functools.cache(pydantic.TypeAdapter)


def _first_fault(fault: ErrorDetails, name: str) -> str:
    """The message for the first fault that pydantic found."""
    place = name + "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in fault["loc"])
    match fault["type"]:
        case "missing":
            return f"field {place} is missing"
        case "unexpected_keyword_argument":
            return f"field {place} is unknown"
        case "value_error":  # raised by the dataclass itself
            return str(fault["ctx"]["error"])
    return f"field {place} is {fault['input']!r}: {fault['msg']}"


def read_fields(kind: type[Fields], path: Path, remedy: str) -> Fields:
    """Read a JSON file as a dataclass. The arguments are those of `decode` and `read_json`."""
    try:
        return decode(kind, read_json(path, remedy), "content")
    except ValueError as error:
        raise DamagedFileError(f"{path} has another content than expected ({error}): {remedy}.") from None


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write named arrays to an `.npz` file atomically."""
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    write_bytes(path, buffer.getvalue())


def read_arrays(path: Path, remedy: str) -> dict[str, np.ndarray]:
    """Read the arrays of a file that `write_arrays` wrote.

    Args:
        remedy: Text at the end of the error message, with the remedy for a damaged file.
    """
    data = path.read_bytes()
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
            return dict(arrays)
    except Exception as error:  # np.load raises errors of five types for damaged files
        raise DamagedFileError(f"{path} is damaged ({error}): {remedy}.") from error


def claim(path: Path, content: dict, defaults: dict | None = None, ignored: Sequence[str] = ()) -> None:
    """Record settings in a JSON file, or check that an existing file has the same settings.

    The check ensures that all results in a folder have the same settings. Tuples count as lists. A field that the file
    lacks, because an older version wrote it, counts as equal to its default in `defaults`, from `default_fields`. The
    dotted names in `ignored` may differ.
    """
    content = json.loads(json_bytes(content))
    if not path.exists():
        write_json(path, content)
        return
    recorded = read_json(path, f"delete {path.parent}, or choose another folder")
    old = _filled(recorded, content, json.loads(json_bytes(defaults or {})))
    if changes := differences(old, content, ignored):
        raise ValueError(
            f"{path} was made with {changes}: choose another folder, or delete {path.parent} to start again."
        )


_SHOWN = 3  # number of differing fields whose values a message contains


def differences(old: object, new: object, ignored: Sequence[str] = ()) -> str:
    """The fields of two contents of JSON types that differ, as a part of a message. Empty if all are equal."""
    changes = [change for change in _differences(old, new) if change[0] not in ignored]
    before = ", ".join(f"{field or 'content'} = {value!r}" for field, value, _ in changes[:_SHOWN])
    now = ", ".join(f"{field or 'content'} = {value!r}" for field, _, value in changes[:_SHOWN])
    more = f" (also different: {', '.join(field for field, *_ in changes[_SHOWN:])})" if changes[_SHOWN:] else ""
    return f"{before}, but the current settings have {now}{more}" if changes else ""


def default_fields(value: Any) -> dict:
    """The default values of the fields of a dataclass instance, with those of the dataclasses in its fields."""
    fields = {field.name: field.default for field in dataclasses.fields(value)}
    inner = {name: getattr(value, name) for name in fields if dataclasses.is_dataclass(getattr(value, name))}
    plain = {name: default for name, default in fields.items() if name not in inner}
    return {name: default for name, default in plain.items() if default is not dataclasses.MISSING} | {
        name: default_fields(part) for name, part in inner.items()
    }


def _filled(recorded: Any, content: Any, defaults: dict) -> Any:
    """A recorded content with the defaults of the fields that it lacks, of those that the new content has."""
    if not isinstance(recorded, dict) or not isinstance(content, dict):
        return recorded
    inner = {name: part for name, part in defaults.items() if isinstance(part, dict)}
    parts = {name: _filled(recorded[name], content.get(name), inner[name]) for name in inner if name in recorded}
    lacking = {name: value for name, value in defaults.items() if name in content and name not in {**recorded, **inner}}
    return recorded | parts | lacking


def _differences(old: object, new: object, field: str = "") -> Iterator[tuple[str, object, object]]:
    """Yield each field in which two contents differ: its dotted name, the old value and the new value."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in dict.fromkeys([*old, *new]):
            yield from _differences(old.get(key), new.get(key), f"{field}.{key}".lstrip("."))
    elif old != new:
        yield field, old, new


def sha256(path: Path) -> str:
    """SHA-256 of a file's content, in hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def digest(content: Any) -> str:
    """SHA-256 of an object of JSON types, in hexadecimal digits, independent of the order of its keys."""
    plain = json.loads(json_bytes(content))
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()


MANIFEST = "manifest.json"


class Manifest(NamedTuple):
    """The files of a folder with their checksums, and what else its writer records, such as a step number."""

    files: dict[str, str]  # SHA-256 in hexadecimal digits, by path relative to the folder
    facts: dict[str, Any]  # JSON values

    @property
    def content(self) -> dict[str, Any]:
        """The content of `manifest.json`, with its checksum."""
        return {**self._asdict(), "checksum": digest(self._asdict())}


def checksums(folder: Path, names: Iterable[str]) -> dict[str, str]:
    """SHA-256 of some files of a folder, by their paths relative to the folder."""
    return {name: sha256(folder / name) for name in names}


def write_manifest(
    folder: Path, files: Mapping[str, str], facts: Mapping[str, Any] | None = None, *, name: str = MANIFEST
) -> Manifest:
    """Write `manifest.json`, after all other files of the folder. The file also has a checksum of its own content.

    Args:
        files: SHA-256 by relative path, from `checksums`. For files that have not changed, pass the values of the
            previous manifest, so that damage since then is not hidden.
        facts: Further JSON values.
        name: Name of a manifest of only some files of the folder.
    """
    manifest = Manifest(dict(files), dict(facts or {}))
    write_json(folder / name, manifest.content)
    return manifest


@dataclasses.dataclass(frozen=True)
class _Content:
    """The content of `manifest.json`."""

    files: dict[str, str]
    facts: dict[str, Any]
    checksum: str


def read_manifest(folder: Path, remedy: str, kind: type[Any] | None = None, *, name: str = MANIFEST) -> Manifest | None:
    """Read `manifest.json`, without comparing the files. None if the folder has no such file.

    Args:
        remedy: Text at the end of the error message, with the remedy for a damaged, edited or exchanged manifest.
        kind: Dataclass with the facts that a folder of this kind has. None: any facts.
        name: Name of a manifest of only some files of the folder.
    """
    path = folder / name
    if not path.exists():
        return None
    try:
        content = decode(_Content, read_json(path, remedy), "content")
        if content.checksum != digest({"files": content.files, "facts": content.facts}):
            raise ValueError("its checksum differs")
    except ValueError as error:
        text = f"{path} is damaged, or was written by another version of sts_jax ({error}): {remedy}."
        raise DamagedFileError(text) from None
    if kind is not None:
        try:
            decode(kind, content.facts, "facts")
        except ValueError as error:
            raise DamagedFileError(f"{path} is that of another folder ({error}): {remedy}.") from None
    return Manifest(content.files, content.facts)


def verify(
    folder: Path, manifest: Manifest, remedy: str, names: Iterable[str] | None = None, *, listing: str = MANIFEST
) -> None:
    """Compare files of a folder with their checksums in its manifest. The first that differs is named.

    Args:
        remedy: Text at the end of the error message.
        names: Relative paths of the files to compare. None: all files of the manifest.
        listing: Name of the manifest, for messages.
    """
    for name in manifest.files if names is None else names:
        path = folder / name
        if name not in manifest.files:
            raise DamagedFileError(f"{path} is not listed in {listing}: {remedy}.")
        try:
            actual = sha256(path)
        except FileNotFoundError:
            raise DamagedFileError(f"{path} is missing, but {listing} lists it: {remedy}.") from None
        except OSError as error:
            raise DamagedFileError(f"{path} cannot be read ({error}): {remedy}.") from error
        if actual != manifest.files[name]:
            raise DamagedFileError(
                f"{path} is not the file that {listing} lists (its SHA-256 differs). It was edited, exchanged or "
                f"damaged: {remedy}."
            )


_LOOK_S = 5.0  # longest wait for a lock that another process may only look at (s)


@contextlib.contextmanager
def lock(folder: Path, *, finished: bool = False, part: tuple[int, int] = (0, 1)) -> Iterator[None]:
    """Lock a folder for this process until the `with` block or the process ends. A missing folder is created.

    What killed processes have left of unfinished writes is deleted, unless several processes work in the folder.

    Args:
        finished: True if the results in the folder may be complete, so that nothing needs to be written. A folder on a
            read-only file system is then not locked.
        part: Index of this process and number of the processes that work in the folder at the same time. Each locks
            the folder for its own index only.

    Raises:
        LockedError: The folder is already locked for this index or another number of processes, also by this process.
    """
    index, count = part
    name = ".lock" if count == 1 else f".lock-{index}-of-{count}"
    held = filelock.FileLock(folder / name, timeout=0)
    this = f"process {os.getpid()} on {platform.node()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        held.acquire()
        _owner(folder / name).write_text(this)
        for path in _other_locks(folder, name, count):
            # Other processes that start look at these locks for a moment, too.
            with filelock.FileLock(path, timeout=_LOOK_S):
                _unlock(path, keep=path.name == ".lock")
    except filelock.Timeout as error:
        taken = Path(error.lock_file)
        if taken.name != name:
            _unlock(folder / name, keep=count == 1)
        held.release()
        holder = "another process"
        with contextlib.suppress(OSError):  # the holder may not have written it yet, or may have just finished
            holder = _owner(taken).read_text(errors="replace") or holder
        what = "" if count == 1 and taken.name == name else f", which locked it with {taken.name}"
        own = holder == this
        remedy = "close what uses the folder in this process" if own else "wait until that process has finished"
        raise LockedError(f"{folder} is in use by {holder}{what}: {remedy}, or choose another folder.") from None
    except OSError as error:
        held.release()
        if finished and error.errno in _FORBIDDEN and folder.is_dir():
            yield
            return
        raise OSError(f"cannot create or write to {folder}: {error}. Choose a folder you can write to.") from error
    try:
        if count == 1:
            delete_partial(folder)
        yield
    finally:
        with contextlib.suppress(OSError):  # the folder may have been deleted meanwhile
            _unlock(folder / name, keep=count == 1)
        held.release()


def _owner(path: Path) -> Path:
    """File with the number of the process that holds a lock."""
    return path.with_name(f"{path.name}-owner")


def _unlock(path: Path, *, keep: bool) -> None:
    """Delete the files of a lock that this process holds. The lock of a whole folder may be kept."""
    _owner(path).unlink(missing_ok=True)
    if not keep:
        path.unlink(missing_ok=True)


def _other_locks(folder: Path, name: str, count: int) -> list[Path]:
    """The locks of a folder that exclude this one: those for another number of processes."""
    paths = [path for path in folder.glob(".lock*") if not path.name.endswith("-owner")]
    return [path for path in paths if path.name != name and not path.name.endswith(f"-of-{count}")]


def _in_use(folder: Path) -> bool:
    """Whether the lock of a whole folder is held."""
    try:
        with filelock.FileLock(folder / ".lock", timeout=0):
            return False
    except filelock.Timeout:
        return True


def delete_partial(folder: Path, prefix: str = "") -> None:
    """Delete unfinished files and folders, except in folders below that have a lock of their own.

    Args:
        prefix: Beginning of the names to delete.
    """
    with contextlib.suppress(OSError):  # a folder of another user
        for path in list(folder.iterdir()):
            is_folder = path.is_dir() and not path.is_symlink()
            if path.name.startswith(f".{prefix}") and path.suffix == ".partial" and not (is_folder and _in_use(path)):
                shutil.rmtree(path, ignore_errors=True) if is_folder else path.unlink(missing_ok=True)
            elif is_folder and not any(path.glob(".lock*")):
                delete_partial(path, prefix)


def flush_folder(folder: Path) -> None:
    """Flush the list of a folder's files to disk, so that new and renamed files survive a power failure."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.EBADF):  # some shared file systems cannot flush folders
            raise
    finally:
        os.close(descriptor)


def write_folder(path: Path, files: Mapping[str, bytes], facts: Mapping[str, Any] | None = None) -> None:
    """Create a folder with files atomically. An interruption leaves either the complete folder or the previous state.

    All files are on disk when the function returns. An OSError names the folder and the remedy.

    Args:
        path: The folder. A folder that already exists must be empty.
        files: The content of each file, by its name.
        facts: Facts of the manifest.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(temporary, ignore_errors=True)
        temporary.mkdir()
        for name, data in files.items():
            with (temporary / name).open("wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
        write_manifest(temporary, {name: hashlib.sha256(data).hexdigest() for name, data in files.items()}, facts)
        flush_folder(temporary)
        temporary.rename(path)
        flush_folder(path.parent)
    except OSError as error:
        raise OSError(error.errno, f"cannot write {path}: {error.strerror or error}. {remedy(error)}.") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
