"""The ceilings of an experiment: its first held-out starts re-rolled once, scored, and kept in the work directory."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

import sts_jax as sts
from experiments.shared import results
from experiments.shared.progress import Bar, say
from sts_jax import _files, dataset, evaluation
from sts_jax.dataset.records import read_arrays

Judge = Callable[[evaluation.Predicted, dataset.Pairs], evaluation.Scores]
SEED = 20  # of the re-rolls
FORMAT = 2  # of the files (2: outcomes are decided by the ratio of probability to frequency)


class Ceilings(NamedTuple):
    """Re-rolls of the first held-out starts, and their scores."""

    scores: dict[str, evaluation.Scores]  # of their mean, and of a single re-roll
    pose: np.ndarray  # (times, n, 7), last poses
    outcome: np.ndarray  # int (times, n)


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
) -> Ceilings:
    """The ceilings of the first `num` held-out items: read, or computed and written to `ceiling{suffix}.npz`.

    `ceiling{suffix}.json` records the checksums of the inputs from which they were computed.

    Args:
        workdir: The work directory.
        suffix: Suffix of the names of the files, for a second split.
        collection: The collection of the experiment.
        sensor: The sensor that renders the ends of the re-rolls.
        data: The dataset of the items.
        test: The held-out items.
        times: Number of re-rolls per item.
        num: Number of items.
        judge: Scores a prediction of all these items, see `evaluation.scorer`.
    """
    few = dataset.Pairs(*(leaf[:num] for leaf in test))
    record, path = workdir / f"ceiling{suffix}.json", workdir / f"ceiling{suffix}.npz"
    inputs = {
        "dataset": data.identity,
        "the held-out list": _files.digest(few.trajectory.tolist()),
        "the re-rolls": _files.digest([times, SEED, FORMAT]),
    }
    reason = results.stale(record, inputs)
    if reason is not None:
        if record.exists():
            say(f"ceilings: again, because {reason}")
        with Bar() as bar:
            total = times * len(few.object)
            made = reroll(collection, sensor, few, times, judge, lambda done: bar("re-roll", done, total))
        dataset.write_arrays(path, _flat(made))
        results.write(record, {"times": times, "items": len(few.object)}, inputs, [path])
    return _restored(read_arrays(path))


def reroll(
    collection: dataset.Collection,
    sensor: sts.Sensor,
    test: dataset.Pairs,
    times: int,
    judge: Judge,
    progress: Callable[[int], object] | None = None,
) -> Ceilings:
    """Re-roll some items, and score the mean of the re-rolls and a single one."""
    mean = evaluation.ceiling(collection, sensor, test, times, jax.random.key(SEED), progress=progress)
    samples = mean.samples
    if samples is None or samples.pose is None or samples.outcome is None:
        raise TypeError("evaluation.ceiling returned no samples")
    one = evaluation.Predicted(*(None if leaf is None else leaf[0] for leaf in samples[:4]))
    scores = {
        evaluation.CEILING: judge(mean, test),
        evaluation.ONE_REROLL: judge(one, test),
    }
    return Ceilings(scores, samples.pose, samples.outcome)


def _flat(made: Ceilings) -> dict[str, np.ndarray]:
    """All arrays by a path such as `one re-roll/visual/bce`."""
    arrays = {"pose": made.pose, "outcome": made.outcome}
    for name, scores in made.scores.items():
        for field, value in scores._asdict().items():
            if isinstance(value, evaluation.metrics.ImageError):
                arrays |= {f"{name}/{field}/{part}": leaf for part, leaf in value._asdict().items()}
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
            parts = evaluation.metrics.ImageError._fields
            fields[field] = evaluation.metrics.ImageError(*(own[f"{field}/{part}"] for part in parts))
        scores[name] = evaluation.Scores(**fields)
    return Ceilings(scores, arrays["pose"], arrays["outcome"])
