"""Waiting times of a new user (first image, another resolution, gradient, simulation), and frames/s of `jax.vmap`.

python -m benchmarks.first_hour    # about six minutes on two CPU cores
"""

import tempfile
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import sts_jax as sts
from benchmarks.instruments.first_steps import CLASS
from benchmarks.instruments.timing import fresh, in_turn

FRAMES = 32


def waiting() -> None:
    """Print how long each first step of a new user takes (s), such as the import and the first image."""
    with tempfile.TemporaryDirectory() as folder:
        runs = [fresh("benchmarks.instruments.first_steps.stamps", cache=Path(folder)) for _ in range(2)]
    print(f"{'seconds, each step by itself':<32}{'empty cache':>12}{'kept cache':>12}")
    before = [0.0, 0.0]
    for name in runs[0]:
        seconds = [run[name] - start for run, start in zip(runs, before, strict=True)]
        before = [run[name] for run in runs]
        print(f"{name:<32}{seconds[0]:>12.1f}{seconds[1]:>12.1f}")


def rates() -> None:
    """Print how many frames and how many gradients per second are computed with `jax.vmap` and with `jax.lax.map`."""
    body = sts.objects.make(jax.random.key(0), CLASS)
    sensor = sts.Sensor()
    placed = [sts.physics.place(body, sensor, yaw=float(yaw)) for yaw in jnp.linspace(0, 3, FRAMES)]
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
    print(f"{'per second, 64x64, batch of 32':<32}{'vmap':>12}{'lax.map':>12}{'ratio':>12}")
    for name, (vmapped, looped) in ways.items():
        compiled = jax.jit(vmapped), jax.jit(looped)
        seconds = in_turn(*(lambda way=way: way(poses, wrenches) for way in compiled), repeats=7)
        rate = FRAMES / np.median(seconds, axis=0)
        ratio = np.median(seconds[:, 1] / seconds[:, 0])
        print(f"{name:<32}{rate[0]:>12.0f}{rate[1]:>12.0f}{ratio:>12.2f}")


def main() -> None:
    """Print the waiting times, and the frames and gradients per second."""
    waiting()
    rates()


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
