"""Waiting times of a new user (first image, another resolution, gradient, simulation) and the rate of `vmap`.

    python -m benchmarks.first_hour            # about six minutes on two CPU cores
    python -m benchmarks.first_hour --vmap     # only the rates of `jax.vmap` and `jax.lax.map`

The waiting times are the seconds of each step in two fresh processes. The first process starts with an empty
compilation cache, the second one with the cache that the first one left. Rates are medians of seven calls with 32 poses
at 64x64 in this process.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable

CLASS = "scissors"
FRAMES = 32


def steps() -> None:
    """Run the steps in this process and print the seconds from the start to the end of each as JSON."""
    begun = time.perf_counter()
    stamps: dict[str, float] = {}

    def stamp(name: str) -> None:
        stamps[name] = time.perf_counter() - begun

    import jax
    import jax.numpy as jnp

    import sts_jax as sts

    sts.enable_compilation_cache()
    stamp("import")
    body = sts.objects.make(jax.random.key(0), CLASS)
    sensor = sts.Sensor()
    pose, wrench = sts.physics.place(body, sensor)
    stamp("make and place a body")
    sts.show(sts.sense(sensor, body, pose, wrench, resolution=(240, 320))).savefig(os.devnull, format="png")
    stamp("first picture (240 x 320)")
    jax.block_until_ready(sts.sense(sensor, body, pose, wrench, resolution=(64, 64)).visual)
    stamp("another resolution (64 x 64)")
    darkness = jax.jit(jax.grad(lambda p: jnp.sum(sts.sense(sensor, body, p, wrench, resolution=(64, 64)).tactile)))
    jax.block_until_ready(darkness(pose))
    stamp("gradient (64 x 64)")
    falls = sts.physics.simulate(jax.random.key(1), body, sensor, sts.physics.Freefall(), num=64)
    jax.block_until_ready(falls.pose)
    stamp("64 falls")
    print(json.dumps(stamps))


def waiting() -> None:
    """Print the seconds of each step, with an empty and with a kept compilation cache."""
    with tempfile.TemporaryDirectory() as folder:
        environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": folder, "TF_CPP_MIN_LOG_LEVEL": "3"}
        runs = []
        for _ in range(2):
            command = [sys.executable, "-m", "benchmarks.first_hour", "--steps"]
            done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
            runs.append(json.loads(done.stdout.splitlines()[-1]))
    print(f"{'seconds, each step by itself':<32}{'empty cache':>12}{'kept cache':>12}")
    before = [0.0, 0.0]
    for name in runs[0]:
        own = [run[name] - start for run, start in zip(runs, before, strict=True)]
        before = [run[name] for run in runs]
        print(f"{name:<32}{own[0]:>12.1f}{own[1]:>12.1f}")


def rates() -> None:
    """Print the rates of `jax.vmap` and `jax.lax.map` for frames and for gradients."""
    import jax
    import jax.numpy as jnp

    import sts_jax as sts

    body = sts.objects.make(jax.random.key(0), CLASS)
    sensor = sts.Sensor()
    turns = jnp.linspace(0, 3, FRAMES)
    placed = [sts.physics.place(body, sensor, yaw=float(turn)) for turn in turns]
    poses, wrenches = (jnp.stack(leaf) for leaf in zip(*placed, strict=True))

    def frame(pose: jax.Array, wrench: jax.Array) -> sts.Frame:
        return sts.sense(sensor, body, pose, wrench, resolution=(64, 64))

    def loss(pose: jax.Array, wrench: jax.Array) -> jax.Array:
        return jnp.sum(frame(pose, wrench).tactile)

    def total(poses: jax.Array, wrenches: jax.Array) -> jax.Array:
        return jnp.sum(jax.vmap(loss)(poses, wrenches))

    def mapped(function: Callable) -> Callable:
        return lambda *batch: jax.lax.map(lambda item: function(*item), batch)

    ways = {
        "frames": (jax.vmap(frame), mapped(frame)),
        "gradients": (jax.vmap(jax.grad(loss)), mapped(jax.grad(loss))),
        "gradient of a sum over vmap": (jax.grad(total), mapped(jax.grad(loss))),
    }
    print(f"{'a second, 64x64, batch of 32':<32}{'vmap':>12}{'lax.map':>12}{'ratio':>12}")
    for name, pair in ways.items():
        compiled = [jax.jit(way) for way in pair]
        spent: list[list[float]] = [[], []]
        for turn in range(8):  # in turn, so that a busy machine slows both. The first turn compiles.
            for way, times in zip(compiled, spent, strict=True):
                start = time.perf_counter()
                jax.block_until_ready(way(poses, wrenches))
                if turn:
                    times.append(time.perf_counter() - start)
        speeds = [FRAMES / statistics.median(times) for times in spent]
        ratio = statistics.median(b / a for a, b in zip(*spent, strict=True))
        print(f"{name:<32}{speeds[0]:>12.0f}{speeds[1]:>12.0f}{ratio:>12.2f}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--vmap", action="store_true", help="print the rates only")
    parser.add_argument("--steps", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.steps:
        steps()
    else:
        if not arguments.vmap:
            waiting()
        rates()
