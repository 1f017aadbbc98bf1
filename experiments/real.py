"""Collect and review trajectories of the real sensor or its digital twin, and learn from them (the paper's Table 2).

    python -m experiments.real                    # about 15 minutes, collects 100 trajectories of the twin if needed
    python -m experiments.real --preset paper     # the paper's training schedule, 500 trajectories at 1640x1232
    python -m experiments.real --preset smoke     # a short run of every stage, for tests

    python -m experiments.real collect --sensor bench --count 500   # shows a page in the browser
    python -m experiments.real collect --twin --workdir runs/twin   # the digital twin, on a virtual clock
    python -m experiments.real review                       # lists the trajectories
    python -m experiments.real review --sheet review.png    # draws the last 20
    python -m experiments.real review --discard 3 17

The default sub-command `train` trains "VAE visual only", "VAE tactile only" and "MVAE without pose" on the trajectories
in `WORKDIR/dataset`, to predict the images of the object at rest from those of the held object. Results go to
`WORKDIR/table2`. A work directory cannot contain trajectories of both a device and the twin.

`collect` guides a person: place the object in an unstable pose, hold it, release it, and wait until it rests. A visual
and a tactile image are saved at once, raw and uncropped, when the object is held and when it rests. After an
interruption, the same command continues. `--sensor` is the sensor file of `experiments.commission`.
"""

import dataclasses
import sys
from collections.abc import Sequence
from typing import Annotated

import tyro

import sts_jax as sts
from experiments.shared import table2, terminal
from experiments.shared.collecting import Collect, Review, collect, review
from experiments.shared.run import chosen_preset, options, with_epochs
from experiments.shared.table2 import Config, Train
from sts_jax.training import TrainConfig

DEFAULT = Config(
    training=TrainConfig(batch_size=16, learning_rate=1e-3, schedule="cosine"),
    steps=(300, 300, 300),
)
SMOKE = dataclasses.replace(
    DEFAULT,
    training=dataclasses.replace(DEFAULT.training, batch_size=4, log_every=1, checkpoint_every=2),
    steps=(2, 2, 2),
    count=5,
    size=(240, 180),  # the noise of smaller images hides when the lights have settled
    shifts=1,
)
PAPER = Config(TrainConfig(), count=500, size=(1640, 1232), targets="own", rest=False, shifts=0)
PRESETS = {"smoke": SMOKE, "default": DEFAULT, "paper": PAPER}


def parse(words: Sequence[str]) -> Train | Collect | Review:
    """Read the options of the command line. Without a sub-command, `train` is used."""
    if not words or (words[0].startswith("-") and words[0] not in ("-h", "--help")):
        words = ["train", *words]
    config: Train | Collect | Review = tyro.cli(
        Annotated[Train, tyro.conf.subcommand("train", default=Train(chosen_preset(PRESETS, words)))]
        | Annotated[Collect, tyro.conf.subcommand("collect")]
        | Annotated[Review, tyro.conf.subcommand("review")],
        args=words,
        description=__doc__,
    )
    if isinstance(config, Train):
        return dataclasses.replace(config, config=with_epochs(config.config, options(words)))
    return config


def main(config: Train | Collect | Review) -> None:
    """Run a sub-command. If the user can correct an error, print the error on one line without a traceback."""
    with terminal.on_one_line(debug=config.debug):
        match config:
            case Train():
                table2.main(config)
            case Collect():
                collect(config)
            case Review():
                review(config)


if __name__ == "__main__":
    sts.enable_compilation_cache()
    main(parse(sys.argv[1:]))
