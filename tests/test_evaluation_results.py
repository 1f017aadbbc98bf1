"""Baselines, errors and summaries, compared with values written out by hand, and the tables."""

import dataclasses
import enum
import json
import math
import re

import numpy as np
import pytest

from sts_jax import dataset, evaluation, physics
from sts_jax.evaluation import Metric, Predicted, metrics

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


def test_without_a_condition_or_with_a_constant_one_the_nearest_image_decides():
    for condition, scenario in ((np.zeros((3, 0)), physics.Freefall()), (np.ones((3, 3)), physics.Perturbed())):
        train, test = pairs([10, 60, 200], condition), pairs([40, 150, 0], condition)
        assert nearest(train, test, scenario) == [1, 2, 0]


@pytest.mark.parametrize("unit", [1.0, 1000.0])
def test_image_and_condition_count_alike_whatever_their_units(unit):
    corners = np.array([[0.0, 0, 0], [0, 0, 1], [1, 1, 0], [1, 1, 1]]) * [1, 1, unit]
    train = pairs([0, 200, 0, 200], corners)
    # The image selects items 1 and 3, and the condition decides between them.
    assert nearest(train, pairs([190, 190], [[0.1, 0.1, unit], [0.9, 0.9, unit]]), physics.Perturbed()) == [1, 3]
    # The distance of the image is the same for all items, and the condition decides.
    assert nearest(train, pairs([100] * 4, corners), physics.Perturbed()) == [0, 1, 2, 3]


def test_the_rule_keeps_the_start_at_the_median_height_of_objects_that_stay():
    train, test = (pairs([0] * size, np.zeros((size, 0))) for size in (4, 2))
    train = train._replace(outcome=np.array([0, 1, 0, 0], np.int32))  # 1: fell off
    train.pose[:, 1, 2] = [0.01, -0.5, 0.05, 0.02]
    test.pose[:, 0, :3] = [[0.03, 0.04, 0.2], [-0.06, 0, 0.2]]
    test.pose[:, 0, 3:] = [[0, 1, 0, 0], [0.6, 0, 0, 0.8]]
    constant, _, _, rule = evaluation.baselines(physics.Freefall(), train, test).values()
    np.testing.assert_allclose(constant.outcome_probability, [[0.75, 0.25]] * 2)
    np.testing.assert_allclose(rule.pose[:, :3], [[0.03, 0.04, 0.02], [-0.06, 0, 0.02]])
    np.testing.assert_array_equal(rule.pose[:, 3:], test.pose[:, 0, 3:])
    assert rule.visual is rule.tactile is None
    assert rule.outcome.tolist() == [physics.Outcome.RESTS] * 2
    np.testing.assert_array_equal(test.pose[:, 0, 2], np.float32(0.2))  # the items are as they were


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
    samples = Predicted(
        visual=rng.integers(0, 256, (k, count, SIDE, SIDE, 3), np.uint8),
        tactile=rng.integers(0, 256, (k, count, SIDE, SIDE, 3), np.uint8),
        pose=np.concatenate([0.02 * rng.normal(size=(k, count, 3)), np.tile([1.0, 0, 0, 0], (k, count, 1))], -1),
    )
    chance = rng.random(count)
    return test, Predicted(
        visual=samples.visual.mean(0) / 255,
        tactile=samples.tactile.mean(0) / 255,
        pose=samples.pose[0],
        samples=samples,
        outcome_probability=np.stack([chance, 1 - chance], 1),
    )


