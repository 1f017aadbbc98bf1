"""Another metric and another image size, from outside the library, as `docs/extending.md` describes."""

import dataclasses
import json

import numpy as np
import pytest
from extending_page import blocks
from test_evaluation_scores import judged

from experiments import freefall
from experiments.shared import run
from sts_jax import dataset, evaluation, physics, training


def height_error(predicted, test):
    return None if predicted.pose is None else np.abs(predicted.pose[:, 2] - test.pose[:, 1, 2])


def farthest(judged):
    error = judged.scores.position
    return None if error is None else lambda weight: error[weight > 0].max()


HEIGHT = evaluation.Metric("height_error", height_error, unit="mm", factor=1e3, digits=2, compared="lower")
FARTHEST = evaluation.Metric("farthest", statistic=farthest, unit="mm", factor=1e3, digits=1, note="Farthest: largest.")
METRICS = (*evaluation.METRICS, HEIGHT, FARTHEST)


@pytest.fixture(scope="module")
def items():
    (test, predicted), (train, _) = judged(), judged(8, seed=1)
    return test, train, predicted


@pytest.fixture(scope="module")
def summary(items):
    test, train, predicted = items
    judge = evaluation.scorer(physics.Freefall(), train, metrics=METRICS)
    rows = evaluation.baselines(physics.Freefall(), train, test) | {"model": predicted}
    scores = {name: judge(row, test) for name, row in rows.items()}
    return evaluation.summarise(scores, test, metrics=METRICS, num=50)


def test_another_metric_is_in_the_summary_with_its_interval_and_its_differences(items, summary):
    test, _, predicted = items
    error = np.abs(predicted.pose[:, 2] - test.pose[:, 1, 2])
    own = summary["predictors"]["model"]["height_error"]
    assert own["value"] == pytest.approx(error.mean())
    assert own["low"] < own["value"] < own["high"]
    copied = np.abs(test.pose[:, 0, 2] - test.pose[:, 1, 2]).mean()
    against = summary["differences"]["model"]["copy of the input"]["height_error"]
    assert against["value"] == pytest.approx(error.mean() - copied)
    place = np.linalg.norm(predicted.pose[:, :3] - test.pose[:, 1, :3], axis=-1)
    assert summary["predictors"]["model"]["farthest"]["value"] == pytest.approx(place.max())
    json.dumps(summary)


def test_another_metric_is_a_column_of_both_tables(summary):
    value = 1e3 * summary["predictors"]["model"]["height_error"]["value"]
    text = evaluation.full_table(summary, title="t", metrics=METRICS)
    heads = [line for line in text.splitlines() if line.startswith("| predictor")]
    assert [line.split(" | ")[-2:] for line in heads] == [
        ["height error (mm)", "farthest (mm) |"],
        ["log loss (nats)", "height error (mm) |"],
    ]
    (row,) = [line for line in text.splitlines() if line.startswith("| model | ") and "copy" not in line][:1]
    assert row.split(" | ")[-2].startswith(f"{value:.2f} [")
    assert "Farthest: largest." in text
    columns = (*evaluation.COLUMNS, evaluation.Column("height", (HEIGHT,)))
    (row,) = [
        line for line in evaluation.table(summary, title="t", columns=columns).splitlines() if "| model |" in line
    ]
    assert row.split(" | ")[-1].startswith(f"{value:.2f} [")


def test_other_metrics_are_not_changed(items, summary):
    test, train, predicted = items
    judge = evaluation.scorer(physics.Freefall(), train)
    rows = evaluation.baselines(physics.Freefall(), train, test) | {"model": predicted}
    plain = evaluation.summarise({name: judge(row, test) for name, row in rows.items()}, test, num=50)
    names = [metric.name for metric in evaluation.METRICS]
    assert all(
        {name: own[name] for name in names} == plain["predictors"][predictor]
        for predictor, own in summary["predictors"].items()
    )


def test_a_summary_without_the_metric_is_refused(items):
    test, train, _ = items
    judge = evaluation.scorer(physics.Freefall(), train)
    rows = evaluation.baselines(physics.Freefall(), train, test)
    plain = evaluation.summarise({name: judge(row, test) for name, row in rows.items()}, test, num=2)
    with pytest.raises(ValueError, match="summary lacks 'height_error': pass all metrics of the table to score"):
        evaluation.full_table(plain, title="t", metrics=(HEIGHT,))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: evaluation.Metric("", height_error), "the name of a metric must not be empty: give it a name"),
        (lambda: evaluation.Metric("height"), "'height' has neither `errors` nor `statistic`: give a function"),
        (lambda: evaluation.Metric("height", height_error, digits=-1), "`digits` must be a whole number >= 0, got -1"),
        (
            lambda: evaluation.Metric("height", height_error, compared="up"),
            "must be 'higher', 'lower' or None, got 'up'",
        ),
    ],
)
def test_an_invalid_metric_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_metric_needs_a_name_of_its_own_and_one_number_per_item(items):
    test, train, predicted = items
    with pytest.raises(ValueError, match="metrics has more than one metric named 'position': give each metric its own"):
        evaluation.summarise({}, test, metrics=(*evaluation.METRICS, dataclasses.replace(HEIGHT, name="position")))
    wrong = dataclasses.replace(HEIGHT, errors=lambda predicted, test: predicted.pose)
    with pytest.raises(ValueError, match=r"'height_error': its function `errors` .* \(6, 7\), but .* \(6,\): keep"):
        evaluation.scorer(physics.Freefall(), train, metrics=(wrong,))(predicted, test)


@pytest.mark.slow
@pytest.mark.parametrize("title", ["Another metric", "Another image size"])
def test_the_code_of_the_page_runs(title, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    exec("\n".join(blocks(title)), {"__name__": "page"})
    assert "height error (mm)" in capsys.readouterr().out or title != "Another metric"


@pytest.mark.slow
@pytest.mark.parametrize(("model", "side", "size"), [("statespace", 96, 48), ("paper", 64, 32)])
def test_another_image_size_goes_through_every_stage(model, side, size, tmp_path):
    smoke = freefall.SMOKE
    tiny = dataclasses.replace(
        smoke,
        collection=dataclasses.replace(
            smoke.collection,
            scenario=physics.Freefall(frames=15),
            num_per_object=1,
            num_views=1,
            num_full=0,
            resolution=(side, side),
        ),
        model=model,
        image_size=size,
        steps=(2, 2, 2, 2),
        training=dataclasses.replace(smoke.training, batch_size=4, checkpoint_every=2),
        state_training=dataclasses.replace(smoke.state_training, steps=2, batch_size=4, checkpoint_every=2),
        num_shown=1,
        num_samples=2,
        rerolls=2,
    )
    run.main(tiny, tmp_path)
    predictors = json.loads((tmp_path / "metrics.json").read_text())["predictors"]
    assert predictors["constant (mean training target)"]["visual_skill"]["value"] == 0
    trained = [own for name, own in predictors.items() if "from visual" in name]
    assert trained
    assert all(np.isfinite(own["visual_skill"]["value"]) for own in trained)
    folder = tmp_path / "models" / ("statespace" if model == "statespace" else "mvae")
    found = training.load(folder).config
    sizes = [found.image_size] if model == "statespace" else [m.shape[0] for m in found.modalities if m.kind == "image"]
    assert set(sizes) == {size}
    assert dataset.load(tmp_path / "dataset").collection["resolution"] == [side, side]
