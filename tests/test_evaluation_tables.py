"""The metrics of a summary, compared with means written out by hand, and the columns of the tables."""

import enum
import json

import numpy as np
import pytest
from test_evaluation_scores import FELL, judged

from sts_jax import evaluation, physics


@pytest.fixture(scope="module")
def scored():
    """Items, and the scores of the baselines, of a distribution, and of one that has the first two items only."""
    test, predicted = judged()
    train, _ = judged(8, seed=1)
    outcomes = physics.Freefall.outcomes
    rows = evaluation.baselines(physics.Freefall(), train, test)
    rows |= {"model": predicted, evaluation.CEILING: evaluation.first(predicted, 2)}
    return test, {name: evaluation.score(row, test, outcomes=outcomes) for name, row in rows.items()}


@pytest.fixture(scope="module")
def summary(scored):
    test, scores = scored
    return evaluation.summarise(scores, test, num=50)


def test_metrics_are_over_all_items_or_over_those_that_stay(scored, summary):
    test, scores = scored
    own = scores["model"]
    found = {name: cell and cell["value"] for name, cell in summary["predictors"]["model"].items()}
    stayed = test.outcome != FELL
    assert found["position"] == pytest.approx(own.position.mean())
    assert found["position_on_pad"] == pytest.approx(own.position[stayed].mean())
    assert found["position_on_pad_median"] == pytest.approx(np.median(own.position[stayed]))
    assert found["energy"] == pytest.approx(own.energy.mean())
    assert found["coverage"] == pytest.approx(own.coverage.mean())
    assert found["outcome_log_loss"] == pytest.approx(own.log_loss.mean())
    assert found["sharpness"] == pytest.approx(own.gradient.sum() / own.gradient_target.sum())
    constant = scores["constant (mean training target)"].visual.excess.sum()
    assert found["visual_skill"] == pytest.approx(1 - own.visual.excess.sum() / constant)
    assert found["visual_skill_best"] == pytest.approx(1 - own.best.excess.sum() / constant)
    pairs = own.fell_off[~stayed][:, None] > own.fell_off[stayed]
    assert found["fell_off_auc"] == pytest.approx(pairs.mean())
    json.dumps(summary)


def test_a_metric_lies_in_its_interval_and_a_missing_one_is_none(summary):
    cell = summary["predictors"]["model"]["position"]
    assert cell["low"] <= cell["value"] <= cell["high"]
    rule = summary["predictors"]["rests below its start"]
    assert rule["visual_skill"] is rule["coverage"] is rule["outcome_log_loss"] is None
    assert rule["energy"] == rule["position"]


def test_a_ceiling_of_the_first_items_is_compared_with_the_constant_on_these(scored, summary):
    _, scores = scored
    assert summary["scored"][evaluation.CEILING] == 2
    constant = scores["constant (mean training target)"].visual.excess[:2].sum()
    skill = 1 - scores["model"].visual.excess[:2].sum() / constant
    assert summary["predictors"][evaluation.CEILING]["visual_skill"]["value"] == pytest.approx(skill)
    assert set(summary["differences"]) == {"model"}
    text = evaluation.table(summary, title="t")
    assert f'The metrics of "{evaluation.CEILING}" are over the first 2 trajectories.' in text


def test_both_tables_have_their_columns(summary):
    def heads(text):
        lines = [line for line in text.splitlines() if line.startswith("| predictor")]
        return [line.strip("| ").split(" | ") for line in lines]

    (short,) = heads(evaluation.table(summary, title="t"))
    assert short == [
        *("predictor", "visual skill", "visual skill on the object", "tactile skill"),
        *("position on pad, mean / median (mm)", "up axis on pad (deg)"),
        *("outcome, balanced accuracy / log loss (nats)", "energy score (mm) / coverage of 90 %"),
    ]
    complete, differences = heads(evaluation.full_table(summary, title="t"))
    assert complete == [
        *("predictor", "visual BCE", "visual excess x1e-4", "visual skill", "visual skill on the object"),
        *("visual skill, best sample", "sharpness", "tactile BCE", "tactile excess x1e-4", "tactile skill"),
        *("tactile skill on the object", "position (mm)", "position, median (mm)", "position on pad (mm)"),
        *("position on pad, median (mm)", "energy score (mm)", "coverage of 90 %", "angle (deg)", "angle on pad (deg)"),
        *("up axis (deg)", "up axis on pad (deg)", "up axis on pad, median (deg)", "outcome, balanced accuracy"),
        *("log loss (nats)", "calibration error", "ROC area of falling off"),
    ]
    assert differences == [
        *("predictor", "baseline", "visual skill", "visual skill on the object", "tactile skill"),
        *("tactile skill on the object", "position on pad (mm)", "energy score (mm)", "up axis on pad (deg)"),
        "log loss (nats)",
    ]
    hidden = {f"{stream}_{kind}_object" for stream in ("visual", "tactile") for kind in ("bce", "excess")}
    assert (
        {metric.name for metric in evaluation.METRICS if not metric.column}
        == hidden
        <= set(summary["predictors"]["model"])
    )


def test_the_short_table_has_the_requested_rows(summary):
    chosen = [evaluation.CEILING, "rests below its start", "model"]
    lines = evaluation.table(summary, title="t", rows=chosen, notes=["A note."]).splitlines()
    rows = [line for line in lines if line.startswith("|")]
    assert {line.count("|") for line in rows} == {9}
    assert [line.split(" | ")[0] for line in rows[2:]] == [f"| {name}" for name in chosen]
    assert lines[-1] == "A note."
    position, rule = summary["predictors"]["model"]["position_on_pad"]["value"], rows[3]
    assert f" {1e3 * position:.1f} / " in rows[4]
    assert rule.startswith("| rests below its start | - | - | - |")


def test_the_full_table_has_every_predictor_and_leaves_out_empty_differences(summary):
    lines = evaluation.full_table(summary, title="t").splitlines()
    whole = [line for line in lines if line.startswith("| model |")]
    assert len([line for line in lines if line.startswith("|") and line.count("|") == whole[0].count("|")]) >= 8
    assert len(whole) == 1 + len(evaluation.BASELINES)  # its metrics, and a line against each baseline
    assert all(name in "\n".join(lines) for name in summary["predictors"])


def test_the_gain_is_the_removed_share_of_the_log_loss(scored):
    test, scores = scored
    model = scores["model"]
    half = model._replace(log_loss=model.log_loss / 2)
    gain = evaluation.gain(model, half, test, num=50)
    np.testing.assert_allclose([gain[key] for key in ("value", "low", "high")], 0.5)
    assert evaluation.gain(model, scores["copy of the input"], test) is None


def test_a_summary_needs_every_baseline(scored):
    test, scores = scored
    few = {name: own for name, own in scores.items() if name != "nearest neighbour"}
    with pytest.raises(ValueError, match=r"`scores` lacks 'nearest neighbour': pass the predictions of evaluation\.b"):
        evaluation.summarise(few, test, num=2)


def test_outcomes_are_named_by_the_scenario(scored):
    class Ends(enum.IntEnum):
        FELL_OFF = 1
        LIES = 0

    test, scores = scored
    assert evaluation.summarise(scores, test, outcomes=tuple(Ends), num=2)["outcomes"] == {"lies": 3, "fell_off": 3}
