"""Durations of calls that are compared with each other."""

import time
from collections.abc import Callable

import jax
import numpy as np


def in_turn(*calls: Callable[[], object], repeats: int = 5) -> np.ndarray:
    """Seconds `(repeats, calls)` of calls that alternate, so that a busy machine slows all of them alike.

    A call ends when its arrays are ready. The first round, which compiles, is not counted.
    """
    seconds = np.empty((repeats + 1, len(calls)))
    for row in seconds:
        for i, call in enumerate(calls):
            begin = time.perf_counter()
            jax.block_until_ready(call())
            row[i] = time.perf_counter() - begin
    return seconds[1:]
