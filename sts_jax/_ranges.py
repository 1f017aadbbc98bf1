"""Allowed ranges of a dataclass's fields, declared in their metadata, as in `field(default=4 / 3, metadata=POSITIVE)`.

The metadata's keys are "above" (>), "at_least" (>=), "below" (<), "at_most" (<=), "whole" and "static". The key
"metres" is the power of the unit metre in a constant of the sensor (`Sensor.sized`).
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

POSITIVE = {"above": 0.0}
NOT_NEGATIVE = {"at_least": 0.0}
SHARE = {"at_least": 0.0, "at_most": 1.0}
NUMBER = {"at_least": 0, "at_most": 2**32 - 1, "whole": True}
COUNT = {"at_least": 1, "at_most": 10**9, "whole": True}
MOST_PIXELS = 8192  # height or width of an image
LENGTH = {"metres": 1}
STATIC = {"static": True}  # JAX compiles a program for each value of the field

_LARGEST = 2**32  # whole numbers must be smaller, because JAX has 32 bits for a seed
_SMALLEST = float(np.finfo(np.float32).tiny)  # float32 arithmetic flushes smaller numbers to 0


def limits(metadata: Mapping[str, Any], array: Any) -> list[tuple[Any, str]]:
    """Compare numbers, a NumPy or traced JAX array, with the limits in a field's metadata.

    Returns:
        One pair for each limit: True if all numbers satisfy it, and a text such as "it must be > 0".
    """
    conditions = []
    if "above" in metadata:
        conditions.append(((array - metadata["above"] >= _SMALLEST).all(), f"it must be > {metadata['above']:g}"))
    if "at_least" in metadata:
        conditions.append(((array >= metadata["at_least"]).all(), f"it must be >= {metadata['at_least']:g}"))
    if "below" in metadata:
        conditions.append(((array < metadata["below"]).all(), f"it must be < {metadata['below']:.4f}"))
    if "at_most" in metadata:
        conditions.append(((array <= metadata["at_most"]).all(), f"it must be <= {metadata['at_most']:,.10g}"))
    return conditions


def check(config: Any, owner: str = "") -> None:
    """Raise a ValueError for the first number of a dataclass that is not finite, not whole or out of its range."""
    for field in dataclasses.fields(config):
        value, metadata = getattr(config, field.name), field.metadata
        if not metadata or value is None:
            continue
        if metadata.get("whole") and not isinstance(value, int | np.integer):
            raise ValueError(f"{owner}{field.name} must be a whole number, got {value!r}")
        if not -np.inf < value < np.inf:
            raise ValueError(f"{owner}{field.name} must be finite, got {value!r}")
        number = value
        if metadata.get("whole"):
            number = min(max(value, -_LARGEST), _LARGEST)
        bounds = {"at_most": _LARGEST - 1, **metadata} if metadata.get("whole") else metadata
        for holds, words in limits(bounds, np.asarray(number)):
            if not holds:
                raise ValueError(f"{owner}{field.name} {words.removeprefix('it ')}, got {value!r}")
