"""Allowed ranges of a dataclass's fields, declared in their metadata.

`aspect: float = dataclasses.field(default=4 / 3, metadata=POSITIVE)` declares that every number of the field must be
> 0. The metadata's keys are "above" (>), "at_least" (>=), "below" (<), "at_most" (<=), "whole" (a whole
number) and "static" (JAX compiles a program for each value).

`limits` compares the numbers of one field with the limits in its metadata. `check` raises an error if a field of a
dataclass violates its limits.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

POSITIVE = {"above": 0.0}
NOT_NEGATIVE = {"at_least": 0.0}
SHARE = {"at_least": 0.0, "at_most": 1.0}
COUNT = {"at_least": 1, "whole": True}
STATIC = {"static": True}  # JAX compiles a program for each value of the field

_SMALLEST = float(np.finfo(np.float32).tiny)  # float32 arithmetic flushes smaller numbers to 0


def limits(metadata: Mapping[str, Any], array: Any) -> list[tuple[Any, str]]:
    """Compare the numbers of a dataclass's field with the range that the field allows.

    Args:
        metadata: Metadata of the field. The keys of its limits are "above" (>), "at_least" (>=), "below" (<) and
            "at_most" (<=).
        array: The numbers, a NumPy array or a traced JAX array.

    Returns:
        One pair (flag, text) for each limit. The flag is True if all numbers satisfy the limit, and the text describes
        the limit for an error message.
    """
    found = []
    if "above" in metadata:
        found.append(((array - metadata["above"] >= _SMALLEST).all(), f"it must be > {metadata['above']:g}"))
    if "at_least" in metadata:
        found.append(((array >= metadata["at_least"]).all(), f"it must be >= {metadata['at_least']:g}"))
    if "below" in metadata:
        found.append(((array < metadata["below"]).all(), f"it must be < {metadata['below']:.4f}"))
    if "at_most" in metadata:
        found.append(((array <= metadata["at_most"]).all(), f"it must be <= {metadata['at_most']:g}"))
    return found


def check(config: Any) -> None:
    """Check each field of a dataclass against the limits in its metadata. A field without metadata is not checked.

    The value of a checked field must be a number or None. None is always allowed. If the metadata has the entry
    `"whole": True`, the number must be an integer.

    Raises:
        ValueError: A number is out of its field's range, not finite, or not whole.
    """
    for field in dataclasses.fields(config):
        value, metadata = getattr(config, field.name), field.metadata
        if not metadata or value is None:
            continue
        if metadata.get("whole") and not isinstance(value, int | np.integer):
            raise ValueError(f"{field.name} must be a whole number, got {value!r}")
        if not np.isfinite(value):
            raise ValueError(f"{field.name} must be finite, got {value!r}")
        for holds, words in limits(metadata, np.asarray(value)):
            if not holds:
                raise ValueError(f"{field.name} {words.removeprefix('it ')}, got {value!r}")
