"""Metrics of several predictors with their intervals, as numbers and as two tables, a short and a complete one."""

import enum
import functools
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from sts_jax import physics
from sts_jax.dataset import Pairs
from sts_jax.evaluation import metrics
from sts_jax.evaluation.report import BASELINES, CEILINGS, CONSTANT, Scores

Statistic = Callable[[np.ndarray], float]  # a function of the items' weights

_DEGREES = 180 / np.pi
# Columns of the complete table: heading, metric, factor, decimals, and whether the interval is shown.
_ALL = (
    ("visual BCE", "visual_bce", 1, 4, False),
    ("visual excess x1e-4", "visual_excess", 1e4, 1, False),
    ("visual skill", "visual_skill", 1, 3, True),
    ("visual on object", "visual_skill_object", 1, 3, True),
    ("visual skill, best sample", "visual_skill_best", 1, 3, True),
    ("sharpness", "sharpness", 1, 2, False),
    ("tactile BCE", "tactile_bce", 1, 4, False),
    ("tactile excess x1e-4", "tactile_excess", 1e4, 1, False),
    ("tactile skill", "tactile_skill", 1, 3, True),
    ("tactile on object", "tactile_skill_object", 1, 3, True),
    ("position (mm)", "position", 1e3, 1, False),
    ("position, median (mm)", "position_median", 1e3, 1, False),
    ("position on pad (mm)", "position_on_pad", 1e3, 1, True),
    ("position on pad, median (mm)", "position_on_pad_median", 1e3, 1, True),
    ("energy score (mm)", "energy", 1e3, 1, True),
    ("coverage of 90 %", "coverage", 1, 3, True),
    ("angle (deg)", "angle", _DEGREES, 0, False),
    ("angle on pad (deg)", "angle_on_pad", _DEGREES, 0, False),
    ("axis (deg)", "axis", _DEGREES, 0, False),
    ("axis on pad (deg)", "axis_on_pad", _DEGREES, 0, False),
    ("axis on pad, median (deg)", "axis_on_pad_median", _DEGREES, 0, False),
    ("outcome, balanced accuracy", "outcome_balanced_accuracy", 1, 3, True),
    ("log loss (nats)", "outcome_log_loss", 1, 3, True),
    ("calibration error", "outcome_calibration_error", 1, 3, False),
    ("ROC area of falling off", "fell_off_auc", 1, 3, True),
)
_COMPARED = {
    *(f"{stream}_skill{part}" for stream in ("visual", "tactile") for part in ("", "_object")),
    *("position_on_pad", "energy", "axis_on_pad", "outcome_log_loss"),
}
# The names of the metrics of a predictor. BCE and excess (nats per pixel and channel) and skill of each stream are over
# all pixels or over the target's object pixels. Position and energy score (m), angle and angle of the up axes (rad) are
# over all items or over those that stayed on the pad. The rest are sharpness, coverage and outcome.
FIGURES = (
    *(row[1] for row in _ALL),
    *(f"{stream}_{figure}_object" for stream in ("visual", "tactile") for figure in ("bce", "excess")),
)


