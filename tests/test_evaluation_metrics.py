"""Metrics against sums written out by hand."""

import math

import numpy as np
import pytest

from sts_jax.evaluation import metrics


def test_excess_is_the_divergence_summed_pixel_by_pixel():
    rng = np.random.default_rng(0)
    predicted, target = rng.random((2, 5, 4, 3)), rng.random((2, 5, 4, 3))
    mask = rng.random((2, 5, 4)) < 0.5
    error = metrics.image_error(predicted, target, mask)
    for i in range(2):
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


def test_a_perfect_prediction_has_no_excess_and_full_skill():
    target = np.random.default_rng(1).integers(1, 255, (3, 8, 8, 3)) / 255
    error = metrics.image_error(target, target)
    constant = metrics.image_error(np.full_like(target, 0.5), target)
    np.testing.assert_allclose(error.excess, 0, atol=1e-9)
    assert np.all(error.bce > 0)  # the entropy of grey targets remains
    assert metrics.skill(error, constant) == pytest.approx(1)
    assert metrics.skill(constant, constant) == 0


def test_black_and_white_targets_keep_everything_finite():
    target = np.zeros((1, 2, 2, 3))
    target[0, 0] = 1
    error = metrics.image_error(1 - target, target)
    assert np.isfinite(error.bce).all()
    assert np.isfinite(error.excess).all()
    np.testing.assert_allclose(error.bce, 12 * math.log(510))


def test_angle_knows_that_a_quaternion_and_its_negative_are_one_rotation():
    pose = np.zeros((2, 7))
    pose[:, 3] = 1
    turned = pose.copy()
    turned[0, 3:] = [-1, 0, 0, 0]
    turned[1, 3:] = [math.cos(math.pi / 6), 0, math.sin(math.pi / 6), 0]
    np.testing.assert_allclose(metrics.geodesic_angle(turned, pose), [0, math.pi / 3], atol=1e-7)


def test_the_up_axis_knows_no_turn_about_itself():
    half = math.pi / 6
    pose = np.zeros((3, 7))
    pose[:, 3] = 1
    turned = pose.copy()
    turned[0, 3:] = [math.cos(half), 0, 0, math.sin(half)]
    turned[1, 3:] = [math.cos(half), math.sin(half), 0, 0]
    turned[2, 3:] = [0, math.sqrt(0.5), math.sqrt(0.5), 0]
    np.testing.assert_allclose(metrics.axis_angle(turned, pose), [0, math.pi / 3, math.pi], atol=1e-7)
    np.testing.assert_allclose(metrics.axis_angle(turned[:1], turned[1:2]), [math.pi / 3], atol=1e-7)


def test_balanced_accuracy_weighs_classes_alike():
    target = np.array([0] * 9 + [1])
    assert metrics.balanced_accuracy(np.zeros(10), target) == pytest.approx(0.5)
    assert metrics.balanced_accuracy(target, target) == 1
    assert metrics.balanced_accuracy(np.array([0] * 8 + [1, 1]), target) == pytest.approx((8 / 9 + 1) / 2)


def test_threshold_separates_what_can_be_separated():
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