def test_a_distribution_is_scored_by_its_samples_and_probabilities():
    test, predicted = judged()
    scores = evaluation.score(predicted, test, outcomes=physics.Freefall.outcomes)
    truth, place = test.visual[:, 1] / 255, predicted.samples.pose[..., :3]
    np.testing.assert_allclose(scores["energy"], metrics.energy_score(place, test.pose[:, 1, :3]))
    np.testing.assert_allclose(scores["coverage"], metrics.coverage(place, test.pose[:, 1, :3]))
    each = [metrics.image_error(image / 255, truth).excess for image in predicted.samples.visual]
    np.testing.assert_allclose(scores["visual_skill_best"][:, 1], np.min(each, 0), rtol=1e-5)
    assert (scores["visual_skill_best"] > scores["visual_skill"])[:, 1].any()  # a mean may be better than each sample
    sharp = np.mean([metrics.gradient_energy(image / 255) for image in predicted.samples.visual], 0)
    np.testing.assert_allclose(scores["sharpness"].T, [sharp, metrics.gradient_energy(truth)], rtol=1e-5)
    felt = np.mean([metrics.gradient_energy(image / 255) for image in predicted.samples.tactile], 0)
    true = metrics.gradient_energy(test.tactile[:, 1] / 255)
    np.testing.assert_allclose(scores["tactile_sharpness"].T, [felt, true], rtol=1e-5)
    rests = predicted.outcome_probability[:, 0]  # Freefall.outcomes: rests, fell off
    happened = np.where(test.outcome == RESTS, rests, 1 - rests)
    np.testing.assert_allclose(scores["outcome_log_loss"], -np.log(np.maximum(happened, 1e-3)))
    np.testing.assert_allclose(scores["fell_off_auc"].T, [1 - rests, test.outcome == FELL])
    likeliest = np.where(rests > 0.5, RESTS, FELL)
    np.testing.assert_array_equal(scores["outcome_balanced_accuracy"].T, [likeliest, test.outcome])
    np.testing.assert_array_equal(scores["outcome_calibration_error"][:, 1], likeliest == test.outcome)


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
    predicted = Predicted(outcome_probability=np.stack([1 - off, off], 1))
    outcomes = physics.Freefall.outcomes
    frequency = evaluation.frequency(test.outcome, outcomes)
    np.testing.assert_allclose(frequency, [1 - (test.outcome == FELL).mean(), (test.outcome == FELL).mean()], atol=1e-4)
    decided = evaluation.score(predicted, test, outcomes=outcomes, frequency=frequency)
    decided = decided["outcome_balanced_accuracy"][:, 0]
    accuracy = metrics.balanced_accuracy
    found = accuracy(decided, test.outcome)
    # No other threshold on the probability does better, beyond chance.
    others = [accuracy(np.where(off > limit, FELL, RESTS), test.outcome) for limit in np.linspace(0.01, 0.9, 90)]
    assert found == pytest.approx(max(others), abs=0.01)
    assert found > accuracy(np.where(off > 0.5, FELL, RESTS), test.outcome) + 0.1


def test_a_deterministic_prediction_scores_its_error_and_the_sharpness_of_its_image():
    test, predicted = judged()
    scores = evaluation.score(predicted._replace(samples=None, outcome_probability=None), test)
    np.testing.assert_array_equal(scores["energy"], scores["position"])
    np.testing.assert_allclose(scores["sharpness"][:, 0], metrics.gradient_energy(predicted.visual))
    assert not {"coverage", "visual_skill_best", "outcome_log_loss", "fell_off_auc"} & set(scores)


def test_predictions_in_parts_are_joined_in_order():
    _, predicted = judged()
    whole = evaluation.joined([evaluation.take(predicted, slice(4)), evaluation.take(predicted, slice(2))])
    np.testing.assert_array_equal(whole.pose, predicted.pose[[0, 1, 2, 3, 0, 1]])
    np.testing.assert_array_equal(whole.samples.visual, predicted.samples.visual[:, [0, 1, 2, 3, 0, 1]])


def height_error(predicted, test):
    return None if predicted.pose is None else np.abs(predicted.pose[:, 2] - test.pose[:, 1, 2])


def position_error(predicted, test):
    return None if predicted.pose is None else metrics.position_error(predicted.pose, test.pose[:, 1])


HEIGHT = Metric("height_error", height_error, unit="mm", factor=1e3, digits=2, compared="lower")
FARTHEST = Metric(
    "farthest",
    position_error,
    unit="mm",
    factor=1e3,
    digits=1,
    reduce=lambda error, weight: error[weight > 0].max(),
    note="Farthest: largest.",
)
OWN = (*evaluation.METRICS, HEIGHT, FARTHEST)


