"""A model of a work directory becomes a model of the library and replaces an earlier one, unless it is refused."""

import dataclasses
import re
import shutil

import jax
import made_up_dataset
import numpy as np
import pytest
from flax import nnx
from statespace_config import STATE, state_model, untrained

import sts_jax as sts
from experiments import ship
from sts_jax import statespace, storage, training


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


@pytest.mark.slow
def test_the_copy_is_calibrated_on_another_dataset(models, tmp_path, monkeypatch):
    workdir, folder, collection = tmp_path / "runs/falls", tmp_path / "others", made_up_dataset.COLLECTION
    monkeypatch.setattr(made_up_dataset, "SIZE", STATE.input_size)
    monkeypatch.setattr(
        made_up_dataset, "COLLECTION", dataclasses.replace(collection, resolution=(STATE.input_size,) * 2)
    )
    original = untrained(dataclasses.replace(STATE, outcomes=4), condition_scale=(1.0, 1.0, 1.0))
    original.save(workdir / "models/statespace")
    made_up_dataset.write(folder)
    ship.ship(workdir, "falls", folder)
    assert ".lock" not in content(models / "falls")
    got = sts.Predictor.load("falls").model
    data = sts.dataset.load(folder)
    empty = {name: np.round(255 * image).astype(np.uint8) for name, image in original.empty.items()}
    arrays = training.state_arrays(
        data.pairs(data.rendered()), got.config, collection.scenario, original.preprocessing, empty
    )
    params, _ = nnx.split_state(got.state, nnx.Param, nnx.BatchStat)
    expected = statespace.fit_calibration(
        got.graphdef, params, arrays.inputs, arrays.targets, empty, condition=arrays.condition
    )
    for one, other in zip(jax.tree.leaves(got.calibration), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4)
    assert np.ptp(got.calibration.variance) > 0.1
    files, trained = content(models / "falls"), dataclasses.asdict(collection)
    for change, message in (
        ({}, r"others has the seed 3 of the training objects.* with another seed"),
        ({"scenario": {**trained["scenario"], "frames": 99}}, r"others: the model has frames = 99, .* same scenario"),
    ):
        storage.write_json(workdir / "config.json", {"collection": trained | change})
        with pytest.raises(ValueError, match=message):
            ship.ship(workdir, "falls", folder)
    assert content(models / "falls") == files


@pytest.mark.parametrize("name", ["..", "runs/falls", "free fall"])
def test_a_name_with_other_characters_is_refused(models, tmp_path, name):
    with pytest.raises(ValueError, match="must be letters, digits and underscores"):
        ship.ship(tmp_path, name)
