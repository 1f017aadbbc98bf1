"""What the command line makes of a preset, and what presets hold; nothing of it is run."""

import dataclasses
from pathlib import Path

import pytest
import trimesh

import sts_jax as sts
from experiments import command, freefall, inclined, perturbed, stages
from sts_jax import compilation, dataset, physics

BOTTLES = ("bottle",)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Four bottles and three boxes; four objects are enough."""
    for label, count in (("bottle", 4), ("box", 3)):
        (tmp_path / "meshes" / label).mkdir(parents=True)
        for i in range(count):
            side = 0.03 + 0.005 * i
            mesh = trimesh.creation.box((side, 0.04, 0.05)) if label == "box" else trimesh.creation.cylinder(side, 0.06)
            mesh.export(tmp_path / "meshes" / label / f"{i}.stl")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(command, "LEAST_OBJECTS", 4)
    return tmp_path / "meshes"


@pytest.mark.parametrize(
    ("experiment", "classes", "trajectories"),
    [(freefall, sts.objects.CATEGORIES, 1700), (inclined, sts.objects.CATEGORIES, 2400), (perturbed, BOTTLES, 2500)],
)
def test_presets_hold_out_what_they_should_and_the_paper_s_has_its_counts(experiment, classes, trajectories):
    default, paper = experiment.DEFAULT.collection, experiment.PAPER.collection
    for one, num, held_out in ((default, 120, 24), (paper, 300, 60)):
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
    model = stages.model_config(stages.MODELS["mvae"], stages.preprocessing_of(experiment.PAPER))
    assert [m.weight for m in model.modalities] == [1, 1, 1000]
    assert [m.shape for m in model.modalities] == [(64, 64, 3), (64, 64, 3), (7,)]


def test_flags_reach_the_experiment(tmp_path, monkeypatch, capsys):
    ran = []
    monkeypatch.setattr(stages, "main", lambda config, workdir: ran.append((config, workdir)))
    monkeypatch.setattr(command, "plan", lambda config: f"plan of {config.collection.num_objects} objects")
    monkeypatch.setattr("sys.argv", ["freefall", "--hidden", "off", "--classes", "fork", "bottle", "--parts"])
    command.run(freefall.PRESETS, str(tmp_path), "What it does.")
    monkeypatch.setattr("sys.argv", ["freefall", "--preset", "smoke", "--workdir", str(tmp_path / "other")])
    command.run(freefall.PRESETS, str(tmp_path), None)
    collection = dataclasses.replace(
        freefall.DEFAULT.collection,
        scenario=physics.variant(physics.Freefall(), "off"),
        categories=("fork", "bottle"),
        parts=True,
    )
    asked = dataclasses.replace(freefall.DEFAULT, collection=collection)
    assert ran == [(asked, tmp_path), (freefall.SMOKE, tmp_path / "other")]
    monkeypatch.setattr("sys.argv", ["freefall", "--plan"])
    command.run(freefall.PRESETS, str(tmp_path), None)
    assert capsys.readouterr().out == "plan of 320 objects\n"
    assert len(ran) == 2
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("experiment", [freefall, perturbed])
@pytest.mark.parametrize("asked", [(), ("box", "bottle")])
def test_of_a_folder_the_experiment_s_classes_are_taken_or_those_asked_for(experiment, asked, folder, tmp_path, capsys):
    args = command.Args(tmp_path / "run", objects=folder, classes=asked)
    one = command.configure(experiment.SMOKE, args).collection
    assert one.meshes is not None
    assert one.meshes.labels == ("bottle",) * 4 + ("box",) * (3 if asked else 0)
    assert one.num_objects == len(one.meshes.names)
    assert one.num_per_object == round(32 / one.num_objects)
    assert one.meshes.cache == str(tmp_path / "cache" / "sts_jax" / "objects")
    said = capsys.readouterr().err
    assert ("classes taken: box, bottle\n" if asked else "classes taken: bottle; left out: box\n") in said
    listing = tmp_path / "run" / "objects.txt"
    assert "bottle/3.stl" in listing.read_text()
    assert ("classes left out: box" in listing.read_text()) != bool(asked)

    stages.note(listing, ["collect: left out object 0"])  # stays when the folder is read again
    before = listing.stat().st_mtime_ns
    assert command.configure(experiment.SMOKE, args).collection == one
    assert listing.stat().st_mtime_ns == before


def test_a_folder_of_other_classes_is_taken_whole(folder, tmp_path):
    small = command.Args(tmp_path / "small", objects=folder, scale=0.5, up="y")
    meshes = command.configure(freefall.SMOKE, small).collection.meshes
    assert meshes is not None
    assert (meshes.scale, meshes.up) == (0.5, "y")
    with pytest.raises(ValueError, match="--scale and --up are of the files of a folder"):
        command.configure(perturbed.SMOKE, command.Args(tmp_path, up="y"))

    (folder / "bottle").rename(folder / "jar")
    one = command.configure(perturbed.SMOKE, command.Args(tmp_path / "run", objects=folder)).collection
    assert one.meshes is not None
    assert one.meshes.labels == ("box",) * 3 + ("jar",) * 4


def test_unknown_classes_and_too_few_objects_are_refused(folder, tmp_path):
    args = command.Args(tmp_path / "run", classes=("bottle", "teapot"))
    with pytest.raises(ValueError, match=r"unknown classes teapot: take some of .*bottle"):
        command.configure(freefall.SMOKE, args)
    with pytest.raises(ValueError, match=r"teapot.*bottle, box"):
        command.configure(freefall.SMOKE, dataclasses.replace(args, objects=folder))
    with pytest.raises(ValueError, match="3 objects are too few to hold some out: give 4"):
        command.configure(freefall.SMOKE, dataclasses.replace(args, objects=folder, classes=("box",)))


def test_what_collecting_left_out_is_listed_once(tmp_path, monkeypatch):
    made = dataset.Collected(0, ("object 1 (bottle): sank", "object 11 (bottle): sank"))
    monkeypatch.setattr(dataset, "collect", lambda *args, **kwargs: made)
    monkeypatch.setattr(dataset, "load", lambda folder: None)
    for _ in range(2):
        stages.collect(freefall.SMOKE, tmp_path, sts.Sensor())
    listed = "".join(f"collect: left out {line}\n" for line in made.left_out)
    assert (tmp_path / "objects.txt").read_text() == listed


@pytest.mark.parametrize("told", ["", None])
def test_without_xdg_cache_home_things_are_kept_at_home(told, monkeypatch):
    monkeypatch.setenv("HOME", "/home/somebody")
    if told is None:
        monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    else:
        monkeypatch.setenv("XDG_CACHE_HOME", told)
    assert compilation.cache_folder() == Path("/home/somebody/.cache/sts_jax")
