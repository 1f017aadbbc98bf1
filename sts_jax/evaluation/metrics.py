"""Metrics of predictions, per item, so that items can be grouped in any way.

Predicted images are probabilities in [0, 1]. Targets are grey values, so that the binary cross-entropy is at least the
entropy of the target: `BCE(x, p) = H(x) + KL(x || p)`. The excess is the KL term, which a better prediction can reduce.
The skill is one minus the ratio of the excess to that of the mean training image.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

# Predicted probabilities are kept at least half a grey level from 0 and 1, so that stored images can be predictions.
HALF_LEVEL = 1 / 510
FLOOR = 1e-3  # outcome probabilities below this count as this in the log loss
BINS = 10  # of equal width in [0, 1], for the calibration of outcome probabilities
LEVEL = 0.9  # probability of the region whose coverage is measured
_CHUNK = 128  # items whose images are compared at once, which bounds the memory
_CLOSE = 1e-6  # m, the distance below which the geometric median's weights no longer grow


class ImageError(NamedTuple):
    """Cross-entropy and excess of predicted images, summed over the pixels that count."""

    bce: np.ndarray  # (n,) nats, summed over pixels and channels
    excess: np.ndarray  # (n,) nats, bce less the entropy of the target
    pixels: np.ndarray  # (n,) number of pixels times channels


def image_error(predicted: np.ndarray, target: np.ndarray, mask: np.ndarray | None = None) -> ImageError:
    """Binary cross-entropy of predicted images and its excess over the targets' entropy.

    Args:
        predicted: Probabilities `(n, height, width, 3)`.
        target: Grey values in [0, 1], same shape.
        mask: Which pixels count, bool `(n, height, width)` (default: all).
    """
    if len(target) > _CHUNK:
        cuts = [slice(start, start + _CHUNK) for start in range(0, len(target), _CHUNK)]
        parts = [image_error(predicted[c], target[c], None if mask is None else mask[c]) for c in cuts]
        return ImageError(*(np.concatenate(leaves) for leaves in zip(*parts, strict=True)))
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
    """Mean per pixel of an error that is summed over the pixels that count."""
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
    """Angle between the up axes of two orientations, radians `(n,)` in [0, pi].

    A turn about the axis itself does not count. It is invisible for round objects.
    """
    w, x, y, z = (np.stack([predicted, target])[..., i].astype(np.float64) for i in range(3, 7))
    up = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), w**2 - x**2 - y**2 + z**2], -1)
    return np.arctan2(np.linalg.norm(np.cross(up[0], up[1]), axis=-1), (up[0] * up[1]).sum(-1))


def best_of(errors: Sequence[ImageError]) -> ImageError:
    """The error of each item's best sample: the one with the smallest excess.

    Args:
        errors: One per sample.
    """
    excess = np.stack([error.excess for error in errors])
    best, item = excess.argmin(0), np.arange(excess.shape[1])
    return ImageError(*(np.stack(leaves)[best, item] for leaves in zip(*errors, strict=True)))


def gradient_energy(images: np.ndarray) -> np.ndarray:
    """Sum of the squared differences of neighbouring pixels along both axes, `(*n,)`.

    Args:
        images: Grey values in [0, 1], `(*n, height, width, 3)`.
    """
    down, across = (np.diff(images, axis=axis) for axis in (-3, -2))
    return (down.astype(np.float64) ** 2).sum((-3, -2, -1)) + (across.astype(np.float64) ** 2).sum((-3, -2, -1))


def energy_score(samples: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Energy score of samples of a position, `E|X - y| - E|X - X'| / 2`, in the unit of the positions, `(n,)`.

    The second mean is taken over the k (k - 1) pairs of different samples, so that the expectation does not depend on
    k. The score of one sample is its distance, so that a deterministic prediction scores its absolute error.

    Args:
        samples: `(k, n, d)`.
        target: `(n, d)`.

    Source: Gneiting and Raftery (2007), Strictly proper scoring rules, prediction, and estimation.
    """
    error = np.linalg.norm(samples - target, axis=-1).mean(0)
    number = len(samples)
    if number < 2:
        return error
    spread = np.linalg.norm(samples[:, None] - samples[None], axis=-1).sum((0, 1)) / (number * (number - 1))
    return error - spread / 2


def coverage(samples: np.ndarray, target: np.ndarray, level: float = LEVEL) -> np.ndarray:
    """Whether the target lies in the central region of some samples, `(n,)`. The mean over items is the coverage.

    The target and the k samples are ranked by their mean distance from each other. The region leaves out the
    outermost points. For a calibrated predictor the target is a draw like the samples, whatever their distribution, so
    that its rank is one of 1 to k + 1 with equal probability. A rank r counts `level (k + 1) - (r - 1)`, limited to
    [0, 1], so that the mean is `level` for every k. Points of equal distance share the mean of their counts.

    Args:
        samples: `(k, n, d)`, k >= 1.
        target: `(n, d)`.
        level: Probability of the region.
    """
    points = np.concatenate([target[None], samples]).astype(np.float64)
    outlying = np.linalg.norm(points[:, None] - points[None], axis=-1).sum(1)  # (k + 1, n)
    # Sums of the same distances differ by rounding.
    tolerance = 1e-9 * outlying.max(0)
    inner = (outlying < outlying[0] - tolerance).sum(0)
    ties = (np.abs(outlying - outlying[0]) <= tolerance).sum(0)  # the target included

    def counted(ranks: np.ndarray) -> np.ndarray:  # sum of the counts of ranks 1 to `ranks`
        return np.minimum(ranks, level * len(points))

    return (counted(inner + ties) - counted(inner)) / ties


