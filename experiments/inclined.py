"""Objects laid on the tilted pad, or let go just above: from the first moment to what the sensor sees at rest.

    python -m experiments.inclined                    # about 15 to 20 minutes on two CPU cores
    python -m experiments.inclined --preset smoke     # about two minutes, for tests
    python -m experiments.inclined --preset paper     # the paper's counts and schedule: hours; a GPU helps
    python -m experiments.inclined --plan             # seconds per stage, measured on a little of each; then stops

Leaves `runs/inclined/`: config.json, dataset/, models/NAME/, metrics.json, table.md, figures/*.png. Started again on
the same --workdir it goes on where it stopped, and touches nothing where all is done.
"""

import dataclasses

from experiments import command, stages
from sts_jax import dataset, physics, training

OBJECTS = dataset.Collection(physics.Inclined())
DEFAULT = stages.Config(
    collection=dataclasses.replace(OBJECTS, num_objects=192, num_per_object=4, num_full=20, seed=2),
    training=training.TrainConfig(batch_size=16, learning_rate=2e-3, schedule="cosine", encoder_epsilon=3.0),
    steps=(750, 350, 400, 200),
)
SMOKE = stages.smoke(DEFAULT)
PAPER = stages.paper(OBJECTS, num_objects=480, num_per_object=5)  # 2,400 trajectories
PRESETS = {"smoke": SMOKE, "default": DEFAULT, "paper": PAPER}

if __name__ == "__main__":
    command.run(PRESETS, "runs/inclined", __doc__)  # collect, train, evaluate: stages.main
