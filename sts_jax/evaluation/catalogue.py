"""The metrics of summaries and tables (METRICS), and the default columns of `table` (COLUMNS)."""

import dataclasses
import functools
from collections.abc import Callable

import numpy as np

from sts_jax import physics
from sts_jax.evaluation import metrics
from sts_jax.evaluation.records import Column, Judged, Metric, Statistic, mean

_Number = Callable[[Judged], Statistic | None]


def _image(stream: str, kind: str) -> _Number:
    """The statistic of an image metric.

    Args:
        stream: Field of `Scores`: `visual` or `tactile`, or `visual_object` or `tactile_object` (the object's pixels).
        kind: `bce` or `excess`, as a mean per pixel and channel, or `skill`.
    """

    def statistic(judged: Judged) -> Statistic | None:
        error, constant = getattr(judged.scores, stream), getattr(judged.constant, stream)
        if error is None:
            return None
        if kind == "skill":
            return functools.partial(metrics.skill, error, constant)
        return functools.partial(metrics.mean_per_pixel, getattr(error, kind), error.pixels)

    return statistic


def _of(field: str, reduce: Callable[[np.ndarray, np.ndarray], float] = mean, *, on_pad: bool = False) -> _Number:
    """The statistic of a field of `Scores` that has one number per item.

    Args:
        field: Name of the field.
        reduce: Function of the numbers and of the weights of the items, by default their weighted mean.
        on_pad: True to use only the items whose object stays on the pad.
    """

    def statistic(judged: Judged) -> Statistic | None:
        values = getattr(judged.scores, field)
        if values is None:
            return None
        if not on_pad:
            return functools.partial(reduce, values)
        stayed = judged.test.outcome != int(physics.Outcome.FELL_OFF)
        return lambda weight: reduce(values[stayed], weight[stayed])

    return statistic


def _best(judged: Judged) -> Statistic | None:
    if judged.scores.best is None or judged.constant.visual is None:
        return None
    return functools.partial(metrics.skill, judged.scores.best, judged.constant.visual)


def _sharpness(judged: Judged) -> Statistic | None:
    own = judged.scores
    if own.gradient is None or own.gradient_target is None:
        return None
    return functools.partial(metrics.mean_per_pixel, own.gradient, own.gradient_target)


def _accuracy(judged: Judged) -> Statistic | None:
    if judged.scores.outcome is None:
        return None
    return functools.partial(metrics.balanced_accuracy, judged.scores.outcome, judged.test.outcome)


def _calibration(judged: Judged) -> Statistic | None:
    own = judged.scores
    if own.confidence is None or own.right is None:
        return None
    return functools.partial(metrics.calibration_error, own.confidence, own.right)


def _auc(judged: Judged) -> Statistic | None:
    if judged.scores.fell_off is None:
        return None
    fell = judged.test.outcome == int(physics.Outcome.FELL_OFF)
    return functools.partial(metrics.auc, fell, judged.scores.fell_off)


