"""Experiments with another metric, image size and modality, as the pages show."""

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


def tiny(smoke, scenario, resolution=(64, 64), **changes):
    """The smallest experiment that runs all stages."""
    collection = dataclasses.replace(
        smoke.collection, scenario=scenario, num_per_object=1, num_views=1, num_full=0, resolution=resolution
    )
    fields = {
        "collection": collection,
        "image_size": 32,
        "steps": (2, 2, 2, 2),
        "training": dataclasses.replace(smoke.training, batch_size=4, checkpoint_every=2),
        "state_training": dataclasses.replace(smoke.state_training, steps=2, batch_size=4, checkpoint_every=2),
        "num_shown": 1,
        "num_samples": 2,
        "rerolls": 2,
    }
    return dataclasses.replace(smoke, **(fields | changes))


def summary(folder):
    return json.loads((folder / "metrics.json").read_text())["predictors"]


@pytest.mark.slow
@pytest.mark.parametrize("title", ["Another metric", "Another image size"])
def test_the_code_of_the_page_runs(title, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    exec("\n".join(blocks(title)), {"__name__": "page"})
    assert "height error (mm)" in capsys.readouterr().out or title != "Another metric"


@pytest.mark.long
def test_an_experiment_trains_and_scores_a_further_modality(tmp_path):
    def forces(data, trajectories):
        return data.trajectory["wrench"][trajectories][:, [0, -1], :3]

    force = dataset.Measurement("force", (3,), forces, unit="N")
    config = tiny(inclined.SMOKE, physics.Inclined(frames=15), model="paper")
    run.main(config, tmp_path, own=Extensions(measurements=(force,)))
    assert sts.Predictor.load(tmp_path / "models/mvae").modalities == ("visual", "tactile", "pose", "force")
    data = dataset.load(tmp_path / "dataset")
    truth = forces(data, evaluation.rows_of(data)["test"])
    predictors = summary(tmp_path)
    copy = np.linalg.norm(truth[:, 1] - truth[:, 0], axis=1).mean()
    assert predictors["copy of the input"]["force_error"]["value"] == pytest.approx(copy, rel=1e-5)
    assert predictors["MVAE with pose, from force"]["force_error"]["value"] > 0
    assert predictors["VAE visual only, from visual"]["force_error"] is None
    assert "force error (N)" in (tmp_path / "table-full.md").read_text()
    with pytest.raises(ValueError, match=r"contains 'force', but `test\.measurements` does not"):
        run.main(config, tmp_path, only="evaluate")


FORCE = dataset.Measurement("force", (3,), lambda data, rows: None)


def test_a_modality_that_the_model_cannot_have_is_refused_before_anything_is_collected(tmp_path):
    with pytest.raises(ValueError, match="measurements must be empty for model='statespace', got the modality 'force'"):
        run.main(freefall.SMOKE, tmp_path / "run", own=Extensions(measurements=(FORCE,)))
    assert not (tmp_path / "run").exists()
