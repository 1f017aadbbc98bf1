"""A model of a work directory becomes a model of the library and replaces an earlier one, unless it is refused."""

import re
import shutil

import numpy as np
import pytest
from statespace_config import STATE, state_model

import sts_jax as sts
from experiments import ship


@pytest.fixture
def models(tmp_path, monkeypatch):
    """The library's folder of models, of which there are none."""
    monkeypatch.setattr(ship, "MODELS", tmp_path / "library")
    monkeypatch.setattr("sts_jax.predict.MODELS", tmp_path / "library")
    monkeypatch.chdir(tmp_path)
    return tmp_path / "library"


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    workdir = tmp_path_factory.mktemp("runs") / "falls"
    state_model().save(workdir / "models/statespace")
    return workdir


@pytest.fixture
def workdir(trained, tmp_path):
    return shutil.copytree(trained, tmp_path / "runs/falls")


def content(folder):
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.slow
def test_a_shipped_model_is_loaded_by_its_name_and_replaced_by_the_next(models, workdir):
    line = ship.ship(workdir, "falls")
    assert re.fullmatch(r"falls: 0\.\d MB of at most 12", line)
    assert sts.Predictor.load("falls").model.config == STATE
    files = content(models / "falls")
    assert sorted(files) == ["blank.npz", "checkpoints/00000000/weights.npz", "config.json", "manifest.json"]
    (models / "falls" / "old").write_text("")
    assert ship.ship(workdir, "falls") == line
    assert content(models / "falls") == files
    assert [path.name for path in models.iterdir()] == ["falls"]


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["size", "damage", "absence"])
def test_an_earlier_model_stays_if_the_new_one_is_refused(models, workdir, monkeypatch, fault):
    (models / "falls").mkdir(parents=True)
    (models / "falls" / "config.json").write_text("earlier")
    model = workdir / "models/statespace"
    if fault == "size":
        monkeypatch.setattr(ship, "LIMIT", 100_000)
        error, message = ValueError, r"the model of .*falls has 0\.\d MB, but the limit is 0\.1 MB"
    elif fault == "damage":
        np.savez(model / "blank.npz", visual=np.zeros(1), tactile=np.zeros(1))
        error, message = OSError, r"blank\.npz is not the file"
    else:
        model.rename(workdir / "elsewhere")
        error, message = FileNotFoundError, r"statespace has no config\.json"
    with pytest.raises(error, match=message):
        ship.ship(workdir, "falls")
    assert content(models) == {"falls/config.json": b"earlier"}
    assert [path.name for path in models.iterdir()] == ["falls"]


@pytest.mark.parametrize("name", ["..", "runs/falls", "free fall"])
def test_a_name_with_other_characters_is_refused(models, tmp_path, name):
    with pytest.raises(ValueError, match="must be letters, digits and underscores"):
        ship.ship(tmp_path, name)
