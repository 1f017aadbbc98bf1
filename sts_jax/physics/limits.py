"""Checks of the values of a scenario's fields. Each raises a ValueError that names the field."""

import math
import numbers

import numpy as np

from sts_jax.physics.scene import Contact


def check_kind(name: str, value: object, default: object) -> None:
    """Raise a ValueError unless a field of a scenario has a value of the same kind as its default.

    The four kinds are: a whole number, any real number, a tuple of two numbers, and a `Contact`. A field is not checked
    if its default is of none of these kinds.

    Args:
        name: Name of the field, for the message.
        value: Value of the field.
        default: Default of the field.
    """
    pair = isinstance(default, tuple) and len(default) == 2 and all(map(_is_number, default))
    if isinstance(default, Contact):
        fits, wanted = isinstance(value, Contact), "a physics.Contact"
    elif pair:
        fits = isinstance(value, tuple) and len(value) == 2 and all(map(_is_number, value))
        wanted = "a tuple of two numbers (low, high) of a Python or NumPy type"
    elif not _is_number(default):
        return
    elif isinstance(default, int):
        fits = _is_number(value) and isinstance(value, numbers.Integral)
        wanted = "a whole number of a Python or NumPy type"
    else:
        fits, wanted = _is_number(value), "a number of a Python or NumPy type"
    if not fits:
        raise ValueError(f"scenario.{name} is {value!r}, but it must be {wanted}")


def check_range(name: str, values: tuple[float, float], *, positive: bool = True) -> None:
    """Raise a ValueError unless a range (low, high) is finite with low <= high and low > 0.

    Args:
        name: Name of the scenario's field, for the message.
        values: The range, (low, high).
        positive: If False, `low` may also be 0.
    """
    low, high = values
    if not (math.isfinite(low) and math.isfinite(high) and low <= high and (low > 0 if positive else low >= 0)):
        raise ValueError(
            f"scenario.{name} is {values}, but it must be (low, high) with finite numbers and "
            f"0 {'<' if positive else '<='} low <= high"
        )


def check_length(name: str, value: float) -> None:
    """Raise a ValueError unless a length in a scenario is finite and >= 0.

    Args:
        name: Name of the scenario's field, for the message.
        value: The length (m).
    """
    if not (math.isfinite(value) and value >= 0):
        raise ValueError(f"scenario.{name} is {value} m, but it must be finite and >= 0")


def _is_number(value: object) -> bool:
    return isinstance(value, numbers.Real) and not isinstance(value, bool | np.bool_)
