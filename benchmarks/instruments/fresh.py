"""Call functions in new processes, to measure the time of a first call and the memory of a process."""

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
        function: The function's module and name, as `benchmarks.sensor.cost_of`.
        arguments: Positional arguments. They and the result travel as JSON.
        cache: The folder of JAX's persistent compilation cache in that process. Default: as in this process.

    Raises:
        subprocess.CalledProcessError: The process failed. Its error output appears on this process's.
    """
    module, name = function.rsplit(".", 1)
    environment = os.environ | {"TF_CPP_MIN_LOG_LEVEL": "3"}
    if cache is not None:
        environment["JAX_COMPILATION_CACHE_DIR"] = str(cache)
    command = [sys.executable, "-c", PROGRAM.format(module=module, name=name), json.dumps(arguments)]
    done = subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(done.stdout.splitlines()[-1])
