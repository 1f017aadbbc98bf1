"""All stages of the jerked pad at the smallest size, and the pictures of `show` and of benchmarks."""

import dataclasses
import json
import shutil
import types

import jax
import numpy as np
import pytest
from damage import damaged
from PIL import Image

import sts_jax as sts
from benchmarks import deterministic, scaling
from benchmarks.instruments.experiments import EXPERIMENTS
from experiments import perturbed, show
from experiments.shared import evaluate, run
from sts_jax import dataset, evaluation, physics, storage, training

pytestmark = pytest.mark.slow

TINY = dataclasses.replace(
    perturbed.SMOKE,
    collection=dataclasses.replace(
        perturbed.SMOKE.collection,
        scenario=physics.Perturbed(frames=6),
        num_objects=10,
        num_per_object=2,
        num_rendered=1,
        num_views=1,
        num_full=1,
    ),
    state_training=dataclasses.replace(perturbed.SMOKE.state_training, steps=2, batch_size=4, checkpoint_every=2),
    num_shown=2,
    num_samples=2,
    rerolls=2,
)


@pytest.fixture(scope="module")
def workdir(tmp_path_factory):
    workdir = tmp_path_factory.mktemp("runs") / "perturbed"
    run.main(TINY, workdir)
    return workdir


# Files whose content nothing depends on.
UNREAD = {
    ".lock": "an empty file, which the system locks",
    "objects.txt": "a listing of objects for people",
    "README.md": "the data card, for people",
    "shard-*.json": "checksums of one shard, which the manifest of the finished dataset repeats",
}


def complaints(workdir, top, inputs):
    """What the readers of a part of a work directory say, with the settings and the checksums of the undamaged run."""
    try:
        if top == "config.json":
            storage.claim(workdir / "config.json", dataclasses.asdict(TINY))
        elif top == "dataset":
            data = dataset.load(workdir / "dataset")
            data.pairs(data.rendered())
            data.views("train")
        elif top == "models":
            training.records(workdir / "models/statespace")  # first, because it is faster
            sts.Predictor.load(workdir / "models/statespace")
        else:
            return [reason for part in inputs if (reason := evaluate.stale(workdir, part, inputs[part]))]
    except (OSError, ValueError) as error:
        return [str(error)]
    return []


def test_damage_of_any_file_is_named_or_the_file_is_made_again(workdir, tmp_path):
    copy = shutil.copytree(workdir, tmp_path / "copy")
    inputs = {part: fact.get("inputs", fact) for part, fact in storage.read_manifest(copy, "").facts.items()}
    assert "evaluation by object" in inputs
    paths = [path for path in sorted(copy.rglob("*")) if path.is_file() and not any(map(path.match, UNREAD))]
    assert len(paths) > 30
    assert not any(complaints(copy, top, inputs) for top in ("config.json", "dataset", "models", "metrics.json"))
    unnoticed, unnamed = [], []
    for number, path in enumerate(paths):
        content, place = path.read_bytes(), path.relative_to(copy)
        alike = [other for other in paths[number + 1 :] + paths[:number] if other.suffix == path.suffix]
        alike.sort(key=lambda other: other.name != path.name)
        other = next((other for other in alike if other.read_bytes() != content), None)
        for kind in damaged(path, other, flips=1):
            said = complaints(copy, place.parts[0], inputs)
            if not said and not (path.exists() and path.read_bytes() == content):
                unnoticed.append((str(place), kind))
            elif said and not any(path.name in text for text in said):
                unnamed.append((str(place), kind, said))
    assert not unnoticed
    assert not unnamed


def test_the_model_predicts_from_every_subset_of_its_inputs(workdir):
    predictors = json.loads((workdir / "metrics.json").read_text())["predictors"]
    given = {name.partition(", ")[2] for name in predictors if name.startswith("state-space model")}
    inputs = ("visual", "tactile", "pose")
    pairs = ("visual and tactile", "visual and pose", "tactile and pose")
    assert given == {f"from {names}" for names in (*inputs, *pairs, "all inputs", evaluation.TRUE_STATE)}
    both = predictors["state-space model, from visual and tactile"]
    assert both["outcome_log_loss"]["value"] > 0
    assert 0 <= both["coverage"]["value"] <= 1
    assert both["visual_skill_best"] is not None
    assert "Touch removes " in (workdir / "table.md").read_text()
    rows = [line for line in (workdir / "table.md").read_text().splitlines() if line.startswith("| ")][1:]
    assert len(rows) == 10
    expected = {"predictions", "predictions-all", "ends", "ends-all", "calibration", "training", "strip"}
    assert {path.stem for path in (workdir / "figures").glob("*.png")} == expected


