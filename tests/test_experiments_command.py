"""Presets, and the effect of the options of the command line on them. No experiment is run."""

import dataclasses
import json
import re
import warnings
from pathlib import Path

import pytest
import trimesh

import sts_jax as sts
from experiments import freefall, inclined, perturbed, released
from experiments.shared import config, drawing, evaluate, run, terminal
from sts_jax import compilation, dataset, physics, storage, training

BOTTLES = ("bottle",)


def smoke_of_few(experiment):
    """The preset `smoke` of an experiment, with shares for which four objects are enough."""
    collection = dataclasses.replace(experiment.SMOKE.collection, shares=(0.5, 0.25, 0.25))
    return dataclasses.replace(experiment.SMOKE, collection=collection)


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


@pytest.mark.parametrize(
    ("experiment", "classes", "trajectories"),
    [
        (freefall, sts.objects.CATEGORIES, 1700),
        (inclined, sts.objects.CATEGORIES, 2400),
        (perturbed, BOTTLES, 2500),
        (released, ("camera",), 500),
    ],
)
def test_presets_hold_out_enough_objects_and_that_of_the_paper_has_its_counts(experiment, classes, trajectories):
    default, paper = experiment.DEFAULT.collection, experiment.PAPER.collection
    for one, num, held_out in ((default, 120, 24), (experiment.LONG.collection, 120, 24), (paper, 300, 60)):
        assert one.num_objects >= num
        assert len(dataset.split_objects(one)["test"]) >= held_out
        assert set(dataset.class_names(one)) == set(classes)
    assert paper.num_per_object <= 10
    assert paper.num_trajectories == paper.num_full == trajectories
    assert (paper.scenario.frames, paper.crop, paper.symmetries) == (60, True, False)
    schedule = experiment.PAPER.training
    assert (schedule.epochs, schedule.batch_size, schedule.beta_warmup) == (200, 64, 50 / 200)
    assert (experiment.PAPER.targets, experiment.PAPER.splits) == ("own", ("trajectory", "object"))
    assert not experiment.PAPER.mask_blank_touch
    model = training.paper_model(config.MODELS["paper"]["mvae"], run.preprocessing_of(experiment.PAPER))
    assert [m.weight for m in model.modalities] == [1, 1, 1000]
    assert [m.shape for m in model.modalities] == [(64, 64, 3), (64, 64, 3), (7,)]


def test_options_reach_the_experiment(tmp_path, monkeypatch, capsys):
    ran = []
    monkeypatch.setattr(stages, "main", lambda config, workdir, only: ran.append((config, workdir)))
    monkeypatch.setattr(command, "plan", lambda config: f"plan of {config.collection.num_objects} objects")
    monkeypatch.setattr("sys.argv", ["freefall", "--hidden", "off", "--classes", "fork", "bottle", "--parts"])
    run.run(freefall.PRESETS, str(tmp_path), "What it does.")
    monkeypatch.setattr("sys.argv", ["freefall", "--preset", "smoke", "--workdir", str(tmp_path / "other")])
    run.run(freefall.PRESETS, str(tmp_path), None)
    collection = dataclasses.replace(
        freefall.DEFAULT.collection,
        scenario=physics.variant(physics.Freefall(), "off"),
        categories=("fork", "bottle"),
        parts=True,
    )
    asked = dataclasses.replace(freefall.DEFAULT, collection=collection)
    assert ran == [(asked, tmp_path), (freefall.SMOKE, tmp_path / "other")]
    monkeypatch.setattr("sys.argv", ["freefall", "--plan"])
    run.run(freefall.PRESETS, str(tmp_path), None)
    assert capsys.readouterr().out == "plan of 2000 objects\n"
    assert len(ran) == 2
    assert list(tmp_path.iterdir()) == []


def parsed(monkeypatch, *options: str, presets=freefall.PRESETS) -> run.Args:
    monkeypatch.setattr("sys.argv", ["experiment", *options])
    return run.parse(presets, "runs/experiment", None)


