"""The check of a random key."""

from typing import Any

import jax


def check_key(key: Any) -> None:
    """Check that `key` is one JAX key: of `jax.random.key`, or of the older `jax.random.PRNGKey`.

    Raises:
        TypeError: it is something else. The message names its value and the remedy.
    """
    if isinstance(key, jax.Array) and jax.dtypes.issubdtype(key.dtype, jax.dtypes.prng_key):
        if key.shape:
            raise TypeError(f"key has shape {key.shape}; it takes one key: index it, or use jax.vmap")
    elif not (getattr(key, "shape", None) == (2,) and getattr(key, "dtype", None) == "uint32"):
        raise TypeError(f"key is {key!r}; it takes a JAX key: jax.random.key(0)")