def centre(samples: np.ndarray, *, iterations: int = 100) -> np.ndarray:
    """The central pose of some samples.

    Its position has the smallest mean distance from the samples (geometric median). Its orientation is that of the
    sample with the smallest mean angle to the others.

    Args:
        samples: `(k, n, 7)`, unit quaternions.
        iterations: Iterations of Weiszfeld's method.

    Returns:
        `(n, 7)`.
    """
    place = samples[..., :3].astype(np.float64)
    middle = place.mean(0)
    for _ in range(iterations):
        weight = 1 / np.maximum(np.linalg.norm(place - middle, axis=-1, keepdims=True), _CLOSE)
        middle = (weight * place).sum(0) / weight.sum(0)
    quat = samples[..., 3:].astype(np.float64)
    angle = np.arccos(np.minimum(np.abs((quat[:, None] * quat[None]).sum(-1)), 1)).sum(1)
    chosen = quat[angle.argmin(0), np.arange(quat.shape[1])]
    return np.concatenate([middle, chosen], -1).astype(samples.dtype)


def log_loss(probability: np.ndarray, label: np.ndarray, floor: float = FLOOR) -> np.ndarray:
    """Minus the logarithm of the true outcome's probability, nats `(n,)`.

    Args:
        probability: `(n, c)`.
        label: The column of the true outcome, int `(n,)`.
        floor: Smaller probabilities count as this, so that no single item decides the mean.
    """
    return -np.log(np.maximum(probability[np.arange(len(label)), label], floor))


class Reliability(NamedTuple):
    """Frequency of outcomes that were predicted with similar confidence, in bins."""

    confidence: np.ndarray  # (bins,) mean probability of the likeliest outcome, nan in empty bins
    accuracy: np.ndarray  # (bins,) share of the items in which that outcome came true
    items: np.ndarray  # (bins,) number of items, weighted


def reliability(
    confidence: np.ndarray, right: np.ndarray, weight: np.ndarray | None = None, *, bins: int = BINS
) -> Reliability:
    """How often the likeliest outcome came true, against its probability.

    Args:
        confidence: Probability of the likeliest outcome, `(n,)`.
        right: Whether it came true, bool `(n,)`.
        weight: Weights of the items, `(n,)` (default: 1).
        bins: Number of bins of equal width in [0, 1].
    """
    w = np.ones(len(right)) if weight is None else weight
    place = np.minimum((confidence * bins).astype(int), bins - 1)
    count, said, came = (np.bincount(place, w * x, bins) for x in (np.ones(len(w)), confidence, right))
    some = np.where(count > 0, count, np.nan)
    return Reliability(said / some, came / some, count)


def calibration_error(
    confidence: np.ndarray, right: np.ndarray, weight: np.ndarray | None = None, *, bins: int = BINS
) -> float:
    """Expected calibration error: the mean over items of |accuracy - confidence| of their bins.

    The arguments are those of `reliability`.

    Source: Guo et al. (2017), On calibration of modern neural networks.
    """
    found = reliability(confidence, right, weight, bins=bins)
    total = float(found.items.sum())
    gap = np.nansum(found.items * np.abs(found.accuracy - found.confidence))
    return float(gap) / total if total > 0 else float("nan")


def auc(positive: np.ndarray, score: np.ndarray, weight: np.ndarray | None = None) -> float:
    """Area under the ROC curve: the probability that a positive item scores above a negative one. Ties count half.

    Args:
        positive: bool `(n,)`.
        score: `(n,)`.
        weight: Weights of the items, `(n,)` (default: 1).
    """
    w = np.ones(len(score)) if weight is None else weight
    _, place = np.unique(score, return_inverse=True)
    above, below = (np.bincount(place, w * kind, place.max() + 1) for kind in (positive, ~positive))
    pairs = float(above.sum() * below.sum())
    return float((above * (np.cumsum(below) - below / 2)).sum()) / pairs if pairs > 0 else float("nan")


def median(values: np.ndarray, weight: np.ndarray | None = None) -> float:
    """The weighted median, which is the mean of the lower and the upper median, or nan if there is no weight."""
    w = np.ones(len(values)) if weight is None else weight
    order = np.argsort(values, kind="stable")
    upto = np.cumsum(w[order])
    if not len(upto) or upto[-1] <= 0:
        return float("nan")
    low, high = (np.searchsorted(upto, upto[-1] / 2, side) for side in ("left", "right"))
    return float(values[order[low]] + values[order[min(high, len(order) - 1)]]) / 2


def balanced_accuracy(predicted: np.ndarray, target: np.ndarray, weight: np.ndarray | None = None) -> float:
    """Mean over the classes that occur of the share of their items that are predicted correctly."""
    w = np.ones(len(target)) if weight is None else weight
    shares = []
    for label in np.unique(target):
        here = w * (target == label)
        if here.sum() > 0:
            shares.append(float((here * (predicted == label)).sum() / here.sum()))
    return float(np.mean(shares)) if shares else float("nan")


def best_threshold(score: np.ndarray, positive: np.ndarray) -> float:
    """The threshold above which a score predicts `positive` with the best balanced accuracy.

    If only one class occurs, the threshold is half the smallest score (all are positive) or twice the largest score
    (none is positive).
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
        num: Number of draws.
        seed: Seed of the draws.

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
