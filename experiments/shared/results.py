"""Writes results with the checksums of their inputs and output files, and checks if the results are up to date."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sts_jax import storage


def identity(folder: Path) -> str:
    """The SHA-256 checksum of the names and contents of all files in a model's folder, except hidden files."""
    files = (path for path in folder.rglob("*") if path.is_file() and not path.name.startswith("."))
    return storage.digest({path.relative_to(folder).as_posix(): storage.sha256(path) for path in files})


def write(path: Path, content: Mapping[str, Any], inputs: Mapping[str, str], outputs: Sequence[Path]) -> None:
    """Write results as JSON, with the checksums of their inputs and of further output files.

    Call this function after all other files have been written, because the JSON file marks the results as complete.

    Args:
        path: Path of the JSON file.
        content: Results.
        inputs: Checksum of each input, by name. `stale` compares these checksums with those of the current inputs.
        outputs: Further output files, in the folder of `path` or below it.
    """
    record = {
        **content,
        "inputs": dict(inputs),
        "outputs": {file.relative_to(path.parent).as_posix(): storage.sha256(file) for file in outputs},
    }
    storage.write_json(path, {**record, "checksum": storage.digest(record)})


def stale(path: Path, inputs: Mapping[str, str]) -> str | None:
    """Check if results must be computed again.

    Args:
        path: Path of the JSON file that `write` has written.
        inputs: Current checksum of each input.

    Returns:
        The reason for a new computation, or None if the results are up to date.
    """
    try:
        record = storage.read_json(path, "it will be written again")
    except FileNotFoundError:
        return f"{path.name} is missing"
    except storage.DamagedFileError:
        return f"{path.name} is damaged"
    if not isinstance(record, dict) or "checksum" not in record:
        return f"{path.name} has no record of its inputs"
    if record.pop("checksum") != storage.digest(record):
        return f"{path.name} was changed"
    for name in {**record["inputs"], **inputs}:
        if record["inputs"].get(name) != inputs.get(name):
            return f"{name} has changed since"
    for name, checksum in record["outputs"].items():
        file = path.parent / name
        if not file.is_file() or storage.sha256(file) != checksum:
            return f"{name} is missing or was changed"
    return None
