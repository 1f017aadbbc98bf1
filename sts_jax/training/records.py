"""The training log `metrics.jsonl`.

Each line is a record in JSON: a step, and the mean of each part of the loss since the previous record.
"""

import json
from pathlib import Path

import jax
import numpy as np

from sts_jax import storage
from sts_jax.training.learners import Terms

NAME = "metrics.jsonl"
Record = dict[str, float]  # `step`, and the parts of the loss by name


def mean(step: int, recent: list[Terms]) -> Record:
    """Make the record of the training log at a step.

    Args:
        step: Number of steps done.
        recent: Terms of the loss in each step since the previous record.

    Returns:
        The step, and the mean of each term.
    """
    return {"step": step, **jax.tree.map(lambda *x: float(np.mean(x)), *recent)}


def read(path: Path, last: int | None = None) -> list[Record]:
    """Read the records up to a step. A damaged last line is left out, because an interruption may have cut it.

    Args:
        path: Training log. It need not exist.
        last: Last step whose record is returned (None: return all records).

    Returns:
        The records in the order of the file.

    Raises:
        DamagedFileError: A line other than the last is damaged.
        OSError: The file cannot be read.
    """
    try:
        lines = path.read_bytes().splitlines() if path.exists() else []
    except OSError as error:
        raise OSError(
            f"cannot read {path}: {error}. Check the permissions of this training log, or delete the file to continue "
            "without the earlier records."
        ) from error
    records = []
    for number, line in enumerate(lines, 1):
        try:
            record = json.loads(line.decode())
            keep = last is None or record["step"] <= last
        except (UnicodeDecodeError, json.JSONDecodeError, KeyError, TypeError) as error:
            if number == len(lines):  # the process was killed while it wrote this line
                break
            raise storage.DamagedFileError(
                f"{path}, line {number}, is damaged ({type(error).__name__}: {error}): delete this line to "
                "continue without its record, or delete the file to continue without the earlier records."
            ) from error
        if keep:
            records.append(record)
    return records


def write(path: Path, records: list[Record]) -> None:
    """Replace the training log `path` by the given records.

    Raises:
        OSError: The file cannot be written.
    """
    storage.write_bytes(path, "".join(json.dumps(record) + "\n" for record in records).encode())


def append(path: Path, record: Record) -> None:
    """Append one record to the training log `path`.

    Raises:
        OSError: The file cannot be written.
    """
    try:
        with path.open("a") as file:
            file.write(json.dumps(record) + "\n")
    except OSError as error:
        raise OSError(
            f"cannot write {path}: {error.strerror or error}. {storage.remedy(error)}, then start again (the last "
            "checkpoint is kept)."
        ) from error
