"""`Metric`, the library's metrics (METRICS), and the columns of the main table (COLUMNS)."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np

from sts_jax import physics
from sts_jax.dataset import Measurement, Pairs
from sts_jax.evaluation import metrics
from sts_jax.evaluation.predictions import Predicted, in_unit

Scores = dict[str, np.ndarray]  # results of `Metric.errors` for n items by the metric's name, (n,) or (n, k)


@dataclasses.dataclass(frozen=True)
class Metric:
    """A number that describes the quality of a predictor in summaries and tables.

    First, `errors` computes numbers for each item (held-out trajectory), because images are too large to keep. Then
    `reduce` makes one number of them. The bootstrap over objects calls it many times, with different weights.
    """

    name: str  # name in summaries
    # Function of the predictions and the true items that returns one number per item, (n,), or several, (n, k). It
    # returns None if the predictor does not predict the quantity. Metrics with the same function share one call.
    errors: Callable[[Predicted, Pairs], np.ndarray | None]
    unit: str = ""  # unit in tables, in brackets behind the heading
    digits: int = 3  # number of decimals in tables
    factor: float = 1.0  # value in tables divided by the value in summaries (SI units), such as 1e3 for mm
    heading: str = ""  # heading of the column in tables (default: the name, with spaces)
    # Function of the result of `errors` and of the weights of the items, (n,), that returns the metric.
    reduce: Callable[[np.ndarray, np.ndarray], float] = metrics.mean
    items: Callable[[Pairs], np.ndarray] | None = None  # the items that count, bool (n,) (default: all)
    # Name of a metric. The value is then a skill: 1 minus the ratio of `reduce` to that of the constant prediction,
    # with the constant prediction's errors in the metric of this name.
    relative_to: str | None = None
    interval: bool = True  # true if tables show the interval
    # "higher" or "lower": which values are better. The complete table then also shows the differences from the
    # baselines. None: it does not.
    compared: Literal["higher", "lower"] | None = None
    note: str = ""  # sentences above the table that explain the metric

    @property
    def title(self) -> str:
        """The heading of the metric's column in tables, with the unit, such as "position (mm)"."""
        heading = self.heading or self.name.replace("_", " ")
        return f"{heading} ({self.unit})" if self.unit else heading


class Column(NamedTuple):
    """A column of the main table. Slashes separate the values of its metrics."""

    heading: str
    metrics: tuple[Metric, ...]


def measurement_error(measurement: Measurement) -> Metric:
    """Make the metric `NAME_error` of a measurement in the predicted last frame.

    Its mean is over the items whose last frame was measured. The error of a vector is the length of the difference
    (unit of the measurement). That of an image is the mean absolute difference.
    """

    def errors(predicted: Predicted, test: Pairs) -> np.ndarray | None:
        values = (predicted.measurements or {}).get(measurement.name)
        if values is None or measurement.name not in test.measurements:
            return None
        difference = in_unit(values) - in_unit(test.measurements[measurement.name][:, 1])
        return np.abs(difference).mean((1, 2, 3)) if measurement.is_image else np.linalg.norm(difference, axis=1)

    def measured(test: Pairs) -> np.ndarray:
        return ~np.isnan(test.measurements[measurement.name][:, 1]).reshape(len(test.object), -1).any(1)

    return Metric(f"{measurement.name}_error", errors, measurement.unit, items=measured, compared="lower")


def _image_errors(stream: str, *, inside: bool) -> Callable[[Predicted, Pairs], np.ndarray | None]:
    """Errors of the images of a stream, or of the object's pixels, with the columns of `metrics.ImageError`."""

    def errors(predicted: Predicted, test: Pairs) -> np.ndarray | None:
        images = getattr(predicted, stream)
        if images is None:
            return None
        mask = test.segmentation[:, 1] if inside else None
        return np.stack(metrics.image_error(in_unit(images), getattr(test, stream)[:, 1] / 255, mask), 1)

    return errors


def _best_errors(predicted: Predicted, test: Pairs) -> np.ndarray | None:
    """Errors of the sample with the smallest excess."""
    if predicted.samples is None or predicted.samples.visual is None:
        return None
    truth = test.visual[:, 1] / 255
    errors = np.array([np.stack(metrics.image_error(in_unit(x), truth), 1) for x in predicted.samples.visual])
    return errors[errors[..., 1].argmin(0), np.arange(len(truth))]


