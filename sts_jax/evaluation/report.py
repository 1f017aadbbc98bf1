"""Predictions on held-out objects, baselines, and their errors per item."""

import enum
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sts_jax import physics
from sts_jax.dataset import Pairs
from sts_jax.evaluation import metrics


class Predicted(NamedTuple):
    """The predicted last moment of `n` trajectories. Quantities that are not predicted are None.

    With samples, `visual` and `tactile` are their means and `pose` is a point prediction.
    """

    visual: np.ndarray | None = None  # (n, height, width, 3), float in [0, 1] or uint8
    tactile: np.ndarray | None = None  # (n, height, width, 3), float in [0, 1] or uint8
    pose: np.ndarray | None = None  # float (n, 7)
    outcome: np.ndarray | None = None  # int (n,), physics.Outcome
    samples: "Predicted | None" = None  # k draws of the whole prediction, (k, n, ...), or None if it is deterministic
    outcome_probability: np.ndarray | None = None  # float (n, c), in the order of `scenario.outcomes`


def first(predicted: Predicted, count: int) -> Predicted:
    """The prediction for the first `count` items."""
    return _mapped(lambda leaves, axis: leaves[0][:count] if axis == 0 else leaves[0][:, :count], [predicted])


def joined(parts: Sequence[Predicted]) -> Predicted:
    """One prediction for the items of several predictions of the same quantities, in order."""
    return _mapped(np.concatenate, parts)


def _mapped(
    function: Callable[[Sequence[np.ndarray], int], np.ndarray], parts: Sequence[Predicted], axis: int = 0
) -> Predicted:
    """Apply a function of several arrays and their axis of items to every quantity of several predictions."""

    def apply(leaves: Sequence[np.ndarray | None]) -> np.ndarray | None:
        there = [leaf for leaf in leaves if leaf is not None]
        return function(there, axis) if there else None

    samples = [part.samples for part in parts if part.samples is not None]
    return Predicted(
        visual=apply([part.visual for part in parts]),
        tactile=apply([part.tactile for part in parts]),
        pose=apply([part.pose for part in parts]),
        outcome=apply([part.outcome for part in parts]),
        samples=_mapped(function, samples, 1) if samples else None,
        outcome_probability=apply([part.outcome_probability for part in parts]),
    )


class Scores(NamedTuple):
    """Errors of one predictor, per item. The errors of quantities that it does not predict are None.

    The last fields are for predicted distributions. The energy score of a deterministic position is its error.
    """

    visual: metrics.ImageError | None
    visual_object: metrics.ImageError | None
    tactile: metrics.ImageError | None
    tactile_object: metrics.ImageError | None
    position: np.ndarray | None  # m (n,)
    angle: np.ndarray | None  # rad (n,)
    axis: np.ndarray | None  # rad (n,), of the up axes
    outcome: np.ndarray | None  # int (n,)
    energy: np.ndarray | None = None  # m (n,), energy score of the position
    coverage: np.ndarray | None = None  # (n,), see `metrics.coverage`
    best: metrics.ImageError | None = None  # visual error of each item's sample with the smallest excess
    gradient: np.ndarray | None = None  # (n,) gradient energy of the image, or mean over the visual samples
    gradient_target: np.ndarray | None = None  # (n,) gradient energy of the true images
    log_loss: np.ndarray | None = None  # nats (n,), of the outcome
    confidence: np.ndarray | None = None  # (n,) probability of the likeliest outcome
    right: np.ndarray | None = None  # bool (n,), whether that outcome came true
    fell_off: np.ndarray | None = None  # (n,) probability of FELL_OFF


CONSTANT, COPY, NEIGHBOUR = "constant (mean training target)", "copy of the input", "nearest neighbour"
BELOW = "rests below its start"
BASELINES = (CONSTANT, COPY, NEIGHBOUR, BELOW)
CEILING, ONE_REROLL = "ceiling (mean of re-rolls)", "one re-roll"
CEILINGS = (CEILING, ONE_REROLL)


def outcome_of_pose(scenario: physics.Scenario, first: np.ndarray, last: np.ndarray) -> np.ndarray:
    """`scenario.outcome` of first and last poses `(n, 7)`, true or predicted."""
    return np.asarray(jax.vmap(scenario.outcome)(jnp.asarray(first), jnp.asarray(last)))


