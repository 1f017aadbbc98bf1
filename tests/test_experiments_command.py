"""Presets, the effect of options on them, checks before any work, and the record of results. No experiment is run."""

import dataclasses
import os
import re
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
import trimesh

import sts_jax as sts
from experiments import fit, freefall, inclined, objects, perturbed, released, sense, show
from experiments.shared import config, evaluate, run, terminal
from sts_jax import compilation, dataset, physics, storage, training

EXPERIMENTS = {"freefall": freefall, "inclined": inclined, "perturbed": perturbed, "released": released}
PRESETS = {f"{name}-{key}": one for name, experiment in EXPERIMENTS.items() for key, one in experiment.PRESETS.items()}


def changed(preset=freefall.SMOKE, collection=None, **fields):
    return dataclasses.replace(
        preset, collection=dataclasses.replace(preset.collection, **(collection or {})), **fields
    )


def smoke_of_few(experiment):
    """The preset `smoke` of an experiment, with shares for which four objects are enough."""
    return changed(experiment.SMOKE, {"shares": (0.5, 0.25, 0.25)})


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Four bottles and three boxes."""
    for label, count in (("bottle", 4), ("box", 3)):
        (tmp_path / "meshes" / label).mkdir(parents=True)
        for i in range(count):
            side = 0.03 + 0.005 * i
            mesh = trimesh.creation.box((side, 0.04, 0.05)) if label == "box" else trimesh.creation.cylinder(side, 0.06)
            mesh.export(tmp_path / "meshes" / label / f"{i}.stl")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "meshes"


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_can_be_run(name):
    config.check(PRESETS[name])


@pytest.mark.parametrize(
    ("experiment", "classes", "trajectories"),
    [
        (freefall, sts.objects.CATEGORIES, 1700),
        (inclined, sts.objects.CATEGORIES, 2400),
        (perturbed, ("bottle",), 2500),
        (released, ("camera",), 500),
    ],
)
def test_the_preset_paper_has_the_counts_of_the_paper(experiment, classes, trajectories):
    for one, held_out in ((experiment.DEFAULT, 24), (experiment.LONG, 24), (experiment.PAPER, 60)):
        assert len(dataset.split_objects(one.collection)["test"]) >= held_out
        assert set(dataset.class_names(one.collection)) == set(classes)
    paper, schedule = experiment.PAPER.collection, experiment.PAPER.training
    assert paper.num_trajectories == paper.num_full == trajectories
    assert (paper.scenario.frames, paper.crop) == (60, True)
    assert (schedule.epochs, schedule.batch_size, schedule.beta_warmup) == (200, 64, 50 / 200)
    assert (experiment.PAPER.targets, experiment.PAPER.splits) == ("own", ("trajectory", "object"))
    model = training.paper_model(config.MODELS["paper"]["mvae"], experiment.PAPER.preprocessing)
    assert [(m.weight, m.shape) for m in model.modalities] == [(1, (64, 64, 3)), (1, (64, 64, 3)), (1000, (7,))]
    equation_10 = {"encode_condition": experiment.PAPER.encode_condition, "prior": experiment.PAPER.prior}
    assert equation_10 == {"encode_condition": True, "prior": "conditional"}
    model = training.paper_model(("visual",), experiment.PAPER.preprocessing, **equation_10)
    depends = experiment is perturbed  # the only scenario with a condition
    assert (model.encode_condition, model.prior == "conditional") == (depends, depends)


def test_options_reach_the_experiment(tmp_path, monkeypatch):
    ran = []
    monkeypatch.setattr(
        run, "main", lambda config, workdir, only, skin, source: ran.append((config, workdir, only, skin))
    )
    options = ["--hidden", "off", "--classes", "fork", "bottle", "--parts", "--skin", "clear"]
    monkeypatch.setattr("sys.argv", ["freefall", *options])
    run.command(freefall.PRESETS, str(tmp_path), "What it does.")
    other = ["--preset", "smoke", "--workdir", str(tmp_path / "other"), "--only", "train"]
    monkeypatch.setattr("sys.argv", ["freefall", *other])
    run.command(freefall.PRESETS, str(tmp_path), None)
    scenario = physics.variant(physics.Freefall(), "off")
    asked = changed(freefall.DEFAULT, {"scenario": scenario, "categories": ("fork", "bottle"), "parts": True})
    assert ran == [(asked, tmp_path, None, "clear"), (freefall.SMOKE, tmp_path / "other", "train", "hazy")]
    assert list(tmp_path.iterdir()) == []


def parsed(monkeypatch, *options: str) -> run.Args:
    monkeypatch.setattr("sys.argv", ["experiment", *options])
    return run.parse(freefall.PRESETS, "runs/experiment", None)


def test_any_field_of_a_preset_can_be_changed(monkeypatch, capsys):
    args = parsed(
        monkeypatch,
        *("--collection.num-objects", "1000", "--state-training.learning-rate", "1e-3", "--image-size", "32"),
        *("--collection.scenario.height", "0.07", "--collection.scenario.contact.soft", "0.1"),
        *("--collection.num-rendered", "None", "--splits", "trajectory", "object"),
        *("--preset", "smoke"),
    )
    smoke, scenario = freefall.SMOKE, freefall.SMOKE.collection.scenario
    scenario = dataclasses.replace(scenario, height=0.07, contact=dataclasses.replace(scenario.contact, soft=0.1))
    expected = changed(
        smoke,
        {"num_objects": 1000, "scenario": scenario, "num_rendered": None},
        state_training=dataclasses.replace(smoke.state_training, learning_rate=1e-3),
        image_size=32,
        splits=("trajectory", "object"),
    )
    assert (args.config, args.preset) == (expected, "smoke")
    assert parsed(monkeypatch).config == freefall.DEFAULT
    assert capsys.readouterr().err == ""


def test_options_of_a_model_that_is_not_trained_are_noted(monkeypatch, capsys):
    parsed(monkeypatch, "--training.learning-rate", "1e-3")
    assert capsys.readouterr().err == "note: --training.* has no effect, because --model statespace is trained\n"
    parsed(monkeypatch, "--training.learning-rate", "1e-3", "--model", "paper")
    assert capsys.readouterr().err == ""
    parsed(monkeypatch, "--model", "paper", "--num-samples", "3")
    assert capsys.readouterr().err == "note: --num-samples has no effect, because --model paper is trained\n"


def test_epochs_and_steps_on_the_command_line_replace_the_steps_of_the_preset(monkeypatch):
    assert parsed(monkeypatch, "--model", "paper", "--training.epochs", "3").config.steps is None
    assert parsed(monkeypatch, "--model", "paper", "--training.steps=3").config.steps is None
    assert parsed(monkeypatch, "--model", "paper", "--training.epochs", "3", "--steps", "1", "2", "3", "4").config.steps
    assert parsed(monkeypatch, "--state-training.epochs", "3").config.state_training.steps is None
    assert parsed(monkeypatch, "--state-training.epochs", "3", "--state-training.steps", "9").config.schedule.steps == 9


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--preset", "tiny"), "--preset"),
        (("--only", "draw"), "--only"),
        (("--collection.num-object", "x"), "--collection.num-object"),
    ],
)
def test_a_wrong_option_is_refused(options, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stopped:
        parsed(monkeypatch, *options)
    assert stopped.value.code == 2
    assert message in " ".join("".join(capsys.readouterr()).replace("│", " ").split())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"image_size": 48}, r"image_size must be >= 16 and divide the side of collection\.resolution, 128, got 48"),
        ({"image_size": 8}, r"image_size must be >= 16 .*, got 8"),
        ({"image_size": 16, "model": "paper"}, "16"),
        ({"collection": {"resolution": (96, 128)}}, r"must be square, got 96 x 128: give 96 96"),
        ({"collection": {"crop": True}}, r"crop must be False .*: give --collection\.no-crop, or --model paper"),
        ({"model": "paper", "steps": (5,)}, r"steps must have one number for each model \(mvae, .*, got \(5,\)"),
        (
            {"state_training": training.TrainConfig(steps=100, warmup=150, schedule="cosine")},
            r"state_training\.warmup must be smaller than state_training\.steps \(100\), got 150",
        ),
        (
            {
                "model": "paper",
                "steps": (150, 60, 60, 10),
                "training": training.TrainConfig(warmup=15, schedule="cosine"),
            },
            r"training\.warmup must be smaller than the least of steps \(10\), got 15",
        ),
        ({"rerolls": 0}, "rerolls must be >= 1, got 0"),
        ({"splits": ("frame",)}, r"splits must be one or more of object, trajectory, got \('frame',\)"),
        ({"splits": ()}, r"splits must be one or more of object, trajectory, got \(\)"),
        ({"collection": {"num_objects": 5}}, r"the part 'validation' .* there are 5 objects, .* raise --collection"),
        ({"collection": {"shares": (0.8, 0.0, 0.2)}}, r"the part 'validation' .* collection\.shares is \(0\.8, 0\.0"),
        ({"collection": {"seed": -1}}, "seed must be"),
        ({"collection": {"scenario": physics.Freefall(friction=(0.8, 0.4))}}, r"friction is \(0\.8, 0\.4\)"),
    ],
)
def test_a_wrong_field_is_an_error_before_anything_is_written(fields, message, tmp_path):
    wrong = changed(**fields)
    with pytest.raises(ValueError, match=message):
        run.main(wrong, tmp_path / "run")
    with pytest.raises(ValueError, match=message):
        run.configure(run.Args(tmp_path / "run", wrong))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("command", "config", "option"),
    [
        (show, show.Config("freefall", out=Path("unused"), seed=10**20), "seed"),
        (objects, objects.Config(num=10**20), "num"),
        (objects, objects.Config(size=-1), "size"),
        (fit, fit.Config("mouse", starts=0), "starts"),
        *((sense, sense.Config("mouse", **{name: float("nan")}), name) for name in ("mass", "force", "height", "turn")),
        (sense, sense.Config("mouse", position=(float("inf"), 0.0)), "position"),
        (sense, sense.Config("mouse", resolution=(10**6, 10**6)), "resolution"),
    ],
)
def test_a_number_out_of_range_is_named_before_any_work(command, config, option, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=f"--{option} is .*, but it must be from "):
        command.main(config)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("number", ["99999999999999999999", "1" + "0" * 400, "-99999999999999999999", "1e999", "nan"])
@pytest.mark.parametrize(
    "option",
    [
        *("training.warmup", "state-training.beta-warmup", "collection.seed", "collection.num-per-object"),
        *("num-samples", "image-size", "collection.scenario.rate", "collection.scenario.frames"),
    ],
)
def test_an_absurd_number_is_one_line(option, number, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(run, "main", lambda *_, **__: pytest.fail("the number is accepted"))
    monkeypatch.setattr("sys.argv", ["freefall", "--preset", "smoke", f"--{option}", number])
    with pytest.raises(SystemExit) as stopped:
        run.command(freefall.PRESETS, str(tmp_path), None)
    printed = "".join(capsys.readouterr())
    name = option.rpartition(".")[2]
    assert name.replace("-", "_") in f"{stopped.value}{printed}" or name in printed
    assert "\n" not in str(stopped.value)


@pytest.mark.parametrize("count", [3, 6, 12, 25])
def test_a_split_with_an_empty_part_is_refused(count):
    few = changed(freefall.DEFAULT, {"num_objects": count, "num_full": 0})
    if count == 25:
        config.check(few)
    else:
        with pytest.raises(ValueError, match=f"of the split by object is empty: there are {count} objects"):
            config.check(few)


def test_a_split_by_trajectory_needs_two_parts():
    few = {"num_objects": 1, "num_per_object": 2, "num_full": 0, "shares": (0.7, 0.1, 0.2)}
    with pytest.raises(ValueError, match=r"the part 'test' of the split by trajectory .* 2 trajectories"):
        config.check(changed(collection=few, splits=("trajectory",)))
    config.check(changed(collection={**few, "num_per_object": 3}, splits=("trajectory",)))


def test_one_stage_runs_on_the_results_of_the_stages_before_it(tmp_path, monkeypatch):
    ran = []
    for stage in ("train", "evaluate"):
        monkeypatch.setattr(run, stage, lambda *_, stage=stage: ran.append(stage))
    with pytest.raises(FileNotFoundError, match="dataset is not a collected dataset"):
        run.main(freefall.SMOKE, tmp_path, only="train")
    monkeypatch.setattr(run, "collect", lambda *_: ran.append("collect"))
    monkeypatch.setattr(dataset, "load", lambda folder: None)
    run.sensor("clear").save(tmp_path / "dataset" / "sensor.json")  # of the dataset, which the later stages use
    for only in ("collect", "train", "evaluate", None):
        run.main(freefall.SMOKE, tmp_path, only=only)
    assert ran == [*(stages := ["collect", "train", "evaluate"]), *stages]


def test_a_work_directory_of_another_configuration_names_the_fields_that_differ(tmp_path, monkeypatch):
    monkeypatch.setattr(run, "collect", lambda *_: None)
    run.main(freefall.SMOKE, tmp_path, only="collect")
    steps = dataclasses.replace(freefall.SMOKE.state_training, steps=9)
    with pytest.raises(
        ValueError,
        match=r"config\.json was made with collection\.num_objects = 16, state_training\.steps = 8, image_size = 64, "
        r"but the current settings have collection\.num_objects = 20, state_training\.steps = 9, image_size = 32 "
        r"\(also different: rerolls\): choose another folder",
    ):
        run.main(changed(collection={"num_objects": 20}, state_training=steps, image_size=32, rerolls=2), tmp_path)


def test_a_second_run_in_a_work_directory_is_refused(folder, tmp_path):
    with storage.lock(tmp_path / "run"):
        with pytest.raises(storage.LockedError, match="close what uses the folder in this process"):
            run.main(freefall.SMOKE, tmp_path / "run")
        with pytest.raises(storage.LockedError):
            run.configure(run.Args(tmp_path / "run", smoke_of_few(freefall), objects=folder))
    assert not {"config.json", "objects.txt"} & {path.name for path in (tmp_path / "run").iterdir()}


@pytest.mark.parametrize("asked", [(), ("box", "bottle")])
def test_the_classes_of_the_experiment_or_the_requested_ones_are_taken_from_a_folder(asked, folder, tmp_path):
    args = run.Args(tmp_path / "run", smoke_of_few(freefall), objects=folder, classes=asked, scale=0.5, up="y")
    one = run.configure(args).collection
    assert one.meshes is not None
    assert one.meshes.labels == ("bottle",) * 4 + ("box",) * (3 if asked else 0)
    assert (one.meshes.scale, one.meshes.up) == (0.5, "y")
    assert (one.num_objects, one.num_per_object) == ((7, 5) if asked else (4, 8))  # of 32 trajectories
    assert one.meshes.cache == str(tmp_path / "cache" / "sts_jax" / "objects")
    listing = tmp_path / "run" / "objects.txt"
    assert "bottle/3.stl" in listing.read_text()
    assert ("classes left out: box" in listing.read_text()) != bool(asked)
    before = listing.stat().st_mtime_ns
    assert run.configure(args).collection == one
    assert listing.stat().st_mtime_ns == before


@pytest.mark.parametrize(
    ("options", "counts"),
    [
        ((), (24, 16)),  # as many trajectories as without a folder, 96, and two thirds of them with images
        (("--collection.num-per-object", "6"), (6, 6)),  # the preset's own number
        (("--collection.num_per_object=5", "--collection.num-rendered", "2"), (5, 2)),
        (("--collection.num-rendered", "3"), (24, 3)),
    ],
)
def test_explicit_numbers_win_over_those_for_a_folder(options, counts, folder, tmp_path, monkeypatch, capsys):
    (folder / "bottle" / "4.stl").write_bytes((folder / "bottle" / "0.stl").read_bytes())  # the same mesh
    presets = {"default": changed(config.Config(config.COLLECTION), {"num_objects": 16, "shares": (0.5, 0.25, 0.25)})}
    monkeypatch.setattr("sys.argv", ["x", "--objects", str(folder), "--workdir", str(tmp_path / "run"), *options])
    one = run.configure(run.parse(presets, "unused", None)).collection
    assert (one.num_objects, one.num_per_object, one.rendered_per_object) == (4, *counts)
    assert f"4 objects with {one.num_per_object} trajectories each, split into train 2, " in capsys.readouterr().err
    monkeypatch.setattr("sys.argv", [*sys.argv, "--collection.num-objects", "9"])
    with pytest.raises(ValueError, match="num_objects=9, but `meshes` has 4 objects"):
        run.configure(run.parse(presets, "unused", None))


def test_files_with_their_own_scale_are_read_again_from_the_collection(folder, tmp_path, monkeypatch):
    options = (
        "--objects",
        str(folder),
        "--workdir",
        str(tmp_path / "run"),
        "--scale",
        "bottle/0.stl",
        "0.5",
        "box",
        "2",
    )
    monkeypatch.setattr("sys.argv", ["x", *options])
    one = run.configure(run.parse({"default": smoke_of_few(freefall)}, "unused", None)).collection
    assert one.meshes.scale == (("bottle/0.stl", 0.5), ("box", 2.0))
    first, second = dataset.make_bodies(one, np.array([0, 1]))
    assert np.ptp(first.vertices, axis=0).max() == pytest.approx(0.03)
    assert np.ptp(second.vertices, axis=0).max() == pytest.approx(0.07)


def test_all_classes_are_taken_from_a_folder_without_those_of_the_experiment(folder, tmp_path):
    (folder / "bottle").rename(folder / "jar")
    one = run.configure(run.Args(tmp_path / "run", smoke_of_few(perturbed), objects=folder)).collection
    assert one.meshes is not None
    assert one.meshes.labels == ("box",) * 3 + ("jar",) * 4


def test_wrong_options_for_objects_are_refused(folder, tmp_path):
    args = run.Args(tmp_path / "run", smoke_of_few(freefall), classes=("bottle", "teapot"))
    for changes, message in (
        ({}, r"category is 'teapot', but it must be one of .*bottle"),
        ({"objects": folder}, r"teapot.*bottle, box"),
        ({"objects": folder, "classes": ("box",)}, r"there are 3 objects, .*add usable objects to the folder"),
        ({"classes": (), "up": "y"}, "--scale and --up apply only to mesh files in a folder"),
    ):
        with pytest.raises(ValueError, match=message):
            run.configure(dataclasses.replace(args, **changes))


@pytest.mark.parametrize("told", ["", None])
def test_the_cache_is_in_the_home_folder_without_xdg_cache_home(told, monkeypatch):
    monkeypatch.setenv("HOME", "/home/somebody")
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    if told is not None:
        monkeypatch.setenv("XDG_CACHE_HOME", told)
    assert compilation.cache_folder() == Path("/home/somebody/.cache/sts_jax")


def test_an_error_that_the_user_can_correct_is_one_line_unless_debug_is_set(tmp_path, monkeypatch):
    path = tmp_path / "a.txt"
    path.write_text("")
    monkeypatch.setattr("sys.argv", ["freefall", "--preset", "smoke", "--workdir", str(path)])
    with pytest.raises(SystemExit, match=rf"^error: cannot create or write to {path}: .*Choose a folder") as stopped:
        run.command(freefall.PRESETS, "unused", None)
    assert stopped.value.__suppress_context__
    monkeypatch.setattr("sys.argv", ["freefall", "--classes", "teapot", "--debug"])
    with pytest.raises(ValueError, match="teapot"):
        run.command(freefall.PRESETS, str(tmp_path), None)


def test_an_error_of_the_program_keeps_its_traceback_and_a_warning_is_one_line():
    def formatted():
        return warnings.formatwarning("the mesh has a hole", UserWarning, "file.py", 1, "")

    usual = formatted()
    with terminal.on_one_line():
        assert formatted() == "note: the mesh has a hole\n"
    with pytest.raises(KeyError), terminal.on_one_line():
        raise KeyError
    with pytest.raises(SystemExit, match="in use"), terminal.on_one_line():
        raise storage.LockedError("in use")
    assert formatted() == usual


INPUTS = {"dataset": "d" * 64, "models/mvae": "m" * 64}


@pytest.fixture
def evaluated(tmp_path: Path) -> Path:
    """The results of two evaluations: a table and a figure, and another table."""
    (tmp_path / "figures").mkdir()
    files = [tmp_path / name for name in ("table.md", "figures/a.png", "other.md")]
    for path in files:
        path.write_bytes(path.name.encode())
    evaluate.record(tmp_path, "other", {"dataset": INPUTS["dataset"]}, files[2:])
    evaluate.record(tmp_path, "evaluation", INPUTS, files[:2])
    return tmp_path


@pytest.mark.parametrize(
    ("part", "inputs", "reason"),
    [
        ("evaluation", INPUTS, None),
        ("other", {"dataset": INPUTS["dataset"]}, None),
        ("table", INPUTS, "manifest.json has no record of the table"),
        ("evaluation", {**INPUTS, "models/mvae": "n" * 64}, "models/mvae has changed since"),
        ("evaluation", {**INPUTS, "models/vae": "n" * 64}, "models/vae has changed since"),
        ("evaluation", {"dataset": INPUTS["dataset"]}, "models/mvae has changed since"),
    ],
)
def test_results_of_other_inputs_are_stale(evaluated, part, inputs, reason):
    assert evaluate.stale(evaluated, part, inputs) == reason


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("table.md", b"rubbish", r"table\.md is not the file"),
        ("figures/a.png", None, r"figures/a\.png is missing"),
        ("manifest.json", None, r"manifest\.json has no record of the evaluation"),
        ("manifest.json", b"{", r"manifest\.json cannot be read"),
        ("manifest.json", b'{"files": {}, "facts": {}, "checksum": "0"}', r"manifest\.json is damaged"),
    ],
)
def test_results_that_are_missing_or_changed_are_stale_until_they_are_written_again(evaluated, name, content, reason):
    (evaluated / name).unlink()
    if content is not None:
        (evaluated / name).write_bytes(content)
    assert re.search(reason, evaluate.stale(evaluated, "evaluation", INPUTS))
    files = [evaluated / "table.md", evaluated / "figures" / "a.png"]
    for path in files:
        path.write_bytes(b"new")
    evaluate.record(evaluated, "evaluation", INPUTS, files)
    assert evaluate.stale(evaluated, "evaluation", INPUTS) is None


def test_damage_stays_visible_when_another_part_is_written(evaluated):
    (evaluated / "other.md").write_bytes(b"flipped")
    evaluate.record(evaluated, "evaluation", INPUTS, [evaluated / "table.md"])
    assert "other.md is not the file" in evaluate.stale(evaluated, "other", {"dataset": INPUTS["dataset"]})


@pytest.mark.skipif(sys.platform != "linux", reason="the variable is of Linux's C library")
@pytest.mark.parametrize(
    ("given", "value"), [(None, "glibc.malloc.hugetlb=1"), ("glibc.malloc.hugetlb=0", "glibc.malloc.hugetlb=0")]
)
def test_a_command_has_large_pages_from_its_start_unless_the_user_chose(given, value):
    command = "import sys; sys.argv[0] = '-m'; import experiments, os; print(*sys.argv[1:], os.getpid(), end=' ')"
    read = "print(open('/proc/self/environ').read().split('GLIBC_TUNABLES=')[1].split(chr(0))[0])"
    variables = {name: text for name, text in os.environ.items() if name != "GLIBC_TUNABLES"}
    pipes = {"stdout": subprocess.PIPE, "text": True}
    words = [sys.executable, "-W", "error", "-c", f"{command}; {read}", "--seed", "3"]
    with subprocess.Popen(words, env=variables | ({"GLIBC_TUNABLES": given} if given else {}), **pipes) as process:
        output, _ = process.communicate(timeout=60)
    assert (process.returncode, output) == (0, f"--seed 3 {process.pid} {value}\n")
