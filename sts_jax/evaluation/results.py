"""Results: `score` computes errors, `summarise` and `image_summary` metrics with intervals, and `table` shows them."""

import enum
import functools
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from sts_jax import physics
from sts_jax.dataset import Pairs
from sts_jax.evaluation.catalogue import COLUMNS, LOG_LOSS, METRICS, Column, Metric, Scores
from sts_jax.evaluation.metrics import bootstrap, image_error, interval, ratio, skill, written
from sts_jax.evaluation.predictions import Predicted, in_unit
from sts_jax.evaluation.predictions import frequency as frequency_of
from sts_jax.evaluation.references import BASELINES, CEILINGS, CONSTANT, COPY, Streams

STREAMS = ("visual", "tactile")


def score(
    predicted: Predicted,
    test: Pairs,
    *,
    outcomes: Sequence[enum.IntEnum] = (),
    frequency: np.ndarray | None = None,
    metrics: Sequence[Metric] = METRICS,
) -> Scores:
    """Compute the errors of a prediction for each held-out trajectory (item).

    With outcome probabilities and `frequency`, the predicted outcome is the one with the largest ratio of probability
    to frequency. This choice has the best expected balanced accuracy, in which a rare outcome counts as much as a
    common one.

    Args:
        predicted: The prediction of all items, or of the first ones only.
        outcomes: The outcomes of the scenario, `scenario.outcomes`, for predictions with `outcome_probability`.
        frequency: Frequency of each outcome among the training trajectories, `(c,)`, from `evaluation.frequency`. If it
            is None, the predicted outcome is `predicted.outcome`, or else the likeliest outcome.

    Returns:
        The results of `Metric.errors` by the name of the metric, without metrics of quantities that are not predicted.
    """
    leaves = (
        *(predicted.visual, predicted.tactile, predicted.pose, predicted.outcome, predicted.outcome_probability),
        *(predicted.measurements or {}).values(),
    )
    test = test.take(slice(next((len(leaf) for leaf in leaves if leaf is not None), len(test.object))))
    items = len(test.object)
    if predicted.outcome_probability is not None:
        predicted = _decided(predicted, items, outcomes, frequency)
    errors = {metric.errors: metric.errors(predicted, test) for metric in metrics}
    scores = {}
    for metric in metrics:
        values = errors[metric.errors]
        if values is None:
            continue
        scores[metric.name] = np.asarray(values)
        if scores[metric.name].shape[:1] != (items,) or scores[metric.name].ndim > 2:
            raise ValueError(
                f"metric {metric.name!r}: its function `errors` returned an array of shape "
                f"{scores[metric.name].shape}, but it must be ({items},) or ({items}, k), with a row for each item"
            )
    return scores


def scorer(
    scenario: physics.Scenario, train: Pairs, *, metrics: Sequence[Metric] = METRICS
) -> Callable[[Predicted, Pairs], Scores]:
    """`score` as a function of a prediction and the held-out items, with the outcomes' frequencies in `train`."""
    frequencies = frequency_of(train.outcome, scenario.outcomes)
    return functools.partial(score, outcomes=scenario.outcomes, frequency=frequencies, metrics=metrics)


def _decided(
    predicted: Predicted, items: int, outcomes: Sequence[enum.IntEnum], frequency: np.ndarray | None
) -> Predicted:
    """Add the predicted outcome and the outcomes of the columns of `outcome_probability`."""
    probability, numbers = predicted.outcome_probability, np.array([int(outcome) for outcome in outcomes])
    assert probability is not None
    if probability.shape != (items, len(outcomes)):
        raise ValueError(
            f"outcome_probability has shape {probability.shape}, but it must have shape {(items, len(outcomes))}: "
            "pass the items that were predicted, and outcomes=scenario.outcomes"
        )
    outcome = predicted.outcome
    if frequency is not None:
        outcome = numbers[(probability / frequency).argmax(1)]
    elif outcome is None:
        outcome = numbers[probability.argmax(1)]
    return predicted._replace(outcome=outcome, outcomes=numbers)