def test_any_field_of_a_preset_can_be_changed(monkeypatch, capsys):
    options = (
        *("--collection.num-objects", "1000", "--state-training.learning-rate", "1e-3", "--image-size", "32"),
        *("--collection.scenario.height", "0.07", "--collection.scenario.contact.soft", "0.1"),
        *("--collection.symmetries", "--collection.num-rendered", "None", "--splits", "trajectory", "object"),
        *("--preset", "smoke"),
    )
    found = parsed(monkeypatch, *options)
    smoke = freefall.SMOKE
    contact = dataclasses.replace(smoke.collection.scenario.contact, soft=0.1)
    expected = dataclasses.replace(
        smoke,
        collection=dataclasses.replace(
            smoke.collection,
            num_objects=1000,
            scenario=dataclasses.replace(smoke.collection.scenario, height=0.07, contact=contact),
            symmetries=True,
            num_rendered=None,
        ),
        state_training=dataclasses.replace(smoke.state_training, learning_rate=1e-3),
        image_size=32,
        splits=("trajectory", "object"),
    )
    assert (found.config, found.preset) == (expected, "smoke")
    assert parsed(monkeypatch).config == freefall.DEFAULT
    assert capsys.readouterr().err == ""


def test_options_of_a_model_that_is_not_trained_are_noted(monkeypatch, capsys):
    parsed(monkeypatch, "--training.learning-rate", "1e-3")
    assert capsys.readouterr().err == "note: --training.* has no effect, because --model statespace is trained\n"
    parsed(monkeypatch, "--training.learning-rate", "1e-3", "--model", "paper")
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("options", [("--preset", "tiny"), ("--only", "draw"), ("--collection.num-object", "x")])
def test_an_unknown_option_is_refused(options, monkeypatch, capsys):
    with pytest.raises(SystemExit) as stopped:
        parsed(monkeypatch, *options)
    assert stopped.value.code == 2
    assert options[0] in "".join(capsys.readouterr())


def test_one_stage_runs_on_the_results_of_the_stages_before_it(tmp_path, monkeypatch):
    ran = []
    monkeypatch.setattr(stages, "collect", lambda *_: ran.append("collect"))
    monkeypatch.setattr(stages, "train", lambda *_: ran.append("train"))
    monkeypatch.setattr(stages, "evaluate", lambda *_: ran.append("evaluate"))
    monkeypatch.setattr(dataset, "load", lambda folder: None)
    run.main(freefall.SMOKE, tmp_path, only="collect")
    assert ran == ["collect"]
    with pytest.raises(FileNotFoundError, match=r"dataset is not a collected dataset: first run .* `--only collect`"):
        run.main(freefall.SMOKE, tmp_path, only="train")
    (tmp_path / "dataset").mkdir()
    (tmp_path / "dataset" / "collection.json").write_text("{}")
    run.main(freefall.SMOKE, tmp_path, only="train")
    assert ran == ["collect", "train"]
    with pytest.raises(FileNotFoundError, match=r"statespace is not a trained model: first run .* `--only train`"):
        run.main(freefall.SMOKE, tmp_path, only="evaluate")
    (tmp_path / "models" / "statespace").mkdir(parents=True)
    (tmp_path / "models" / "statespace" / "config.json").write_text("{}")
    run.main(freefall.SMOKE, tmp_path, only="evaluate")
    assert ran == ["collect", "train", "evaluate"]
    run.main(freefall.SMOKE, tmp_path)
    assert ran[3:] == ["collect", "train", "evaluate"]


def test_a_work_directory_of_another_configuration_names_the_fields_that_differ(tmp_path):
    run.claim(freefall.SMOKE, tmp_path)
    other = dataclasses.replace(
        freefall.SMOKE,
        image_size=32,
        collection=dataclasses.replace(freefall.SMOKE.collection, num_objects=20),
        state_training=dataclasses.replace(freefall.SMOKE.state_training, steps=9),
        rerolls=2,
    )
    with pytest.raises(
        ValueError,
        match=r"config\.json was made with collection\.num_objects = 16, state_training\.steps = 8, image_size = 64, "
        r"but the current settings have collection\.num_objects = 20, state_training\.steps = 9, image_size = 32 "
        r"\(also different: rerolls\): choose another folder",
    ):
        run.claim(other, tmp_path)


