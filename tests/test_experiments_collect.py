"""The command that makes a dataset alone: its options, its words, faults of the disk, and random kills."""

import dataclasses
import re
from pathlib import Path

import native_dataset
import numpy as np
import pytest

import sts_jax as sts
from benchmarks import kills
from experiments import collect, freefall, inclined, perturbed, released
from experiments.shared import datasets, run
from experiments.shared.config import Run
from experiments.shared.terminal import on_one_line
from sts_jax import dataset, evaluation

SMALL = dataset.Collection(
    sts.physics.Freefall(frames=12), num_objects=4, num_per_object=2, num_full=1, objects_per_shard=2
)


@pytest.mark.parametrize(
    ("experiment", "trajectories"), [(freefall, 1700), (inclined, 2400), (perturbed, 2500), (released, 500)]
)
def test_a_preset_is_the_dataset_of_the_experiment(experiment, trajectories):
    scenario = experiment.__name__.rpartition(".")[2]
    for name, preset in experiment.PRESETS.items():
        args = collect.parse(["--scenario", scenario, "--preset", name])
        assert args.collection == preset.collection
    paper = collect.parse(["--scenario", scenario, "--preset", "paper"]).collection
    assert paper.num_trajectories == paper.num_full == trajectories


def test_options_replace_single_fields(monkeypatch, tmp_path):
    made = []
    monkeypatch.setattr(collect, "make", lambda *args, **options: made.append((args, options)))
    words = "--scenario perturbed --preset smoke --num-objects 3 --num-per-object 5 --resolution 1232 1640"
    for frames, full in (("all", 15), ("ends", 0)):
        more = f"--frames {frames} --scenario.rate 20 --process-index 1 --process-count 4 --out {tmp_path}"
        collect.main(collect.parse(f"{words} {more}".split()))
        (one, _, out), options = made.pop()
        assert (one.num_objects, one.num_per_object, one.resolution, one.num_full) == (3, 5, (1232, 1640), full)
        assert one.scenario == sts.physics.Perturbed(rate=20)
        assert out == str(tmp_path)
        assert options == {"process_index": 1, "process_count": 4, "cluster": None, "repair": False}
    with pytest.raises(SystemExit):
        collect.parse(["--scenario", "flight"])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("collect") / "falls"
    datasets.make(SMALL, sts.Sensor(), folder)
    return folder


def test_the_time_is_said_first_and_what_is_finished_is_not_counted(folder, tmp_path, capsys):
    dataset.collect(SMALL, sts.Sensor(), tmp_path, process_index=1, process_count=2)
    datasets.make(SMALL, sts.Sensor(), tmp_path)
    said = capsys.readouterr().err.splitlines()
    assert re.fullmatch(r"collect: 4 trajectories and 18 images, about \d+ (s|min) on this computer", said[0])
    assert said[-1] == "collect: 100%, 8/8 trajectories, 26/26 images"
    datasets.make(SMALL, sts.Sensor(), tmp_path)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(("seconds", "words"), [(12.3, "12 s"), (89, "89 s"), (600, "10 min"), (9000, "2.5 h")])
def test_durations_have_a_fitting_unit(seconds, words):
    assert datasets.duration(seconds) == words


def test_an_experiment_takes_a_finished_dataset_of_another_computer(folder, tmp_path, monkeypatch):
    ran = []
    monkeypatch.setattr(run, "train", lambda one, data, own: ran.append(data.identity))
    monkeypatch.setattr(run, "check", lambda *_: None)
    config = dataclasses.replace(freefall.SMOKE, collection=SMALL)
    source = f"file://{folder}"
    run.main(config, tmp_path / "run", only="train", source=source)
    run.main(config, tmp_path / "run", only="train", source=source)
    run.main(config, tmp_path / "run", only="train")
    assert ran == 3 * [dataset.load(folder).identity]
    assert (tmp_path / "run" / "dataset").resolve() == folder
    other = dataclasses.replace(SMALL, num_per_object=3, seed=7)
    message = (
        r"collected with num_per_object = 2, seed = \d, but the current settings have num_per_object = 3, seed = 7"
    )
    with pytest.raises(ValueError, match=message):
        run.main(dataclasses.replace(config, collection=other), tmp_path / "other", only="train", source=source)
    run.main(config, tmp_path / "other", only="train", source=source)  # the wrong options did not claim the folder
    run.main(config, tmp_path / "clear", only="train", source=source, skin="clear")  # the dataset has its own sensor
    with pytest.raises(ValueError, match=r"collected with room\.\w+ = .*, but the current settings have"):
        run.main(config, tmp_path / "clear", only="collect", source=source, skin="clear")
    dataset.collect(SMALL, sts.Sensor(), tmp_path / "again")
    with pytest.raises(ValueError, match="run/dataset is another dataset than"):
        run.main(config, tmp_path / "run", only="train", source=str(tmp_path / "again"))


def test_a_full_disk_is_named_and_nothing_is_lost(folder, small_disk):
    np.zeros(200_000, np.uint8).tofile(small_disk / "ballast")
    with (
        pytest.raises(SystemExit, match=r"cannot write .*shard-.*Free some disk space"),
        on_one_line(),
    ):
        datasets.make(SMALL, sts.Sensor(), small_disk / "falls")
    (small_disk / "ballast").unlink()
    assert not list((small_disk / "falls").glob(".*partial"))


@pytest.mark.parametrize(
    "processes", [pytest.param(1, marks=pytest.mark.long), pytest.param(2, marks=pytest.mark.slow)]
)
def test_random_kills_of_the_command_leave_the_same_bytes_and_nothing_else(tmp_path: Path, processes):
    result = kills.drill(kills.Args(kills=5, processes=processes), tmp_path)
    assert result.kills >= 5
    assert result.inside >= 2
    assert (result.different, result.left_over) == (0, 0)
    assert result.datasets >= 1


@pytest.mark.parametrize("split", ["object", "trajectory"])
def test_no_held_out_trajectory_is_in_the_training_of_the_state_space_model(tmp_path, monkeypatch, split):
    native_dataset.write(tmp_path / "native")
    data, given = dataset.load(tmp_path / "native"), []
    monkeypatch.setattr(run, "jobs", lambda *args: given.append(args) or iter(()))
    run.train(Run(perturbed.SMOKE, tmp_path, sts.Sensor(), split), data)
    ((_, _, pairs, _, falls, _),) = given
    test = evaluation.rows_of(data, split)["test"]
    assert test.size
    assert not set(test) & {*pairs.trajectory, *falls.trajectory}
    assert set(falls.trajectory) - set(pairs.trajectory)  # also those without images
    left = set(evaluation.rows_of(data, split)["train"]) - set(pairs.trajectory)
    assert bool(left) == (split == "trajectory")  # they calibrate the model
    assert not left & set(falls.trajectory)
