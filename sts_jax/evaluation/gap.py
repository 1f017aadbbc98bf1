"""Distances between real and simulated images: per pixel, in a feature space, and by a classifier.

All images of a comparison are visual images, or all are tactile images, uint8 `(n, height, width, 3)`. Each has a group
number, which is the number of its trajectory. The two sets either have no group in common, or they are matched: both
contain the same groups, and image i of both sets shows the same object in the same pose.
"""

import importlib.util
from typing import NamedTuple

import cv2
import numpy as np

from sts_jax.evaluation.metrics import bootstrap, interval

LEVELS = 3  # number of scales of the features, each with half the resolution of the previous one
CELLS = 4  # number of cells of the features along each side of the image
LEAST_SIDE = 4 * CELLS * 2 ** (LEVELS - 1)  # pixels, side for which a cell of the coarsest scale has 4 x 4 pixels
GREY_LEVEL = 1 / 255  # least standard deviation by which a feature is divided, so that rounding has no large effect
PERMUTATIONS = 999  # number of permutations of the permutation test
FOLDS = 5  # number of folds of a cross-validation
REPEATS = 5  # number of cross-validations with different folds, whose accuracies are averaged
PENALTY = 10.0  # weight of the classifier's L2 regularisation, for features of unit variance


class Streams(NamedTuple):
    """n pairs of a visual and a tactile image, and the number of the trajectory of each pair."""

    visual: np.ndarray  # uint8 (n, height, width, 3)
    tactile: np.ndarray  # uint8 (n, height, width, 3)
    group: np.ndarray  # int (n,): number of the trajectory of each pair


class Estimate(NamedTuple):
    """A value with its 95 % interval, from a bootstrap that draws whole trajectories."""

    value: float
    low: float
    high: float


class PixelErrors(NamedTuple):
    """Differences between real and simulated images of matched sets."""

    mae: Estimate  # mean absolute error, in grey levels of 8-bit images (0 to 255)
    rmse: Estimate  # root of the mean squared error, in grey levels of 8-bit images (0 to 255)
    psnr: Estimate  # dB, 20 log10(255 / rmse), infinite for equal images
    ssim: Estimate  # structural similarity (Wang et al. 2004) as OpenCV computes it, 1 for equal images


class Distance(NamedTuple):
    """The distance between the distributions of real and of simulated images, with its statistical significance."""

    value: float
    p: float  # p-value of the hypothesis that both distributions are equal


def pixel_errors(real: np.ndarray, simulated: np.ndarray, group: np.ndarray) -> PixelErrors:
    """Compute the MAE, RMSE, PSNR and SSIM between images of matched sets. `group` has the trajectory of each image."""
    for name, images in (("real", real), ("simulated", simulated)):
        if images.dtype != np.uint8:
            raise ValueError(f"{name} must be uint8, got {images.dtype}")
    if real.shape != simulated.shape:
        raise ValueError(f"real and simulated must have equal shapes, got {real.shape} and {simulated.shape}")
    each = np.array([_differences(a, b) for a, b in zip(real, simulated, strict=True)])

    def summary(weight: np.ndarray) -> np.ndarray:
        mae, mse, ssim = np.average(each, axis=0, weights=weight)
        rmse = np.sqrt(mse)
        with np.errstate(divide="ignore"):
            return np.array([mae, rmse, 20 * np.log10(255 / rmse), ssim])

    draws = bootstrap(group, summary)
    values = summary(np.ones(len(group)))
    return PixelErrors(*(_estimate(value, column) for value, column in zip(values, draws.T, strict=True)))


