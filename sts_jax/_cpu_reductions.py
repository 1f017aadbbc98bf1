"""Reductions of vectors in a form that XLA's CPU backend vectorises.

XLA computes `jnp.min`, `jnp.max` and `jnp.cumsum` one element at a time on a CPU.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

_LANES = 32  # row length in `cumsum`. `_fold` splits vectors of at least twice this length


def minimum(values: Array) -> Array:
    """Smallest value of a vector. `jnp.min` gives the same result but is slower on a CPU."""
    return _fold(jnp.minimum, jnp.min, values)


def maximum(values: Array) -> Array:
    """Largest value of a vector. `jnp.max` gives the same result but is slower on a CPU."""
    return _fold(jnp.maximum, jnp.max, values)


def cumsum(counts: Array) -> Int[Array, "n"]:
    """Cumulative sum of integers or flags, in float32 by triangular matrices. The total must be below 2^24."""
    size = len(counts)
    rows = -(-size // _LANES)
    table = jnp.pad(counts.astype(jnp.float32), (0, rows * _LANES - size)).reshape(rows, _LANES)
    sums = jnp.matmul(table, jnp.triu(jnp.ones((_LANES, _LANES))), precision=jax.lax.Precision.HIGHEST)
    sums = sums.astype(jnp.int32)
    if rows > 1:
        sums = sums.at[1:].add(cumsum(sums[:-1, -1])[:, None])
    return sums.reshape(-1)[:size]


def flatnonzero(flags: Bool[Array, "n"]) -> Int[Array, "n"]:
    """Indices of the true flags in ascending order, followed by the value n up to the length n of `flags`."""
    size = len(flags)
    place = jnp.where(flags, cumsum(flags) - 1, size)
    return jnp.full(size, size, jnp.int32).at[place].set(jnp.arange(size, dtype=jnp.int32), mode="drop")


def _fold(pair: Callable[[Array, Array], Array], whole: Callable[[Array], Array], values: Array) -> Array:
    """Reduce a vector: `pair` combines its eight parts until it is short, then `whole` reduces the rest."""
    while len(values) >= 2 * _LANES:
        part = len(values) // 8
        parts = [values[k * part : (k + 1) * part] for k in range(8)]
        rest = values[8 * part :]
        values = jnp.concatenate([functools.reduce(pair, parts), rest]) if len(rest) else functools.reduce(pair, parts)
    return whole(values)
