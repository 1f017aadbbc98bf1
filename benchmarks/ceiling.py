"""What can be predicted at all: held-out starts again and again, with other hidden values.

    python -m benchmarks.ceiling                         # freefall, about 10 minutes on two CPU cores
    python -m benchmarks.ceiling --scenario perturbed
    python -m benchmarks.ceiling --workdir runs/inclined --scenario inclined  # of this run's dataset

Prints the errors of the mean of the re-rolls (the best prediction from shape, pose and condition), of a single re-roll
(a sharp sample of the truth), and of the baselines, with the metrics and the held-out starts of the experiment. Below
the table it prints how far the ends of one start lie from each other.
"""

import argparse
import dataclasses
import tempfile
from pathlib import Path

import numpy as np
from tqdm import tqdm

import sts_jax as sts
from experiments import freefall, inclined, perturbed
from experiments.shared import rerolls, stages
from sts_jax import _files, dataset, evaluation

CONFIGS = {"freefall": freefall.DEFAULT, "perturbed": perturbed.DEFAULT, "inclined": inclined.DEFAULT}


def spread(start: np.ndarray, end: np.ndarray, outcome: np.ndarray) -> list[str]:
    """How far ends lie from each other and from their start, a line each.

    Args:
        start: First poses, `(n, 7)`.
        end: Last poses of the re-rolls, `(times, n, 7)`.
        outcome: int `(times, n)`.
    """
    times = len(end)
    place, stays = 1e3 * end[..., :2], outcome != int(sts.physics.Outcome.FELL_OFF)
    own = np.linalg.norm(place - place.mean(0), axis=-1).mean(0) * np.sqrt(times / (times - 1))
    moved = np.linalg.norm(place - 1e3 * start[:, :2], axis=-1)
    always = stays.all(0)
    mixed = (outcome != outcome[0]).any(0)
    return [
        f"{place.shape[1]} starts, {times} draws of the hidden values each",
        f"the end lies from the start                  {moved[stays].mean():5.1f} mm (mean, of those that stay)",
        f"the ends of one start from their own mean    {own[always].mean():5.1f} mm (mean), "
        f"{np.median(own[always]):.1f} (median), of starts that always stay",
        f"starts with several outcomes                 {100 * mixed.mean():5.1f} %",
    ]


def main(name: str, times: int, workdir: Path | None) -> None:
    """Collect the default dataset of an experiment, as far as it is not there, and print its ceilings."""
    config, sensor = CONFIGS[name], sts.Sensor()
    if workdir is None:  # the symmetric copies change nothing about the held-out list
        collection = dataclasses.replace(config.collection, symmetries=False, num_full=0)
        config = dataclasses.replace(config, collection=collection)
    with tempfile.TemporaryDirectory() as temporary, _files.lock(workdir or Path(temporary)):
        folder = workdir or Path(temporary)
        stages.claim(config, folder)
        data = stages.collect(config, folder, sensor)
        rows = evaluation.rows_of(data, config.splits[0])
        pairs = data.pairs(rows["train"]), data.pairs(rows["test"][: config.num_rerolled])
    train, test = (dataset.reduced(part, config.image_size) for part in pairs)
    judge = evaluation.scorer(config.collection.scenario, train)
    with tqdm(total=times * len(test.object), desc="re-roll", unit="trajectories") as bar:
        made = rerolls.reroll(config.collection, sensor, test, times, judge, lambda done: bar.update(done - bar.n))
    scores = dict(made.scores)
    for title, row in evaluation.baselines(config.collection.scenario, train, test).items():
        scores[title] = judge(row, test)
    summary = evaluation.summarise(scores, test, outcomes=config.collection.scenario.outcomes)
    print(evaluation.table(summary, title=f"{name}: the best possible predictions"))
    print(evaluation.full_table(summary, title=f"{name}: every figure"))
    print("\n".join(spread(test.pose[:, 0], made.pose, made.outcome)))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", choices=CONFIGS, default="freefall")
    parser.add_argument("--times", type=int, default=16, help="how often each start is rolled, at least 2 (16)")
    parser.add_argument("--workdir", type=Path, help="of a run with --preset default (default: collect anew)")
    arguments = parser.parse_args()
    if arguments.times < 2:
        parser.error(f"--times must be at least 2, got {arguments.times}: ends of one start are compared")
    main(arguments.scenario, arguments.times, arguments.workdir)
