"""Predict the final images and the final pose of an object that falls on the pad.

    python -m experiments.freefall                    # 10 to 30 minutes on two CPU cores
    python -m experiments.freefall --preset long      # 1.5 to 2.5 hours, can be stopped and started again
    python -m experiments.freefall --model paper      # the paper's four models instead of the state-space model
    python -m experiments.freefall --preset smoke     # about two minutes, for tests
    python -m experiments.freefall --preset paper     # the paper's data size and training schedule: hours, a GPU helps

The results go to `runs/freefall/`. The same command continues after an interruption. See `docs/experiments.md`
for the files and the options. Every field of the configuration is an option too: `--collection.num-objects 1000`.
"""

import dataclasses

from experiments.shared import config, run
from sts_jax import physics

COLLECTION = dataclasses.replace(config.COLLECTION, scenario=physics.Freefall(), num_objects=2000, num_views=8)
DEFAULT = config.Config(
    COLLECTION,
    state_training=dataclasses.replace(config.STATE_TRAINING, steps=1900),
    steps=(1500, 600, 600, 100),
)
# Many objects and views: the encoder of a long training lacks them, see "More objects and views" in docs/trials.md
MORE = dataclasses.replace(DEFAULT, collection=dataclasses.replace(COLLECTION, num_rendered=2, num_views=10))
LONG = config.long(MORE, num_objects=12000, num_per_object=6, steps=16000)
SMOKE = config.smoke(DEFAULT)
PAPER = config.paper(COLLECTION, num_objects=340, num_per_object=5)  # 1,700 trajectories
PRESETS = {"smoke": SMOKE, "default": DEFAULT, "long": LONG, "paper": PAPER}

if __name__ == "__main__":
    run.command(PRESETS, "runs/freefall", __doc__)
