"""Reductions for the CPU against NumPy."""

import jax
import numpy as np
import pytest

from sts_jax import _cpu_reductions


@pytest.mark.parametrize("size", [1, 7, 33, 64, 150, 1000, 5003])
def test_reductions_equal_numpy(size):
    rng = np.random.default_rng(size)
    values, counts = rng.normal(size=size).astype(np.float32), rng.integers(0, 5, size).astype(np.int32)
    flags = rng.uniform(size=size) < 0.3
    assert jax.jit(_cpu_reductions.minimum)(values) == values.min()
    assert jax.jit(_cpu_reductions.maximum)(values) == values.max()
    np.testing.assert_array_equal(jax.jit(_cpu_reductions.cumsum)(counts), np.cumsum(counts))
    expected = np.concatenate([np.flatnonzero(flags), np.full(size - flags.sum(), size)])
    np.testing.assert_array_equal(jax.jit(_cpu_reductions.flatnonzero)(flags), expected)
