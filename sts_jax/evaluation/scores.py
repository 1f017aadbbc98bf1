"""Errors of the predicted last frames of held-out trajectories. Each held-out trajectory is called an item."""

import enum
import functools
from collections.abc import Callable, Sequence

import numpy as np

from sts_jax import physics
from sts_jax.dataset import Pairs
from sts_jax.evaluation.catalogue import METRICS
from sts_jax.evaluation.metrics import (
    ImageError,
    axis_angle,
    best_of,
    coverage,
    energy_score,
    geodesic_angle,
    gradient_energy,
    image_error,
    log_loss,
    position_error,
)
from sts_jax.evaluation.outcomes import frequency as frequency_of
from sts_jax.evaluation.predictions import Predicted, in_unit
from sts_jax.evaluation.records import Metric, Scores


def score(
    predicted: Predicted,
    test: Pairs,
    *,
    outcomes: Sequence[enum.IntEnum] = (),
    frequency: np.ndarray | None = None,
    metrics: Sequence[Metric] = METRICS,
) -> Scores:
    """Compute the errors of a predictor, for each held-out trajectory (item).

    If the prediction has outcome probabilities and `frequency` is given, the predicted outcome is the outcome with the
    largest ratio of probability to frequency. This choice has the best expected balanced accuracy, in which a rare
    outcome counts as much as a common one.

    Args:
        predicted: The prediction of all items, or of the first ones only.
        test: The held-out items.
        outcomes: The outcomes of the scenario, `scenario.outcomes`. They are needed if the prediction has
            `outcome_probability`.
        frequency: Frequency of each of the c outcomes among the training trajectories, `(c,)`, from
            `evaluation.frequency`. If `frequency` is None, the predicted outcome is `predicted.outcome`. If
            `predicted.outcome` is also None, the predicted outcome is the outcome with the largest probability.
        metrics: The metrics of the evaluation. For each metric that has a function `Metric.errors`, `score` calls this
            function and stores the result in `Scores.further`.

    Returns:
        The errors of the items that are predicted.

    Raises:
        ValueError: `outcome_probability` does not have one row per item and one column per outcome, or `errors` of a
            metric does not return one number per item.
    """
    leaves = (
        *(predicted.visual, predicted.tactile, predicted.pose, predicted.outcome, predicted.outcome_probability),
        *(predicted.measurements or {}).values(),
    )
    count = next((len(leaf) for leaf in leaves if leaf is not None), len(test.object))
    test = test.take(slice(count))
    scores = _with_samples(_of_point(predicted, test), predicted, test)
    if predicted.outcome_probability is not None:
        scores = _with_probability(scores, predicted.outcome_probability, test, outcomes, frequency)
    return scores._replace(further=_further(predicted, test, metrics))


def scorer(
    scenario: physics.Scenario, train: Pairs, *, metrics: Sequence[Metric] = METRICS
) -> Callable[[Predicted, Pairs], Scores]:
    """Return a function that calls `score` with the outcomes of a scenario and their frequencies in the training set.

    Args:
        scenario: The scenario of the trajectories.
        train: The training trajectories.
        metrics: The metrics of the evaluation, for the argument `metrics` of `score`.

    Returns:
        A function that takes a prediction and the held-out trajectories, and returns the `Scores` of the prediction.
    """
    return functools.partial(
        score,
        outcomes=scenario.outcomes,
        frequency=frequency_of(train.outcome, scenario.outcomes),
        metrics=metrics,
    )


def _of_point(predicted: Predicted, test: Pairs) -> Scores:
    """Errors of the mean images, the pose and the outcome."""
    inside = test.segmentation[:, 1]

    def images(image: np.ndarray | None, target: np.ndarray, mask: np.ndarray | None) -> ImageError | None:
        return None if image is None else image_error(in_unit(image), target[:, 1] / 255, mask)

    pose, target = predicted.pose, test.pose[:, 1]
    return Scores(
        visual=images(predicted.visual, test.visual, None),
        visual_object=images(predicted.visual, test.visual, inside),
        tactile=images(predicted.tactile, test.tactile, None),
        tactile_object=images(predicted.tactile, test.tactile, inside),
        position=None if pose is None else position_error(pose, target),
        angle=None if pose is None else geodesic_angle(pose, target),
        axis=None if pose is None else axis_angle(pose, target),
        outcome=predicted.outcome,
    )


def _with_samples(scores: Scores, predicted: Predicted, test: Pairs) -> Scores:
    """Add the errors of the samples. A prediction without samples gets an energy score and a gradient energy too."""
    samples, truth, place = predicted.samples or Predicted(), test.visual[:, 1] / 255, test.pose[:, 1, :3]
    if samples.pose is not None:
        scores = scores._replace(
            energy=energy_score(samples.pose[..., :3], place),
            coverage=coverage(samples.pose[..., :3], place),
        )
    elif predicted.pose is not None:
        scores = scores._replace(energy=scores.position)
    if samples.visual is not None:
        scores = scores._replace(
            best=best_of([image_error(in_unit(image), truth) for image in samples.visual]),
            gradient=np.mean([gradient_energy(in_unit(image)) for image in samples.visual], axis=0),
        )
    elif predicted.visual is not None:
        scores = scores._replace(gradient=gradient_energy(in_unit(predicted.visual)))
    if predicted.visual is not None or samples.visual is not None:
        scores = scores._replace(gradient_target=gradient_energy(truth))
    return scores


def _further(predicted: Predicted, test: Pairs, metrics: Sequence[Metric]) -> dict[str, np.ndarray] | None:
    """Call the `errors` of some metrics. Return the results by the names of the metrics, or None without results."""
    found = {}
    for metric in metrics:
        values = None if metric.errors is None else metric.errors(predicted, test)
        if values is None:
            continue
        found[metric.name] = np.asarray(values, np.float64)
        if found[metric.name].shape != (len(test.object),):
            raise ValueError(
                f"metric {metric.name!r}: its function `errors` returned an array of shape "
                f"{found[metric.name].shape}, but the array must have one number per item and the shape "
                f"{(len(test.object),)}: keep the axis of the items, and reduce all other axes, for instance by a mean"
            )
    return found or None


def _with_probability(
    scores: Scores,
    probability: np.ndarray,
    test: Pairs,
    outcomes: Sequence[enum.IntEnum],
    frequency: np.ndarray | None,
) -> Scores:
    """Add the errors of the outcome probabilities."""
    if probability.shape != (len(test.outcome), len(outcomes)):
        raise ValueError(
            f"outcome_probability has shape {probability.shape}, but it must have shape "
            f"{(len(test.outcome), len(outcomes))}, with one row for each item of `test` and one column for each "
            "member of `outcomes`: pass the items that were predicted, and outcomes=scenario.outcomes"
        )
    number = np.array([int(outcome) for outcome in outcomes])
    likeliest = number[probability.argmax(1)]
    label = (test.outcome[:, None] == number).argmax(1)
    outcome = scores.outcome
    if frequency is not None:
        outcome = number[(probability / frequency).argmax(1)]
    elif outcome is None:
        outcome = likeliest
    fell_off = number.tolist().index(int(physics.Outcome.FELL_OFF))
    return scores._replace(
        outcome=outcome,
        log_loss=log_loss(probability, label),
        confidence=probability.max(1),
        right=likeliest == test.outcome,
        fell_off=probability[:, fell_off],
    )
