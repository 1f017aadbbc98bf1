"""The command `real` without a sub-command: Table 2 from recorded trajectories."""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from recorded_session import record

import sts_jax as sts
from experiments import real
from experiments.shared import evaluate, table2
from experiments.shared.collecting import Collect
from experiments.shared.config import MODELS
from experiments.shared.table2 import Train
from sts_jax import hardware, training

TINY = dataclasses.replace(real.SMOKE, steps=(1, 1, 1), count=6, shifts=1, largest_shift=3)


def test_options_without_a_sub_command_are_those_of_train():
    for words in ([], ["--preset", "default"], ["train"], ["train", "--preset", "default"]):
        found = real.parse(words)
        assert isinstance(found, Train)
        assert found.config == real.DEFAULT
    small = real.parse(["--preset", "smoke", "--count", "7", "--training.batch-size", "2"])
    assert small.config == dataclasses.replace(
        real.SMOKE, count=7, training=dataclasses.replace(real.SMOKE.training, batch_size=2)
    )
    assert isinstance(real.parse(["collect", "--twin"]), Collect)


def test_trajectories_of_a_device_are_split_by_trajectory_and_read_in_the_order_of_their_numbers(tmp_path):
    record(tmp_path / "work", 10)
    data = table2.read(TINY, tmp_path / "work")
    assert len(data.train.number) == 8
    assert sorted([*data.train.number, *data.validation.number]) == list(range(10))
    assert data.source == "the sensor camera"
    assert table2.missing(TINY, tmp_path / "work") == 0  # although there are fewer than count
    again = table2.read(TINY, tmp_path / "work")
    np.testing.assert_array_equal(again.validation.visual, data.validation.visual)
    other = table2.read(dataclasses.replace(TINY, seed=1), tmp_path / "work")
    assert other.validation.number.tolist() != data.validation.number.tolist()
    assert other.identity == data.identity
    with hardware.Session(tmp_path / "work" / "dataset") as session:
        session.discard(3)
    assert table2.read(TINY, tmp_path / "work").identity != data.identity


def test_the_source_of_a_twin_is_named_and_its_collection_continues_with_its_seed(tmp_path):
    assert table2.twin_seed(tmp_path / "work") == 0
    record(tmp_path / "work", 5, leds="TWIN31")
    assert table2.read(TINY, tmp_path / "work").source == "a digital twin"
    assert table2.twin_seed(tmp_path / "work") == 31


def test_missing_trajectories_and_sensor_files_are_errors_with_a_remedy(tmp_path):
    with pytest.raises(FileNotFoundError, match="holds no session"):
        table2.read(TINY, tmp_path)
    record(tmp_path / "few", 3)
    with pytest.raises(ValueError, match="must be >= 5, got 3: collect more"):
        table2.read(TINY, tmp_path / "few")
    record(tmp_path / "bare", 5, sensor_file=False)
    with pytest.raises(FileNotFoundError, match=r"sensor\.json"):
        table2.read(TINY, tmp_path / "bare")
    hardware.Device.load(tmp_path / "few").save(tmp_path / "bare", sts.Sensor())
    with pytest.raises(ValueError, match=r"has no images of the empty pad.*experiments\.commission"):
        table2.read(TINY, tmp_path / "bare")


@pytest.mark.parametrize(
    ("field", "value"),
    [("held_out", 1.0), ("num_shown", 0), ("count", 4), ("largest_shift", 64), ("shifts", -1), ("image_size", 50)],
)
def test_a_field_out_of_range_is_refused_before_anything_is_collected(field, value):
    with pytest.raises(ValueError, match=field if field != "image_size" else "50"):
        table2.check(dataclasses.replace(TINY, **{field: value}))


def test_copies_move_both_streams_alike_and_the_resting_moment_is_an_input_too(tmp_path):
    record(tmp_path / "work", 5)
    data = table2.read(TINY, tmp_path / "work")
    job = next(job for job in table2.jobs(TINY, data) if job.name == "mvae-without-pose")
    inputs, targets, count = job.arrays.inputs, job.arrays.targets, len(data.train.number)
    assert len(job.arrays) == 4 * count

    def centres(images):
        dark = np.abs(images[..., 0].astype(int) - data.empty["visual"][..., 0]) > 25
        return np.array([np.argwhere(own).mean(0) for own in dark])

    first, last = (centres(images[: 2 * count]) for images in (inputs["visual"], targets["visual"]))
    np.testing.assert_allclose(last - first, [[10, 0]] * 2 * count, atol=1)
    felt = centres(inputs["tactile"][: 2 * count])
    np.testing.assert_allclose(felt, first, atol=1)
    assert np.abs(first[count:] - first[:count]).max() > 0.9  # the copies have moved
    np.testing.assert_array_equal(inputs["visual"][2 * count :], targets["visual"][: 2 * count])
    np.testing.assert_array_equal(targets["visual"][2 * count :], targets["visual"][: 2 * count])


