"""Predict the images and the pose at rest of a bottle on a jerked pad, from the first frame and the jerk.

    python -m experiments.perturbed                    # 10 to 30 minutes on two CPU cores
    python -m experiments.perturbed --preset long      # at most 150 minutes, can be stopped and started again
    python -m experiments.perturbed --model paper      # the paper's four models instead of the state-space model
    python -m experiments.perturbed --preset smoke     # about two minutes, for tests
    python -m experiments.perturbed --preset paper     # the paper's data size and training schedule: hours, a GPU helps

A jerk is a short sideways acceleration of the pad. It is not a derivative of the acceleration.

Results go to `runs/perturbed/`: config.json, dataset/, models/NAME/, metrics.json, table.md and figures/*.png. A second
run with the same `--workdir` resumes after an interruption, and leaves finished results unchanged. `--only train` runs
one stage. Every field of the configuration is an option too, such as `--collection.num-objects 1000`, see `--help`.
"""

import dataclasses

from experiments.shared import config, run
from sts_jax import dataset, physics
from sts_jax.training import TrainConfig

COLLECTION = dataset.Collection(
    physics.Perturbed(),
    categories=("bottle",),
    num_objects=1600,
    num_per_object=6,
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
    collection=dataclasses.replace(COLLECTION, num_objects=6000, num_per_object=10, shares=(0.97, 0.01, 0.02)),
    state_training=dataclasses.replace(config.STATE_TRAINING, steps=8000),
)
SMOKE = config.smoke(DEFAULT)
PAPER = config.paper(COLLECTION, num_objects=500, num_per_object=5)  # 2,500 trajectories
PRESETS = {"smoke": SMOKE, "default": DEFAULT, "long": LONG, "paper": PAPER}

if __name__ == "__main__":
    run.command(PRESETS, "runs/perturbed", __doc__)
