"""Checks of the arguments of a `Predictor`. The messages name the argument, its value and the remedy."""

import operator
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

_QUAT_TOLERANCE = 1e-2  # largest deviation of a quaternion's length from 1
_FARTHEST = 10.0  # m, largest coordinate of a position (larger numbers cannot be metres)


def traced(value: object) -> bool:
    """Whether a value is traced by `jax.jit`, `jax.vmap` or `jax.grad`, so that its numbers are unknown."""
    return isinstance(value, jax.core.Tracer)


def checked_array(name: str, value: Any, wanted: str) -> np.ndarray | Array:
    """Return a value as an array. A traced value is returned unchanged.

    Args:
        name: name of the argument, for messages.
        value: the argument.
        wanted: the contents that the array must have, for messages.

    Raises:
        ValueError: the value is a path, text or otherwise no array of numbers.
    """
    if traced(value):
        return value
    if isinstance(value, str | bytes | Path):
        raise ValueError(
            f"{name} is {value!r}, but it must be an array of {wanted}, not a path (for a picture: "
            "np.asarray(PIL.Image.open(path)) / 255)."
        )
    try:
        array = np.asarray(value)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} is not an array ({error}): give an array of {wanted}.") from error
    if array.dtype.kind in "OUSMm":
        raise ValueError(f"{name} is a {type(value).__name__}, but it must be an array of {wanted}.")
    return array


def float32(array: np.ndarray | Array) -> np.ndarray | Array:
    """Convert to float32. A number beyond its range becomes infinite, which a later check refuses."""
    with np.errstate(over="ignore"):
        return array.astype(np.float32)


def checked_masks(
    present: Any, arrays: dict[str, np.ndarray | Array], lead: tuple[int, ...]
) -> dict[str, np.ndarray | Array]:
    """Check the masks by modality, and return them as bool arrays.

    Raises:
        ValueError: a mask is not bool, masks no given modality, or has another shape than `lead`.
    """
    if not isinstance(present, Mapping | None):
        raise ValueError(f"present is a {type(present).__name__}, but it must be a dict of bool arrays by modality.")
    masks = {}
    for name, value in (present or {}).items():
        mask = checked_array(f"present[{name!r}]", value, "bool")
        if name not in arrays or mask.shape != lead:
            raise ValueError(
                f"present[{name!r}] has shape {mask.shape}, but it must mask a given modality, one of "
                f"{list(arrays)}, with shape {lead}."
            )
        if mask.dtype != bool:
            raise ValueError(f"present[{name!r}] is {mask.dtype}, but it must be bool, True for the items that count.")
        masks[name] = mask
    return masks


def checked_samples(num_samples: Any, key: Any) -> int:
    """Check the number of samples and their key, and return the number.

    Raises:
        ValueError: the number is negative or no constant, or the key is missing or no key.
    """
    try:
        number = operator.index(num_samples)
    except TypeError:
        raise ValueError(
            f"num_samples={num_samples!r}, but it must be a whole number. Inside jax.jit it must be a constant "
            "(static_argnames makes it one)."
        ) from None
    if number < 0:
        raise ValueError(f"num_samples={number}, but it must be >= 0.")
    if number > 0 and key is None:
        raise ValueError(f"num_samples={number}, but key is missing: pass key=jax.random.key(0), or num_samples=0.")
    if key is not None and not (
        isinstance(key, jax.Array) and jnp.issubdtype(key.dtype, jax.dtypes.prng_key) and key.shape == ()
    ):
        shown = f"{key.dtype} of shape {key.shape}" if isinstance(key, jax.Array | np.ndarray) else repr(key)
        raise ValueError(f"key is {shown}, but it must be one key, such as jax.random.key(0).")
    return number


def plausible(name: str, array: Float[Array, "..."]) -> Bool[Array, "*n"]:
    """Which items `check_values` would accept, `(*n,)`."""
    if name == "pose":
        lengths = jnp.linalg.norm(jax.lax.stop_gradient(array[..., 3:]), axis=-1)
        return (jnp.abs(lengths - 1) <= _QUAT_TOLERANCE) & (jnp.abs(array[..., :3]) <= _FARTHEST).all(-1)
    return ((array >= 0) & (array <= 1)).all((-3, -2, -1))


def check_values(name: str, array: np.ndarray) -> None:
    """Raise a ValueError if an image has values outside [0, 1] or a pose is implausible, or a value is NaN."""
    if not np.isfinite(array).all():
        raise ValueError(f"{name} has NaN or infinite values: mask such items with present={{{name!r}: ...}}.")
    if name == "pose":
        lengths = np.linalg.norm(array[..., 3:].astype(np.float64), axis=-1)  # squares of 1e30 are beyond float32
        if lengths.size and np.abs(lengths - 1).max() > _QUAT_TOLERANCE:
            raise ValueError(
                f"pose has a quaternion of length {lengths.flat[np.abs(lengths - 1).argmax()]:.3g}: "
                "give a position (m) and a unit quaternion [w, x, y, z]."
            )
        if array.size and np.abs(array[..., :3]).max() > _FARTHEST:
            raise ValueError(f"pose has a position {np.abs(array[..., :3]).max():.3g} m away: give metres, not mm.")
    elif array.size and (array.min() < 0 or array.max() > 1):
        raise ValueError(
            f"{name} has values in [{array.min():.3g}, {array.max():.3g}], but images are in [0, 1] (divide by 255?)."
        )
