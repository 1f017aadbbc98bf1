"""Another metric and another image size, from outside the library, as `docs/extending.md` describes."""

import dataclasses
import json

import numpy as np
import pytest
from extending_page import blocks

from experiments import freefall
from experiments.shared import run
from sts_jax import dataset, physics, training


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
