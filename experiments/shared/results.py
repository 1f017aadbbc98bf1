"""Checksums of the inputs and outputs of results, which show whether the results are up to date."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sts_jax import _files


def identity(folder: Path) -> str:
    """SHA-256 of the names and contents of all files in a model's folder, without hidden files."""
    files = (path for path in folder.rglob("*") if path.is_file() and not path.name.startswith("."))
    return _files.digest({path.relative_to(folder).as_posix(): _files.sha256(path) for path in files})


def write(path: Path, content: Mapping[str, Any], inputs: Mapping[str, str], outputs: Sequence[Path]) -> None:
    """Write results as JSON, with the checksums of their inputs and of the files made with them.

    Args:
        path: The JSON file. It is written last and marks the results as complete.
        content: The results.
        inputs: The checksum of each input, by a name for messages.
        outputs: The other files, in the folder of `path` or below it.
    """
    record = {
        **content,
        "inputs": dict(inputs),
        "outputs": {file.relative_to(path.parent).as_posix(): _files.sha256(file) for file in outputs},
    }
    _files.write_json(path, {**record, "checksum": _files.digest(record)})


def stale(path: Path, inputs: Mapping[str, str]) -> str | None:
    """The reason why results must be computed again, or None if they are up to date.

    Args:
        path: The file that `write` wrote.
        inputs: The checksum of each input as it is now.
    """
    try:
        record = _files.read_json(path, "it will be written again")
    except FileNotFoundError:
        return f"{path.name} is missing"
    except _files.TornFileError:
        return f"{path.name} is damaged"
    if not isinstance(record, dict) or "checksum" not in record:
        return f"{path.name} has no record of its inputs"
    if record.pop("checksum") != _files.digest(record):
        return f"{path.name} was changed"
    for name in {**record["inputs"], **inputs}:
        if record["inputs"].get(name) != inputs.get(name):
            return f"{name} has changed since"
    for name, checksum in record["outputs"].items():
        file = path.parent / name
        if not file.is_file() or _files.sha256(file) != checksum:
            return f"{name} is missing or was changed"
    return None
