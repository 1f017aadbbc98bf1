"""Predict the images and the pose at rest of a bottle on a jerked pad, from the first frame and the jerk.

    python -m experiments.perturbed                    # 10 to 30 minutes on two CPU cores
    python -m experiments.perturbed --preset long      # at most 150 minutes, can be stopped and started again
    python -m experiments.perturbed --model paper      # the paper's four models instead of the state-space model
    python -m experiments.perturbed --preset smoke     # about two minutes, for tests
    python -m experiments.perturbed --preset paper     # the paper's data size and training schedule: hours, a GPU helps

A jerk is a short sideways acceleration of the pad. It is not a derivative of the acceleration.

The results go to `runs/perturbed/`. The same command continues after an interruption. See `docs/experiments.md`
for the files and the options. Every field of the configuration is an option too: `--collection.num-objects 1000`.
"""

import dataclasses

from experiments.shared import config, run
from sts_jax import physics

COLLECTION = dataclasses.replace(config.COLLECTION, scenario=physics.Perturbed(), categories=("bottle",))
DEFAULT = config.Config(COLLECTION)
LONG = config.long(DEFAULT)
SMOKE = config.smoke(DEFAULT)
PAPER = config.paper(COLLECTION, num_objects=500, num_per_object=5)  # 2,500 trajectories
PRESETS = {"smoke": SMOKE, "default": DEFAULT, "long": LONG, "paper": PAPER}

if __name__ == "__main__":
    run.command(PRESETS, "runs/perturbed", __doc__)
