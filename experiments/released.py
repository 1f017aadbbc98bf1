"""Predict the images and the pose at rest of an object that a hand releases, from a frame that shows the held object.

    python -m experiments.released                    # 26 minutes on one CPU core of a busy computer
    python -m experiments.released --preset long      # unknown duration, can be stopped and started again
    python -m experiments.released --model paper      # the paper's four models instead of the state-space model
    python -m experiments.released --preset smoke     # a few minutes, for tests
    python -m experiments.released --preset paper     # the paper's data size and training schedule: hours, a GPU helps

The objects are small cameras (object class `camera`). This experiment is the simulated counterpart of the paper's real
dataset. Results go to `runs/released/`: config.json, dataset/, models/NAME/, metrics.json, table.md and figures/*.png.
A second run with the same `--workdir` resumes after an interruption, and leaves finished results unchanged.
`--only train` runs one stage. Every field of the configuration is an option too, such as
`--collection.num-objects 1000`, see `--help`. The authors have not yet run the preset `long` to the end.
"""

import dataclasses

from experiments.shared import config, run
from sts_jax import dataset, physics
from sts_jax.training import TrainConfig

COLLECTION = dataset.Collection(
    physics.Released(),
    categories=("camera",),
    num_objects=1600,
    num_per_object=10,
    num_rendered=4,
    num_full=20,
    resolution=(128, 128),
    shares=(0.9, 0.04, 0.06),
    seed=2,
)
DEFAULT = config.Config(
    collection=COLLECTION,
    state_training=dataclasses.replace(config.STATE_TRAINING, steps=2000),
    training=TrainConfig(batch_size=16, learning_rate=2e-3, schedule="cosine", encoder_epsilon=3.0),
    steps=(750, 350, 400, 200),
)
LONG = dataclasses.replace(
    DEFAULT,
    collection=dataclasses.replace(COLLECTION, num_objects=6000, shares=(0.97, 0.01, 0.02)),
    state_training=dataclasses.replace(config.STATE_TRAINING, steps=8000),
)
SMOKE = config.smoke(DEFAULT)
PAPER = config.paper(COLLECTION, num_objects=500, num_per_object=1)  # 500 trajectories, as many as the real ones
PRESETS = {"smoke": SMOKE, "default": DEFAULT, "long": LONG, "paper": PAPER}

if __name__ == "__main__":
    run.command(PRESETS, "runs/released", __doc__)
