"""Distances between real and simulated images: per pixel, in a feature space, and by a classifier.

Images are `uint8 (n, height, width, 3)`, one stream at a time. Each image belongs to a group, its trajectory. A group
that occurs on both sides shows the same object in the same poses, and the two sides are then called matched: image i of
one side belongs to image i of the other. Either all groups occur on both sides, or none does.
"""

from typing import NamedTuple

import cv2
import numpy as np

from sts_jax.evaluation import metrics

LEVELS = 3  # scales of the features, each with half the resolution of the one before
CELLS = 4  # of the features along each side of the image
LEAST_SIDE = 4 * CELLS * 2 ** (LEVELS - 1)  # pixels, so that a cell of the coarsest scale has 4 x 4
GREY_LEVEL = 1 / 255  # least scale of a feature, so that rounding does not count
PERMUTATIONS = 999
FOLDS = 5
REPEATS = 5  # cross-validations with other folds, which are averaged
PENALTY = 10.0  # of the classifier's squared weights, for features of unit variance


class Streams(NamedTuple):
    """Images of both streams and their groups."""

    visual: np.ndarray  # uint8 (n, height, width, 3)
    tactile: np.ndarray  # uint8 (n, height, width, 3)
    group: np.ndarray  # int (n,): trajectory of each image


class Estimate(NamedTuple):
    """A value with its 95 % interval over groups."""

    value: float
    low: float
    high: float


class PixelErrors(NamedTuple):
    """Differences of matched images. Values are those of 8-bit images, 0 to 255."""

    mae: Estimate  # mean absolute error
    rmse: Estimate  # root of the mean squared error
    psnr: Estimate  # dB, 20 log10(255 / rmse), infinite for equal images
    ssim: Estimate  # structural similarity (Wang et al. 2004) as OpenCV computes it, 1 for equal images


class Distance(NamedTuple):
    """A distance of two distributions with the p-value of the hypothesis that they are equal."""

    value: float
    p: float


def pixel_errors(real: np.ndarray, simulated: np.ndarray, group: np.ndarray) -> PixelErrors:
    """Differences of matched images, with intervals over groups (bootstrap).

    Args:
        real: `uint8 (n, height, width, 3)`.
        simulated: Same shape. Image i belongs to image i of `real`.
        group: `(n,)`.

    Raises:
        ValueError: The images are not uint8, or their shapes differ.
    """
    _check(real, simulated, group, group)
    if real.shape != simulated.shape:
        raise ValueError(f"matched images must have equal shapes, got real {real.shape}, simulated {simulated.shape}")
    each = np.array([_differences(a, b) for a, b in zip(real, simulated, strict=True)])

    def summary(weight: np.ndarray) -> np.ndarray:
        mae, mse, ssim = np.average(each, axis=0, weights=weight)
        rmse = np.sqrt(mse)
        with np.errstate(divide="ignore"):
            return np.array([mae, rmse, 20 * np.log10(255 / rmse), ssim])

    draws = metrics.bootstrap(group, summary)
    values = summary(np.ones(len(group)))
    return PixelErrors(*(_estimate(value, column) for value, column in zip(values, draws.T, strict=True)))


def features(images: np.ndarray) -> np.ndarray:
    """Colours and oriented gradients of images in a grid of 4 x 4 cells, without anything that was learned.

    Each cell has the mean of each colour, and at each of three scales the mean absolute difference of neighbours of the
    grey image in four directions: across, down, both diagonals. Brightness, vignetting and colour change the means.
    Noise, blur, edges and texture change the differences.

    Args:
        images: `uint8 (n, height, width, 3)`, at least `LEAST_SIDE` pixels high and wide.

    Returns:
        `(n, 240)`, grey values in [0, 1]: 48 colours, then 64 gradients of each scale from fine to coarse.

    Raises:
        ValueError: The images are not uint8 or too small.
    """
    if images.dtype != np.uint8 or images.ndim != 4 or images.shape[3] != 3:
        raise ValueError(f"images must be uint8 of shape (n, height, width, 3), got {images.dtype} of {images.shape}")
    if min(images.shape[1:3]) < LEAST_SIDE:
        raise ValueError(
            f"images must be at least {LEAST_SIDE} pixels high and wide, got {images.shape[1]} x {images.shape[2]}: "
            "give a larger resolution"
        )
    return np.stack([_described(image) for image in images])


