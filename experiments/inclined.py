"""Predict the final images and the final pose of objects that are released on a tilted pad.

    python -m experiments.inclined                    # 10 to 30 minutes on two CPU cores
    python -m experiments.inclined --preset long      # at most 150 minutes, can be stopped and started again
    python -m experiments.inclined --model paper      # the paper's four models instead of the state-space model
    python -m experiments.inclined --preset smoke     # about two minutes, for tests
    python -m experiments.inclined --preset paper     # the paper's data size and training schedule: hours, a GPU helps

The results go to `runs/inclined/`. The same command continues after an interruption. See `docs/experiments.md`
for the files and the options. Every field of the configuration is an option too: `--collection.num-objects 1000`.
"""

import dataclasses

from experiments.shared import config, run
from sts_jax import physics

COLLECTION = dataclasses.replace(config.COLLECTION, scenario=physics.Inclined(), num_views=4)
DEFAULT = config.Config(COLLECTION)
LONG = config.long(DEFAULT)
SMOKE = config.smoke(DEFAULT)
PAPER = config.paper(COLLECTION, num_objects=480, num_per_object=5)  # 2,400 trajectories
PRESETS = {"smoke": SMOKE, "default": DEFAULT, "long": LONG, "paper": PAPER}

if __name__ == "__main__":
    run.command(PRESETS, "runs/inclined", __doc__)