def _gradients(stream: str) -> Callable[[Predicted, Pairs], np.ndarray | None]:
    """Gradient energy of the image of a stream (mean over the samples), and of the true one."""

    def energies(predicted: Predicted, test: Pairs) -> np.ndarray | None:
        samples = None if predicted.samples is None else getattr(predicted.samples, stream)
        images = [getattr(predicted, stream)] if samples is None else samples
        if images[0] is None:
            return None
        energy = np.mean([metrics.gradient_energy(in_unit(image)) for image in images], axis=0)
        return np.stack([energy, metrics.gradient_energy(getattr(test, stream)[:, 1] / 255)], 1)

    return energies


def _of_pose(
    function: Callable[[np.ndarray, np.ndarray], np.ndarray],
) -> Callable[[Predicted, Pairs], np.ndarray | None]:
    return lambda predicted, test: None if predicted.pose is None else function(predicted.pose, test.pose[:, 1])


def _energy(predicted: Predicted, test: Pairs) -> np.ndarray | None:
    """Energy score of the position, which is the error of a prediction without samples (m)."""
    if predicted.samples is not None and predicted.samples.pose is not None:
        return metrics.energy_score(predicted.samples.pose[..., :3], test.pose[:, 1, :3])
    return _position(predicted, test)


def _coverage(predicted: Predicted, test: Pairs) -> np.ndarray | None:
    if predicted.samples is None or predicted.samples.pose is None:
        return None
    return metrics.coverage(predicted.samples.pose[..., :3], test.pose[:, 1, :3])


def _outcomes(predicted: Predicted, test: Pairs) -> np.ndarray | None:
    """Predicted and true outcome."""
    return None if predicted.outcome is None else np.stack([predicted.outcome, test.outcome], 1)


def _log_loss(predicted: Predicted, test: Pairs) -> np.ndarray | None:
    if predicted.outcome_probability is None:
        return None
    return metrics.log_loss(predicted.outcome_probability, (test.outcome[:, None] == predicted.outcomes).argmax(1))


def _confidence(predicted: Predicted, test: Pairs) -> np.ndarray | None:
    """Probability of the likeliest outcome, and 1 if this is the true outcome."""
    probability, outcomes = predicted.outcome_probability, predicted.outcomes
    if probability is None or outcomes is None:
        return None
    return np.stack([probability.max(1), outcomes[probability.argmax(1)] == test.outcome], 1)


def _falls(predicted: Predicted, test: Pairs) -> np.ndarray | None:
    """Predicted probability of falling off, and 1 if the object falls off."""
    probability, outcomes = predicted.outcome_probability, predicted.outcomes
    if probability is None or outcomes is None:
        return None
    fell_off = int(physics.Outcome.FELL_OFF)
    return np.stack([probability[:, outcomes.tolist().index(fell_off)], test.outcome == fell_off], 1)


def _stays(test: Pairs) -> np.ndarray:
    return test.outcome != int(physics.Outcome.FELL_OFF)


def _excess(errors: np.ndarray, weight: np.ndarray) -> float:
    return float((weight * errors[:, 1]).sum())


def _image_metrics(stream: str) -> tuple[Metric, ...]:
    """Cross-entropy, excess and skill of a stream, and the skill on the object."""
    whole, inside = (_image_errors(stream, inside=inside) for inside in (False, True))
    mean = functools.partial(Metric, errors=whole, interval=False)
    skill = functools.partial(
        Metric,
        reduce=_excess,
        compared="higher",
        note="Excess is the cross-entropy of an image minus the entropy of the true image. Skill is 1 minus the ratio "
        "of the excess to that of the constant prediction. With samples, it is the skill of their mean image.",
    )
    return (
        mean(
            f"{stream}_bce",
            heading=f"{stream} BCE",
            digits=4,
            reduce=lambda errors, weight: metrics.ratio(errors[:, 0], errors[:, 2], weight),
            note="BCE is the binary cross-entropy of an image. BCE and excess are in nats per pixel and channel.",
        ),
        mean(
            f"{stream}_excess",
            heading=f"{stream} excess x1e-4",
            factor=1e4,
            digits=1,
            reduce=lambda errors, weight: metrics.ratio(errors[:, 1], errors[:, 2], weight),
        ),
        skill(f"{stream}_skill", whole, relative_to=f"{stream}_skill"),
        skill(
            f"{stream}_skill_object",
            inside,
            heading=f"{stream} skill on the object",
            relative_to=f"{stream}_skill_object",
        ),
    )


def _sharpness(stream: str, name: str, note: str = "") -> Metric:
    return Metric(
        name,
        _gradients(stream),
        digits=2,
        reduce=lambda gradients, weight: metrics.ratio(gradients[:, 0], gradients[:, 1], weight),
        interval=False,
        note=note,
    )


