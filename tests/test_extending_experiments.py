"""A whole experiment with another loss, optimiser, logger, metric and modality, as `docs/extending.md` shows."""

import dataclasses
import json

import numpy as np
import pytest
from extending_page import blocks

import sts_jax as sts
from experiments import freefall, inclined
from experiments.shared import run
from experiments.shared.config import Extensions
from sts_jax import dataset, evaluation, physics


def tiny(smoke, scenario, **changes):
    """The smallest experiment that runs all stages."""
    collection = dataclasses.replace(
        smoke.collection, scenario=scenario, num_per_object=1, num_views=1, num_full=0, resolution=(64, 64)
    )
    return dataclasses.replace(
        smoke,
        collection=collection,
        image_size=32,
        steps=(2, 2, 2, 2),
        training=dataclasses.replace(smoke.training, batch_size=4, checkpoint_every=2),
        state_training=dataclasses.replace(smoke.state_training, steps=2, batch_size=4, checkpoint_every=2),
        num_shown=1,
        num_samples=2,
        rerolls=2,
        **changes,
    )


def records(folder):
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


@pytest.mark.slow
def test_the_code_of_the_page_runs_an_experiment_with_its_own_parts(tmp_path, capsys):
    names = {}
    exec("\n".join(blocks("A whole experiment with your own parts")), names)
    own, config = names["own"], tiny(freefall.SMOKE, physics.Freefall(frames=15))
    run.main(config, tmp_path, own=own)
    logged = records(tmp_path / "models/statespace")
    assert all(record["penalty"] > 0 for record in logged)
    printed = capsys.readouterr().out
    for record in logged:
        assert f"statespace {record['step']} {record['loss']}" in printed
    assert "farthest (mm)" in (tmp_path / "table.md").read_text()
    settings = json.loads((tmp_path / "models/statespace/config.json").read_text())
    assert settings["notes"] == {"optimiser": "AdamW, 1e-3"}
    assert (settings["loss"], settings["optimiser"]) == ("given as loss=", "given as optimiser=")

    # The rows without a model follow from the dataset.
    data = dataset.load(tmp_path / "dataset")
    rows = evaluation.rows_of(data)
    ends = data.ends(rows["test"]).pose
    summary = json.loads((tmp_path / "metrics.json").read_text())["predictors"]
    copy = np.abs(ends[:, 0, :3] - ends[:, 1, :3]).max(1).mean()
    assert summary["copy of the input"]["farthest"]["value"] == pytest.approx(copy, rel=1e-5)
    assert summary[evaluation.ONE_REROLL]["farthest"]["value"] > 0

    written = (tmp_path / "metrics.json").stat().st_mtime_ns
    run.main(config, tmp_path, own=own)
    assert (tmp_path / "metrics.json").stat().st_mtime_ns == written
    capsys.readouterr()
    run.main(config, tmp_path, only="evaluate")
    assert "again, because the list of metrics has changed" in "".join(capsys.readouterr())
    assert "farthest" not in json.loads((tmp_path / "metrics.json").read_text())["predictors"]["copy of the input"]
    with pytest.raises(ValueError, match=r"loss = 'given as loss='"):
        run.main(config, tmp_path, only="train")


@pytest.mark.slow
def test_an_experiment_trains_and_scores_a_further_modality(tmp_path):
    def forces(data, trajectories):
        return data.trajectory["wrench"][trajectories][:, [0, -1], :3]

    force = dataset.Measurement("force", (3,), forces, unit="N")
    config = tiny(inclined.SMOKE, physics.Inclined(frames=15), model="paper")
    run.main(config, tmp_path, own=Extensions(measurements=(force,)))
    assert sts.Predictor.load(tmp_path / "models/mvae").modalities == ("visual", "tactile", "pose", "force")
    assert sts.Predictor.load(tmp_path / "models/vae-visual").modalities == ("visual",)
    data = dataset.load(tmp_path / "dataset")
    truth = forces(data, evaluation.rows_of(data)["test"])
    summary = json.loads((tmp_path / "metrics.json").read_text())["predictors"]
    copy = np.linalg.norm(truth[:, 1] - truth[:, 0], axis=1).mean()
    assert summary["copy of the input"]["force_error"]["value"] == pytest.approx(copy, rel=1e-5)
    assert summary["MVAE with pose, from force"]["force_error"]["value"] > 0
    assert summary["VAE visual only, from visual"]["force_error"] is None
    assert "force error (N)" in (tmp_path / "table-full.md").read_text()
    with pytest.raises(ValueError, match=r"names in measurements are .*mvae was trained with \['force'\]"):
        run.main(config, tmp_path, only="evaluate")


def test_a_further_modality_of_a_state_space_model_is_refused_before_anything_is_collected(tmp_path):
    force = dataset.Measurement("force", (3,), lambda data, rows: None)
    with pytest.raises(ValueError, match="measurements must be empty for model='statespace', got the modality 'force'"):
        run.main(freefall.SMOKE, tmp_path / "run", own=Extensions(measurements=(force,)))
    assert not (tmp_path / "run").exists()


def test_wrong_metrics_and_columns_are_named():
    metric = evaluation.Metric("height", lambda predicted, test: None)
    with pytest.raises(ValueError, match="metrics has more than one metric named 'height'"):
        Extensions(metrics=(metric, metric))
    with pytest.raises(ValueError, match=r"'h' has the metric 'height', which is not among .* \('visual_bce', "):
        Extensions(columns=(evaluation.Column("h", (metric,)),))
