"""Simulates re-rolls of held-out trajectories, and stores the scores of the re-rolls.

A re-roll is a new simulation from the first pose of a trajectory, with newly drawn hidden properties such as friction.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

import sts_jax as sts
from experiments.shared import results
from experiments.shared.progress import Bar, say
from sts_jax import dataset, evaluation, storage

Judge = Callable[[evaluation.Predicted, dataset.Pairs], evaluation.Scores]
SEED = 20  # seed of the re-rolls
FORMAT = 2  # version of the files (2: outcomes are decided by the ratio of probability to frequency)


class Ceilings(NamedTuple):
    """Re-rolls (new simulations) of held-out trajectories, and the scores of predictions made from the re-rolls.

    In the tables of results, the ceiling is the score of the mean of the re-rolls.
    """

    scores: dict[str, evaluation.Scores]  # scores of the mean of the re-rolls, and of a single re-roll
    pose: np.ndarray  # poses at rest, shape (times, n, 7)
    outcome: np.ndarray  # numbers of the outcomes, int of shape (times, n)


def ceilings(
    workdir: Path,
    suffix: str,
    collection: dataset.Collection,
    sensor: sts.Sensor,
    data: dataset.Dataset,
    test: dataset.Pairs,
    *,
    times: int,
    num: int,
    judge: Judge,
    metrics: Sequence[evaluation.Metric] = evaluation.METRICS,
) -> Ceilings:
    """Read the re-rolls of the first `num` held-out trajectories, or compute and write the re-rolls.

    A re-roll is a new simulation from the first pose of a trajectory, with newly drawn hidden properties such as
    friction. The re-rolls and their scores are in `ceiling{suffix}.npz`. `ceiling{suffix}.json` records the checksums
    of the inputs of the computation. If an input has changed, the re-rolls are computed again. The checksums do not
    cover the source code that computes the metrics. If you change this source code, delete both files.

    Args:
        workdir: Work directory.
        suffix: Suffix of the file names, different for each split of the dataset.
        collection: Description of the dataset, with the scenario and the physics engine of the simulation.
        sensor: Sensor that renders the last frames of the re-rolls.
        data: Dataset of the experiment.
        test: Held-out trajectories.
        times: Number of re-rolls of each trajectory.
        num: Number of trajectories with re-rolls.
        judge: Function that scores a prediction of the first `num` held-out trajectories (`evaluation.scorer`).
        metrics: Metrics that `judge` computes.
    """
    few = test.take(slice(num))
    record, path = workdir / f"ceiling{suffix}.json", workdir / f"ceiling{suffix}.npz"
    inputs = {
        "dataset": data.identity,
        "the held-out list": storage.digest(few.trajectory.tolist()),
        "the re-rolls": storage.digest([times, SEED, FORMAT]),
    }
    further = sorted(metric.name for metric in metrics if metric.errors is not None)
    if further:  # the library's metrics have no `errors`
        inputs["the list of metrics per trajectory"] = storage.digest(further)
    reason = results.stale(record, inputs)
    if reason is not None:
        if record.exists():
            say(f"ceilings: again, because {reason}")
        with Bar() as bar:
            total = times * len(few.object)
            made = reroll(collection, sensor, few, times, judge, lambda done: bar("re-roll", done, total))
        storage.write_arrays(path, _flat(made))
        results.write(record, {"times": times, "items": len(few.object)}, inputs, [path])
    return _restored(storage.read_arrays(path, f"delete {path.name} and {record.name}, and evaluate again"))


def reroll(
    collection: dataset.Collection,
    sensor: sts.Sensor,
    test: dataset.Pairs,
    times: int,
    judge: Judge,
    progress: Callable[[int], object] | None = None,
) -> Ceilings:
    """Re-roll trajectories, and score two predictions of each: the mean of its re-rolls, and one of its re-rolls.

    A re-roll is a new simulation from the first pose of a trajectory, with newly drawn hidden properties such as
    friction.

    Args:
        collection: Description of the dataset, with the scenario and the physics engine of the simulation.
        sensor: Sensor that renders the last frames of the re-rolls.
        test: Trajectories to re-roll.
        times: Number of re-rolls of each trajectory.
        judge: Function that scores a prediction of the trajectories in `test`.
        progress: Function that receives the total number of re-rolls that have been simulated so far.
    """
    mean = evaluation.ceiling(collection, sensor, test, times, jax.random.key(SEED), progress=progress)
    samples = mean.samples
    if samples is None or samples.pose is None or samples.outcome is None:
        raise TypeError(
            "evaluation.ceiling must return samples of the pose and of the outcome, but the field `samples`, "
            "`samples.pose` or `samples.outcome` of its result is None"
        )
    one = evaluation.Predicted(*(None if leaf is None else leaf[0] for leaf in samples[:4]))
    scores = {
        evaluation.CEILING: judge(mean, test),
        evaluation.ONE_REROLL: judge(one, test),
    }
    return Ceilings(scores, samples.pose, samples.outcome)


def _flat(made: Ceilings) -> dict[str, np.ndarray]:
    """All arrays by a path such as `one re-roll/visual/bce` or `one re-roll/further/height_error`, for a file."""
    arrays = {"pose": made.pose, "outcome": made.outcome}
    for name, scores in made.scores.items():
        for field, value in scores._asdict().items():
            if isinstance(value, evaluation.metrics.ImageError):
                arrays |= {f"{name}/{field}/{part}": leaf for part, leaf in value._asdict().items()}
            elif isinstance(value, dict):
                arrays |= {f"{name}/{field}/{part}": leaf for part, leaf in value.items()}
            elif isinstance(value, np.ndarray):
                arrays[f"{name}/{field}"] = value
    return arrays


def _restored(arrays: dict[str, np.ndarray]) -> Ceilings:
    """The inverse of `_flat`."""
    scores = {}
    for name in evaluation.CEILINGS:
        own = {key.removeprefix(f"{name}/"): leaf for key, leaf in arrays.items() if key.startswith(f"{name}/")}
        fields: dict = dict.fromkeys(evaluation.Scores._fields) | {
            key: leaf for key, leaf in own.items() if "/" not in key
        }
        for field in {key.partition("/")[0] for key in own if "/" in key}:
            parts = {key.partition("/")[2]: leaf for key, leaf in own.items() if key.startswith(f"{field}/")}
            fields[field] = parts if field == "further" else evaluation.metrics.ImageError(**parts)
        scores[name] = evaluation.Scores(**fields)
    return Ceilings(scores, arrays["pose"], arrays["outcome"])