@pytest.fixture(scope="module")
def scored():
    """Items, and the scores of the baselines, of a distribution, and of one that has the first two items only."""
    (test, predicted), (train, _) = judged(), judged(8, seed=1)
    rows = evaluation.baselines(physics.Freefall(), train, test)
    rows |= {"model": predicted, evaluation.CEILING: evaluation.take(predicted, slice(2))}
    outcomes = physics.Freefall.outcomes
    return test, {name: evaluation.score(row, test, outcomes=outcomes, metrics=OWN) for name, row in rows.items()}


@pytest.fixture(scope="module")
def summary(scored):
    test, scores = scored
    return evaluation.summarise(scores, test, metrics=OWN, num=50)


def test_metrics_are_over_all_items_or_over_those_that_stay(scored, summary):
    test, scores = scored
    errors = scores["model"]
    value = {name: cell and cell["value"] for name, cell in summary["predictors"]["model"].items()}
    stayed = test.outcome != FELL
    for name in ("position", "energy", "coverage", "outcome_log_loss", "height_error"):
        assert value[name] == pytest.approx(errors[name].mean())
    assert value["position_on_pad"] == pytest.approx(errors["position"][stayed].mean())
    assert value["position_on_pad_median"] == pytest.approx(np.median(errors["position"][stayed]))
    assert value["sharpness"] == pytest.approx(np.divide(*errors["sharpness"].sum(0)))
    assert value["farthest"] == pytest.approx(errors["position"].max())
    constant = scores["constant (mean training target)"]["visual_excess"][:, 1].sum()
    for name in ("visual_skill", "visual_skill_best"):
        assert value[name] == pytest.approx(1 - errors[name][:, 1].sum() / constant)
    chance = errors["fell_off_auc"][:, 0]
    assert value["fell_off_auc"] == pytest.approx((chance[~stayed][:, None] > chance[stayed]).mean())
    json.dumps(summary)


def test_values_lie_in_their_intervals_and_differences_are_from_the_baselines(scored, summary):
    _, scores = scored
    cell = summary["predictors"]["model"]["position"]
    assert cell["low"] <= cell["value"] <= cell["high"]
    rule = summary["predictors"]["rests below its start"]
    assert rule["visual_skill"] is rule["coverage"] is rule["outcome_log_loss"] is None
    assert rule["energy"] == rule["position"]
    difference = scores["model"]["height_error"].mean() - scores["copy of the input"]["height_error"].mean()
    against = summary["differences"]["model"]["copy of the input"]["height_error"]
    assert against["value"] == pytest.approx(difference)


def test_a_ceiling_of_the_first_items_is_compared_with_the_constant_on_these(scored, summary):
    _, scores = scored
    assert summary["scored"][evaluation.CEILING] == 2
    constant = scores["constant (mean training target)"]["visual_excess"][:2, 1].sum()
    skill = 1 - scores["model"]["visual_excess"][:2, 1].sum() / constant
    assert summary["predictors"][evaluation.CEILING]["visual_skill"]["value"] == pytest.approx(skill)
    assert set(summary["differences"]) == {"model"}
    text = evaluation.table(summary, title="t")
    assert f'The metrics of "{evaluation.CEILING}" are over the first 2 trajectories.' in text


def test_a_model_of_the_first_items_is_compared_with_the_baselines_on_these(scored):
    test, scores = scored
    part = {name: values[:4] for name, values in scores["model"].items()}
    found = evaluation.summarise({**scores, "part": part}, test, metrics=OWN, num=50)["differences"]
    alone = {name: {key: values[:4] for key, values in row.items()} for name, row in scores.items()}
    expected = evaluation.summarise(alone, test.take(slice(4)), metrics=OWN, num=50)["differences"]["model"]
    for base, cells in expected.items():
        for name, cell in cells.items():
            assert (found["part"][base][name] or {}).get("value") == (cell or {}).get("value"), (base, name)
    assert found["part"] != found["model"]