def summarise(
    scores: Mapping[str, Scores],
    test: Pairs,
    *,
    metrics: Sequence[Metric] = METRICS,
    outcomes: Sequence[enum.IntEnum] = tuple(physics.Outcome),
    num: int = 2000,
    seed: int = 0,
) -> dict:
    """Compute all metrics of all predictors, and their differences from the baselines.

    Args:
        scores: Scores by predictor, including those of `evaluation.baselines`. A predictor may have scores of the first
            items only. Its metrics are then computed from these items.
        metrics: The metrics, the same as for `score`.
        outcomes: The outcomes of the scenario, `scenario.outcomes`, for their names.

    Returns:
        A dictionary that can be written as JSON, with the following entries. Each metric is a dictionary of `value` and
        of the limits `low` and `high` of its 95 % bootstrap interval over objects, or None if the predictor does not
        have the metric. The limits are None if all items of the metric are of one object.

        - `items`: Number of items.
        - `objects`: Number of different objects among the items.
        - `outcomes`: Number of items with each true outcome, by its name.
        - `scored`: Number of items that were scored, by predictor.
        - `predictors`: The metrics, by predictor and name of the metric.
        - `differences`: The metrics of each model minus those of each baseline, by model, baseline and name of the
            metric. Predictors from `evaluation.baselines` and `evaluation.ceiling` are not models.
    """
    keys = [metric.name for metric in metrics]
    for key in keys:
        if keys.count(key) > 1:
            raise ValueError(f"metrics has more than one metric named {key!r}: give each metric its own name")
    missing = [name for name in BASELINES if name not in scores]
    if missing:
        raise ValueError(
            f"`scores` lacks {' and '.join(map(repr, missing))}: add the scores of the predictions of "
            "evaluation.baselines"
        )
    items, names = len(test.object), {int(outcome): outcome.name.lower() for outcome in outcomes}
    scored = {name: len(next(iter(of_predictor.values()), test.object)) for name, of_predictor in scores.items()}
    # Baselines are compared with a model on the items for which the model was scored.
    counts = {scored[name] for name in scores if name not in (*BASELINES, *CEILINGS)}
    every = list(scored.items())
    every += [(base, count) for base in BASELINES for count in sorted(counts - {scored[base]})]
    statistics = [
        [
            _statistic(metric, _first(scores[name], count), scores[CONSTANT], test.take(slice(count)))
            for metric in metrics
        ]
        for name, count in every
    ]

    def numbers(weight: np.ndarray) -> np.ndarray:
        """All metrics, `(predictors, metrics)`, for weights of the items. NaN if a predictor lacks the metric."""
        rows = [
            [np.nan if statistic is None else statistic(weight[:count]) for statistic in row]
            for row, (_, count) in zip(statistics, every, strict=True)
        ]
        return np.array(rows)

    value = numbers(np.ones(items))
    draws = bootstrap(test.object, numbers, num=num, seed=seed)
    for i, (_, count) in enumerate(every):
        first = test.take(slice(count))
        for k, metric in enumerate(metrics):
            if statistics[i][k] is not None:
                counted = slice(None) if metric.items is None else metric.items(first)
                if len(np.unique(first.object[counted])) < 2:
                    draws[:, i, k] = np.nan

    def cells(values: np.ndarray, sample: np.ndarray) -> dict:
        return {key: cell(values[k], sample[:, k]) for k, key in enumerate(keys)}

    rows = list(scores)
    place = {one: i for i, one in enumerate(every)}
    return {
        "items": items,
        "objects": len(np.unique(test.object)),
        "outcomes": {names[int(o)]: int((test.outcome == o).sum()) for o in np.unique(test.outcome)},
        "scored": scored,
        "predictors": {name: cells(value[i], draws[:, i]) for i, name in enumerate(rows)},
        "differences": {
            name: {
                base: cells(value[i] - value[j], draws[:, i] - draws[:, j])
                for base in BASELINES
                for j in [place[base, scored[name]]]
            }
            for i, name in enumerate(rows)
            if name not in (*BASELINES, *CEILINGS)
        },
    }


def _first(scores: Scores, count: int) -> Scores:
    return {name: values[:count] for name, values in scores.items()}


def _statistic(metric: Metric, scores: Scores, constant: Scores, test: Pairs) -> Callable[[np.ndarray], float] | None:
    """The metric of a predictor as a function of the weights of its items, or None if the predictor lacks it."""
    values, reference = scores.get(metric.name), None
    if values is None:
        return None
    items = slice(None) if metric.items is None else metric.items(test)
    if metric.relative_to is not None:
        if metric.relative_to not in constant:
            return None
        reference = constant[metric.relative_to][: len(values)][items]
    values = values[items]

    def statistic(weight: np.ndarray) -> float:
        w = weight[items]
        if not w.any():
            return np.nan
        value = float(metric.reduce(values, w))
        if reference is None:
            return value
        whole = float(metric.reduce(reference, w))
        return 1 - value / whole if whole > 0 else np.nan

    return statistic


