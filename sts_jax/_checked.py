"""Run-time checks of arguments at the public entry points and of arrays from files, and the settings of JAX."""

import contextlib
import functools
import sys
import typing
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import jax
import jaxtyping
import numpy as np
from beartype import BeartypeConf, beartype
from jaxtyping import jaxtyped

_by_annotations = jaxtyped(typechecker=beartype(conf=BeartypeConf(is_pep484_tower=True)))  # an int is also a float
_INSIDE = (str(Path(__file__).parent), str(Path(jaxtyping.__file__).parent), "<@beartype")  # files of the entry points
P = ParamSpec("P")
R = TypeVar("R")


def checked(function: Callable[P, R]) -> Callable[P, R]:
    """Check array shapes and argument types by the annotations, with errors that leave out the other arguments."""
    inside = _by_annotations(function)

    @functools.wraps(function)
    def run(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            return inside(*args, **kwargs)
        except jaxtyping.TypeCheckError as error:
            what, line, rest = str(error).partition("\n----")
            if not line:  # of a function inside, whose error is short already
                raise
            _, known, axes = rest.partition("\nThe current values for each jaxtyping axis")  # such as b=3
            raise jaxtyping.TypeCheckError(what + known + axes) from None

    return run


def in_32_bits(function: Callable[P, R]) -> Callable[P, R]:
    """Run a function in 32 bits and with JAX's usual promotion of types and ranks, whatever the user has set.

    64-bit arrays are rounded. The settings hold for one thread, so a function that a pool runs needs the decorator too.
    """

    @functools.wraps(function)
    def run(*args: P.args, **kwargs: P.kwargs) -> R:
        if current_settings() == (False, "standard", "allow"):
            return function(*args, **kwargs)
        args, kwargs = jax.tree.map(_rounded, (args, kwargs))
        with settings(False):
            return function(*args, **kwargs)

    return run


def current_settings() -> tuple[bool, str, str]:
    config: Any = jax.config  # whose attributes mypy does not know
    return config.jax_enable_x64, config.jax_numpy_dtype_promotion, config.jax_numpy_rank_promotion


@contextlib.contextmanager
def settings(x64: bool) -> Iterator[None]:
    """JAX's usual promotion, and 64 bits or not."""
    with jax.enable_x64(x64), jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


def _rounded(leaf: Any) -> Any:
    """A 64-bit array in 32 bits."""
    if isinstance(leaf, jax.Array) and leaf.dtype in ("float64", "int64", "uint64", "complex128"):
        return leaf.astype(str(leaf.dtype).replace("64", "32").replace("128", "64"))
    return leaf


def warn(problem: str) -> None:
    """Warn, at the line that called the library."""
    frame, level = sys._getframe(1), 2
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_INSIDE):
        frame, level = frame.f_back, level + 1
    warnings.warn(problem, stacklevel=level)


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
        kind: A dataclass or NamedTuple of arrays. The field `fill` of its field `hidden` has the name `hidden/fill`. An
            array whose annotation includes None may be missing.
        arrays: The arrays, with any leading axes, all the same. Their values must be finite.
        infinite: Names of arrays whose values may be infinite.
    """
    hints = {name: hint for name, hint, optional in _annotations(kind) if name in arrays or not optional}
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


def _annotations(kind: type, prefix: str = "") -> Iterator[tuple[str, Any, bool]]:
    """Names and annotations of the arrays, and whether they may be None."""
    for name, hint in typing.get_type_hints(kind).items():
        array, *rest = typing.get_args(hint) or (hint,)
        if hasattr(array, "dim_str"):
            yield prefix + name, array, rest == [type(None)]
        else:
            yield from _annotations(hint, f"{prefix}{name}/")