@pytest.mark.parametrize("experiment", [freefall, perturbed])
@pytest.mark.parametrize("asked", [(), ("box", "bottle")])
def test_the_classes_of_the_experiment_or_the_requested_ones_are_taken_from_a_folder(
    experiment, asked, folder, tmp_path, capsys
):
    args = run.Args(tmp_path / "run", smoke_of_few(experiment), objects=folder, classes=asked)
    one = run.configure(args).collection
    assert one.meshes is not None
    assert one.meshes.labels == ("bottle",) * 4 + ("box",) * (3 if asked else 0)
    assert one.num_objects == len(one.meshes.names)
    assert one.num_per_object == round(32 / one.num_objects)
    assert one.meshes.cache == str(tmp_path / "cache" / "sts_jax" / "objects")
    said = capsys.readouterr().err
    assert ("classes used: box, bottle\n" if asked else "classes used: bottle. Left out: box\n") in said
    listing = tmp_path / "run" / "objects.txt"
    assert "bottle/3.stl" in listing.read_text()
    assert ("classes left out: box" in listing.read_text()) != bool(asked)

    run.note(listing, ["collect: left out object 0"])  # stays when the folder is read again
    before = listing.stat().st_mtime_ns
    assert run.configure(args).collection == one
    assert listing.stat().st_mtime_ns == before


def test_all_classes_are_taken_from_a_folder_without_those_of_the_experiment(folder, tmp_path):
    small = run.Args(tmp_path / "small", smoke_of_few(freefall), objects=folder, scale=0.5, up="y")
    meshes = run.configure(small).collection.meshes
    assert meshes is not None
    assert (meshes.scale, meshes.up) == (0.5, "y")
    with pytest.raises(ValueError, match="--scale and --up apply only to mesh files in a folder"):
        run.configure(run.Args(tmp_path, perturbed.SMOKE, up="y"))

    (folder / "bottle").rename(folder / "jar")
    one = run.configure(run.Args(tmp_path / "run", smoke_of_few(perturbed), objects=folder)).collection
    assert one.meshes is not None
    assert one.meshes.labels == ("box",) * 3 + ("jar",) * 4