def gain(
    before: Scores, after: Scores, test: Pairs, *, metric: str = LOG_LOSS, num: int = 2000, seed: int = 0
) -> dict | None:
    """Compute the relative reduction `1 - after / before` of a mean error, such as from vision to vision and touch.

    Returns:
        A dictionary as in `summarise`, or None if a predictor lacks the metric or the reduction is not finite.
    """
    if metric not in before or metric not in after:
        return None

    def statistic(weight: np.ndarray) -> np.ndarray:
        return np.asarray(skill(after[metric], before[metric], weight))

    value = float(statistic(np.ones(len(before[metric]))))
    return cell(value, bootstrap(test.object, statistic, num=num, seed=seed))


def image_summary(
    predictions: Mapping[str, Predicted], test: Streams, *, num: int = 2000, seed: int = 0
) -> dict[str, dict]:
    """Compute cross-entropy and skill of predicted images, with 95 % bootstrap intervals over trajectories.

    Args:
        predictions: Predictions by name, with those of `image_baselines`.

    Returns:
        A dictionary for each of the streams `visual` and `tactile`, with the following entries.

        - `floor`: The entropy of the true images (nats per pixel and channel).
        - `predictors`: The metrics by predictor: the cross-entropy `bce` (nats per pixel and channel), and the skills
            relative to the mean training image (`skill`) and to the first image (`skill_copy`), each a dictionary as in
            `summarise`.
    """
    missing = [name for name in (CONSTANT, COPY) if name not in predictions]
    if missing:
        raise ValueError(
            f"`predictions` lacks {' and '.join(map(repr, missing))}: add the results of evaluation.image_baselines"
        )
    return {stream: _of_stream(predictions, test, stream, num, seed) for stream in STREAMS}


def _of_stream(predictions: Mapping[str, Predicted], test: Streams, stream: str, num: int, seed: int) -> dict:
    """The part of `image_summary` for one stream."""
    truth, errors = getattr(test, stream)[:, 1].astype(np.float32) / 255, {}
    for name, predicted in predictions.items():
        images = getattr(predicted, stream)
        if images is None:
            continue
        if images.shape != truth.shape:
            raise ValueError(
                f"prediction {name!r}: {stream} has shape {images.shape}, but the true images have shape {truth.shape}"
            )
        errors[name] = image_error(in_unit(images), truth)
    constant, copy = errors[CONSTANT], errors[COPY]

    def numbers(weight: np.ndarray) -> np.ndarray:
        bce = [ratio(error.bce, error.pixels, weight) for error in errors.values()]
        skills = [[skill(error.excess, base.excess, weight) for base in (constant, copy)] for error in errors.values()]
        return np.column_stack([bce, skills])

    value, draws = numbers(np.ones(len(truth))), bootstrap(np.arange(len(truth)), numbers, num=num, seed=seed)
    cells = {
        name: {key: cell(value[i, k], draws[:, i, k]) for k, key in enumerate(("bce", "skill", "skill_copy"))}
        for i, name in enumerate(errors)
    }
    return {"floor": ratio(constant.bce - constant.excess, constant.pixels), "predictors": cells}


def cell(number: float, sample: np.ndarray) -> dict | None:
    """A value and its interval from bootstrap samples, or None if the value is not finite."""
    if not np.isfinite(number):
        return None
    low, high = (None if np.isnan(limit) else limit for limit in interval(sample))
    return {"value": float(number), "low": low, "high": high}


def table(
    summary: dict,
    *,
    title: str,
    rows: Sequence[str] | None = None,
    notes: Sequence[str] = (),
    columns: Sequence[Column] = COLUMNS,
) -> str:
    """Format the main metrics as a Markdown table, below a title and an explanation of the metrics.

    Args:
        summary: The result of `summarise`.
        rows: Names of the predictors, in the order of the rows (default: all).
        columns: The columns of metrics, from left to right.
    """
    lines = head(["predictor", *(column.heading for column in columns)])
    for name in summary["predictors"] if rows is None else rows:
        cells = [
            [_shown(summary["predictors"][name], metric, interval=metric.interval) for metric in column.metrics]
            for column in columns
        ]
        lines.append(row([name, *("-" if set(cell) == {"-"} else " / ".join(cell) for cell in cells)]))
    return _page(summary, title, [metric for column in columns for metric in column.metrics], lines, notes)


