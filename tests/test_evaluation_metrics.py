"""Metrics against sums written out by hand."""

import math

import numpy as np
import pytest
import sklearn.metrics
from scipy import stats

from sts_jax.evaluation import metrics


def test_excess_is_the_divergence_summed_pixel_by_pixel():
    rng = np.random.default_rng(0)
    predicted, target = rng.random((10, 5, 4, 3)), rng.random((10, 5, 4, 3))  # more than one chunk
    mask = rng.random((10, 5, 4)) < 0.5
    error = metrics.image_error(predicted, target, mask)
    for i in range(10):
        bce = excess = count = 0.0
        for row in range(5):
            for column in range(4):
                if not mask[i, row, column]:
                    continue
                for channel in range(3):
                    x = target[i, row, column, channel]
                    p = min(max(predicted[i, row, column, channel], 1 / 510), 1 - 1 / 510)
                    bce -= x * math.log(p) + (1 - x) * math.log(1 - p)
                    excess += x * math.log(x / p) + (1 - x) * math.log((1 - x) / (1 - p))
                    count += 1
        assert error.bce[i] == pytest.approx(bce, rel=1e-9)
        assert error.excess[i] == pytest.approx(excess, rel=1e-9)
        assert error.pixels[i] == count


def test_the_angle_ignores_the_sign_of_a_quaternion_and_the_axis_angle_a_turn_about_the_axis():
    half = math.pi / 6
    pose = np.zeros((3, 7))
    pose[:, 3] = 1
    turned = pose.copy()
    turned[0, 3:] = [math.cos(half), 0, 0, math.sin(half)]
    turned[1, 3:] = [math.cos(half), math.sin(half), 0, 0]
    turned[2, 3:] = [0, math.sqrt(0.5), math.sqrt(0.5), 0]
    np.testing.assert_allclose(metrics.axis_angle(turned, pose), [0, math.pi / 3, math.pi], atol=1e-7)
    np.testing.assert_allclose(metrics.geodesic_angle(turned, -pose), [math.pi / 3, math.pi / 3, math.pi], atol=1e-7)
    np.testing.assert_allclose(metrics.axis_angle(turned[:1], turned[1:2]), [math.pi / 3], atol=1e-7)


def test_balanced_accuracy_weighs_classes_alike():
    target = np.array([0] * 9 + [1])
    assert metrics.balanced_accuracy(np.zeros(10), target) == pytest.approx(0.5)
    assert metrics.balanced_accuracy(target, target) == 1
    assert metrics.balanced_accuracy(np.array([0] * 8 + [1, 1]), target) == pytest.approx((8 / 9 + 1) / 2)


def test_the_threshold_separates_separable_scores():
    score = np.array([0.01, 0.02, 0.4, 0.5])
    threshold = metrics.best_threshold(score, score > 0.1)
    assert 0.02 < threshold < 0.4
    assert metrics.best_threshold(score, np.ones(4, bool)) < 0.01
    assert metrics.best_threshold(score, np.zeros(4, bool)) > 0.5


def test_bootstrap_over_objects_has_the_standard_error_of_the_mean_over_objects():
    rng = np.random.default_rng(2)
    level = rng.normal(size=50)
    groups = np.repeat(np.arange(50), 4)
    values = level[groups] + 0.01 * rng.normal(size=200)
    draws = metrics.bootstrap(groups, lambda w: np.sum(w * values) / np.sum(w), num=4000)
    assert np.std(draws) == pytest.approx(np.std(level) / math.sqrt(50), rel=0.1)
    low, high = metrics.interval(draws)
    assert low < values.mean() < high


def test_gradient_energy_is_the_sum_over_neighbours():
    image = np.random.default_rng(4).random((2, 3, 4, 3))
    for i in range(2):
        total = 0.0
        for row in range(3):
            for column in range(4):
                if row:
                    total += ((image[i, row, column] - image[i, row - 1, column]) ** 2).sum()
                if column:
                    total += ((image[i, row, column] - image[i, row, column - 1]) ** 2).sum()
        assert metrics.gradient_energy(image)[i] == pytest.approx(total)


@pytest.mark.parametrize("offset", [0.0, 0.7, 3.0])
@pytest.mark.parametrize("number", [2, 16])
def test_the_energy_score_of_gaussian_samples_is_unbiased(offset, number):
    # The closed form in one dimension is the continuous ranked probability score of a standard Gaussian.
    rng = np.random.default_rng(5)
    items = 40_000
    found = metrics.energy_score(rng.normal(size=(number, items, 1)), np.full((items, 1), offset))
    density = math.exp(-(offset**2) / 2) / math.sqrt(2 * math.pi)
    closed = offset * math.erf(offset / math.sqrt(2)) + 2 * density - 1 / math.sqrt(math.pi)
    assert found.mean() == pytest.approx(closed, abs=5 * found.std() / math.sqrt(items))


