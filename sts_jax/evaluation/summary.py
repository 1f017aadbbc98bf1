"""`summarise` computes the metrics of several predictors, with bootstrap intervals over objects."""

import enum
from collections.abc import Mapping, Sequence

import numpy as np

from sts_jax.dataset import Pairs
from sts_jax.evaluation.catalogue import METRICS
from sts_jax.evaluation.intervals import bootstrap, interval
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
    """Compute all metrics of all predictors, and their differences from the baselines.

    Each value has a 95 % bootstrap interval over objects.

    Args:
        scores: Scores of the predictors by name. The predictors must include the baselines (`evaluation.baselines`). A
            predictor may have scores of the first items only. Its metrics are then computed from these items.
        test: The held-out trajectories (items) that were scored.
        metrics: The metrics to compute. Pass the same metrics to `evaluation.score`, which computes the errors of each
            item.
        outcomes: The outcomes of the scenario, `scenario.outcomes`. The summary contains their names.
        num: Number of bootstrap samples.
        seed: Seed of the bootstrap.

    Returns:
        A dictionary that can be written as JSON, with the following entries. Each metric is a dictionary of `value` and
        of the limits `low` and `high` of its interval, or None if the predictor does not have the metric.

        - `items`: Number of items.
        - `objects`: Number of different objects among the items.
        - `outcomes`: Number of items with each true outcome, by the name of the outcome.
        - `scored`: Number of items that were scored, by the name of the predictor.
        - `predictors`: The metrics of each predictor, by the name of the predictor and then of the metric.
        - `differences`: The metrics of each model minus those of each baseline, by the names of the model, of the
            baseline and of the metric. A model is a predictor that comes neither from
            `evaluation.baselines` nor from `evaluation.ceiling`.

    Raises:
        ValueError: Two metrics have the same name, or `scores` lacks a baseline.
    """
    keys = [metric.name for metric in metrics]
    twice = sorted({key for key in keys if keys.count(key) > 1})
    if twice:
        raise ValueError(
            f"metrics has more than one metric named {' and more than one named '.join(map(repr, twice))}: "
            "give each metric its own name"
        )
    missing = [name for name in BASELINES if name not in scores]
    if missing:
        raise ValueError(
            f"`scores` lacks {' and '.join(map(repr, missing))}: pass the predictions of evaluation.baselines to "
            "evaluation.score, and add the results to `scores`"
        )
    names = list(scores)
    scored = {name: _count(own, len(test.object)) for name, own in scores.items()}
    statistics = {name: _statistics(scores, name, scored[name], test, metrics) for name in names}

    def numbers(weight: np.ndarray) -> np.ndarray:
        """Compute all metrics with the given weights of the items. A metric that a predictor does not have is NaN.

        Args:
            weight: Weights of the items, `(n,)`.

        Returns:
            The metrics, `(predictors, metrics)`.
        """
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
    """Compute the relative reduction of the outcome's log loss from one predictor to another.

    The reduction is `1 - b / a`, where a is the mean log loss of the first predictor, and b is that of the second one.

    Args:
        before: Scores of the first predictor, for instance from vision.
        after: Scores of the second predictor, for instance from vision and touch.
        test: The held-out trajectories that were scored.
        num: Number of bootstrap samples over objects.
        seed: Seed of the bootstrap.

    Returns:
        A dictionary of the reduction `value` and of the limits `low` and `high` of its 95 % interval. The result is
        None if a predictor has no outcome probabilities, or if the reduction is not finite.
    """
    if before.log_loss is None or after.log_loss is None:
        return None
    first, second = before.log_loss, after.log_loss

    def statistic(weight: np.ndarray) -> np.ndarray:
        return np.asarray(1 - (weight * second).sum() / (weight * first).sum())

    return _cell(float(statistic(np.ones(len(first)))), bootstrap(test.object, statistic, num=num, seed=seed))


def _cell(number: float, sample: np.ndarray) -> dict | None:
    """A value and its interval from bootstrap samples, or None if the value is not finite."""
    if not np.isfinite(number):
        return None
    low, high = interval(sample)
    return {"value": float(number), "low": low, "high": high}


def _count(own: Scores, items: int) -> int:
    """The number of items for which a predictor has scores."""
    errors = (error.excess for error in (own.visual, own.tactile) if error is not None)
    leaves = (*errors, own.position, own.outcome, *(own.further or {}).values())
    return next((len(leaf) for leaf in leaves if leaf is not None), items)


def _statistics(
    scores: Mapping[str, Scores], name: str, count: int, test: Pairs, metrics: Sequence[Metric]
) -> list[Statistic | None]:
    """The metrics of a predictor, each as a function of the weights of its items, or None."""
    judged = Judged(scores[name], scores[CONSTANT].first(count), test.take(slice(count)))
    return [metric.of(judged) for metric in metrics]