def features(images: np.ndarray) -> np.ndarray:
    """Compute colours and oriented gradients in the cells of a 4 x 4 grid on each image, without a neural network.

    The colours are the means of the three channels in a cell. The gradients are the mean absolute differences of
    neighbouring pixels of the grey image, in four directions (horizontal, vertical and both diagonals) and at three
    scales. Brightness, vignetting and tint affect the colours. Noise, blur, edges and texture affect the gradients.

    Returns:
        Features in [0, 1], `(n, 240)`: 48 colours (16 cells, 3 channels), then the gradients (16 cells, 4 directions)
        from the finest to the coarsest scale.
    """
    if images.dtype != np.uint8:
        raise ValueError(f"images must be uint8, got {images.dtype}")
    if min(images.shape[1:3]) < LEAST_SIDE:
        raise ValueError(f"images must be at least {LEAST_SIDE} pixels high and wide, got {images.shape[1:3]}")
    return np.stack([_described(image) for image in images])


def energy_distance(
    real: np.ndarray, simulated: np.ndarray, real_group: np.ndarray, simulated_group: np.ndarray, *, seed: int = 0
) -> Distance:
    """Compute the normalised energy distance of two sets of features, and test whether their distributions differ.

    The distance is `1 - (E|X - X'| + E|Y - Y'|) / (2 E|X - Y|)`. X and X' are the features of two real images, and Y
    and Y' are those of two simulated images. E is the mean over pairs of images of different trajectories, so the
    estimate has no bias: for equal distributions, it varies around 0 and may be negative. It is 1 for sets that are far
    apart. Each feature is first divided by its standard deviation over both sets, or by one grey level (1/255) if the
    deviation is smaller.

    A permutation of the test exchanges the real and the simulated images of random trajectories in matched sets. In
    other sets, it distributes the trajectories to the two sets at random.

    Args:
        real: Features of the real images, from `features`, `(n, k)`.
        real_group: Number of the trajectory of each real image, int `(n,)`.

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


def check_installed() -> None:
    """Raise an ImportError with the remedy if a package of `told_apart` is missing."""
    if not all(map(importlib.util.find_spec, ("sklearn", "threadpoolctl"))):
        raise ImportError("the classifier needs two packages: pip install scikit-learn threadpoolctl")


def told_apart(
    real: np.ndarray, simulated: np.ndarray, real_group: np.ndarray, simulated_group: np.ndarray
) -> Estimate:
    """Compute the cross-validated accuracy of a classifier that distinguishes real from simulated images.

    The classifier is a logistic regression on standardised features, in five cross-validations of five folds. All
    images of a trajectory are in the same fold. The accuracy is the mean of the accuracies for real and for simulated
    images, so 0.5 is chance. The bootstrap of its interval does not fit the classifier again, so the interval does not
    include the variation between training sets.

    The arguments are those of `energy_distance`.
    """
    check_installed()
    from sklearn.linear_model import LogisticRegression
    from sklearn.model_selection import StratifiedGroupKFold
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler
    from threadpoolctl import threadpool_limits

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

    return _estimate(float(accuracy(np.ones(len(x)))), bootstrap(group, accuracy))


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
    """Mean of each cell of the grid of CELLS x CELLS cells."""
    return cv2.resize(values, (CELLS, CELLS), interpolation=cv2.INTER_AREA)


def _matched(
    real: np.ndarray, simulated: np.ndarray, real_group: np.ndarray, simulated_group: np.ndarray, *, least: int = 2
) -> bool:
    """Return whether the two sets are matched, or raise an error for invalid features and groups."""
    for name, values, group in (("real", real, real_group), ("simulated", simulated, simulated_group)):
        if not np.isfinite(values).all():
            raise ValueError(f"{name} must be finite, got {values[~np.isfinite(values)][0]}")
        if (number := len(np.unique(group))) < least:
            raise ValueError(
                f"{name} must have images of at least {least} trajectories, got {number}: collect more trajectories"
            )
    common = np.intersect1d(real_group, simulated_group)
    if not len(common):
        return False
    if set(common) != set(np.r_[real_group, simulated_group]) or len(real) != len(simulated):
        raise ValueError(
            "the real and the simulated images must have no common trajectory, or the same trajectories and as many "
            f"images, got {len(common)} common trajectories, {len(real)} real and {len(simulated)} simulated images"
        )
    return True


def _estimate(value: float, draws: np.ndarray) -> Estimate:
    with np.errstate(invalid="ignore"):
        return Estimate(float(value), *interval(draws))