def full_table(summary: dict, *, title: str, notes: Sequence[str] = (), metrics: Sequence[Metric] = METRICS) -> str:
    """Format all metrics as a Markdown table, followed by a table of the differences from the baselines.

    Args:
        summary: The result of `summarise`.
        metrics: The metrics, in the order of the columns.
    """
    lines = head(["predictor", *(metric.title for metric in metrics)])
    for name, cells in summary["predictors"].items():
        lines.append(row([name, *(_shown(cells, metric, interval=metric.interval) for metric in metrics)]))
    compared = [metric for metric in metrics if metric.compared is not None]
    lines += ["", _directions(compared), "", *head(["predictor", "baseline", *(metric.title for metric in compared)])]
    for name, against in summary["differences"].items():
        for base, differences in against.items():
            texts = [_shown(differences, metric, interval=True) for metric in compared]
            if set(texts) != {"-"}:
                lines.append(row([name, base, *texts]))
    return _page(summary, title, metrics, lines, notes)


def short_table(summary: dict, *, metrics: Sequence[Metric], rows: Sequence[str] | None = None) -> str:
    """Format metrics without intervals in aligned columns for a terminal, with the arguments of `table`."""
    lines = [["predictor", *(metric.title for metric in metrics)]]
    for name in summary["predictors"] if rows is None else rows:
        lines.append([name, *(_shown(summary["predictors"][name], metric, interval=False) for metric in metrics)])
    return aligned(lines)


def aligned(rows: Sequence[Sequence[str]]) -> str:
    """Format the rows of a table in aligned columns for a terminal."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join("  ".join(map(str.ljust, row, widths)).rstrip() for row in rows)


def head(cells: Sequence[str]) -> list[str]:
    """The first two lines of a Markdown table: the headings of its columns."""
    return [row(cells), "|---" * len(cells) + "|"]


def row(cells: Sequence[str]) -> str:
    """A line of a Markdown table."""
    return f"| {' | '.join(cells)} |"


def _shown(cells: Mapping[str, dict | None], metric: Metric, *, interval: bool) -> str:
    """The text of a cell: the value of a metric, or "-" if the predictor does not have the metric."""
    if metric.name not in cells:
        raise ValueError(f"summary lacks {metric.name!r}: pass all metrics of the table to score() and summarise()")
    value = cells[metric.name]
    if value is None:
        return "-"
    text = written(**value, digits=metric.digits, factor=metric.factor)
    return text if interval else text.partition(" ")[0]


def _directions(compared: Sequence[Metric]) -> str:
    """Sentences above the differences: for which metrics a positive or a negative difference is better."""
    text = "Differences from the baselines (predictor minus baseline)."
    for sign, direction in (("positive", "higher"), ("negative", "lower")):
        headings = [
            metric.heading or metric.name.replace("_", " ") for metric in compared if metric.compared == direction
        ]
        if headings:
            text += f" A {sign} difference is better for {', '.join(headings)}."
    return text


def _page(summary: dict, title: str, metrics: Sequence[Metric], lines: Sequence[str], notes: Sequence[str]) -> str:
    """Tables with their title, the number of held-out trajectories, explanations of the metrics, and notes."""
    outcomes = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in summary["outcomes"].items())
    text = (
        f"{summary['items']} held-out trajectories of {summary['objects']} objects ({outcomes}). Brackets contain "
        "95 % bootstrap intervals over objects."
    )
    if any("[-]" in line for line in (*lines, *notes)):
        text += " [-] stands for no interval, because all items are of one object."
    fewer = [
        f'The metrics of "{name}" are over the first {count} trajectories.'
        for name, count in summary["scored"].items()
        if count < summary["items"]
    ]
    explained = dict.fromkeys(metric.note for metric in metrics if metric.note)
    return "\n".join([f"# {title}", "", " ".join([text, *fewer, *explained]), "", *lines, "", *notes, ""])
