"""Durations of function calls, in this process or in new ones."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

PROGRAM = "import json, sys; from {module} import {name}; print(json.dumps({name}(*json.loads(sys.argv[1]))))"


def fresh(function: str, *arguments: Any, cache: Path | None = None) -> Any:
    """Call a function in a new process, and return its result."""
    module, name = function.rsplit(".", 1)
    environment = os.environ | {"TF_CPP_MIN_LOG_LEVEL": "3"}
    if cache is not None:
        environment["JAX_COMPILATION_CACHE_DIR"] = str(cache)
    command = [sys.executable, "-c", PROGRAM.format(module=module, name=name), json.dumps(arguments)]
    done = subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def median_seconds(*calls: Callable[[], object], repeats: int = 7) -> list[float]:
    """Median seconds of each function, see `in_turn`."""
    return np.median(in_turn(*calls, repeats=repeats), axis=0).tolist()


def in_turn(*calls: Callable[[], object], repeats: int = 5) -> np.ndarray:
    """Measure the durations of functions in alternation, so that a busy machine slows all of them alike."""
    seconds = np.empty((repeats + 1, len(calls)))
    for row in seconds:
        for i, call in enumerate(calls):
            begin = time.perf_counter()
            jax.block_until_ready(call())
            row[i] = time.perf_counter() - begin
    return seconds[1:]
