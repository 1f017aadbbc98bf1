"""Checks of the fields of scenarios."""

import math
import numbers

import numpy as np

from sts_jax.physics.scene import Contact


def check_kind(name: str, value: object, default: object) -> None:
    """Raise an error unless a value is of its default's kind: whole number, number, pair of numbers or `Contact`.

    Values of other kinds, which only some scenarios have, are not checked.
    """
    pair = isinstance(default, tuple) and len(default) == 2 and all(map(_is_number, default))
    if isinstance(default, Contact):
        fits, wanted = isinstance(value, Contact), "a physics.Contact"
    elif pair:
        fits = isinstance(value, tuple) and len(value) == 2 and all(map(_is_number, value))
        wanted = "a tuple of two numbers of Python or NumPy, (low, high)"
    elif not _is_number(default):
        return
    elif isinstance(default, int):
        fits, wanted = _is_number(value) and isinstance(value, numbers.Integral), "a whole number of Python or NumPy"
    else:
        fits, wanted = _is_number(value), "a number of Python or NumPy"
    if not fits:
        raise ValueError(f"scenario.{name} is {value!r}, but it must be {wanted}")


def check_range(name: str, values: tuple[float, float], *, positive: bool = True) -> None:
    """Raise an error unless a pair (low, high) is finite, in order, and above 0 (or not below)."""
    low, high = values
    if not (math.isfinite(low) and math.isfinite(high) and low <= high and (low > 0 if positive else low >= 0)):
        raise ValueError(
            f"scenario.{name} is {values}, but it must be (low, high), finite, low <= high and "
            f"{'>' if positive else '>='} 0"
        )


def check_length(name: str, value: float) -> None:
    """Raise an error unless a length (m) is finite and not negative."""
    if not (math.isfinite(value) and value >= 0):
        raise ValueError(f"scenario.{name} is {value} m, but it must be finite and >= 0")


def _is_number(value: object) -> bool:
    return isinstance(value, numbers.Real) and not isinstance(value, bool | np.bool_)
