"""Formulas of the metrics, for n items (held-out trajectories), and the bootstrap of their intervals.

Functions that average over items take weights of the items, `(n,)` (default: 1). The bootstrap varies these weights.

Predicted images are probabilities p, true images are grey values x, both in [0, 1]. The binary cross-entropy of a value
is `BCE(x, p) = -x log p - (1 - x) log(1 - p) = H(x) + KL(x || p)`, with the entropy H(x). The excess is KL(x || p). The
skill is `1 - excess / constant_excess`, where `constant_excess` is the excess of the mean training image.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

# Predicted probabilities are limited to half a grey level from 0 and 1, so that an 8-bit image has a finite BCE.
HALF_LEVEL = 1 / 510
FLOOR = 1e-3  # least probability of an outcome in the log loss, so that no single item dominates the mean
BINS = 10  # number of bins of equal width in [0, 1], for the calibration of outcome probabilities
LEVEL = 0.9  # probability of the region whose coverage is measured
_CHUNK = 8  # number of items whose images are compared at once: few, so that the arrays fit into the cache of a CPU
_CLOSE = 1e-6  # m, least distance in the weights of the geometric median, which keeps them finite


class ImageError(NamedTuple):
    """Errors of n predicted images, each a sum over the pixels and channels of an image or of a mask."""

    bce: np.ndarray  # (n,): binary cross-entropy (nats)
    excess: np.ndarray  # (n,): `bce` minus the entropy of the target (nats)
    pixels: np.ndarray  # (n,): number of summed pixels times the number of channels


def image_error(predicted: np.ndarray, target: np.ndarray, mask: np.ndarray | None = None) -> ImageError:
    """Errors of predicted images in [0, 1], `(n, height, width, 3)`, in the pixels of a bool mask (default: all)."""
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


def gradient_energy(images: np.ndarray) -> np.ndarray:
    """Sum of the squared differences of neighbouring pixels of images `(*n, height, width, 3)`, over all channels."""
    down, across = (np.diff(images, axis=axis) for axis in (-3, -2))
    return (down.astype(np.float64) ** 2).sum((-3, -2, -1)) + (across.astype(np.float64) ** 2).sum((-3, -2, -1))


def position_error(predicted: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Compute the distances (m) between the positions of poses `(n, 7)`."""
    return np.linalg.norm(predicted[:, :3] - target[:, :3], axis=-1)


def geodesic_angle(predicted: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Compute the angles (rad) between the orientations of poses `(n, 7)`."""
    dot = np.abs((predicted[:, 3:].astype(np.float64) * target[:, 3:]).sum(-1))
    return 2 * np.arccos(np.minimum(dot, 1))


def axis_angle(predicted: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Angles (rad) between the z axes of poses `(n, 7)`. Round objects look the same after rotations about it."""
    w, x, y, z = (np.stack([predicted, target])[..., i].astype(np.float64) for i in range(3, 7))
    up = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), w**2 - x**2 - y**2 + z**2], -1)
    return np.arctan2(np.linalg.norm(np.cross(up[0], up[1]), axis=-1), (up[0] * up[1]).sum(-1))


