"""Baselines, and the errors of predictions, compared with values written out by hand."""

import numpy as np
import pytest

from sts_jax import dataset, evaluation, physics

SIDE = 4


def pairs(grey, condition):
    """One pair per grey value of the first image. The outcomes count the pairs."""
    grey = np.asarray(grey, np.uint8)
    num = len(grey)
    images = np.broadcast_to(grey[:, None, None, None, None], (num, 2, SIDE, SIDE, 3))
    pose = np.zeros((num, 2, 7), np.float32)
    pose[..., 3] = 1
    return dataset.Pairs(
        visual=images,
        tactile=images,
        segmentation=np.ones((num, 2, SIDE, SIDE), bool),
        pose=pose,
        contact=np.ones((num, 2), bool),
        condition=np.asarray(condition, np.float32).reshape(num, -1),
        outcome=np.arange(num, dtype=np.int32),
        object=np.arange(num),
        trajectory=np.arange(num),
        support=np.zeros((num, 128), np.float32),
        mass=np.ones(num, np.float32),
        com=np.zeros((num, 3), np.float32),
    )


def nearest(train, test, scenario):
    predicted = evaluation.baselines(scenario, train, test)
    return predicted["nearest neighbour"].outcome.tolist()


def test_without_a_condition_the_nearest_image_decides():
    train = pairs([10, 60, 200], np.zeros((3, 0)))
    assert nearest(train, pairs([40, 150, 0], np.zeros((3, 0))), physics.Freefall()) == [1, 2, 0]


@pytest.mark.parametrize("unit", [1.0, 1000.0])
def test_image_and_condition_count_alike_whatever_their_units(unit):
    corners = np.array([[0.0, 0, 0], [0, 0, 1], [1, 1, 0], [1, 1, 1]]) * [1, 1, unit]
    train = pairs([0, 200, 0, 200], corners)
    # The image selects items 1 and 3, and the condition decides between them.
    assert nearest(train, pairs([190, 190], [[0.1, 0.1, unit], [0.9, 0.9, unit]]), physics.Perturbed()) == [1, 3]
    # The distance of the image is the same for all items, and the condition decides.
    assert nearest(train, pairs([100] * 4, corners), physics.Perturbed()) == [0, 1, 2, 3]


def test_a_constant_condition_does_not_disturb_the_nearest_image():
    train = pairs([10, 60, 200], np.ones((3, 3)))
    assert nearest(train, pairs([40, 150, 0], np.ones((3, 3))), physics.Perturbed()) == [1, 2, 0]


def test_the_rule_keeps_the_start_at_the_median_height_of_objects_that_stay():
    train, test = (pairs([0] * size, np.zeros((size, 0))) for size in (4, 2))
    train = train._replace(outcome=np.array([0, 1, 0, 0], np.int32))  # 1: fell off
    train.pose[:, 1, 2] = [0.01, -0.5, 0.05, 0.02]
    test.pose[:, 0, :3] = [[0.03, 0.04, 0.2], [-0.06, 0, 0.2]]
    test.pose[:, 0, 3:] = [[0, 1, 0, 0], [0.6, 0, 0, 0.8]]
    rule = evaluation.baselines(physics.Freefall(), train, test)["rests below its start"]
    np.testing.assert_allclose(rule.pose[:, :3], [[0.03, 0.04, 0.02], [-0.06, 0, 0.02]])
    np.testing.assert_array_equal(rule.pose[:, 3:], test.pose[:, 0, 3:])
    assert rule.visual is rule.tactile is None
    assert rule.outcome.tolist() == [physics.Outcome.RESTS] * 2
    np.testing.assert_array_equal(test.pose[:, 0, 2], np.float32(0.2))  # the items are as they were


def test_the_constants_probabilities_are_the_outcomes_shares():
    train, test = (pairs([0] * size, np.zeros((size, 0))) for size in (4, 2))
    train = train._replace(outcome=np.array([0, 1, 0, 0], np.int32))
    constant = evaluation.baselines(physics.Freefall(), train, test)["constant (mean training target)"]
    np.testing.assert_allclose(constant.outcome_probability, [[0.75, 0.25]] * 2)


def test_shares_count_the_samples_and_one_more_spread_over_all_outcomes():
    outcomes = physics.Perturbed.outcomes
    drawn = np.array([[4, 1], [4, 2], [2, 1]])  # columns: topples, topples, stands, and fell off, stands, fell off
    shares = evaluation.shares(drawn, outcomes)
    assert [outcome.name for outcome in outcomes] == ["TOPPLES", "SLIDES", "STANDS", "FELL_OFF"]
    np.testing.assert_allclose(shares * 4, [[2.25, 0.25, 1.25, 0.25], [0.25, 0.25, 1.25, 2.25]])


RESTS, FELL = int(physics.Outcome.RESTS), int(physics.Outcome.FELL_OFF)