def test_the_full_table_has_every_predictor_and_the_differences(summary):
    lines = evaluation.full_table(summary, title="t", metrics=OWN).splitlines()
    complete, differences = [line.strip("| ").split(" | ") for line in lines if line.startswith("| predictor")]
    assert complete == ["predictor", *(metric.title for metric in OWN)]
    assert differences == ["predictor", "baseline", *(metric.title for metric in OWN if metric.compared)]
    assert {"visual excess x1e-4", "coverage of 90 %", "up axis on pad (deg)", "farthest (mm)"} < set(complete)
    rows = [line.strip("| ").split(" | ") for line in lines if line.startswith("| model |")]
    assert len(rows) == 1 + len(evaluation.BASELINES)  # its metrics, and a line against each baseline
    value = 1e3 * summary["predictors"]["model"]["height_error"]["value"]
    assert rows[0][-2].startswith(f"{value:.2f} [")
    assert "Farthest: largest." in "".join(lines)
    assert all(name in "".join(lines) for name in summary["predictors"])


def test_the_short_table_has_the_requested_rows_and_columns(summary):
    chosen = [evaluation.CEILING, "rests below its start", "model"]
    columns = (*evaluation.COLUMNS, evaluation.Column("height", (HEIGHT,)))
    lines = evaluation.table(summary, title="t", rows=chosen, notes=["A note."], columns=columns).splitlines()
    head, _, _, rule, model = [line.strip("| ").split(" | ") for line in lines if line.startswith("|")]
    assert head == [
        *("predictor", "visual skill", "visual skill on the object", "tactile skill"),
        *("position on pad, mean / median (mm)", "up axis on pad (deg)"),
        *("outcome, balanced accuracy / log loss (nats)", "energy score (mm) / coverage of 90 %", "height"),
    ]
    assert rule[:4] == ["rests below its start", "-", "-", "-"]
    cells = summary["predictors"]["model"]
    assert model[4].startswith(f"{1e3 * cells['position_on_pad']['value']:.1f} / ")
    assert model[-1].startswith(f"{1e3 * cells['height_error']['value']:.2f} [")
    assert lines[-1] == "A note."


def test_the_gain_is_the_removed_share_of_the_log_loss(scored):
    test, scores = scored
    half = {name: errors / 2 for name, errors in scores["model"].items()}
    gain = evaluation.gain(scores["model"], half, test, num=50)
    np.testing.assert_allclose([gain[key] for key in ("value", "low", "high")], 0.5)
    assert evaluation.gain(scores["model"], scores["copy of the input"], test) is None


def test_there_is_no_interval_from_items_of_one_object(scored):
    test, scores = scored
    alone = test._replace(object=np.zeros_like(test.object))
    summary = evaluation.summarise(scores, alone, metrics=OWN, num=5)
    cells = [cell for row in summary["predictors"].values() for cell in row.values() if cell]
    cells += [cell for row in summary["differences"]["model"].values() for cell in row.values() if cell]
    assert {(cell["low"], cell["high"]) for cell in cells} == {(None, None)}
    text, full = evaluation.table(summary, title="t"), evaluation.full_table(summary, title="t", metrics=OWN)
    assert not re.search(r"\[[^-]*\d", text + full)
    assert all("[-] stands for no interval, because all items are of one object." in page for page in (text, full))
    gain = evaluation.gain(scores["model"], {name: errors / 2 for name, errors in scores["model"].items()}, alone)
    assert gain == {"value": pytest.approx(0.5), "low": None, "high": None}
    assert metrics.written(**gain, digits=2) == "0.50 [-]"


def test_a_metric_of_some_items_needs_two_objects_among_these(scored):
    test, scores = scored
    one_stays = np.where(test.object == 0, test.outcome, FELL).astype(np.int32)
    cells = evaluation.summarise(scores, test._replace(outcome=one_stays), metrics=OWN, num=20)["predictors"]["model"]
    assert cells["position_on_pad"]["low"] is cells["position_on_pad"]["high"] is None
    assert cells["position"]["low"] < cells["position"]["high"]


def test_there_is_no_interval_from_one_trajectory_of_a_sensor():
    one = TEST.take(slice(1))
    summary = evaluation.image_summary(
        {name: evaluation.take(row, slice(1)) for name, row in IMAGES.items()}, one, num=5
    )
    assert summary["visual"]["predictors"][COPY]["bce"]["low"] is None
    json.dumps(summary, allow_nan=False)


def test_outcomes_are_named_by_the_scenario(scored):
    class Ends(enum.IntEnum):
        FELL_OFF = 1
        LIES = 0

    test, scores = scored
    assert evaluation.summarise(scores, test, outcomes=tuple(Ends), num=2)["outcomes"] == {"lies": 3, "fell_off": 3}


