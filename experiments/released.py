"""Predict the images and the pose at rest of an object that a hand releases, from a frame that shows the held object.

    python -m experiments.released                    # 26 minutes on one CPU core of a busy computer
    python -m experiments.released --preset long      # unknown duration, can be stopped and started again
    python -m experiments.released --model paper      # the paper's four models instead of the state-space model
    python -m experiments.released --preset smoke     # a few minutes, for tests
    python -m experiments.released --preset paper     # the paper's data size and training schedule: hours, a GPU helps

The objects are small cameras (object class `camera`). This experiment is the simulated counterpart of the paper's real
dataset. The authors have not yet run the preset `long` to the end.

The results go to `runs/released/`. The same command continues after an interruption. See `docs/experiments.md`
for the files and the options. Every field of the configuration is an option too: `--collection.num-objects 1000`.
"""

import dataclasses

from experiments.shared import config, run
from sts_jax import physics

COLLECTION = dataclasses.replace(
    config.COLLECTION, scenario=physics.Released(), categories=("camera",), num_per_object=10
)
DEFAULT = config.Config(COLLECTION)
LONG = config.long(DEFAULT)
SMOKE = config.smoke(DEFAULT)
PAPER = config.paper(COLLECTION, num_objects=500, num_per_object=1)  # 500 trajectories, as many as the real ones
PRESETS = {"smoke": SMOKE, "default": DEFAULT, "long": LONG, "paper": PAPER}

if __name__ == "__main__":
    run.command(PRESETS, "runs/released", __doc__)