_position, _angle, _axis = (
    _of_pose(function) for function in (metrics.position_error, metrics.geodesic_angle, metrics.axis_angle)
)
_millimetres = functools.partial(Metric, unit="mm", factor=1e3, digits=1)
_degrees = functools.partial(Metric, unit="deg", factor=180 / np.pi, digits=0, interval=False)
_AXIS_NOTE = "The up axis is the z axis of the object. Its error is the angle between the predicted and the true axis."
LOG_LOSS, CALIBRATION = "outcome_log_loss", "outcome_calibration_error"  # names of metrics
# In the order of the columns of the complete table. Values in summaries are in SI units.
METRICS: tuple[Metric, ...] = (
    *_image_metrics("visual"),
    Metric(
        "visual_skill_best",
        _best_errors,
        heading="visual skill, best sample",
        reduce=_excess,
        relative_to="visual_skill",
        note="The best sample of a trajectory is the one with the smallest visual excess. This choice uses the true "
        "image.",
    ),
    _sharpness(
        "visual",
        "sharpness",
        note="Sharpness is the gradient energy of the samples divided by that of the true images, of the visual ones "
        "unless it is named otherwise. Gradient energy is the sum of the squared differences of neighbouring pixels.",
    ),
    *_image_metrics("tactile"),
    _sharpness("tactile", "tactile_sharpness"),
    _millimetres("position", _position, interval=False),
    _millimetres("position_median", _position, heading="position, median", reduce=metrics.median, interval=False),
    _millimetres(
        "position_on_pad",
        _position,
        items=_stays,
        compared="lower",
        note="Position is the distance between the predicted and the true position. On pad means that only "
        "trajectories count whose object stays on the pad.",
    ),
    _millimetres(
        "position_on_pad_median",
        _position,
        heading="position on pad, median",
        reduce=metrics.median,
        items=_stays,
    ),
    _millimetres(
        "energy",
        _energy,
        heading="energy score",
        compared="lower",
        note="The energy score of the position is the mean distance of the samples from the true position, minus half "
        "their mean distance from each other. For a single predicted position, it is the error.",
    ),
    Metric(
        "coverage",
        _coverage,
        heading=f"coverage of {100 * metrics.LEVEL:g} %",
        note=f"Coverage is the share of the true positions in the central {100 * metrics.LEVEL:g} % region of the "
        f"samples. It is {metrics.LEVEL:g} for calibrated predictions.",
    ),
    _degrees("angle", _angle, note="The angle is that of the rotation between the predicted and the true orientation."),
    _degrees("angle_on_pad", _angle, items=_stays),
    _degrees("axis", _axis, heading="up axis", note=_AXIS_NOTE),
    _degrees("axis_on_pad", _axis, heading="up axis on pad", items=_stays, compared="lower", note=_AXIS_NOTE),
    _degrees("axis_on_pad_median", _axis, heading="up axis on pad, median", reduce=metrics.median, items=_stays),
    Metric(
        "outcome_balanced_accuracy",
        _outcomes,
        heading="outcome, balanced accuracy",
        reduce=lambda outcome, weight: metrics.balanced_accuracy(outcome[:, 0], outcome[:, 1], weight),
        note="Balanced accuracy is the mean, over the outcomes, of the share of their trajectories that are predicted "
        "correctly.",
    ),
    Metric(
        LOG_LOSS,
        _log_loss,
        heading="log loss",
        unit="nats",
        compared="lower",
        note="The log loss is minus the logarithm of the predicted probability of the true outcome. Probabilities "
        f"below {metrics.FLOOR} count as {metrics.FLOOR}.",
    ),
    Metric(
        CALIBRATION,
        _confidence,
        heading="calibration error",
        reduce=lambda judged, weight: metrics.calibration_error(judged[:, 0], judged[:, 1], weight),
        interval=False,
        note="The calibration error is the mean difference between the probability of the likeliest outcome and its "
        f"frequency, in {metrics.BINS} bins of equal width.",
    ),
    Metric(
        "fell_off_auc",
        _falls,
        heading="ROC area of falling off",
        reduce=lambda falls, weight: metrics.auc(falls[:, 1] > 0, falls[:, 0], weight),
        note="The ROC area is the probability that an object that falls off has a higher predicted probability of "
        "falling off than one that stays.",
    ),
)


def _brief(name: str, digits: int, *, interval: bool = False) -> Metric:
    """A metric of METRICS as `table` shows it, with other decimals and with or without its interval."""
    (metric,) = (metric for metric in METRICS if metric.name == name)
    return dataclasses.replace(metric, digits=digits, interval=interval)


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
