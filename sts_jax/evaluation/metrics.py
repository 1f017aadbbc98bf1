"""Numbers that say how good a prediction is, each per item so that any grouping can follow.

Images are probabilities in [0, 1]; targets are grey values, so their binary cross-entropy has a floor, the entropy
of the target itself: `BCE(x, p) = H(x) + KL(x || p)`. The excess is the KL term, what a prediction could do better;
the skill is one minus its ratio to the excess of the mean training image.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

# Predicted probabilities are kept this far from 0 and 1: half a grey level, so that stored images can be predictions.
HALF_LEVEL = 1 / 510


class ImageError(NamedTuple):
    """Cross-entropy and excess of predicted images, summed over the pixels that count."""

    bce: np.ndarray  # (n,) nats, summed over pixels and channels
    excess: np.ndarray  # (n,)
    pixels: np.ndarray  # (n,) how many pixels times channels


def image_error(predicted: np.ndarray, target: np.ndarray, mask: np.ndarray | None = None) -> ImageError:
    """Binary cross-entropy of predicted images and its excess over the targets' entropy.

    Args:
        predicted: Probabilities `(n, height, width, 3)`.
        target: Grey values in [0, 1], same shape.
        mask: Which pixels count, bool `(n, height, width)`; all where not given.
    """
    p = np.clip(predicted.astype(np.float64), HALF_LEVEL, 1 - HALF_LEVEL)
    x = target.astype(np.float64)
    weight = np.ones(x.shape[:3]) if mask is None else mask.astype(np.float64)
    bce = -(x * np.log(p) + (1 - x) * np.log1p(-p))
    entropy = -(_xlogx(x) + _xlogx(1 - x))
    total, excess = ((values.sum(-1) * weight).sum((1, 2)) for values in (bce, bce - entropy))
    return ImageError(total, excess, 3 * weight.sum((1, 2)))


def skill(error: ImageError, constant: ImageError, weight: np.ndarray | None = None) -> float:
    """`1 - excess / excess of the constant prediction`, over all items with their weights."""
    w = np.ones(len(error.excess)) if weight is None else weight
    reference = float((w * constant.excess).sum())
    return 1 - float((w * error.excess).sum()) / reference if reference > 0 else float("nan")


def mean_per_pixel(values: np.ndarray, count: np.ndarray, weight: np.ndarray | None = None) -> float:
    """Mean of a summed error over the pixels that count."""
    w = np.ones(len(values)) if weight is None else weight
    total = float((w * count).sum())
    return float((w * values).sum()) / total if total > 0 else float("nan")


def position_error(predicted: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Distance of positions, metres `(n,)`, from poses `(n, 7)`."""
    return np.linalg.norm(predicted[:, :3] - target[:, :3], axis=-1)


def geodesic_angle(predicted: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Angle between orientations, radians `(n,)` in [0, pi], from poses `(n, 7)` with unit quaternions."""
    dot = np.abs((predicted[:, 3:].astype(np.float64) * target[:, 3:]).sum(-1))
    return 2 * np.arccos(np.minimum(dot, 1))


def axis_angle(predicted: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Angle between the objects' up axes, radians `(n,)` in [0, pi]: a turn about the own axis, unseen of round things,
    does not count.
    """
    w, x, y, z = (np.stack([predicted, target])[..., i].astype(np.float64) for i in range(3, 7))
    up = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), w**2 - x**2 - y**2 + z**2], -1)
    return np.arctan2(np.linalg.norm(np.cross(up[0], up[1]), axis=-1), (up[0] * up[1]).sum(-1))


def balanced_accuracy(predicted: np.ndarray, target: np.ndarray, weight: np.ndarray | None = None) -> float:
    """Mean over the classes that occur of the share of each that is predicted rightly."""
    w = np.ones(len(target)) if weight is None else weight
    shares = []
    for label in np.unique(target):
        here = w * (target == label)
        if here.sum() > 0:
            shares.append(float((here * (predicted == label)).sum() / here.sum()))
    return float(np.mean(shares)) if shares else float("nan")


def best_threshold(score: np.ndarray, positive: np.ndarray) -> float:
    """The threshold on a score above which `positive` is said with the best balanced accuracy.

    Without both classes in sight nothing can be chosen: then halfway between 0 and the smallest positive score, or
    above all scores if there is none.
    """
    if positive.all():
        return float(score.min()) / 2
    if not positive.any():
        return float(score.max()) * 2
    values = np.sort(score)
    candidates = np.concatenate([[values[0] - 1e-6], (values[1:] + values[:-1]) / 2])
    scores = [balanced_accuracy(score > threshold, positive) for threshold in candidates]
    return float(candidates[int(np.argmax(scores))])


def bootstrap(
    groups: np.ndarray, statistic: Callable[[np.ndarray], np.ndarray], *, num: int = 2000, seed: int = 0
) -> np.ndarray:
    """Distribution of a statistic when whole groups (objects) are drawn with replacement.

    Args:
        groups: The group of each item, `(n,)`.
        statistic: Maps item weights `(n,)` to a value or array of values.
        num: How many draws.
        seed: Of the draws.

    Returns:
        `(num, ...)` values.
    """
    rng = np.random.default_rng(seed)
    _, member = np.unique(groups, return_inverse=True)
    size = member.max() + 1
    draws = rng.multinomial(size, np.full(size, 1 / size), size=num)
    return np.stack([statistic(draw[member].astype(np.float64)) for draw in draws])


def interval(draws: np.ndarray) -> tuple[float, float]:
    """The central 95 % of bootstrap draws, ignoring draws in which the statistic is undefined."""
    low, high = np.nanpercentile(draws, [2.5, 97.5])
    return float(low), float(high)


def _xlogx(x: np.ndarray) -> np.ndarray:
    return np.where(x > 0, x * np.log(np.where(x > 0, x, 1)), 0)