def energy_score(samples: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Compute the energy score `E|X - y| - E|X - X'| / 2` of samples X of a position with the true value y.

    The mean of |X - X'| is over the k (k - 1) pairs of different samples, so the expected score does not depend on k.
    The score of a single sample is its distance from the true position. Lower is better.

    Args:
        samples: k samples of n positions with d coordinates, `(k, n, d)`.
        target: True positions, `(n, d)`.

    Source: Gneiting and Raftery (2007), Strictly proper scoring rules, prediction, and estimation.
    """
    error = np.linalg.norm(samples - target, axis=-1).mean(0)
    number = len(samples)
    if number < 2:
        return error
    spread = np.linalg.norm(samples[:, None] - samples[None], axis=-1).sum((0, 1)) / (number * (number - 1))
    return error - spread / 2


def coverage(samples: np.ndarray, target: np.ndarray, level: float = LEVEL) -> np.ndarray:
    """Determine whether true positions lie in the central region of their samples, from 0 (outside) to 1 (inside).

    If the predictor is calibrated, the expected result is `level`, for every number of samples and every distribution:
    The true position and its k samples are sorted by their mean distance from the other points. Each rank r from 1 (the
    most central) to k + 1 is then equally likely for the true position, and the result is
    `level * (k + 1) - (r - 1)`, limited to [0, 1]. Points with equal mean distances get the mean of their results.

    Args:
        samples: k >= 1 samples of n positions with d coordinates, `(k, n, d)`.
        target: True positions, `(n, d)`.
        level: Probability of the central region.
    """
    points = np.concatenate([target[None], samples]).astype(np.float64)
    outlying = np.linalg.norm(points[:, None] - points[None], axis=-1).sum(1)  # (k + 1, n)
    # Equal sums may differ by rounding, because their terms are added in another order.
    tolerance = 1e-9 * outlying.max(0)
    inner = (outlying < outlying[0] - tolerance).sum(0)
    ties = (np.abs(outlying - outlying[0]) <= tolerance).sum(0)  # includes the target

    def counted(ranks: np.ndarray) -> np.ndarray:  # sum of the results of ranks 1 to `ranks`
        return np.minimum(ranks, level * len(points))

    return (counted(inner + ties) - counted(inner)) / ties


def centre(samples: np.ndarray, *, iterations: int = 100) -> np.ndarray:
    """Central poses `(n, 7)` of k samples `(k, n, 7)`.

    The position is the geometric median, by `iterations` of Weiszfeld's method. The orientation is that of the sample
    with the smallest mean angle to the other samples.
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
    """Negative logarithms of the probabilities `(n, c)` of the true outcomes, in the columns `label` (nats)."""
    return -np.log(np.maximum(probability[np.arange(len(label)), label], floor))


def mean(values: np.ndarray, weight: np.ndarray) -> float:
    """Compute the weighted mean, or NaN if the sum of the weights is 0."""
    return float((weight * values).sum() / weight.sum()) if weight.sum() > 0 else float("nan")


def ratio(values: np.ndarray, count: np.ndarray, weight: np.ndarray | None = None) -> float:
    """Compute the weighted sum of `values` divided by that of `count`, or NaN if the latter is 0."""
    w = np.ones(len(values)) if weight is None else weight
    total = float((w * count).sum())
    return float((w * values).sum()) / total if total > 0 else float("nan")


def skill(excess: np.ndarray, constant_excess: np.ndarray, weight: np.ndarray | None = None) -> float:
    """Compute `1 - excess / constant_excess`, each a weighted sum over items. NaN if the latter sum is 0."""
    return 1 - ratio(excess, constant_excess, weight)


def median(values: np.ndarray, weight: np.ndarray | None = None) -> float:
    """Compute the mean of the lower and the upper weighted median, or NaN if the sum of the weights is 0."""
    w = np.ones(len(values)) if weight is None else weight
    order = np.argsort(values, kind="stable")
    upto = np.cumsum(w[order])
    if not len(upto) or upto[-1] <= 0:
        return float("nan")
    low, high = (np.searchsorted(upto, upto[-1] / 2, side) for side in ("left", "right"))
    return float(values[order[low]] + values[order[min(high, len(order) - 1)]]) / 2


class Reliability(NamedTuple):
    """Data of a reliability diagram. The bins divide the items by the probability of their likeliest outcome."""

    confidence: np.ndarray  # (bins,): mean probability of the likeliest outcome, NaN in empty bins
    accuracy: np.ndarray  # (bins,): share of items whose likeliest outcome is the true one, NaN in empty bins
    items: np.ndarray  # (bins,): number of items, or sum of their weights


def reliability(
    confidence: np.ndarray, right: np.ndarray, weight: np.ndarray | None = None, *, bins: int = BINS
) -> Reliability:
    """Compute the data of a reliability diagram, with `bins` of equal width in [0, 1].

    Args:
        confidence: Probability of the likeliest outcome of each item, `(n,)`.
        right: True if the likeliest outcome is the true one, bool `(n,)`.
    """
    w = np.ones(len(right)) if weight is None else weight
    place = np.minimum((confidence * bins).astype(int), bins - 1)
    count, said, came = (np.bincount(place, w * x, bins) for x in (np.ones(len(w)), confidence, right))
    some = np.where(count > 0, count, np.nan)
    return Reliability(said / some, came / some, count)


def calibration_error(
    confidence: np.ndarray, right: np.ndarray, weight: np.ndarray | None = None, *, bins: int = BINS
) -> float:
    """Mean over items of |accuracy - confidence| of their bin in the diagram of `reliability`, NaN without weights.

    Source: Guo et al. (2017), On calibration of modern neural networks.
    """
    diagram = reliability(confidence, right, weight, bins=bins)
    total = float(diagram.items.sum())
    gap = np.nansum(diagram.items * np.abs(diagram.accuracy - diagram.confidence))
    return float(gap) / total if total > 0 else float("nan")


def auc(positive: np.ndarray, score: np.ndarray, weight: np.ndarray | None = None) -> float:
    """Area under the ROC curve: the probability that a positive item scores above a negative one (equal: half).

    NaN if no item with a weight is positive, or none is negative.
    """
    # scikit-learn's roc_auc_score gives the same value, but takes about thirty times as long. The bootstrap of the
    # intervals calls this function thousands of times.
    w = np.ones(len(score)) if weight is None else weight
    _, place = np.unique(score, return_inverse=True)
    above, below = (np.bincount(place, w * kind, place.max() + 1) for kind in (positive, ~positive))
    pairs = float(above.sum() * below.sum())
    return float((above * (np.cumsum(below) - below / 2)).sum()) / pairs if pairs > 0 else float("nan")


def balanced_accuracy(predicted: np.ndarray, target: np.ndarray, weight: np.ndarray | None = None) -> float:
    """Share of correctly predicted items in each class of `target`, averaged over the classes, NaN without weights."""
    w = np.ones(len(target)) if weight is None else weight
    shares = []
    for label in np.unique(target):
        here = w * (target == label)
        if here.sum() > 0:
            shares.append(float((here * (predicted == label)).sum() / here.sum()))
    return float(np.mean(shares)) if shares else float("nan")


def best_threshold(score: np.ndarray, positive: np.ndarray) -> float:
    """Find the threshold for which `score > threshold` predicts `positive` with the best balanced accuracy.

    The threshold is half the smallest score if all items are positive, and twice the largest if none is.
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
    """Compute a statistic for bootstrap samples, in which whole groups of items are drawn with replacement.

    The result is NaN if there is only one group, because one group does not show how much groups vary.

    Args:
        groups: Group of each item, such as its object, `(n,)`.
        statistic: Function of the weights of the items, `(n,)`: how often the group of each item was drawn.
    """
    rng = np.random.default_rng(seed)
    _, member = np.unique(groups, return_inverse=True)
    size = member.max() + 1
    # Few groups have few different samples, each of which is computed once.
    draws, of_sample = np.unique(rng.multinomial(size, np.full(size, 1 / size), size=num), axis=0, return_inverse=True)
    values = np.stack([statistic(draw[member].astype(np.float64)) for draw in draws])[of_sample.reshape(num)]
    return values if size > 1 else values * np.nan


def interval(draws: np.ndarray) -> tuple[float, float]:
    """Compute the 2.5 % and 97.5 % quantiles of bootstrap values, (n,). NaN is ignored, and NaN if all are NaN."""
    finite = draws[~np.isnan(draws)]
    low, high = np.percentile(finite, [2.5, 97.5]) if len(finite) else (np.nan, np.nan)
    return float(low), float(high)


def written(value: float, low: float | None, high: float | None, digits: int, factor: float = 1) -> str:
    """Write a value with its interval, each times `factor`: "0.50 [0.41, 0.58]", or "0.50 [-]" without an interval."""
    if low is None or high is None or not low <= high:
        return f"{factor * value:.{digits}f} [-]"
    return f"{factor * value:.{digits}f} [{factor * low:.{digits}f}, {factor * high:.{digits}f}]"


def _xlogx(x: np.ndarray) -> np.ndarray:
    return np.where(x > 0, x * np.log(np.where(x > 0, x, 1)), 0)