def judged(count=6, k=5, seed=0):
    """Items with outcomes of freefall, and a prediction of them as a distribution."""
    rng = np.random.default_rng(seed)
    test = pairs(rng.integers(0, 256, count), np.zeros((count, 0)))
    test = test._replace(
        visual=rng.integers(0, 256, test.visual.shape, np.uint8),
        tactile=rng.integers(0, 256, test.tactile.shape, np.uint8),
        outcome=np.array([RESTS, FELL] * (count // 2), np.int32),
        object=np.arange(count) // 2,
    )
    test.pose[..., :3] = 0.02 * rng.normal(size=(count, 2, 3))
    samples = evaluation.Predicted(
        visual=rng.integers(0, 256, (k, count, SIDE, SIDE, 3), np.uint8),
        tactile=rng.integers(0, 256, (k, count, SIDE, SIDE, 3), np.uint8),
        pose=np.concatenate([0.02 * rng.normal(size=(k, count, 3)), np.tile([1.0, 0, 0, 0], (k, count, 1))], -1),
    )
    chance = rng.random(count)
    return test, evaluation.Predicted(
        visual=samples.visual.mean(0) / 255,
        tactile=samples.tactile.mean(0) / 255,
        pose=samples.pose[0],
        samples=samples,
        outcome_probability=np.stack([chance, 1 - chance], 1),
    )


def test_a_distribution_is_scored_by_its_samples_and_probabilities():
    test, predicted = judged()
    scores = evaluation.score(predicted, test, outcomes=physics.Freefall.outcomes)
    metrics, truth = evaluation.metrics, test.visual[:, 1] / 255
    place = predicted.samples.pose[..., :3]
    np.testing.assert_allclose(scores.energy, metrics.energy_score(place, test.pose[:, 1, :3]))
    np.testing.assert_allclose(scores.coverage, metrics.coverage(place, test.pose[:, 1, :3]))
    each = [metrics.image_error(image / 255, truth).excess for image in predicted.samples.visual]
    np.testing.assert_allclose(scores.best.excess, np.min(each, 0), rtol=1e-5)
    assert (scores.best.excess > scores.visual.excess).any()  # a mean of samples may be better than each
    sharp = np.mean([metrics.gradient_energy(image / 255) for image in predicted.samples.visual], 0)
    np.testing.assert_allclose(scores.gradient, sharp, rtol=1e-5)
    np.testing.assert_allclose(scores.gradient_target, metrics.gradient_energy(truth))
    rests = predicted.outcome_probability[:, 0]  # Freefall.outcomes: rests, fell off
    happened = np.where(test.outcome == RESTS, rests, 1 - rests)
    np.testing.assert_allclose(scores.log_loss, -np.log(np.maximum(happened, 1e-3)))
    np.testing.assert_allclose(scores.fell_off, 1 - rests)
    likeliest = np.where(rests > 0.5, RESTS, FELL)
    np.testing.assert_array_equal(scores.outcome, likeliest)
    np.testing.assert_array_equal(scores.right, likeliest == test.outcome)


def test_the_outcome_is_decided_for_the_best_balanced_accuracy():
    """The true probabilities are given, and one item in ten falls off."""
    count, rng = 20000, np.random.default_rng(0)
    off = np.clip(rng.beta(0.3, 2.7, count), 0.01, 0.99)
    test, predicted = judged(2)
    test = test._replace(outcome=np.where(rng.random(count) < off, FELL, RESTS).astype(np.int32))
    test = test._replace(
        **{
            name: np.broadcast_to(getattr(test, name)[:1], (count, *getattr(test, name).shape[1:]))
            for name in ("visual", "tactile", "segmentation", "pose", "contact", "condition", "object", "trajectory")
        }
    )
    predicted = evaluation.Predicted(outcome_probability=np.stack([1 - off, off], 1))
    outcomes = physics.Freefall.outcomes
    frequency = evaluation.frequency(test.outcome, outcomes)
    np.testing.assert_allclose(frequency, [1 - (test.outcome == FELL).mean(), (test.outcome == FELL).mean()], atol=1e-4)
    decided = evaluation.score(predicted, test, outcomes=outcomes, frequency=frequency).outcome
    accuracy = evaluation.metrics.balanced_accuracy
    found = accuracy(decided, test.outcome)
    # No other threshold on the probability does better, beyond chance.
    others = [accuracy(np.where(off > limit, FELL, RESTS), test.outcome) for limit in np.linspace(0.01, 0.9, 90)]
    assert found == pytest.approx(max(others), abs=0.01)
    assert found > accuracy(np.where(off > 0.5, FELL, RESTS), test.outcome) + 0.1


def test_a_deterministic_prediction_scores_its_error_and_the_sharpness_of_its_image():
    test, predicted = judged()
    scores = evaluation.score(predicted._replace(samples=None, outcome_probability=None), test)
    np.testing.assert_array_equal(scores.energy, scores.position)
    np.testing.assert_allclose(scores.gradient, evaluation.metrics.gradient_energy(predicted.visual))
    assert scores.coverage is scores.best is scores.log_loss is scores.confidence is None


def test_probabilities_need_the_names_of_their_columns():
    test, predicted = judged()
    with pytest.raises(
        ValueError, match=r"shape \(6, 2\), but it must have shape \(6, 0\).*pass .* and outcomes=scenario\.outcomes"
    ):
        evaluation.score(predicted, test)


def test_predictions_in_parts_are_joined_in_order():
    _, predicted = judged()
    whole = evaluation.joined([evaluation.first(predicted, 4), evaluation.first(predicted, 2)])
    np.testing.assert_array_equal(whole.pose, predicted.pose[[0, 1, 2, 3, 0, 1]])
    np.testing.assert_array_equal(whole.samples.visual, predicted.samples.visual[:, [0, 1, 2, 3, 0, 1]])
    np.testing.assert_array_equal(whole.outcome_probability, predicted.outcome_probability[[0, 1, 2, 3, 0, 1]])
    assert whole.outcome is whole.samples.outcome is None