WRONG = dataclasses.replace(HEIGHT, errors=lambda predicted, test: predicted.pose[:2])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda test, _, predicted: evaluation.score(predicted, test), r"shape \(6, 2\), .* shape \(6, 0\): pass"),
        (
            lambda test, _, predicted: evaluation.score(
                predicted, test, outcomes=physics.Freefall.outcomes, metrics=(WRONG,)
            ),
            r"'height_error': .* shape \(2, 7\), but it must be \(6,\) or \(6, k\)",
        ),
        (lambda test, scores, _: evaluation.summarise(scores, test, metrics=OWN[:1] * 2), "named 'visual_bce': give"),
        (lambda test, scores, _: evaluation.summarise({"model": scores["model"]}, test), "`scores` lacks 'constant"),
        (
            lambda test, scores, _: evaluation.full_table(
                evaluation.summarise(scores, test, num=2), title="t", metrics=OWN
            ),
            "summary lacks 'height_error': pass all metrics",
        ),
        (lambda *_: evaluation.image_summary({CONSTANT: IMAGES[CONSTANT]}, TEST), "lacks 'copy of the input'"),
        (
            lambda *_: evaluation.image_summary({**IMAGES, "small": Predicted(visual=np.zeros((5, 4, 4, 3)))}, TEST),
            r"'small': visual has shape \(5, 4, 4, 3\)",
        ),
    ],
)
def test_bad_calls_are_refused(call, message, scored):
    with pytest.raises(ValueError, match=message):
        call(*scored, judged()[1])


TRAIN, TEST = judged(8)[0], judged(6, seed=1)[0]
IMAGES = evaluation.image_baselines(TRAIN, TEST)
CONSTANT, COPY, NEIGHBOUR = IMAGES


def test_baselines_of_images_are_the_mean_the_input_and_the_nearest_end():
    np.testing.assert_allclose(IMAGES[CONSTANT].tactile[3], TRAIN.tactile[:, 1].mean(0) / 255, atol=1e-6)
    np.testing.assert_array_equal(IMAGES[COPY].visual, TEST.visual[:, 0] / 255)
    for item in range(6):
        gaps = [np.abs(TEST.visual[item, 0].astype(float) - image) for image in TRAIN.visual[:, 0]]
        nearest = int(np.argmin([(gap**2).sum() for gap in gaps]))
        np.testing.assert_array_equal(IMAGES[NEIGHBOUR].tactile[item], TRAIN.tactile[nearest, 1] / 255)


def test_cross_entropy_floor_and_skill_of_images_equal_plain_loops():
    guess = np.full(TEST.visual[:, 1].shape, 0.4, np.float32)
    exact = Predicted(TEST.visual[:, 1], TEST.tactile[:, 1])
    summary = evaluation.image_summary({**IMAGES, "guess": Predicted(visual=guess), "exact": exact}, TEST, num=50)
    truth = np.clip(TEST.visual[:, 1] / 255, 1e-300, 1 - 1e-16).ravel()
    bce = [-(x * math.log(0.4) + (1 - x) * math.log(0.6)) for x in truth]
    floor = [-(x * math.log(x) + (1 - x) * math.log(1 - x)) for x in truth]
    cells = summary["visual"]["predictors"]
    assert summary["visual"]["floor"] == pytest.approx(np.mean(floor), rel=1e-5)
    assert cells["guess"]["bce"]["value"] == pytest.approx(np.mean(bce), rel=1e-5)
    for key, name in (("skill", CONSTANT), ("skill_copy", COPY)):
        expected = 1 - (np.mean(bce) - np.mean(floor)) / (cells[name]["bce"]["value"] - np.mean(floor))
        assert cells["guess"][key]["value"] == pytest.approx(expected, rel=1e-4)
        assert cells["guess"][key]["low"] <= cells["guess"][key]["value"] <= cells["guess"][key]["high"]
    assert "guess" not in summary["tactile"]["predictors"]
    assert cells["exact"]["skill"]["value"] == pytest.approx(1, abs=1e-3)
    assert cells[CONSTANT]["skill"]["value"] == 0
