"""Draw a few trajectories, from outside and through the sensor, as a strip of pictures and as an animation.

    python -m experiments.show perturbed --num 4 --out show    # about a minute on two CPU cores

The files are OUT/SCENARIO-NUMBER.png and OUT/SCENARIO-NUMBER.gif. The objects have the same classes as in the default
experiment of the scenario. `--seed` is the seed of the objects and the trajectories.
"""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import sts_jax as sts
from experiments import freefall, inclined, perturbed, released
from experiments.shared import drawing, terminal
from sts_jax import dataset, evaluation

SCENARIOS = {
    one.__name__.rpartition(".")[2]: one.DEFAULT.collection for one in (freefall, inclined, perturbed, released)
}


@dataclasses.dataclass(frozen=True)
class Config:
    """Options of the command line: scenario, number of trajectories, seed, folder of the pictures, and image size."""

    scenario: Annotated[Literal["freefall", "inclined", "perturbed", "released"], tyro.conf.Positional]
    num: int = 4  # number of trajectories, each with another object
    seed: int = 0  # seed of the objects and the trajectories
    out: Path = Path("show")  # folder for the pictures
    size: int = 128  # side of the sensor's images (pixels)


def main(config: Config) -> None:
    """Simulate the trajectories, render them from outside and through the sensor, and draw them."""
    terminal.check_numbers(config, num=(1, 1000), seed=terminal.SEEDS, size=terminal.SIDES)
    drawing.make_folder(config.out)
    sensor = sts.Sensor()
    collection = dataclasses.replace(SCENARIOS[config.scenario], num_objects=config.num, seed=config.seed)
    names, bodies = dataset.class_names(collection), dataset.make_bodies(collection, np.arange(config.num))
    trajectories = sts.physics.simulate(jax.random.key(config.seed), bodies, sensor, collection.scenario)
    for i, (name, body) in enumerate(zip(names, bodies, strict=True)):
        one = jax.tree.map(lambda x, i=i: np.asarray(x[i]), trajectories)
        motion, size = (jnp.asarray(one.pose), jnp.asarray(one.wrench)), (config.size, config.size)
        seen = dataset.render_uint8(sensor, body, *motion, resolution=size, crop=False)
        visual, tactile = (np.asarray(stream) / 255 for stream in seen[:2])
        view = drawing.views(body, one.pose, one.gravity, sensor, collection.scenario.wall)
        words = drawing.describe(collection.scenario, name, one._asdict(), one.hidden._asdict())
        path = config.out / f"{config.scenario}-{i}.png"
        shown = one.time, view, visual, tactile, one.wrench
        evaluation.figures.strip(path, *shown, title=words)
        outcome = collection.scenario.named(int(one.outcome))
        evaluation.figures.animation(path.with_suffix(".gif"), *shown, one.gravity, title=words, outcome=outcome)
        print(f"{path.with_suffix('')}: {words}")


if __name__ == "__main__":
    sts.enable_compilation_cache()
    with terminal.on_one_line():
        main(tyro.cli(Config, description=__doc__))
