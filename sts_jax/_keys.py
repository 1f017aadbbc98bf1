"""`check_key`, which checks that an argument is a random key of JAX."""

from typing import Any

import jax


def check_key(key: Any) -> None:
    """Raise a TypeError unless an argument is one key, from `jax.random.key` or `jax.random.PRNGKey`."""
    if isinstance(key, jax.Array) and jax.dtypes.issubdtype(key.dtype, jax.dtypes.prng_key):
        if key.shape:
            raise TypeError(f"key has shape {key.shape}, but it must be one key: call the function once for each key")
    elif not (getattr(key, "shape", None) == (2,) and getattr(key, "dtype", None) == "uint32"):
        raise TypeError(f"key is {key!r}, but it must be a JAX key, such as jax.random.key(0)")