def energy_distance(
    real: np.ndarray, simulated: np.ndarray, real_group: np.ndarray, simulated_group: np.ndarray, *, seed: int = 0
) -> Distance:
    """Normalised energy distance of two sets of features, 0 for equal distributions, 1 for sets that are far apart.

    `1 - (E|X - X'| + E|Y - Y'|) / (2 E|X - Y|)` with real features X, X' and simulated ones Y, Y'. Each feature is
    divided by its standard deviation over both sets, or by a grey level if that is larger. All three means are taken
    over pairs of images of different groups only. The estimate is therefore not biased by the number of images or by
    matched pairs, and for equal distributions it varies around 0, below 0 too.

    The p-value is that of a permutation test: matched groups swap their sides at random, other groups change them.

    Args:
        real: `(n, k)`, see `features`.
        simulated: `(m, k)`.
        real_group: `(n,)`.
        simulated_group: `(m,)`.
        seed: Of the permutations.

    Raises:
        ValueError: Some groups are matched and others not, a value is not finite, or a side has fewer than 2 groups.

    Source: Szekely and Rizzo (2013), Energy statistics: a class of statistics based on distances.
    """
    matched = _matched(real, simulated, real_group, simulated_group)
    both, group = np.concatenate([real, simulated]).astype(np.float64), np.r_[real_group, simulated_group]
    scaled = both / np.maximum(both.std(0), GREY_LEVEL)
    squares = (scaled**2).sum(1)
    apart = np.sqrt(np.maximum(squares[:, None] + squares - 2 * scaled @ scaled.T, 0))
    counted = (group[:, None] != group).astype(np.float64)
    apart *= counted

    def statistic(is_real: np.ndarray) -> float:
        sides = np.stack([is_real, ~is_real]).astype(np.float64)
        mean = (sides @ apart @ sides.T) / (sides @ counted @ sides.T)
        return float(1 - (mean[0, 0] + mean[1, 1]) / (2 * mean[0, 1])) if mean[0, 1] > 0 else 0.0

    names, member = np.unique(group, return_inverse=True)
    is_real = np.arange(len(group)) < len(real)
    first = np.zeros(len(names), bool)
    first[member[is_real]] = True
    value, rng = statistic(is_real), np.random.default_rng(seed)
    above = 0
    for _ in range(PERMUTATIONS):
        permuted = is_real ^ (rng.random(len(names)) < 0.5)[member] if matched else rng.permutation(first)[member]
        above += statistic(permuted) >= value - 1e-12
    return Distance(value, (1 + above) / (1 + PERMUTATIONS))


def told_apart(
    real: np.ndarray, simulated: np.ndarray, real_group: np.ndarray, simulated_group: np.ndarray
) -> Estimate:
    """Cross-validated accuracy of a classifier of real and simulated images. No group is in both fit and test.

    A logistic regression on standardised features, in five cross-validations of five folds. All images of a group are
    in the same fold, those of both sides if they are matched. The accuracy is the mean over both sides, so 0.5 is
    chance. The interval is that of the groups that were judged (bootstrap), not of those that the classifier was fitted
    to.

    Args:
        real: `(n, k)`, see `features`.
        simulated: `(m, k)`.
        real_group: `(n,)`.
        simulated_group: `(m,)`.

    Raises:
        ValueError: Some groups are matched and others not, a value is not finite, or a side has fewer than 5 groups.
        ImportError: scikit-learn is not installed.
    """
    try:
        from sklearn.linear_model import LogisticRegression
        from sklearn.model_selection import StratifiedGroupKFold
        from sklearn.pipeline import make_pipeline
        from sklearn.preprocessing import StandardScaler
        from threadpoolctl import threadpool_limits
    except ImportError as error:
        raise ImportError(
            "the classifier needs the package scikit-learn, which is not installed: pip install -e '.[bench]'"
        ) from error
    _matched(real, simulated, real_group, simulated_group, least=FOLDS)
    x, group = np.concatenate([real, simulated]), np.r_[real_group, simulated_group]
    is_real = np.arange(len(x)) < len(real)
    right = np.zeros(len(x))
    for repeat in range(REPEATS):
        folds = StratifiedGroupKFold(FOLDS, shuffle=True, random_state=repeat)
        for fitted, judged in folds.split(x, is_real, group):
            regression = LogisticRegression(C=1 / PENALTY, class_weight="balanced", max_iter=1000)
            model = make_pipeline(StandardScaler(), regression)
            with threadpool_limits(1):  # threads that wait for each other are slow on a busy machine
                model.fit(x[fitted], is_real[fitted])
            right[judged] += (model.predict(x[judged]) == is_real[judged]) / REPEATS

    def accuracy(weight: np.ndarray) -> np.ndarray:  # the mean over both sides
        sides = [weight * is_real, weight * ~is_real]
        shares = [(side * right).sum() / side.sum() if side.sum() else np.nan for side in sides]
        return np.asarray(np.mean(shares))

    return _estimate(float(accuracy(np.ones(len(x)))), metrics.bootstrap(group, accuracy))


