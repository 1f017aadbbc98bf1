"""Checks of the arguments of `Predictor`. Each error message states the argument, the problem and the remedy."""

import operator
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

_QUAT_TOLERANCE = 1e-2  # largest deviation of a quaternion's length from 1
_FARTHEST = 10.0  # m, largest coordinate of a position. A larger number is probably in millimetres


def traced(value: object) -> bool:
    """Return True if a value is traced by `jax.jit`, `jax.vmap` or `jax.grad`, so that its numbers are unknown."""
    return isinstance(value, jax.core.Tracer)


def checked_array(name: str, value: Any, wanted: str) -> np.ndarray | Array:
    """Convert an argument to a NumPy array. A traced value is returned unchanged.

    Args:
        name: Name of the argument, for error messages.
        value: Value of the argument.
        wanted: Description of the contents that the array must have, for error messages.

    Returns:
        The array, of any shape and numeric or Boolean type.

    Raises:
        ValueError: The value is a path or text, or cannot be converted to an array of numbers.
    """
    if traced(value):
        return value
    if isinstance(value, str | bytes | Path):
        raise ValueError(
            f"{name} is {value!r}, but it must be an array of {wanted}, not a path. Load a picture with "
            "np.asarray(PIL.Image.open(path)) / 255."
        )
    try:
        array = np.asarray(value)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} is not an array ({error}): give an array of {wanted}.") from error
    if array.dtype.kind in "OUSMm":
        raise ValueError(
            f"{name} must be an array of {wanted}, got a value of type {type(value).__name__} that NumPy converts to "
            f"the dtype {array.dtype}."
        )
    return array


def float32(array: np.ndarray | Array) -> np.ndarray | Array:
    """Convert an array to float32. Numbers that are too large become infinite, and a later check rejects them."""
    with np.errstate(over="ignore"):
        return array.astype(np.float32)


def checked_masks(
    present: Any, arrays: dict[str, np.ndarray | Array], lead: tuple[int, ...]
) -> dict[str, np.ndarray | Array]:
    """Check the argument `present` of a `Predictor`, and return its masks as Boolean arrays.

    Args:
        present: Dictionary from the name of a modality, such as "tactile", to a Boolean mask of the items in the batch.
            None for no masks.
        arrays: Dictionary from the name of a modality to its input. It contains only the inputs that were given.
        lead: Sizes of the leading axes that all inputs have. Each mask must have this shape.

    Returns:
        Dictionary from the name of a modality to its mask, empty if `present` is None.

    Raises:
        ValueError: `present` is not a dictionary, a mask is for a modality that was not given, or a mask has another
            shape or type.
    """
    if not isinstance(present, Mapping | None):
        raise ValueError(
            f"present has the type {type(present).__name__}, but it must be a dict of bool arrays, such as "
            "present={'tactile': mask}."
        )
    masks = {}
    for name, value in (present or {}).items():
        mask = checked_array(f"present[{name!r}]", value, "bool")
        if name not in arrays:
            raise ValueError(
                f"present[{name!r}] is the mask of an input that was not given: give this input, or leave out its "
                f"mask. The given inputs are {list(arrays)}."
            )
        if mask.shape != lead:
            raise ValueError(
                f"present[{name!r}] has shape {mask.shape}, but it must have shape {lead}, because {name} has shape "
                f"{arrays[name].shape}: give one Boolean value for each item in the batch, or a single Boolean value "
                "if there is no batch."
            )
        if mask.dtype != bool:
            raise ValueError(
                f"present[{name!r}] has dtype {mask.dtype}, but it must be bool: give True for the items to use."
            )
        masks[name] = mask
    return masks


def checked_measurements(measurements: Any, reserved: tuple[str, ...]) -> dict[str, Any]:
    """Check the argument `measurements` of a `Predictor`, and return its entries that are not None.

    Args:
        measurements: Dictionary from the name of each further modality to its values. A value of None means that the
            modality was not measured. None instead of the dictionary means that no further modality was measured.
        reserved: Names of the modalities that have an argument of their own.

    Raises:
        ValueError: `measurements` is not a dictionary, or has values with a name in `reserved`.
    """
    if not isinstance(measurements, Mapping | None):
        raise ValueError(
            f"measurements has the type {type(measurements).__name__}, but it must be a dict of arrays, such as "
            "measurements={'wrench': wrench}."
        )
    own = {name: value for name, value in (measurements or {}).items() if value is not None}
    for name in reserved:
        if name in own:
            raise ValueError(f"measurements must not have the key {name!r}: pass these values as the argument {name}.")
    return own