def test_views_and_falls_are_used_in_training(workdir):
    data = dataset.load(workdir / "dataset")
    samples = json.loads((workdir / "models/statespace/config.json").read_text())["data"]["samples"]
    assert 2 * samples == 2 * len(data.members("train")) == len(data.members("train", rendered=False))
    assert len(data.views("train").pose) == len(data.split["train"]) > 0
    record = json.loads((workdir / "models/statespace/metrics.jsonl").read_text().splitlines()[-1])
    assert all(np.isfinite(value) for value in record.values())


def test_a_model_takes_a_jerk_in_si_units(workdir):
    data = dataset.load(workdir / "dataset")
    pairs = data.pairs(data.members("test"))
    predictor = sts.Predictor.load(workdir / "models/statespace")
    assert predictor.preprocessing.condition_scale == physics.Perturbed().condition_scale
    # As many items and samples as in the evaluation, whose compiled program is used
    drawn = {"key": jax.random.split(jax.random.key(0), len(pairs.object)), "num_samples": TINY.num_samples}
    given = {"tactile": pairs.tactile[:, 0] / 255, **drawn}
    out, other = (predictor(**given, condition=pairs.condition * signs) for signs in (1, [-1, -1, 1]))
    assert np.abs(out.pose - other.pose).max() > 1e-4
    with pytest.raises(ValueError, match=r"condition has shape None, but .* needs \(\d, 3\)"):
        predictor(**given)


@pytest.mark.parametrize(("name", "scenario"), [("perturbed", physics.Perturbed), ("inclined", physics.Inclined)])
def test_show_writes_a_strip_and_an_animation(name, scenario, tmp_path, monkeypatch):
    monkeypatch.setitem(show.SCENARIOS, name, dataclasses.replace(show.SCENARIOS[name], scenario=scenario(frames=4)))
    show.main(show.Config(name, num=1, out=tmp_path, size=32))
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"{name}-0.gif", f"{name}-0.png"]
    with Image.open(tmp_path / f"{name}-0.gif") as film:
        assert film.n_frames == 4
        first = np.asarray(film.convert("RGB")).astype(int)
        film.seek(2)
        later = np.asarray(film.convert("RGB")).astype(int)

    def red(page):
        return int(((page[..., 0] > 200) & (page[..., 1:].max(-1) < 60)).sum())

    # Gravity has a component along a slope in every frame, and along a jerked pad during the jerk.
    assert red(later) > 50 + (red(first) if name == "perturbed" else 0)


@pytest.fixture
def tiny_preset(monkeypatch):
    """The run of this file as a preset that benchmarks know."""
    monkeypatch.setitem(EXPERIMENTS, "perturbed", types.SimpleNamespace(PRESETS={"smoke": TINY}))


@pytest.mark.long
@pytest.mark.usefixtures("tiny_preset")
def test_a_scaling_curve_reuses_trained_models(workdir, tmp_path):
    args = scaling.Args(workdir, "perturbed", "smoke", shares=(0.5,), steps=(4,), seeds=(0, 1), out=tmp_path / "a.png")
    text = scaling.main(args)
    rows = [line for line in text.splitlines() if line.startswith(("| visual", "| visual and pose"))]
    assert len(rows) == 2 * 2 * 2  # sizes, seeds, subsets
    assert {f"{number} trajectories, 4 steps" for number in (4, 8, 14)} >= {
        row.split(": ")[1].split(", seed")[0] for row in rows
    }
    with Image.open(tmp_path / "a.png") as picture:
        assert picture.size[0] > 300
    stamps = {path: path.stat().st_mtime_ns for path in (workdir / "scaling").rglob("*") if path.is_file()}
    assert scaling.main(args) == text
    assert stamps == {path: path.stat().st_mtime_ns for path in (workdir / "scaling").rglob("*") if path.is_file()}


@pytest.mark.usefixtures("tiny_preset")
def test_the_deterministic_network_is_judged_beside_the_baselines(workdir):
    text = deterministic.main(deterministic.Args(workdir, "perturbed", "smoke", seconds=1.0))
    for name in (deterministic.TITLE, "nearest neighbour", "rests below its start"):
        assert f"| {name} |" in text


def test_a_film_without_curves_is_smooth_and_ends_after_the_motion(tmp_path):
    """A bottle that is jerked moves for less than 1 s of its 1.9 s."""
    show.main(show.Config("perturbed", num=1, out=tmp_path, size=32, film="webp", curves=False))
    with Image.open(tmp_path / "perturbed-0.webp") as film:
        assert film.format == "WEBP"
        width, height = film.size
        assert width == 3 * show.SIDE
        assert height < 1.3 * show.SIDE
        assert 15 < film.n_frames < 100