def _differences(real: np.ndarray, simulated: np.ndarray) -> tuple[float, float, float]:
    """Mean absolute and mean squared difference, and structural similarity of two uint8 images."""
    difference = real.astype(np.float64) - simulated
    return (
        np.abs(difference).mean(),
        (difference**2).mean(),
        float(np.mean(cv2.quality.QualitySSIM_compute(real, simulated)[0][:3])),  # type: ignore[attr-defined]
    )


def _described(image: np.ndarray) -> np.ndarray:
    """The features of one uint8 image."""
    values = image.astype(np.float32) / 255
    parts, grey = [_cells(values).ravel()], values.mean(-1)
    for level in range(LEVELS):
        if level:
            grey = cv2.resize(grey, (grey.shape[1] // 2, grey.shape[0] // 2), interpolation=cv2.INTER_AREA)
        here = grey[:-1, :-1]
        steps = [grey[:-1, 1:] - here, grey[1:, :-1] - here, grey[1:, 1:] - here, grey[1:, :-1] - grey[:-1, 1:]]
        parts.append(_cells(np.abs(np.stack(steps, -1))).ravel())
    return np.concatenate(parts)


def _cells(values: np.ndarray) -> np.ndarray:
    """Means of the grid's cells."""
    return cv2.resize(values, (CELLS, CELLS), interpolation=cv2.INTER_AREA)


def _check(real: np.ndarray, simulated: np.ndarray, real_group: np.ndarray, simulated_group: np.ndarray) -> None:
    for name, images, group in (("real", real, real_group), ("simulated", simulated, simulated_group)):
        if images.dtype != np.uint8 or images.ndim != 4 or images.shape[3] != 3 or not len(images):
            raise ValueError(
                f"{name} must be uint8 of shape (n, height, width, 3) with n >= 1, got {images.dtype} of {images.shape}"
            )
        if group.shape != images.shape[:1]:
            raise ValueError(f"group must name the trajectory of each of the {len(images)} images, got {group.shape}")


def _matched(
    real: np.ndarray, simulated: np.ndarray, real_group: np.ndarray, simulated_group: np.ndarray, *, least: int = 2
) -> bool:
    """Whether the groups are matched. Raises an error for invalid features and groups."""
    for name, values, group in (("real", real, real_group), ("simulated", simulated, simulated_group)):
        if values.ndim != 2 or group.shape != values.shape[:1]:
            raise ValueError(
                f"{name} must have the shape (n, k) and its groups (n,), got {values.shape}, {group.shape}"
            )
        if not np.isfinite(values).all():
            raise ValueError(f"{name} must be finite, got {values[~np.isfinite(values)][0]}")
        if (number := len(np.unique(group))) < least:
            raise ValueError(f"{name} must have images of at least {least} trajectories, got {number}: collect more")
    common = np.intersect1d(real_group, simulated_group)
    if not len(common):
        return False
    if set(common) != set(np.r_[real_group, simulated_group]) or len(real) != len(simulated):
        raise ValueError(
            f"{len(common)} trajectories occur on both sides and others do not: keep those on both sides, or give "
            "all of one side other numbers"
        )
    return True


def _estimate(value: float, draws: np.ndarray) -> Estimate:
    with np.errstate(invalid="ignore"):
        return Estimate(float(value), *metrics.interval(draws))
