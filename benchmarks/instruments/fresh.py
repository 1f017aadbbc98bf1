"""Function calls in new processes, to measure the time of a first call or the memory of a process."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

PROGRAM = "import json, sys; from {module} import {name}; print(json.dumps({name}(*json.loads(sys.argv[1]))))"


def call(function: str, *arguments: Any, cache: Path | None = None) -> Any:
    """Call a function in a new process, and return its result.

    Args:
        function: Module and name of the function, such as `benchmarks.sensor.cost_of`.
        arguments: Positional arguments of the function. Arguments and result must be serialisable as JSON.
        cache: Folder of JAX's persistent compilation cache in the new process. Default: the environment variable
            JAX_COMPILATION_CACHE_DIR of this process.

    Returns:
        The result of the function.

    Raises:
        subprocess.CalledProcessError: The new process failed. The calling process's error output shows the reason.
    """
    module, name = function.rsplit(".", 1)
    environment = os.environ | {"TF_CPP_MIN_LOG_LEVEL": "3"}
    if cache is not None:
        environment["JAX_COMPILATION_CACHE_DIR"] = str(cache)
    command = [sys.executable, "-c", PROGRAM.format(module=module, name=name), json.dumps(arguments)]
    done = subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(done.stdout.splitlines()[-1])
