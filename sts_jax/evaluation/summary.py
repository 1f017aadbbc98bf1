"""The metrics of several predictors with their intervals over objects, as numbers."""

import enum
from collections.abc import Mapping, Sequence

import numpy as np

from sts_jax.dataset import Pairs
from sts_jax.evaluation.catalogue import METRICS
from sts_jax.evaluation.metrics import bootstrap, interval
from sts_jax.evaluation.outcomes import OUTCOMES, named
from sts_jax.evaluation.records import Judged, Metric, Scores, Statistic
from sts_jax.evaluation.reference import BASELINES, CEILINGS, CONSTANT


def summarise(
    scores: Mapping[str, Scores],
    test: Pairs,
    *,
    metrics: Sequence[Metric] = METRICS,
    outcomes: Sequence[enum.IntEnum] = OUTCOMES,
    num: int = 2000,
    seed: int = 0,
) -> dict:
    """All metrics of all predictors with 95 % intervals over objects, and their differences from the baselines.

    Args:
        scores: Scores by name, including the baselines. A predictor may have scores of the first items only. Its
            metrics are then over these.
        test: The items that were scored.
        metrics: The metrics. Those with `errors` must have been given to `score` too.
        outcomes: `scenario.outcomes`, for their names.
        num: Number of bootstrap draws.
        seed: Seed of the draws.

    Returns:
        A dictionary for JSON: `items`, `objects`, `outcomes`, `scored` (name -> number of items), `predictors`
        (name -> metric -> value, low, high), and `differences` of the others from the baselines (name -> baseline ->
        metric -> value, low, high). A metric that a predictor does not have is None.

    Raises:
        ValueError: Two metrics have the same name, or `scores` lacks a baseline.
    """
    keys = [metric.name for metric in metrics]
    twice = sorted({key for key in keys if keys.count(key) > 1})
    if twice:
        raise ValueError(f"metrics has two metrics of the name {', '.join(twice)}: give each metric its own name")
    missing = [name for name in BASELINES if name not in scores]
    if missing:
        raise ValueError(f"scores lacks {', '.join(missing)}: add the scores of each of evaluation.baselines")
    names = list(scores)
    scored = {name: _count(own, len(test.object)) for name, own in scores.items()}
    statistics = {name: _statistics(scores, name, scored[name], test, metrics) for name in names}

    def numbers(weight: np.ndarray) -> np.ndarray:
        """All metrics of all predictors, (predictors, metrics), nan where a predictor does not have a metric."""
        rows = [
            [np.nan if statistic is None else statistic(weight[: scored[name]]) for statistic in statistics[name]]
            for name in names
        ]
        return np.array(rows)

    value = numbers(np.ones(len(test.object)))
    draws = bootstrap(test.object, numbers, num=num, seed=seed)

    def cells(values: np.ndarray, sample: np.ndarray) -> dict:
        return {key: _cell(values[k], sample[:, k]) for k, key in enumerate(keys)}

    reference = {name: names.index(name) for name in BASELINES}
    return {
        "items": len(test.object),
        "objects": len(np.unique(test.object)),
        "outcomes": {named(int(o), outcomes): int((test.outcome == o).sum()) for o in np.unique(test.outcome)},
        "scored": scored,
        "predictors": {name: cells(value[i], draws[:, i]) for i, name in enumerate(names)},
        "differences": {
            name: {base: cells(value[i] - value[j], draws[:, i] - draws[:, j]) for base, j in reference.items()}
            for i, name in enumerate(names)
            if name not in (*reference, *CEILINGS)
        },
    }


def gain(before: Scores, after: Scores, test: Pairs, *, num: int = 2000, seed: int = 0) -> dict | None:
    """The share of the outcome's log loss of one predictor that another one removes, with its 95 % interval.

    Args:
        before: Scores of a predictor, for instance from vision.
        after: Scores of the other one, for instance from vision and touch.
        test: The items that were scored.
        num: Number of bootstrap draws over objects.
        seed: Seed of the draws.

    Returns:
        `value`, `low` and `high`, or None if a predictor has no outcome probabilities.
    """
    if before.log_loss is None or after.log_loss is None:
        return None
    first, second = before.log_loss, after.log_loss

    def statistic(weight: np.ndarray) -> np.ndarray:
        return np.asarray(1 - (weight * second).sum() / (weight * first).sum())

    return _cell(float(statistic(np.ones(len(first)))), bootstrap(test.object, statistic, num=num, seed=seed))


def _cell(number: float, sample: np.ndarray) -> dict | None:
    if not np.isfinite(number):
        return None
    low, high = interval(sample)
    return {"value": float(number), "low": low, "high": high}


def _count(own: Scores, items: int) -> int:
    """Number of items that a predictor was scored on."""
    errors = (error.excess for error in (own.visual, own.tactile) if error is not None)
    leaves = (*errors, own.position, own.outcome, *(own.further or {}).values())
    return next((len(leaf) for leaf in leaves if leaf is not None), items)


def _statistics(
    scores: Mapping[str, Scores], name: str, count: int, test: Pairs, metrics: Sequence[Metric]
) -> list[Statistic | None]:
    """The metrics of a predictor, each as a function of the weights of its items."""
    judged = Judged(scores[name], scores[CONSTANT].first(count), Pairs(*(leaf[:count] for leaf in test)))
    return [metric.of(judged) for metric in metrics]
