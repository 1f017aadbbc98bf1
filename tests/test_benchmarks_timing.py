"""Durations with a clock of known steps, and calls in fresh processes."""

import os
from pathlib import Path

import numpy as np

from benchmarks.instruments import timing
from benchmarks.instruments.timing import fresh


def test_calls_alternate_and_the_first_round_is_not_counted(monkeypatch):
    now, made = [0.0], []

    def call(name, seconds):
        made.append(name)
        now[0] += seconds + (10 if len(made) <= 2 else 0)  # the first call of each also compiles

    monkeypatch.setattr(timing.time, "perf_counter", lambda: now[0])
    seconds = timing.in_turn(lambda: call("a", 1), lambda: call("b", 2), repeats=3)
    assert "".join(made) == "abababab"
    np.testing.assert_array_equal(seconds, [[1, 2]] * 3)


def test_a_fresh_process_returns_the_result_and_uses_the_given_compilation_cache():
    assert fresh("math.hypot", 3, 4) == 5
    assert fresh("os.getpid") != os.getpid()
    assert fresh("os.getenv", "JAX_COMPILATION_CACHE_DIR", cache=Path("some/folder")) == "some/folder"
