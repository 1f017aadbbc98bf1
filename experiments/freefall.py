"""Predict the final images and the final pose of an object that falls on the pad.

    python -m experiments.freefall                    # 10 to 30 minutes on two CPU cores
    python -m experiments.freefall --preset long      # 1.5 to 2.5 hours, can be stopped and started again
    python -m experiments.freefall --model paper      # the paper's four models instead of the state-space model
    python -m experiments.freefall --preset smoke     # about two minutes, for tests
    python -m experiments.freefall --preset paper     # the paper's data size and training schedule: hours, a GPU helps

Results go to `runs/freefall/`: config.json, dataset/, models/NAME/, metrics.json, table.md and figures/*.png. A second
run with the same `--workdir` resumes after an interruption, and leaves finished results unchanged. `--only train` runs
one stage. Every field of the configuration is an option too, such as `--collection.num-objects 1000`, see `--help`.
"""

import dataclasses

from experiments.shared import config, run
from sts_jax import dataset, physics
from sts_jax.training import TrainConfig

COLLECTION = dataset.Collection(
    physics.Freefall(),
    num_objects=2000,
    num_per_object=6,
    num_rendered=4,
    num_views=8,
    num_full=20,
    resolution=(128, 128),
    shares=(0.9, 0.04, 0.06),
    seed=2,
)
DEFAULT = config.Config(
    collection=COLLECTION,
    state_training=dataclasses.replace(config.STATE_TRAINING, steps=1900),
    training=TrainConfig(batch_size=16, learning_rate=2e-3, schedule="cosine", encoder_epsilon=3.0),
    steps=(1500, 600, 600, 100),
)
LONG = dataclasses.replace(
    DEFAULT,
    collection=dataclasses.replace(COLLECTION, num_objects=6000, num_per_object=12, shares=(0.97, 0.01, 0.02)),
    state_training=dataclasses.replace(config.STATE_TRAINING, steps=16000),
)
SMOKE = config.smoke(DEFAULT)
PAPER = config.paper(COLLECTION, num_objects=340, num_per_object=5)  # 1,700 trajectories
PRESETS = {"smoke": SMOKE, "default": DEFAULT, "long": LONG, "paper": PAPER}

if __name__ == "__main__":
    run.command(PRESETS, "runs/freefall", __doc__)
