"""Timing of several functions, to compare their durations."""

import time
from collections.abc import Callable

import jax
import numpy as np


def in_turn(*calls: Callable[[], object], repeats: int = 5) -> np.ndarray:
    """Measure the durations of functions in alternation, so that a busy machine slows all of them alike.

    Each function is called once before the measurement, so that its compilation is not measured. A call ends when
    its arrays are ready.

    Args:
        calls: Functions without arguments.
        repeats: Number of measured calls of each function.

    Returns:
        Seconds of each call, `(repeats, len(calls))`.
    """
    seconds = np.empty((repeats + 1, len(calls)))
    for row in seconds:
        for i, call in enumerate(calls):
            begin = time.perf_counter()
            jax.block_until_ready(call())
            row[i] = time.perf_counter() - begin
    return seconds[1:]
