"""The records of a training, `metrics.jsonl`: one line of JSON per record, with the step and the parts of the loss."""

import json
from pathlib import Path

import jax
import numpy as np

from sts_jax import _files
from sts_jax.training.learners import Terms

NAME = "metrics.jsonl"
Record = dict[str, float]  # `step` and the parts of the loss by name


def mean(step: int, recent: list[Terms]) -> Record:
    """The record of a step: means over the steps since the previous record."""
    return {"step": step, **jax.tree.map(lambda *x: float(np.mean(x)), *recent)}


def read(path: Path, last: int) -> list[Record]:
    """Read the records up to step `last`, or none if there is no file. A torn last line is left out.

    Raises:
        TornFileError: another line is damaged.
        OSError: the file cannot be read.
    """
    try:
        lines = path.read_bytes().splitlines() if path.exists() else []
    except OSError as error:
        raise OSError(
            f"cannot read {path}: {error}. Check its permissions, or delete it to continue without it."
        ) from error
    records = []
    for number, line in enumerate(lines, 1):
        try:
            record = json.loads(line.decode())
            keep = record["step"] <= last
        except (UnicodeDecodeError, json.JSONDecodeError, KeyError, TypeError) as error:
            if number == len(lines):  # torn by a kill
                break
            raise _files.TornFileError(
                f"{path}, line {number}, is damaged ({type(error).__name__}: {error}): delete this line, or the "
                "file, to continue without these records."
            ) from error
        if keep:
            records.append(record)
    return records


def write(path: Path, records: list[Record]) -> None:
    """Replace the file by these records.

    Raises:
        OSError: the file cannot be written.
    """
    _files.write_bytes(path, "".join(json.dumps(record) + "\n" for record in records).encode())


def append(path: Path, record: Record) -> None:
    """Append one record.

    Raises:
        OSError: the file cannot be written.
    """
    try:
        with path.open("a") as file:
            file.write(json.dumps(record) + "\n")
    except OSError as error:
        raise OSError(
            f"cannot write {path}: {error}. {_files.remedy(error)}, then start again (the last checkpoint is kept)."
        ) from error