def shares(outcome: np.ndarray, outcomes: Sequence[enum.IntEnum]) -> np.ndarray:
    """Probabilities `(n, c)` of outcomes from samples of the outcome.

    One more sample is spread evenly over the outcomes, so that no probability is 0.

    Args:
        outcome: Outcome of each sample, int `(k, n)`.
        outcomes: `scenario.outcomes`, in the order of the columns.
    """
    counts = (outcome[..., None] == np.array([int(one) for one in outcomes])).sum(0)
    return (counts + 1 / len(outcomes)) / (len(outcome) + 1)


def frequency(outcome: np.ndarray, outcomes: Sequence[enum.IntEnum]) -> np.ndarray:
    """Frequency of each outcome `(c,)`, with one more item that is spread evenly, so that no frequency is 0.

    Args:
        outcome: Outcomes of training trajectories, int `(n,)`.
        outcomes: `scenario.outcomes`.
    """
    return shares(outcome[:, None], outcomes)[0]


def outcome_of_image(
    visual: np.ndarray, blank: np.ndarray, threshold: float, stays: int = int(physics.Outcome.RESTS)
) -> np.ndarray:
    """The outcome from an image: `FELL_OFF` if its distance from the empty image is at most a threshold, else `stays`.

    This decides only scenarios with one outcome of objects that stay on the pad. Outcomes that depend on how an object
    lies there are not read from images.
    """
    empty = emptiness(visual, blank) <= threshold
    return np.where(empty, int(physics.Outcome.FELL_OFF), stays)


def emptiness(visual: np.ndarray, blank: np.ndarray) -> np.ndarray:
    """Mean absolute difference `(n,)` of images `(n, height, width, 3)` in [0, 1] from the empty sensor's."""
    return np.abs(visual - blank).mean((1, 2, 3))


def baselines(scenario: physics.Scenario, train: Pairs, test: Pairs) -> dict[str, Predicted]:
    """Predictions without learning: the mean target, the input itself, the target of the nearest input, and a rule.

    The neighbour is the training item whose first visual image is nearest in squared distance. The squared distance of
    the condition, if there is one, has the same weight: both are divided by their variance in the training set, the
    condition number by number.

    The rule keeps x, y and the orientation of the start, at the median height of the training objects that stay on
    the pad. It predicts no images.
    """
    inputs = train.visual[:, 0].reshape(len(train.visual), -1).astype(np.float32)
    queries = test.visual[:, 0].reshape(len(test.visual), -1).astype(np.float32)
    distance = (inputs**2).sum(1) - 2 * queries @ inputs.T
    width = train.condition.shape[1]
    if width:
        variance = float(((inputs - inputs.mean(0)) ** 2).sum(1).mean())
        gap = test.condition[:, None] - train.condition[None]
        distance = distance / variance + (gap**2 / train.condition.var(0)).sum(-1) / width
    nearest = distance.argmin(1)
    num = len(test.visual)

    def repeat(mean: np.ndarray) -> np.ndarray:
        return np.broadcast_to(mean, (num, *mean.shape))

    mean_pose = train.pose[:, 1].mean(0)
    mean_pose[3:] /= max(np.linalg.norm(mean_pose[3:]), 1e-6)
    majority = np.bincount(train.outcome).argmax()
    frequency = np.array([np.mean(train.outcome == outcome) for outcome in scenario.outcomes])
    rests = train.outcome != int(physics.Outcome.FELL_OFF)
    below = test.pose[:, 0].copy()
    below[:, 2] = np.median(train.pose[rests if rests.any() else slice(None), 1, 2])
    return {
        CONSTANT: Predicted(
            repeat(train.visual[:, 1].mean(0) / 255),
            repeat(train.tactile[:, 1].mean(0) / 255),
            repeat(mean_pose),
            np.full(num, majority),
            outcome_probability=repeat(frequency),
        ),
        COPY: Predicted(
            test.visual[:, 0] / 255,
            test.tactile[:, 0] / 255,
            test.pose[:, 0],
            outcome_of_pose(scenario, test.pose[:, 0], test.pose[:, 0]),
        ),
        NEIGHBOUR: Predicted(
            train.visual[nearest, 1] / 255,
            train.tactile[nearest, 1] / 255,
            train.pose[nearest, 1],
            train.outcome[nearest],
        ),
        BELOW: Predicted(pose=below, outcome=outcome_of_pose(scenario, test.pose[:, 0], below)),
    }