def test_unknown_classes_and_too_few_objects_are_refused(folder, tmp_path):
    args = run.Args(tmp_path / "run", smoke_of_few(freefall), classes=("bottle", "teapot"))
    with pytest.raises(ValueError, match=r"category is 'teapot', but it must be one of .*bottle"):
        run.configure(args)
    with pytest.raises(ValueError, match=r"teapot.*bottle, box"):
        run.configure(dataclasses.replace(args, objects=folder))
    with pytest.raises(ValueError, match=r"num_objects is 3, .* at least 4 objects are needed: add usable objects"):
        run.configure(dataclasses.replace(args, objects=folder, classes=("box",)))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"num_objects": 5}, r"num_objects is 5, so the part 'validation' .* at least 6 objects are needed: raise"),
        ({"num_objects": 0}, "num_objects must be a whole number of at least 1, got 0"),
        ({"shares": (0.8, 0.0, 0.2)}, r"collection\.shares must be > 0 for train, validation, test, got \(0\.8, 0\.0"),
        ({"shares": (0.9, 0.1, 0.0)}, r"shares must be > 0"),
        ({"seed": -1}, "seed must be a whole number of at least 0, got -1"),
        ({"resolution": (0, 0)}, "resolution must be two whole numbers of pixels"),
        ({"scenario": physics.Freefall(friction=(0.8, 0.4))}, r"scenario\.friction is \(0\.8, 0\.4\), but"),
    ],
)
def test_a_collection_that_cannot_be_used_is_refused_before_anything_is_written(changes, message, tmp_path):
    wrong = dataclasses.replace(freefall.SMOKE, collection=dataclasses.replace(freefall.SMOKE.collection, **changes))
    with pytest.raises(ValueError, match=message):
        run.configure(run.Args(tmp_path / "run", wrong))
    with pytest.raises(ValueError, match=message):
        run.main(wrong, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_the_smallest_number_of_objects_in_the_message_is_enough():
    """For each preset, the number in the message is compared with the split of the dataset."""
    for experiment in (freefall, inclined, perturbed, released):
        for preset in experiment.PRESETS.values():

            def of(count, preset=preset):
                collection = dataclasses.replace(preset.collection, num_objects=count, num_full=0)
                return dataclasses.replace(preset, collection=collection, splits=("object",))

            with pytest.raises(ValueError, match="objects are needed") as caught:
                config.check(of(2))
            least = int(re.search(r"at least (\d+) objects", str(caught.value))[1])
            config.check(of(least))
            assert min(map(len, dataset.split_objects(of(least).collection).values())) >= 1
            assert min(map(len, dataset.split_objects(of(least - 1).collection).values())) == 0


def test_a_split_by_trajectory_needs_two_parts():
    few = dataclasses.replace(
        freefall.SMOKE.collection, num_objects=1, num_per_object=2, num_full=0, shares=(0.7, 0.1, 0.2)
    )
    with pytest.raises(ValueError, match=r"trajectories with images is 2, so the part 'test' .* at least 3 traj"):
        config.check(dataclasses.replace(freefall.SMOKE, collection=few, splits=("trajectory",)))
    enough = dataclasses.replace(few, num_per_object=3)
    config.check(dataclasses.replace(freefall.SMOKE, collection=enough, splits=("trajectory",)))


def test_objects_left_out_by_the_collection_are_listed_once(tmp_path, monkeypatch):
    made = dataset.Collected(0, ("object 1 (bottle): sank", "object 11 (bottle): sank"))
    monkeypatch.setattr(dataset, "collect", lambda *args, **kwargs: made)
    monkeypatch.setattr(dataset, "load", lambda folder: None)
    for _ in range(2):
        run.collect(freefall.SMOKE, tmp_path, sts.Sensor())
    listed = "".join(f"collect: left out {line}\n" for line in made.left_out)
    assert (tmp_path / "objects.txt").read_text() == listed


@pytest.mark.parametrize("told", ["", None])
def test_the_cache_is_in_the_home_folder_without_xdg_cache_home(told, monkeypatch):
    monkeypatch.setenv("HOME", "/home/somebody")
    if told is None:
        monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    else:
        monkeypatch.setenv("XDG_CACHE_HOME", told)
    assert compilation.cache_folder() == Path("/home/somebody/.cache/sts_jax")


@pytest.mark.parametrize("flag", ["--workdir", "--objects"])
@pytest.mark.parametrize("name", ["", " "])
def test_an_empty_name_of_a_folder_is_refused(flag, name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["freefall", flag, name])
    with pytest.raises(SystemExit) as stopped:
        run.run(freefall.PRESETS, str(tmp_path), None)
    assert stopped.value.code == 2
    assert "name of the folder is empty" in " ".join("".join(capsys.readouterr()).replace("│", " ").split())
    assert list(tmp_path.iterdir()) == []


def test_an_error_that_the_user_can_correct_is_one_line_unless_debug_is_set(tmp_path, monkeypatch):
    path = tmp_path / "a.txt"
    path.write_text("")
    monkeypatch.setattr("sys.argv", ["freefall", "--preset", "smoke", "--workdir", str(path)])
    with pytest.raises(SystemExit, match=rf"^error: cannot create or write to {path}: .*Choose a folder"):
        run.run(freefall.PRESETS, "unused", None)
    monkeypatch.setattr("sys.argv", ["freefall", "--classes", "teapot"])
    with pytest.raises(SystemExit, match=r"^error: category is 'teapot'"):
        run.run(freefall.PRESETS, str(tmp_path), None)
    monkeypatch.setattr("sys.argv", ["freefall", "--classes", "teapot", "--debug"])
    with pytest.raises(ValueError, match="teapot"):
        run.run(freefall.PRESETS, str(tmp_path), None)


def locked_twice(folder: Path) -> None:
    with storage.lock(folder), storage.lock(folder):
        pass


@pytest.mark.parametrize(
    "refused",
    [
        lambda folder: physics.variant(physics.Freefall(), "sideways"),
        lambda folder: (folder / "none").read_text(),
        dataset.load,
        locked_twice,
    ],
)
def test_a_refusal_is_one_line(refused, tmp_path):
    with pytest.raises(SystemExit, match=r"^error: ") as raised, terminal.on_one_line():
        refused(tmp_path)
    assert raised.value.__suppress_context__


@pytest.mark.parametrize(
    ("fault", "kind"),
    [
        (lambda: run.configure(None), AttributeError),
        (lambda: drawing.describe(sts.physics.Freefall(), "cup", {}, {}), KeyError),
    ],
)
def test_an_error_of_the_program_keeps_its_traceback(fault, kind):
    with pytest.raises(kind), terminal.on_one_line():
        fault()


def test_a_warning_is_one_line_and_later_warnings_are_as_before():
    def formatted():
        return warnings.formatwarning("the mesh has a hole", UserWarning, "file.py", 1, "")

    usual = formatted()
    with terminal.on_one_line():
        assert formatted() == "note: the mesh has a hole\n"
    with pytest.raises(SystemExit), terminal.on_one_line():
        raise ValueError
    assert formatted() == usual


def test_a_second_run_in_a_work_directory_is_refused(tmp_path):
    with storage.lock(tmp_path), pytest.raises(storage.LockedError, match="close what uses the folder in this process"):
        run.main(freefall.SMOKE, tmp_path)
    assert not (tmp_path / "config.json").exists()


def test_a_second_run_keeps_the_listing_of_the_first(folder, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "objects.txt").write_text("of the first\n")
    with storage.lock(tmp_path / "run"), pytest.raises(storage.LockedError):
        run.configure(run.Args(tmp_path / "run", smoke_of_few(freefall), objects=folder))
    assert (tmp_path / "run" / "objects.txt").read_text() == "of the first\n"


@pytest.fixture
def evaluated(tmp_path: Path) -> Path:
    """The results of one model, with a table and a figure."""
    (tmp_path / "figures").mkdir()
    outputs = [tmp_path / "table.md", tmp_path / "figures" / "a.png"]
    for path in outputs:
        path.write_bytes(path.name.encode())
    evaluate.write(tmp_path / "metrics.json", {"split": "object"}, INPUTS, outputs)
    return tmp_path


INPUTS = {"dataset": "d" * 64, "models/mvae": "m" * 64}


def test_results_are_valid_while_nothing_changes(evaluated):
    assert evaluate.stale(evaluated / "metrics.json", INPUTS) is None
    content = json.loads((evaluated / "metrics.json").read_text())
    assert (content["split"], content["inputs"]) == ("object", INPUTS)
    assert set(content["outputs"]) == {"table.md", "figures/a.png"}


@pytest.mark.parametrize(
    ("inputs", "reason"),
    [
        ({**INPUTS, "models/mvae": "n" * 64}, "models/mvae has changed since"),
        ({**INPUTS, "models/vae": "n" * 64}, "models/vae has changed since"),
        ({"dataset": INPUTS["dataset"]}, "models/mvae has changed since"),
    ],
)
def test_results_of_other_inputs_are_stale(evaluated, inputs, reason):
    assert evaluate.stale(evaluated / "metrics.json", inputs) == reason


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("table.md", b"rubbish", "table.md is missing or was changed"),
        ("table.md", None, "table.md is missing or was changed"),
        ("figures/a.png", None, "figures/a.png is missing or was changed"),
        ("metrics.json", None, "metrics.json is missing"),
        ("metrics.json", b"{", "metrics.json is damaged"),
        ("metrics.json", b'{"split": "object"}', "metrics.json has no record of its inputs"),
    ],
)
def test_results_that_are_missing_or_changed_are_stale(evaluated, name, content, reason):
    (evaluated / name).unlink()
    if content is not None:
        (evaluated / name).write_bytes(content)
    assert evaluate.stale(evaluated / "metrics.json", INPUTS) == reason


def test_a_changed_number_makes_results_stale(evaluated):
    path = evaluated / "metrics.json"
    path.write_text(path.read_text().replace('"object"', '"trajectory"'))
    assert evaluate.stale(path, INPUTS) == "metrics.json was changed"


def test_the_identity_of_a_model_depends_on_all_its_files(tmp_path):
    (tmp_path / "checkpoints" / "1").mkdir(parents=True)
    weights = tmp_path / "checkpoints" / "1" / "weights"
    weights.write_bytes(b"1234")
    before = evaluate.identity(tmp_path)
    (tmp_path / ".lock").write_bytes(b"")
    assert evaluate.identity(tmp_path) == before
    weights.write_bytes(b"1235")
    changed = evaluate.identity(tmp_path)
    weights.rename(tmp_path / "weights")
    assert len({before, changed, evaluate.identity(tmp_path)}) == 3