def draws(kind, rng, shape):
    """Positions from distributions that a covariance does not describe."""
    if kind == "gaussian":
        return rng.normal(size=(*shape, 3)) * [1, 5, 0.2]
    if kind == "skewed":
        return rng.exponential(size=(*shape, 3)) ** 2
    side = rng.random(shape) < 0.3
    return rng.normal(size=(*shape, 3)) + 20 * side[..., None]


@pytest.mark.parametrize("number", [2, 5, 16])
@pytest.mark.parametrize("kind", ["gaussian", "skewed", "bimodal"])
def test_calibrated_samples_cover_exactly_nine_tenths(kind, number):
    rng = np.random.default_rng(7)
    items = 20_000
    scale, shift = rng.uniform(0.1, 10, (items, 1)), rng.normal(size=(items, 3))  # every item has its own
    samples, target = (shift + scale * draws(kind, rng, shape) for shape in ((number, items), (items,)))
    covered = metrics.coverage(samples, target)
    assert covered.mean() == pytest.approx(0.9, abs=5 * covered.std() / math.sqrt(items))


@pytest.mark.parametrize("kind", ["gaussian", "skewed", "bimodal"])
def test_coverage_shows_samples_that_are_too_narrow_too_wide_or_elsewhere(kind):
    rng = np.random.default_rng(8)
    samples, target = draws(kind, rng, (16, 4000)), draws(kind, rng, (4000,))
    middle = samples.mean((0, 1))
    assert metrics.coverage(middle + 0.5 * (samples - middle), target).mean() < 0.8
    assert metrics.coverage(middle + 3 * (samples - middle), target).mean() > 0.93
    assert metrics.coverage(samples + 100, target).mean() == 0
    same = np.ones((16, 3, 3))
    np.testing.assert_allclose(metrics.coverage(same, same[0]), 0.9)


def test_the_centre_is_nearer_to_the_samples_than_any_of_its_neighbours_and_no_outlier_moves_it():
    rng = np.random.default_rng(9)
    samples = np.zeros((15, 1, 7))
    samples[..., :3] = 0.01 * rng.normal(size=(15, 1, 3))
    samples[0, 0, :3] = [5, 0, 0]
    half = rng.uniform(-0.2, 0.2, 15)
    half[3] = 0.01
    samples[..., 3], samples[..., 6] = np.cos(half)[:, None], np.sin(half)[:, None]
    found = metrics.centre(samples)
    assert np.linalg.norm(found[0, :3]) < 0.01

    def cost(place):
        return np.linalg.norm(samples[:, 0, :3] - place, axis=-1).sum()

    for step in 1e-3 * np.concatenate([np.eye(3), -np.eye(3)]):
        assert cost(found[0, :3]) < cost(found[0, :3] + step)
    angles = [np.abs(half - h).sum() for h in half]  # turns about one axis
    assert found[0, 6] == pytest.approx(math.sin(half[int(np.argmin(angles))]))


def test_the_calibration_error_of_bins_written_out_by_hand():
    confidence = np.array([0.91, 0.93, 0.95, 0.97, 0.55, 0.57])
    right = np.array([True, True, True, False, True, False])
    expected = (4 * abs(0.94 - 0.75) + 2 * abs(0.56 - 0.5)) / 6
    assert metrics.calibration_error(confidence, right) == pytest.approx(expected)
    bins = metrics.reliability(confidence, right)
    np.testing.assert_array_equal(np.flatnonzero(bins.items), [5, 9])
    assert bins.accuracy[9] == pytest.approx(0.75)
    # A weight of 2 is the item twice.
    twice = metrics.calibration_error(np.append(confidence, 0.91), np.append(right, True))
    assert metrics.calibration_error(confidence, right, np.array([2.0, 1, 1, 1, 1, 1])) == pytest.approx(twice)


def test_the_area_under_the_curve_counts_pairs():
    rng = np.random.default_rng(11)
    positive, score = rng.random(60) < 0.4, rng.integers(0, 8, 60) / 8
    weight = rng.integers(0, 3, 60).astype(float)
    wins = total = 0.0
    for i in np.flatnonzero(positive):
        for j in np.flatnonzero(~positive):
            total += weight[i] * weight[j]
            wins += weight[i] * weight[j] * ((score[i] > score[j]) + 0.5 * (score[i] == score[j]))
    assert metrics.auc(positive, score, weight) == pytest.approx(wins / total)
    assert metrics.auc(positive, score, weight) == pytest.approx(
        sklearn.metrics.roc_auc_score(positive, score, sample_weight=weight)
    )
    statistic = stats.mannwhitneyu(score[positive], score[~positive]).statistic
    assert metrics.auc(positive, score) == pytest.approx(statistic / (positive.sum() * (~positive).sum()))
    assert math.isnan(metrics.auc(np.ones(4, bool), score[:4]))


def test_the_weighted_median_is_that_of_repeated_items():
    rng = np.random.default_rng(12)
    for size in (1, 2, 7, 8):
        values, weight = rng.normal(size=size), rng.integers(0, 4, size)
        weight[0] += 1
        assert metrics.median(values, weight.astype(float)) == pytest.approx(np.median(np.repeat(values, weight)))
    assert math.isnan(metrics.median(values, np.zeros(8)))