def score(
    predicted: Predicted,
    test: Pairs,
    *,
    outcomes: Sequence[enum.IntEnum] = (),
    frequency: np.ndarray | None = None,
) -> Scores:
    """Errors per item of a prediction of the last moment.

    With `outcome_probability` and `frequency`, the outcome that is judged is the one with the largest ratio of
    probability to frequency. This decision has the best expected balanced accuracy, in which a rare outcome counts as
    much as a common one.

    Args:
        predicted: Prediction of all items, or of the first ones only.
        test: The held-out items.
        outcomes: `scenario.outcomes`, for predictions with `outcome_probability`.
        frequency: Frequency of each outcome among training trajectories, from `frequency`.

    Raises:
        ValueError: `outcome_probability` has another number of columns than `outcomes`.
    """
    leaves = (predicted.visual, predicted.tactile, predicted.pose, predicted.outcome, predicted.outcome_probability)
    count = next((len(leaf) for leaf in leaves if leaf is not None), len(test.object))
    test = Pairs(*(leaf[:count] for leaf in test))
    inside, truth = test.segmentation[:, 1], test.visual[:, 1] / 255

    def images(image: np.ndarray | None, target: np.ndarray, mask: np.ndarray | None) -> metrics.ImageError | None:
        return None if image is None else metrics.image_error(in_unit(image), target, mask)

    pose = predicted.pose
    scores = Scores(
        images(predicted.visual, truth, None),
        images(predicted.visual, truth, inside),
        images(predicted.tactile, test.tactile[:, 1] / 255, None),
        images(predicted.tactile, test.tactile[:, 1] / 255, inside),
        None if pose is None else metrics.position_error(pose, test.pose[:, 1]),
        None if pose is None else metrics.geodesic_angle(pose, test.pose[:, 1]),
        None if pose is None else metrics.axis_angle(pose, test.pose[:, 1]),
        predicted.outcome,
    )
    samples = predicted.samples or Predicted()
    place = test.pose[:, 1, :3]
    if samples.pose is not None:
        scores = scores._replace(
            energy=metrics.energy_score(samples.pose[..., :3], place),
            coverage=metrics.coverage(samples.pose[..., :3], place),
        )
    elif pose is not None:
        scores = scores._replace(energy=scores.position)
    if samples.visual is not None:
        scores = scores._replace(
            best=metrics.best_of([metrics.image_error(in_unit(image), truth) for image in samples.visual]),
            gradient=np.mean([metrics.gradient_energy(in_unit(image)) for image in samples.visual], axis=0),
        )
    elif predicted.visual is not None:
        scores = scores._replace(gradient=metrics.gradient_energy(in_unit(predicted.visual)))
    if predicted.visual is not None or samples.visual is not None:
        scores = scores._replace(gradient_target=metrics.gradient_energy(truth))
    if predicted.outcome_probability is not None:
        scores = _with_probability(scores, predicted.outcome_probability, test, outcomes, frequency)
    return scores


def in_unit(image: np.ndarray) -> np.ndarray:
    """Grey values in [0, 1] of an image of `uint8` or of floats in [0, 1]."""
    return image.astype(np.float32) / 255 if image.dtype == np.uint8 else image


def _with_probability(
    scores: Scores,
    probability: np.ndarray,
    test: Pairs,
    outcomes: Sequence[enum.IntEnum],
    frequency: np.ndarray | None,
) -> Scores:
    """Add the scores of the outcome probabilities."""
    if probability.shape != (len(test.outcome), len(outcomes)):
        raise ValueError(
            f"outcome_probability has shape {probability.shape}, expected {(len(test.outcome), len(outcomes))} (one "
            "column for each of `outcomes`): pass outcomes=scenario.outcomes"
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
        log_loss=metrics.log_loss(probability, label),
        confidence=probability.max(1),
        right=likeliest == test.outcome,
        fell_off=probability[:, fell_off],
    )
