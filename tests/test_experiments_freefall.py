"""All stages with the paper's models at the smallest size, resumed and with errors, and the resulting predictors."""

import dataclasses
import json
import shutil

import jax
import numpy as np
import pytest
from statespace_config import Killed

import sts_jax as sts
from experiments import freefall
from experiments.shared import config, evaluate, run
from sts_jax import dataset, evaluation, physics, storage

pytestmark = pytest.mark.slow

TINY = dataclasses.replace(
    freefall.SMOKE,
    collection=dataclasses.replace(
        freefall.SMOKE.collection, scenario=physics.Freefall(frames=15), num_objects=16, num_per_object=1
    ),
    model="paper",
    steps=(2, 2, 2, 2),
    training=dataclasses.replace(freefall.SMOKE.training, batch_size=4, checkpoint_every=2),
    num_shown=2,
    rerolls=2,
)


@pytest.fixture(scope="module")
def workdir(tmp_path_factory):
    workdir = tmp_path_factory.mktemp("runs") / "freefall"
    run.main(TINY, workdir)
    return workdir


def test_the_work_directory_has_the_documented_files(workdir):
    names = {path.relative_to(workdir).as_posix() for path in workdir.rglob("*")}
    assert {"config.json", "dataset", "metrics.json", "table.md", "table-full.md", "manifest.json"} <= names
    assert {f"models/{name}/metrics.jsonl" for name in config.MODELS["paper"]} <= names
    assert {f"figures/{name}.png" for name in ("predictions", "predictions-all", "training", "strip")} <= names
    predictors = json.loads((workdir / "metrics.json").read_text())["predictors"]
    main = [
        *("ceiling (mean of re-rolls)", "constant (mean training target)", "copy of the input", "nearest neighbour"),
        *("rests below its start", *(f"MVAE with pose, from {given}" for given in ("visual", "all inputs", "pose"))),
    ]
    others = {"VAE tactile only, no input: the first touch is always blank", "MVAE without pose, from visual"}
    assert {*main, *others, "VAE visual only, from visual", "one re-roll"} <= set(predictors)
    assert predictors["constant (mean training target)"]["visual_skill"]["value"] == 0
    complete = (workdir / "table-full.md").read_text()
    assert all(name in complete for name in predictors)
    rows = [line.split(" | ")[0] for line in (workdir / "table.md").read_text().splitlines() if line[:2] == "| "]
    assert rows[1:] == [f"| {name}" for name in main]


def test_a_second_run_leaves_finished_results_unchanged(workdir):
    stamps = {path: path.stat().st_mtime_ns for path in workdir.rglob("*") if path.is_file()}
    run.main(TINY, workdir)
    assert stamps == {path: path.stat().st_mtime_ns for path in workdir.rglob("*") if path.is_file()}


def test_stale_results_are_computed_again(workdir, capsys, monkeypatch):
    def kill(*_):
        raise Killed

    metrics, table = workdir / "metrics.json", workdir / "table.md"
    before = metrics.read_text(), table.read_text()
    table.write_text("rubbish")
    (workdir / "figures" / "strip.png").unlink()
    run.main(TINY, workdir)
    assert (metrics.read_text(), table.read_text()) == before
    assert (workdir / "figures" / "strip.png").exists()
    said = capsys.readouterr()
    assert "evaluate: again, because " in said.err
    assert "table.md is not the file that manifest.json lists" in said.err
    assert all(f"\n{name}: " in said.out for name in ("tables", "figures", "next"))
    assert max(map(len, said.out.splitlines())) <= 120 + len(str(workdir))
    assert sum(line.startswith("MVAE with pose, from ") for line in said.out.splitlines()) == 3

    log = workdir / "models" / "mvae" / "metrics.jsonl"  # as another training would leave another one
    old = log.read_bytes()
    log.write_bytes(old + b'{"step": 2, "loss": 1.0}\n')
    with monkeypatch.context() as patch:
        patch.setattr(evaluate, "_pairs", kill)
        with pytest.raises(Killed):
            run.main(TINY, workdir)
    assert "evaluate: again, because models/mvae has changed since\n" in capsys.readouterr().err
    log.write_bytes(old)
    run.main(TINY, workdir)  # nothing is stale
    assert "again" not in capsys.readouterr().err


def test_a_model_is_never_scored_on_its_training_data(workdir, tmp_path):
    copy = shutil.copytree(workdir, tmp_path / "copy")
    path = copy / "dataset/split.json"
    split = json.loads(path.read_text())
    split["train"][0], split["test"][0] = split["test"][0], split["train"][0]
    path.write_text(json.dumps(split))
    with pytest.raises(storage.DamagedFileError, match=r"split\.json is not the file"):
        run.main(TINY, copy, only="evaluate")
    listed = storage.read_manifest(copy / "dataset", "")
    storage.write_manifest(copy / "dataset", storage.checksums(copy / "dataset", listed.files), listed.facts)
    with pytest.raises(ValueError, match=r"models/mvae was trained with another split .*restore its split\.json"):
        run.main(TINY, copy, only="evaluate")


def test_another_configuration_is_refused(workdir):
    other = dataclasses.replace(TINY, steps=(3, 2, 2, 2))
    with pytest.raises(ValueError, match=r"config\.json was made with steps = \[2, 2, 2, 2\]"):
        run.main(other, workdir)


def test_the_documented_calls_run(workdir):
    body, sensor = sts.objects.make(jax.random.key(0), "bottle"), sts.Sensor()
    traj = sts.physics.simulate(jax.random.key(1), body, sensor, sts.physics.Freefall(), num=4)
    pose, wrench = traj.pose[0, -1], traj.wrench[0, -1]
    frame = sts.sense(sensor, body, pose, wrench, resolution=(64, 64), crop=False)
    predict = sts.Predictor.load(workdir / "models/mvae")
    out = predict(visual=frame.visual)
    assert out.visual.shape == out.tactile.shape == (64, 64, 3)
    assert out.pose.shape == (7,)
    with pytest.raises(ValueError, match="cannot use tactile"):
        predict(tactile=frame.tactile)


def test_the_split_of_the_paper_holds_out_a_fifth_of_the_trajectories(workdir):
    rows = evaluation.rows_of(dataset.load(workdir / "dataset"), "trajectory")
    assert len(rows["test"]) == round(0.2 * 16)
    np.testing.assert_array_equal(np.sort(np.concatenate([rows["train"], rows["test"]])), np.arange(16))
