"""Run-time checks of arguments at the public entry points."""

from typing import Any

import jax
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
