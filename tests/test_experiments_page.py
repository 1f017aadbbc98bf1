"""The code of `docs/experiments.md` that uses the stages of an experiment in Python."""

import dataclasses

import numpy as np
import pytest
from extending_page import blocks

from experiments import freefall
from experiments.shared import run

SMALLER = (
    ("num_objects=400,", "num_objects=12,"),
    ("num_objects=40,", "num_objects=12,"),
    ("num_rendered=2,", "num_rendered=2, num_per_object=3,"),
    ("num_per_object=4)", "num_per_object=1, num_full=0)"),
    ("steps=1900, batch_size=32,", "steps=8, batch_size=8,"),  # as in the preset smoke, which shares the program
    ("warmup=150,", "warmup=0,"),
    ("steps=500, batch_size=16", "steps=2, batch_size=4"),
)


@pytest.mark.slow
def test_the_code_of_the_page_trains_both_kinds_of_models_as_the_experiments_do(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    code = blocks("Use the stages in Python", "experiments")
    for old, new in SMALLER:
        assert sum(block.count(old) for block in code) == 1, old
        code = [block.replace(old, new) for block in code]
    names = {}
    exec(code[0], names)
    schedule = dataclasses.replace(names["config"], steps=1900, batch_size=32, warmup=150)
    assert schedule == freefall.DEFAULT.state_training

    config = dataclasses.replace(freefall.DEFAULT, collection=names["collection"])
    data = names["data"]
    falls = data.ends(data.members("train", rendered=False))
    pairs = data.pairs(data.members("train"))
    (job,) = run.jobs(config, names["sensor"], pairs, data.views("train"), falls)
    assert job.model == names["model"]
    assert job.preprocessing == names["preprocessing"]
    assert job.arrays.checksum() == names["arrays"].checksum()
    assert len(job.arrays.views["visual"]) > 0
    assert len(job.arrays.falls["pose"]) > len(job.arrays.targets["pose"])

    predict, prediction = names["predict"], names["prediction"]
    assert predict.model.calibration is not None
    assert predict.modalities == ("visual", "pose")
    assert np.isfinite(prediction.pose).all()
    np.testing.assert_allclose(prediction.outcome_probability.sum(1), 1, rtol=1e-5)
    assert str(predict.outcomes) in capsys.readouterr().out

    exec("\n".join(code[1:]), names)
    assert names["predict"].modalities == ("visual", "pose")
    printed = capsys.readouterr().out
    assert all(given in printed for given in ("Held-out objects", "from visual", "from pose", "from all inputs"))