def checked_samples(num_samples: Any, key: Any) -> int:
    """Check the arguments `num_samples` and `key` of a `Predictor`, and return `num_samples` as an int.

    Args:
        num_samples: Number of samples to draw, >= 0.
        key: Random key that draws the samples, one key of `jax.random.key`. It may be None if `num_samples` is 0.

    Raises:
        ValueError: `num_samples` is negative, traced or not a whole number, or `key` is missing or not a single key.
    """
    try:
        number = operator.index(num_samples)
    except TypeError:
        raise ValueError(
            f"num_samples={num_samples!r}, but it must be a whole number. Inside jax.jit, mark it as a constant with "
            "static_argnames."
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


Kind = Literal["image", "pose", "vector"]  # kinds of inputs. Each kind has its own range


def plausible(kind: Kind, array: Float[Array, "..."]) -> Bool[Array, "*n"]:
    """Find the items of a batch whose numbers are in range. The array may be traced.

    The numbers of an image must be in [0, 1]. A pose must have coordinates of at most 10 m in magnitude and a
    quaternion of length 1, with a tolerance of 0.01. The numbers of a vector must be finite.

    Args:
        kind: Kind of the input.
        array: Images of shape (*n, height, width, channels), poses of shape (*n, 7), or vectors of shape (*n, size),
            with any leading axes *n. A pose is a position (m) and a unit quaternion.

    Returns:
        Mask of the items in range.
    """
    if kind == "vector":
        return jnp.isfinite(array).all(-1)
    if kind == "pose":
        lengths = jnp.linalg.norm(jax.lax.stop_gradient(array[..., 3:]), axis=-1)
        return (jnp.abs(lengths - 1) <= _QUAT_TOLERANCE) & (jnp.abs(array[..., :3]) <= _FARTHEST).all(-1)
    return ((array >= 0) & (array <= 1)).all((-3, -2, -1))


def check_values(name: str, kind: Kind, array: np.ndarray) -> None:
    """Check that all numbers of an input are finite and in the range of its kind.

    Args:
        name: Name of the modality, for error messages.
        kind: Kind of the input.
        array: Images of shape (..., height, width, channels), poses of shape (..., 7), or vectors of shape
            (..., size). A pose is a position (m) and a unit quaternion.

    Raises:
        ValueError: A number is NaN or infinite, an image has values outside [0, 1], a quaternion's length is not 1
            (tolerance 0.01), or a coordinate of a position is more than 10 m in magnitude.
    """
    if not np.isfinite(array).all():
        raise ValueError(
            f"{name} has NaN or infinite values. Exclude the items with such values: pass present={{{name!r}: mask}}, "
            "where mask is False for these items."
        )
    if kind == "vector":
        return
    if kind == "pose":
        lengths = np.linalg.norm(array[..., 3:].astype(np.float64), axis=-1)  # squares of 1e30 are beyond float32
        if lengths.size and np.abs(lengths - 1).max() > _QUAT_TOLERANCE:
            raise ValueError(
                f"pose has a quaternion of length {lengths.flat[np.abs(lengths - 1).argmax()]:.5g}, but the length "
                f"must be 1 (tolerance {_QUAT_TOLERANCE}): give a position (m) and a unit quaternion [w, x, y, z]."
            )
        if array.size and np.abs(array[..., :3]).max() > _FARTHEST:
            raise ValueError(
                f"pose has a coordinate of {np.abs(array[..., :3]).max():.3g} m, but at most {_FARTHEST:g} m is "
                "allowed: give metres, not millimetres."
            )
    elif array.size and (array.min() < 0 or array.max() > 1):
        raise ValueError(
            f"{name} has values in [{array.min():.3g}, {array.max():.3g}], but images must be in [0, 1]: "
            "divide by 255 if the values are 8-bit."
        )