_millimetres = functools.partial(Metric, unit="mm", factor=1e3, digits=1)
_degrees = functools.partial(Metric, unit="deg", factor=180 / np.pi, digits=0, interval=False)
_ON_PAD = (
    "Position is the distance between the predicted and the true position. On pad means that only trajectories count "
    "whose object stays on the pad."
)
_ANGLE = "The angle is that of the rotation between the predicted and the true orientation."
_AXIS = "The up axis is the z axis of the object. Its error is the angle between the predicted and the true axis."
# In the order of the columns of the complete table. Values in summaries are in SI units.
METRICS: tuple[Metric, ...] = (
    Metric(
        "visual_bce",
        heading="visual BCE",
        digits=4,
        statistic=_image("visual", "bce"),
        interval=False,
        note="BCE is the binary cross-entropy of an image. BCE and excess are in nats per pixel and channel.",
    ),
    Metric(
        "visual_excess",
        heading="visual excess x1e-4",
        factor=1e4,
        digits=1,
        statistic=_image("visual", "excess"),
        interval=False,
    ),
    Metric(
        "visual_skill",
        statistic=_image("visual", "skill"),
        compared="higher",
        note="Excess is the cross-entropy of an image minus the entropy of the true image. Skill is 1 minus the ratio "
        "of the excess to that of the constant prediction. With samples, it is the skill of their mean image.",
    ),
    Metric(
        "visual_skill_object",
        heading="visual skill on the object",
        statistic=_image("visual_object", "skill"),
        compared="higher",
    ),
    Metric(
        "visual_skill_best",
        heading="visual skill, best sample",
        statistic=_best,
        note="The best sample of a trajectory is the one with the smallest visual excess. This choice uses the true "
        "image.",
    ),
    Metric(
        "sharpness",
        digits=2,
        statistic=_sharpness,
        interval=False,
        note="Sharpness is the gradient energy of the visual samples divided by that of the true images. Gradient "
        "energy is the sum of the squared differences of neighbouring pixels.",
    ),
    Metric("tactile_bce", heading="tactile BCE", digits=4, statistic=_image("tactile", "bce"), interval=False),
    Metric(
        "tactile_excess",
        heading="tactile excess x1e-4",
        factor=1e4,
        digits=1,
        statistic=_image("tactile", "excess"),
        interval=False,
    ),
    Metric("tactile_skill", statistic=_image("tactile", "skill"), compared="higher"),
    Metric(
        "tactile_skill_object",
        heading="tactile skill on the object",
        statistic=_image("tactile_object", "skill"),
        compared="higher",
    ),
    _millimetres("position", statistic=_of("position"), interval=False),
    _millimetres(
        "position_median", heading="position, median", statistic=_of("position", metrics.median), interval=False
    ),
    _millimetres("position_on_pad", statistic=_of("position", on_pad=True), compared="lower", note=_ON_PAD),
    _millimetres(
        "position_on_pad_median",
        heading="position on pad, median",
        statistic=_of("position", metrics.median, on_pad=True),
    ),
    _millimetres(
        "energy",
        heading="energy score",
        statistic=_of("energy"),
        compared="lower",
        note="The energy score of the position is the mean distance of the samples from the true position, minus half "
        "their mean distance from each other. For a single predicted position, it is the error.",
    ),
    Metric(
        "coverage",
        heading=f"coverage of {100 * metrics.LEVEL:g} %",
        statistic=_of("coverage"),
        note=f"Coverage is the share of the true positions in the central {100 * metrics.LEVEL:g} % region of the "
        f"samples. It is {metrics.LEVEL:g} for calibrated predictions.",
    ),
    _degrees("angle", statistic=_of("angle"), note=_ANGLE),
    _degrees("angle_on_pad", statistic=_of("angle", on_pad=True)),
    _degrees("axis", heading="up axis", statistic=_of("axis"), note=_AXIS),
    _degrees(
        "axis_on_pad",
        heading="up axis on pad",
        statistic=_of("axis", on_pad=True),
        compared="lower",
        note=_AXIS,
    ),
    _degrees(
        "axis_on_pad_median",
        heading="up axis on pad, median",
        statistic=_of("axis", metrics.median, on_pad=True),
    ),
    Metric(
        "outcome_balanced_accuracy",
        heading="outcome, balanced accuracy",
        statistic=_accuracy,
        note="Balanced accuracy is the mean, over the outcomes, of the share of their trajectories that are predicted "
        "correctly.",
    ),
    Metric(
        "outcome_log_loss",
        heading="log loss",
        unit="nats",
        statistic=_of("log_loss"),
        compared="lower",
        note="The log loss is minus the logarithm of the predicted probability of the true outcome. Probabilities "
        f"below {metrics.FLOOR} count as {metrics.FLOOR}.",
    ),
    Metric(
        "outcome_calibration_error",
        heading="calibration error",
        statistic=_calibration,
        interval=False,
        note="The calibration error is the mean difference between the probability of the likeliest outcome and its "
        f"frequency, in {metrics.BINS} bins of equal width.",
    ),
    Metric(
        "fell_off_auc",
        heading="ROC area of falling off",
        statistic=_auc,
        note="The ROC area is the probability that an object that falls off has a higher predicted probability of "
        "falling off than one that stays.",
    ),
    *(
        Metric(f"{stream}_{kind}_object", statistic=_image(f"{stream}_object", kind), column=False)
        for stream in ("visual", "tactile")
        for kind in ("bce", "excess")
    ),
)


def _brief(name: str, digits: int, *, interval: bool = False) -> Metric:
    """A metric of METRICS as `table` shows it, with other decimals and with or without its interval."""
    known = {metric.name: metric for metric in METRICS}
    return dataclasses.replace(known[name], digits=digits, interval=interval)


COLUMNS: tuple[Column, ...] = (  # default columns of `table`
    Column("visual skill", (_brief("visual_skill", 3, interval=True),)),
    Column("visual skill on the object", (_brief("visual_skill_object", 3),)),
    Column("tactile skill", (_brief("tactile_skill", 3, interval=True),)),
    Column("position on pad, mean / median (mm)", (_brief("position_on_pad", 1), _brief("position_on_pad_median", 1))),
    Column("up axis on pad (deg)", (_brief("axis_on_pad", 0),)),
    Column(
        "outcome, balanced accuracy / log loss (nats)",
        (_brief("outcome_balanced_accuracy", 2), _brief("outcome_log_loss", 2)),
    ),
    Column(f"energy score (mm) / coverage of {100 * metrics.LEVEL:g} %", (_brief("energy", 1), _brief("coverage", 2))),
)