def test_trajectories_without_any_contact_are_an_error(tmp_path):
    record(tmp_path / "work", 5)
    data = table2.read(TINY, tmp_path / "work")
    blank = np.broadcast_to(data.empty["tactile"], data.train.tactile.shape).copy()
    data = data._replace(train=data.train._replace(tactile=blank))
    with pytest.raises(ValueError, match="none of the initial tactile images for training shows a contact"):
        list(table2.jobs(TINY, data))


@pytest.mark.slow
def test_the_models_are_trained_judged_and_resumed_on_a_device_without_adding_trajectories(tmp_path, capsys):
    work = tmp_path / "work"
    record(work, 6)
    real.main(Train(TINY, work))
    printed, table = capsys.readouterr().out, (work / "table2" / "table.md").read_text()
    assert "6 trajectories, 5 for training and 1 for validation" in table
    assert "[-] stands for no interval, because only one trajectory is held out" in table
    assert "1 held-out trajectories of the sensor camera" in printed
    assert f"figures: {work / 'table2' / 'figures'}" in printed
    assert len(hardware.load_recordings(work / "dataset")) == 6
    assert {path.name for path in (work / "table2" / "figures").iterdir()} == {"predictions.png", "training.png"}

    images = table2.read(TINY, work)
    first = images.validation.visual[:, 0].astype(np.float32) / 255
    numbers = json.loads((work / "table2" / "metrics.json").read_text())
    predictors = {name: sts.Predictor.load(work / "table2" / "models" / name) for name in table2.NAMES}
    assert {name: predict.modalities for name, predict in predictors.items()}.items() <= MODELS["paper"].items()
    assert all(predict.preprocessing.touch_level for predict in predictors.values())
    target = images.validation.visual[:, 1] / 255
    guess = np.clip(np.asarray(predictors["vae-visual"](visual=first).visual), 1 / 510, 1 - 1 / 510)
    bce = -(target * np.log(guess) + (1 - target) * np.log1p(-guess)).mean()
    assert numbers["visual"]["predictors"]["VAE visual only"]["bce"]["value"] == pytest.approx(bce, rel=1e-4)

    identities = {name: evaluate.identity(work / "table2" / "models" / name) for name in table2.NAMES}
    written = (work / "table2" / "metrics.json").stat().st_mtime_ns
    real.main(Train(TINY, work))
    assert (work / "table2" / "metrics.json").stat().st_mtime_ns == written
    (work / "table2" / "table.md").unlink()
    assert table2.evaluate(TINY, images, work, work / "table2") in printed
    assert (work / "table2" / "table.md").read_text() == table
    assert identities == {name: evaluate.identity(work / "table2" / "models" / name) for name in table2.NAMES}

    with hardware.Session(work / "dataset") as session:
        session.discard(2)
    with pytest.raises(SystemExit, match=r"table2/config.json was made with trajectories.*choose another folder"):
        real.main(Train(TINY, work))
    real.main(Train(TINY, work, name="second"))
    assert (work / "second" / "table.md").exists()


@pytest.mark.slow
def test_the_smoke_preset_collects_with_the_twin_and_writes_the_table(tmp_path):
    root = str(Path(__file__).parents[1])
    path = os.pathsep.join([root, os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, "-m", "experiments.real", "--preset", "smoke", "--workdir", str(tmp_path / "work")]
    done = subprocess.run(
        command, cwd=root, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True, timeout=1800
    )
    assert done.returncode == 0, done.stderr
    assert "a digital twin" in done.stdout
    assert "VAE visual only" in done.stdout
    assert len(hardware.load_recordings(tmp_path / "work" / "dataset")) == real.SMOKE.count
    blank = training.load_blank(tmp_path / "work" / "table2" / "models" / "vae-visual")
    assert blank[0].shape == (64, 64, 3)
