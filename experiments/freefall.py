"""Objects dropped on the pad: from the first moment, still in the air, to what the sensor sees at rest.

    python -m experiments.freefall                    # about 15 minutes on two CPU cores
    python -m experiments.freefall --preset smoke     # about two minutes, for tests
    python -m experiments.freefall --preset paper     # the paper's counts and schedule: hours; a GPU helps
    python -m experiments.freefall --plan             # seconds per stage, measured on a little of each; then stops

Leaves `runs/freefall/`: config.json, dataset/, models/NAME/, metrics.json, table.md, figures/*.png. Started again on
the same --workdir it goes on where it stopped, and touches nothing where all is done.
"""

from experiments import command, stages
from sts_jax import dataset, physics, training

DEFAULT = stages.Config(
    collection=dataset.Collection(physics.Freefall(), num_objects=320, num_per_object=4, num_full=20, seed=2),
    training=training.TrainConfig(batch_size=16, learning_rate=2e-3, schedule="cosine", encoder_epsilon=3.0),
    steps=(1500, 600, 600, 100),
)
SMOKE = stages.smoke(DEFAULT)
PAPER = stages.paper(dataset.Collection(physics.Freefall()), num_objects=340, num_per_object=5)  # 1,700 trajectories
PRESETS = {"smoke": SMOKE, "default": DEFAULT, "paper": PAPER}

if __name__ == "__main__":
    command.run(PRESETS, "runs/freefall", __doc__)  # collect, train, evaluate: stages.main
