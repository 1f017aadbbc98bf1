"""Make the dataset of a scenario alone, at any scale, in this process, in several, or on a cluster.

    python -m experiments.collect --scenario freefall --preset paper             # 1,700 trajectories, 102,000 images
    python -m experiments.collect --scenario perturbed --num-objects 40 --frames ends --resolution 1232 1640
    python -m experiments.collect --scenario freefall --process-index 0 --process-count 4    # one of four processes
    python -m experiments.collect --scenario freefall --cluster tcp://10.0.0.1:8786 --out s3://bucket/falls

The same command continues after an interruption, and makes only what is missing. It prints its time first. See
`docs/datasets.md`. Every field of the collection is an option too: `--seed 3`.
"""

import dataclasses
import sys
from typing import Annotated, Literal

import tyro

import sts_jax as sts
from experiments import freefall, inclined, perturbed, released
from experiments.shared import run
from experiments.shared.datasets import make
from experiments.shared.terminal import on_one_line
from sts_jax.dataset import Collection

Scenario = Literal["freefall", "inclined", "perturbed", "released"]
Preset = Literal["smoke", "default", "long", "paper"]
PRESETS = {
    "freefall": freefall.PRESETS,
    "inclined": inclined.PRESETS,
    "perturbed": perturbed.PRESETS,
    "released": released.PRESETS,
}


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the command line."""

    # description of the dataset, from the preset. Each of its fields is an option
    collection: Annotated[Collection, tyro.conf.arg(name="")]
    scenario: Scenario = "freefall"  # what happens to the objects
    preset: Preset = "default"  # set of default values for the options
    # folder or URL (s3://bucket/falls) of the dataset. None: datasets/SCENARIO-PRESET
    out: str | None = None
    # images of all frames of each trajectory, or of its first and last one. None: those of the preset
    frames: Literal["all", "ends"] | None = None
    hidden: sts.physics.Variant = "default"  # ranges of the hidden properties, as in the experiments
    skin: run.Skin = "hazy"  # skin of the sensor, as in the experiments
    process_index: int = 0  # index of this process among those that share the work
    process_count: int = 1  # number of processes that share the work
    cluster: str | None = None  # address of a Dask scheduler, whose workers make the dataset (extra `cluster`)
    repair: bool = False  # make damaged parts again
    debug: bool = False  # show the traceback of every error


def parse(words: list[str]) -> Args:
    """Read the options, which replace single fields of the preset that `--scenario` and `--preset` name."""
    presets = run.chosen_preset(PRESETS, words, "scenario", "freefall")
    default = Args(run.chosen_preset(presets, words).collection)
    return tyro.cli(Args, args=words, default=default, description=__doc__, config=(tyro.conf.AvoidSubcommands,))


def main(args: Args) -> None:
    """Make what is missing of the dataset."""
    collection = args.collection
    if args.frames is not None:
        count = collection.num_trajectories if args.frames == "all" else 0
        collection = dataclasses.replace(collection, num_full=count, num_rendered=None)
    scenario = sts.physics.variant(collection.scenario, args.hidden)
    collection = dataclasses.replace(collection, scenario=scenario)
    out = args.out or f"datasets/{args.scenario}-{args.preset}"
    make(
        collection,
        run.sensor(args.skin),
        out,
        process_index=args.process_index,
        process_count=args.process_count,
        cluster=args.cluster,
        repair=args.repair,
    )
    print(f"dataset: {out}")


if __name__ == "__main__":
    with on_one_line(debug="--debug" in sys.argv):
        arguments = parse(sys.argv[1:])
        sts.enable_compilation_cache()
        main(arguments)
