"""Run-time checks of arguments at the public entry points, and of arrays that were read from files."""

import typing
from collections.abc import Collection, Iterator, Mapping
from typing import Any

import jax
import numpy as np
from beartype import BeartypeConf, beartype
from jaxtyping import jaxtyped

# Check array shapes and argument types by the annotations. An int is accepted for a float (PEP 484).
checked = jaxtyped(typechecker=beartype(conf=BeartypeConf(is_pep484_tower=True)))


def check_key(key: Any) -> None:
    """Raise a TypeError unless an argument is one key, from `jax.random.key` or `jax.random.PRNGKey`."""
    if isinstance(key, jax.Array) and jax.dtypes.issubdtype(key.dtype, jax.dtypes.prng_key):
        if key.shape:
            raise TypeError(f"key has shape {key.shape}, but it must be one key: call the function once for each key")
    elif not (getattr(key, "shape", None) == (2,) and getattr(key, "dtype", None) == "uint32"):
        raise TypeError(f"key is {key!r}, but it must be a JAX key, such as jax.random.key(0)")


def check_arrays(kind: type, arrays: Mapping[str, Any], infinite: Collection[str] = ()) -> None:
    """Raise a ValueError unless arrays have the names, shapes and types of the annotations of a class.

    Args:
        kind: A dataclass or NamedTuple of arrays. The field `fill` of its field `hidden` has the name `hidden/fill`.
        arrays: The arrays, with any leading axes, all the same. Their values must be finite.
        infinite: Names of arrays whose values may be infinite.
    """
    hints = dict(_annotations(kind))
    if different := sorted(hints.keys() ^ arrays.keys()):
        raise ValueError(f"array {different[0]} is {'missing' if different[0] in hints else 'unknown'}")
    with jaxtyped("context"):
        for name, hint in hints.items():
            array, shape = np.asarray(arrays[name]), hint.dim_str.lstrip("*")
            if not isinstance(array, hint.dtype[np.ndarray, f"*{shape}"]):
                raise ValueError(
                    f"array {name} is {array.dtype} of shape {array.shape}, but it must be {hint.dtype.__name__} of "
                    f"shape ({', '.join(shape.split())}), with the axes of the other arrays"
                )
            if array.dtype.kind == "f" and (np.isnan(array) if name in infinite else ~np.isfinite(array)).any():
                raise ValueError(f"array {name} has values that are not finite")


def _annotations(kind: type, prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, hint in typing.get_type_hints(kind).items():
        if hasattr(hint, "dim_str"):
            yield prefix + name, hint
        else:
            yield from _annotations(hint, f"{prefix}{name}/")
