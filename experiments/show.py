"""Draw a few trajectories, from outside and through the sensor, as a strip of pictures and as an animation.

    python -m experiments.show perturbed --num 4 --out show    # about a minute on two CPU cores
    python -m experiments.show freefall --num 8 --seed 1 --size 384 --no-curves --film webp    # the film of the README

The files are OUT/SCENARIO-NUMBER.png and OUT/SCENARIO-NUMBER.gif. The objects have the same classes as in the default
experiment of the scenario. `--seed` is the seed of the objects and the trajectories.
"""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import jax
import numpy as np
import tyro

import sts_jax as sts
from experiments import freefall, inclined, perturbed, released
from experiments.shared import drawing, terminal
from sts_jax import dataset, evaluation

SCENARIOS = {
    one.__name__.rpartition(".")[2]: one.DEFAULT.collection for one in (freefall, inclined, perturbed, released)
}
SIDE = 240  # pixels, least side of an image in a film
STILL = 0.02  # m/s and rad/s, largest velocity of an object that looks still
AFTER = 10  # frames after the motion at which a film without curves ends


@dataclasses.dataclass(frozen=True)
class Config:
    """Options of the command line: scenario, number of trajectories, seed, and look of the pictures."""

    scenario: Annotated[Literal["freefall", "inclined", "perturbed", "released"], tyro.conf.Positional]
    num: int = 4  # number of trajectories, each with another object
    seed: int = 0  # seed of the objects and the trajectories
    out: Path = Path("show")  # folder for the pictures
    size: int = 128  # side of the sensor's images (pixels)
    film: Literal["gif", "webp"] = "gif"  # format of the animations. WebP files have all colours and are smaller
    curves: bool = (
        True  # draw force and moment, and the time at rest. Without them, the film ends soon after the motion
    )


def main(config: Config) -> None:
    """Simulate the trajectories, render them from outside and through the sensor, and draw them."""
    terminal.check_numbers(config, num=(1, 1000), seed=terminal.SEEDS, size=terminal.SIDES)
    drawing.make_folder(config.out)
    sensor = sts.Sensor()
    collection = dataclasses.replace(SCENARIOS[config.scenario], num_objects=config.num, seed=config.seed)
    if not config.curves:  # twice the frame rate, for a smooth film
        scenario = collection.scenario
        scenario = dataclasses.replace(scenario, rate=2 * scenario.rate, frames=2 * scenario.frames)
        collection = dataclasses.replace(collection, scenario=scenario)
    names, bodies = dataset.class_names(collection), dataset.make_bodies(collection, np.arange(config.num))
    trajectories = sts.physics.simulate(jax.random.key(config.seed), bodies, sensor, collection.scenario)
    for i, (name, body) in enumerate(zip(names, bodies, strict=True)):
        one, last = jax.tree.map(lambda x, i=i: np.asarray(x[i]), trajectories), len(trajectories.time[i])
        if not config.curves:
            moving = np.flatnonzero(np.abs(one.velocity).max(1) > STILL)
            last = min(last, int(moving.max(initial=0)) + AFTER)
        pose, wrench, gravity = one.pose[:last], one.wrench[:last], one.gravity[:last]
        # In groups of one size, for which one program is compiled. Copies of the last frame fill the last group.
        group, size = dataset.frames_per_call(), (config.size, config.size)
        parts = np.minimum(np.arange(-(-last // group) * group), last - 1).reshape(-1, group)
        seen = [dataset.render_uint8(sensor, body, pose[k], wrench[k], resolution=size, crop=False)[:2] for k in parts]
        visual, tactile = (np.concatenate(stream)[:last] / 255 for stream in zip(*seen, strict=True))
        side = max(config.size, SIDE)
        view = drawing.views(body, pose, gravity, sensor, collection.scenario.wall, side)
        words = drawing.describe(collection.scenario, name, one._asdict(), one.hidden._asdict())
        path = config.out / f"{config.scenario}-{i}.png"
        shown = one.time[:last], view, visual, tactile
        evaluation.figures.strip(path, *shown, wrench, title=words)
        evaluation.figures.animation(
            path.with_suffix(f".{config.film}"),
            *shown,
            wrench if config.curves else None,
            gravity,
            title=words if config.curves else f"a {name}",
            outcome=collection.scenario.named(int(one.outcome)),
            side=side,
        )
        print(f"{path.with_suffix('')}: {words}")


if __name__ == "__main__":
    sts.enable_compilation_cache()
    with terminal.on_one_line():
        main(tyro.cli(Config, description=__doc__))