def summarise(
    scores: Mapping[str, Scores],
    test: Pairs,
    *,
    outcomes: Sequence[enum.IntEnum] = tuple(physics.Outcome),
    num: int = 2000,
    seed: int = 0,
) -> dict:
    """All metrics of all predictors with 95 % intervals over objects, and their differences from the baselines.

    Args:
        scores: Scores by name, including the baselines. A predictor may have scores of the first items only. Its
            metrics are then over these.
        test: The items that were scored.
        outcomes: `scenario.outcomes`, for their names.
        num: Number of bootstrap draws.
        seed: Seed of the draws.

    Returns:
        A dictionary for JSON: `items`, `objects`, `outcomes`, `scored` (name -> number of items), `predictors`
        (name -> metric -> value, low, high), and `differences` of the others from the baselines (name -> baseline ->
        metric -> value, low, high), where a positive difference of skill and a negative difference of an error favour
        the predictor.
    """
    statistics = {name: _statistics(s, scores[CONSTANT], test) for name, s in scores.items()}
    scored = {name: _count(s, len(test.object)) for name, s in scores.items()}
    names = list(scores)

    def figures(weight: np.ndarray) -> np.ndarray:
        rows = [
            [own[f](weight[: scored[name]]) if f in own else np.nan for f in FIGURES]
            for name, own in statistics.items()
        ]
        return np.array(rows)

    value = figures(np.ones(len(test.object)))
    draws = metrics.bootstrap(test.object, figures, num=num, seed=seed)

    def column(values: np.ndarray, sample: np.ndarray) -> dict:
        return {f: _cell(values[k], sample[:, k]) for k, f in enumerate(FIGURES)}

    reference = {name: names.index(name) for name in BASELINES}
    return {
        "items": len(test.object),
        "objects": len(np.unique(test.object)),
        "outcomes": {o.name.lower(): int((test.outcome == o).sum()) for o in sorted(outcomes) if o in test.outcome},
        "scored": scored,
        "predictors": {name: column(value[i], draws[:, i]) for i, name in enumerate(names)},
        "differences": {
            name: {base: column(value[i] - value[j], draws[:, i] - draws[:, j]) for base, j in reference.items()}
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

    return _cell(float(statistic(np.ones(len(first)))), metrics.bootstrap(test.object, statistic, num=num, seed=seed))


def _cell(number: float, sample: np.ndarray) -> dict | None:
    if not np.isfinite(number):
        return None
    low, high = metrics.interval(sample)
    return {"value": float(number), "low": low, "high": high}


def _count(s: Scores, items: int) -> int:
    """Number of items that a predictor was scored on."""
    errors = (error.excess for error in (s.visual, s.tactile) if error is not None)
    return next((len(x) for x in (*errors, s.position, s.outcome) if x is not None), items)


def _statistics(s: Scores, constant: Scores, test: Pairs) -> dict[str, Statistic]:
    """The metrics of a predictor, each as a function of the weights of its items."""
    count = _count(s, len(test.object))
    truth = test.outcome[:count]
    stayed = truth != int(physics.Outcome.FELL_OFF)
    found: dict[str, Statistic] = {}
    for stream in ("visual", "tactile"):
        for part in ("", "_object"):
            error, whole = getattr(s, f"{stream}{part}"), getattr(constant, f"{stream}{part}")
            if error is None:
                continue
            reference = metrics.ImageError(*(leaf[:count] for leaf in whole))
            found[f"{stream}_bce{part}"] = functools.partial(metrics.mean_per_pixel, error.bce, error.pixels)
            found[f"{stream}_excess{part}"] = functools.partial(metrics.mean_per_pixel, error.excess, error.pixels)
            found[f"{stream}_skill{part}"] = functools.partial(metrics.skill, error, reference)
    if s.best is not None and constant.visual is not None:
        reference = metrics.ImageError(*(leaf[:count] for leaf in constant.visual))
        found["visual_skill_best"] = functools.partial(metrics.skill, s.best, reference)
    if s.gradient is not None and s.gradient_target is not None:
        found["sharpness"] = functools.partial(metrics.mean_per_pixel, s.gradient, s.gradient_target)
    for name, error in (("position", s.position), ("angle", s.angle), ("axis", s.axis)):
        if error is not None:
            found[name] = functools.partial(_mean, error)
            found[f"{name}_median"] = functools.partial(metrics.median, error)
            found[f"{name}_on_pad"] = functools.partial(_mean, error[stayed], keep=stayed)
            found[f"{name}_on_pad_median"] = functools.partial(_median, error[stayed], keep=stayed)
    for name, values in (("energy", s.energy), ("coverage", s.coverage), ("outcome_log_loss", s.log_loss)):
        if values is not None:
            found[name] = functools.partial(_mean, values)
    if s.outcome is not None:
        found["outcome_balanced_accuracy"] = functools.partial(metrics.balanced_accuracy, s.outcome, truth)
    if s.confidence is not None and s.right is not None:
        found["outcome_calibration_error"] = functools.partial(metrics.calibration_error, s.confidence, s.right)
    if s.fell_off is not None:
        found["fell_off_auc"] = functools.partial(metrics.auc, ~stayed, s.fell_off)
    return {name: statistic for name, statistic in found.items() if name in FIGURES}


def _mean(values: np.ndarray, weight: np.ndarray, *, keep: np.ndarray | None = None) -> float:
    w = weight if keep is None else weight[keep]
    return float((w * values).sum() / w.sum()) if w.sum() > 0 else float("nan")


def _median(values: np.ndarray, weight: np.ndarray, *, keep: np.ndarray) -> float:
    return metrics.median(values, weight[keep])


def table(summary: dict, *, title: str, rows: Sequence[str] | None = None, notes: Sequence[str] = ()) -> str:
    """The main metrics as a Markdown table of eight columns.

    Args:
        summary: From `summarise`.
        title: The heading.
        rows: Names of the predictors, in order (default: all).
        notes: Lines below the table.
    """
    heads = (
        "predictor",
        "visual skill",
        "on object",
        "tactile skill",
        "position on pad, mean / median (mm)",
        "axis on pad (deg)",
        "outcome, balanced accuracy / log loss (nats)",
        "energy score (mm) / coverage of 90 %",
    )
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for name in summary["predictors"] if rows is None else rows:
        own = summary["predictors"][name]
        cells = [
            _shown(own["visual_skill"], 1, 3, True),
            _shown(own["visual_skill_object"], 1, 3),
            _shown(own["tactile_skill"], 1, 3, True),
            _pair(_shown(own["position_on_pad"], 1e3, 1), _shown(own["position_on_pad_median"], 1e3, 1)),
            _shown(own["axis_on_pad"], _DEGREES, 0),
            _pair(_shown(own["outcome_balanced_accuracy"], 1, 2), _shown(own["outcome_log_loss"], 1, 2)),
            _pair(_shown(own["energy"], 1e3, 1), _shown(own["coverage"], 1, 2)),
        ]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    explained = (
        "Skill is 1 - excess / excess of the constant, of the mean over samples. The energy score is a distance that a "
        "predicted distribution scores, and the error of a single prediction."
    )
    return "\n".join([f"# {title}", "", f"{_held_out(summary)} {explained}", "", *lines, "", *notes, ""])


def full_table(summary: dict, *, title: str, notes: Sequence[str] = ()) -> str:
    """All metrics of all predictors as a Markdown table, followed by the differences from the baselines."""
    explained = (
        "BCE and excess are nats a pixel and channel; skill is 1 - excess / excess of the constant. The best sample is "
        "each item's sample with the smallest visual excess: it is chosen with the truth in sight. Sharpness is the "
        "gradient energy of the visual samples over that of the true images. Coverage counts how often the true "
        "position is among the inner 90 % of itself and the samples, ranked by their mean distance from each other. "
        f"The log loss counts probabilities below {metrics.FLOOR} as {metrics.FLOOR}. The calibration error compares "
        f"the probability of the likeliest outcome with its frequency in {metrics.BINS} bins of equal width."
    )
    lines = [
        f"# {title}",
        "",
        f"{_held_out(summary)} {explained}",
        "",
        f"| predictor | {' | '.join(head for head, *_ in _ALL)} |",
        "|---" * (len(_ALL) + 1) + "|",
    ]
    for name, own in summary["predictors"].items():
        cells = [
            _shown(own[figure], factor, digits, with_interval) for _, figure, factor, digits, with_interval in _ALL
        ]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    compared = [row for row in _ALL if row[1] in _COMPARED]
    lines += [
        "",
        "Differences from the baselines (skill: positive is better; errors: negative is better):",
        "",
        f"| predictor | against | {' | '.join(row[0] for row in compared)} |",
        "|---" * (len(compared) + 2) + "|",
    ]
    for name, against in summary["differences"].items():
        for base, own in against.items():
            cells = [_shown(own[figure], factor, digits, True) for _, figure, factor, digits, _ in compared]
            if set(cells) != {"-"}:
                lines.append(f"| {name} | {base} | {' | '.join(cells)} |")
    return "\n".join([*lines, "", *notes, ""])


def _held_out(summary: dict) -> str:
    outcomes = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in summary["outcomes"].items())
    text = (
        f"{summary['items']} held-out trajectories of {summary['objects']} objects ({outcomes}). In brackets: 95 % "
        "intervals, bootstrapped over objects."
    )
    fewer = [
        f"{name}: the first {count} of them" for name, count in summary["scored"].items() if count < summary["items"]
    ]
    return " ".join([text, *(f"{'; '.join(fewer)}." for _ in fewer[:1])])


def _shown(figure: dict | None, factor: float, digits: int, with_interval: bool = False) -> str:
    if figure is None:
        return "-"
    value, low, high = (f"{figure[key] * factor:.{digits}f}" for key in ("value", "low", "high"))
    return f"{value} [{low}, {high}]" if with_interval else value


def _pair(one: str, other: str) -> str:
    return one if one == other == "-" else f"{one} / {other}"
