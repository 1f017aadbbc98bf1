"""Errors of the best possible prediction, from repeated simulations of each held-out start.

    python -m benchmarks.ceiling                         # freefall, about 10 minutes on two CPU cores
    python -m benchmarks.ceiling --scenario perturbed
    python -m benchmarks.ceiling --workdir runs/inclined --scenario inclined  # with the dataset of this run

A start is the initial state of a trajectory. A re-roll is another simulation from the same start, with new random
values of the hidden properties, such as friction and mass. The command uses the metrics and the held-out starts of the
scenario's experiment. The command prints the errors of these predictions:

- the mean of the re-rolls, which is the best prediction from shape, pose and condition (such as the pad's acceleration)
- the last frame of a single re-roll. Its image is as sharp as a true image
- the baselines, which are simple predictions without a model, such as a copy of the first frame

Below the tables, the command prints how far the final poses of one start lie apart. Without `--workdir`, the dataset is
collected into a temporary folder. With `--workdir`, missing parts of that run's dataset are collected in the run's
folder.
"""

import dataclasses
import tempfile
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from tqdm import tqdm

import sts_jax as sts
from benchmarks.instruments.experiments import EXPERIMENTS
from experiments.shared import evaluate, run
from experiments.shared.config import Run
from sts_jax import dataset, evaluation, storage


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the command line.

    Raises:
        ValueError: `times` is less than 2.
    """

    scenario: Literal["freefall", "inclined", "perturbed", "released"] = "freefall"  # scenario of the experiment
    times: int = 16  # number of simulations of each start, at least 2
    workdir: Path | None = None  # work directory of a run with --preset default (default: collect a new dataset)

    def __post_init__(self) -> None:
        if self.times < 2:
            raise ValueError(
                f"--times is {self.times}, but the number of simulations from each held-out start must be at least 2, "
                "so that the final poses can be compared"
            )


def spread(start: np.ndarray, end: np.ndarray, outcome: np.ndarray) -> list[str]:
    """Summarise how much repeated simulations of the same start differ.

    Args:
        start: First poses, `(n, 7)`.
        end: Last poses of the repeated simulations of each start, `(times, n, 7)`.
        outcome: Outcome of each simulation, a value of the enum `physics.Outcome` such as `FELL_OFF`, int `(times, n)`.

    Returns:
        Four lines of text: the number of starts, the distance of the last positions from the first position, their
        distance from the mean last position of the same start, and the share of starts with several outcomes.
    """
    times = len(end)
    place, stays = 1e3 * end[..., :2], outcome != int(sts.physics.Outcome.FELL_OFF)
    apart = np.linalg.norm(place - place.mean(0), axis=-1).mean(0) * np.sqrt(times / (times - 1))  # unbiased
    moved = np.linalg.norm(place - 1e3 * start[:, :2], axis=-1)
    always = stays.all(0)
    mixed = (outcome != outcome[0]).any(0)
    return [
        f"{place.shape[1]} starts, {times} draws of the hidden values each",
        f"distance of an end from its start            {moved[stays].mean():5.1f} mm (mean, of those that stay)",
        f"distance of ends from their start's mean     {apart[always].mean():5.1f} mm (mean), "
        f"{np.median(apart[always]):.1f} (median), of starts that always stay",
        f"starts with several outcomes                 {100 * mixed.mean():5.1f} %",
    ]


def main(args: Args) -> None:
    """Collect missing parts of the experiment's dataset, and print the errors of the best possible predictions."""
    config, sensor = EXPERIMENTS[args.scenario].DEFAULT, sts.Sensor()
    if args.workdir is None:  # save time: symmetric copies and whole films do not change the held-out list
        collection = dataclasses.replace(config.collection, symmetries=False, num_full=0)
        config = dataclasses.replace(config, collection=collection)
    with tempfile.TemporaryDirectory() as temporary, storage.lock(args.workdir or Path(temporary)):
        folder = args.workdir or Path(temporary)
        data = run.collect(config, folder, sensor)
        rows = evaluation.rows_of(data, config.splits[0])
        pairs = data.pairs(rows["train"]), data.pairs(rows["test"][: config.num_rerolled])
    train, test = (dataset.reduced(part, config.image_size) for part in pairs)
    judge = evaluation.scorer(config.collection.scenario, train)
    split = Run(config, folder, sensor, config.splits[0])
    with tqdm(total=args.times * len(test.object), desc="re-roll", unit="trajectories") as bar:
        made = evaluate.reroll(split, test, args.times, judge, lambda done: bar.update(done - bar.n))
    scores = dict(made.scores)
    for title, row in evaluation.baselines(config.collection.scenario, train, test).items():
        scores[title] = judge(row, test)
    summary = evaluation.summarise(scores, test, outcomes=config.collection.scenario.outcomes)
    print(evaluation.table(summary, title=f"{args.scenario}: the best possible predictions"))
    print(evaluation.full_table(summary, title=f"{args.scenario}: all metrics"))
    print("\n".join(spread(test.pose[:, 0], made.pose, made.outcome)))


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
