"""The command `table1`: its cells and presets, the arithmetic of the claims, the texts, and a small run."""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from benchmarks import table1 as recomputing
from experiments import table1
from experiments.shared import cells, claims
from experiments.shared.cells import Cell
from experiments.shared.claims import Comparison, Estimate, Results, Side
from experiments.shared.run import apart, with_epochs
from sts_jax import evaluation, storage, training

# Table 1 of the paper, row by row
PAPER = """
freefall vae-visual 6522 5750 NA NA
freefall vae-tactile NA NA 6770 *6703
freefall mvae 6548 *5741 6726 *6703
freefall mvae-without-pose 6635 5752 6735 *6703
inclined vae-visual 6751 5895 NA NA
inclined vae-tactile NA NA 6714 6711
inclined mvae 6625 *5891 6719 *6709
inclined mvae-without-pose 6549 *5890 6713 *6710
perturbed vae-visual 7369 6158 NA NA
perturbed vae-tactile NA NA 6879 6705
perturbed mvae 7552 *6054 6868 *6701
perturbed mvae-without-pose 6967 6095 6896 *6702
"""


def small(preset=table1.SMOKE, **fields):
    return dataclasses.replace(preset, **fields)


@pytest.mark.parametrize("name", table1.PRESETS)
def test_every_preset_can_be_run_and_has_all_its_cells(name):
    config = table1.PRESETS[name]
    cells.check(config)
    found = list(cells.cells(config))
    assert len(found) == len(set(found)) == {"smoke": 37, "default": 111, "paper": 72}[name]
    assert [cell.seed for cell in found] == sorted(cell.seed for cell in found)
    of_freefall = {f"{cell.model}-{cell.scale}" for cell in found if cell.scenario == "freefall"}
    assert not {name for name in of_freefall if "visual-tactile" in name or "visual-pose" in name}
    assert all(cells.estimated_s(config, cell) > 0 for cell in found)


def test_the_preset_paper_has_the_counts_and_the_options_of_the_paper():
    config = table1.PAPER
    counts = {name: config.collection(name).num_full for name in config.scenarios}
    assert counts == {"freefall": 1700, "inclined": 2400, "perturbed": 2500}
    assert all(config.collection(name).crop for name in config.scenarios)
    assert (config.training.epochs, config.training.steps, config.training.batch_size) == (200, None, 64)
    assert (config.split, config.targets, config.mask_blank_touch) == ("trajectory", "own", False)
    assert (config.encode_condition, config.prior, config.stride) == (True, "conditional", 1)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"seeds": ()}, "seeds must have one or more different values"),
        ({"models": ("mvae", "mvae")}, "models must have one or more different values"),
        ({"stride": 4}, "stride must divide the 11 frames from the first to the last of freefall, got 4"),
        ({"rerolls": 0}, "rerolls must be >= 1"),
        ({"moments": (-1,)}, "moments must be >= 0"),
        ({"seeds": (-1,)}, "seed must be"),
        ({"freefall": dataclasses.replace(table1.SMOKE.freefall, crop=True)}, "crop must be False for the state-space"),
        ({"freefall": dataclasses.replace(table1.SMOKE.freefall, num_objects=3)}, "is empty"),
    ],
)
def test_a_wrong_field_is_an_error_before_anything_is_written(fields, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        table1.main(small(**fields), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def scores_of(rng, streams, items, level):
    """Errors of images: excess, cross-entropy 0.5 above it, and pixels."""
    found = {}
    for stream in streams:
        excess = level + rng.normal(0, 1, items)
        found[f"last/{cells.ALL}/{stream}_bce"] = np.stack([excess + 500, excess, np.full(items, 100.0)], 1)
        found[f"best/{cells.ALL}/{stream}_bce"] = found[f"last/{cells.ALL}/{stream}_bce"] + [1, 1, 0]
    return found


def synthetic(levels, scenario="inclined", seeds=(0, 1, 2), objects=20, each=3):
    """Results whose mean excess is given by model and scale."""
    rng, items = np.random.default_rng(0), objects * each
    of_stream = {"vae-visual": ("visual",), "vae-tactile": ("tactile",)}
    found = {
        Cell(scenario, model, scale, seed): scores_of(rng, of_stream.get(model, claims.STREAMS), items, level)
        for (model, scale), level in levels.items()
        for seed in seeds
    }
    references = {
        f"{name}/{cells.ALL}/{stream}_bce": np.tile([[500.0 + level, level, 100]], (items, 1))
        for name, level in (("constant", 40.0), ("copy", 60.0), ("ceiling", 2.0))
        for stream in claims.STREAMS
    }
    return Results(scenario, np.repeat(np.arange(objects), each), seeds, found, references)


def test_epochs_replace_the_steps_of_the_preset():
    config = with_epochs(table1.DEFAULT, frozenset({"training.epochs"}))
    assert (config.training.steps, config.state_training.steps) == (None, 300)
    config = with_epochs(table1.DEFAULT, frozenset({"state-training.epochs", "state-training.steps"}))
    assert (config.training.steps, config.state_training.steps) == (300, 300)


@pytest.mark.parametrize("split", ["object", "trajectory"])
def test_no_validation_trajectory_is_trained_on(split):
    parts = {"train": np.arange(3, 40), "validation": np.arange(3, 40), "test": np.arange(40, 50)}
    if split == "object":
        parts["validation"] = np.arange(3)
    used = apart(parts, split)
    assert sorted(np.concatenate(list(used.values()))) == list(range(3 if split == "trajectory" else 0, 50))
    assert len(used["validation"]) == (4 if split == "trajectory" else 3)


def test_intervals_are_those_of_a_bootstrap_written_as_loops():
    rng = np.random.default_rng(1)
    objects = np.array([0, 0, 0, 1, 2, 2, 3, 4, 4, 4])
    values, count = rng.normal(1, 1, (3, 10)), np.full((3, 10), 2.0)
    values += 2 * objects  # objects differ
    values += np.array([[0.0], [3.0], [5.0]])  # and so do seeds
    found = claims.ratio(values, count, claims.resample(objects, 3, num=4000))
    draws = []
    for _ in range(4000):
        total = whole = 0.0
        chosen = [np.flatnonzero(objects == one) for one in rng.integers(0, 5, 5)]
        for seed in rng.integers(0, 3, 3):
            for rows in chosen:
                total += values[seed, rows].sum()
                whole += count[seed, rows].sum()
        draws.append(total / whole)
    assert found.value == pytest.approx(values.sum() / count.sum())
    low, high = np.percentile(draws, [2.5, 97.5])
    assert (found.low, found.high) == pytest.approx((low, high), abs=0.06 * (high - low))


def test_one_object_has_no_interval_and_decides_nothing():
    assert claims.resample(np.zeros(5, int), 3) is None
    found = claims.ratio(np.ones((1, 5)), np.ones((1, 5)), None)
    assert found == Estimate(1.0, None, None)
    assert claims.verdict([Estimate(-1.0, None, None)]) == claims.UNDECIDED


@pytest.mark.parametrize(
    ("intervals", "expected"),
    [
        ([(-2, -1)], "holds"),
        ([(-2, -1), (-2, 1)], "undecided"),
        ([(-2, -1), (1, 2)], "does not hold"),
        ([(-2, 1), (1, 2)], "does not hold"),
        ([], "undecided"),
    ],
)
def test_a_claim_holds_if_all_of_its_differences_are_below_0(intervals, expected):
    assert claims.verdict([Estimate(sum(x) / 2, *x) for x in intervals]) == expected


def levels(**changes):
    """Mean excess of each cell: the final step is better, and touch helps."""
    base = {(model, scale): {"final": 10.0, "step": 20.0}[scale] for model in cells.PAPER for scale in claims.SCALES}
    base |= {("vae-visual", "final"): 12.0, ("vae-tactile", "final"): 12.0}
    base |= {("statespace", "final"): 5.0, ("statespace", "step"): 4.0}
    base |= {(f"statespace-{name}", "final"): 5.0 for name in ("visual-tactile", "visual-pose", "visual")}
    return base | changes


def test_claims_follow_from_the_scores():
    one = claims.summarise(synthetic(levels()))
    found = {(each.family, each.claim): (each.last, each.best) for each in one.verdicts}
    assert found["paper", "a"] == found["paper", "b"] == ("holds", "holds")
    assert found["statespace", "b"] == ("does not hold", "does not hold")
    assert found["statespace", "a"] == ("undecided", "undecided")  # nothing was predicted from touch alone
    (row,) = (r for r in one.rows if (r.side, r.weights, r.stream) == (Side("mvae"), "last", "visual"))
    assert row.excess.value == pytest.approx(0.1, abs=0.01)
    assert row.skill.value == pytest.approx(0.75, abs=0.02)
    assert len(row.bce_of_seed) == 3
    assert np.mean(row.bce_of_seed) == pytest.approx(row.bce.value)
    first = one.verdicts[0].differences[0]
    assert first.comparison == Comparison(Side("mvae-without-pose"), Side("vae-visual"), "visual")
    assert first.last.value == pytest.approx(-0.02, abs=0.004)
    text = claims.verdicts([one])
    assert "- The paper's models, claim (a): **holds**: MVAE without pose minus VAE visual only, visual -" in text
    assert "- The state-space model, claim (b): **does not hold**: state-space model minus state-space model" in text
    json.dumps(dataclasses.asdict(one))


def test_touch_cannot_be_judged_where_the_first_frame_has_none():
    fewer = {key: level for key, level in levels().items() if key[0] not in ("statespace-visual-tactile",)}
    text = claims.verdicts([claims.summarise(synthetic(fewer, "freefall"))])
    assert "claim (a): **undecided**, because nothing touches the pad in the first frame." in text


def test_the_table_has_the_papers_numbers_beside_ours():
    every = [claims.summarise(synthetic(levels(), name)) for name in table1.DEFAULT.scenarios]
    text = claims.table(every, title="Table 1", notes=["All alike."])
    rows = {
        tuple(x.strip() for x in line.split("|")[1:3]): line.split("|")[3:7]
        for line in text.splitlines()
        if line.startswith("| ")
    }
    for line in PAPER.split("\n")[1:-1]:
        scenario, model, *numbers = line.split()
        found = [cell.strip() for cell in rows[scenario, cells.NAMES[model]]]
        for cell, number in zip(found, numbers, strict=True):
            if number == "NA":
                assert cell == "NA"
            else:
                bold = f"**{number[1:]}**" if number[0] == "*" else number
                assert cell.endswith(f"({bold})")
                assert float(cell.split(" ")[0].strip("*")) > 50_000
    ours = [cell.strip() for cell in rows["inclined", "MVAE with pose"]]
    assert ours[1].startswith("**")
    assert not ours[0].startswith("**")
    assert "(" not in "".join(rows["inclined", "state-space model"])
    assert "| VAE visual only, final-step |" in text
    assert "| VAE visual only, rolled out |" in text


FEW = small(models=("mvae-without-pose", "vae-visual"), scenarios=("perturbed",))


@pytest.fixture(scope="module")
def workdir(tmp_path_factory):
    """A run that is killed after its second cell, and continued."""
    workdir, trained, real = tmp_path_factory.mktemp("runs") / "table1", [], cells.train_model

    def train(job, folder, *args, **options):
        if len(trained) == 2:
            raise KeyboardInterrupt
        trained.append(job.name)
        real(job, folder, *args, **options)

    patch = pytest.MonkeyPatch()
    patch.setattr(jax, "clear_caches", lambda: None)  # the programs of four models fit into memory
    patch.setattr(cells, "train_model", train)
    with pytest.raises(KeyboardInterrupt):
        table1.main(FEW, workdir)
    assert not (workdir / "table1.md").exists()
    patch.setattr(
        cells, "train_model", lambda job, *args, **options: (trained.append(job.name), real(job, *args, **options))
    )
    table1.main(dataclasses.replace(FEW, in_memory=False), workdir)  # as one may do after the memory was full
    patch.setattr(cells, "train_model", real)
    assert sorted(trained) == sorted(cell.name for cell in cells.cells(FEW))  # each was trained once
    yield workdir
    patch.undo()


@pytest.mark.slow
def test_a_finished_run_is_left_unchanged_and_another_seed_can_follow(workdir, capsys):
    stamps = {path: path.stat().st_mtime_ns for path in workdir.rglob("*") if path.is_file() and path.suffix != ".lock"}
    table1.main(FEW, workdir)
    again = {path: path.stat().st_mtime_ns for path in stamps}
    assert stamps == again
    assert "claim (b)" in capsys.readouterr().out
    with pytest.raises(ValueError, match=r"config.json was made with num_validated"):
        table1.main(dataclasses.replace(FEW, num_validated=2), workdir)


@pytest.mark.slow
def test_the_numbers_are_those_of_the_stored_models(workdir):
    names = tuple(
        f"perturbed/{name}-seed0" for name in ("mvae-without-pose-final", "mvae-without-pose-step", "vae-visual-step")
    )
    text = recomputing.main(recomputing.Args(workdir, names))
    assert len(text.splitlines()) == 2 + 2 * (2 + 2 + 1)
    content = storage.read_json(workdir / "metrics.json", "")
    row = next(r for r in content["scenarios"][0]["rows"] if r["side"]["model"] == "vae-visual")
    row["bce_of_seed"][0] += 1e-4
    changed = workdir / "metrics.json"
    before = changed.read_bytes()
    storage.write_json(changed, content)
    try:
        with pytest.raises(ValueError, match="but it is"):
            recomputing.main(recomputing.Args(workdir, (f"perturbed/vae-visual-{row['side']['scale']}-seed0",)))
    finally:
        changed.write_bytes(before)


@pytest.mark.slow
def test_no_held_out_object_is_in_a_training_or_validation_batch(workdir):
    config, sensor = FEW, table1.sts.Sensor()
    scene = cells.scene(config, "perturbed", sensor, workdir)
    held_out = set(scene.data.split["test"].tolist())
    for cell in cells.cells(config):
        job, validation = cells.prepared(config, sensor, scene, cell)
        frames = scene.data.images(np.arange(len(scene.data.frames)))
        objects = scene.data.trajectory["body"][scene.data.frames[:, 0]]
        known = {image.tobytes(): index for image, index in zip(frames.visual, objects, strict=True)}
        for arrays in (job.arrays, validation):
            batch = arrays.take(np.arange(len(arrays)))
            images = [image.tobytes() for group in ("inputs", "targets") for image in batch[group]["visual"]]
            found = {known[image] for image in images if image != scene.empty["visual"].tobytes()}
            assert found
            assert not found & held_out


@pytest.mark.long
def test_the_command_runs_where_the_first_frame_has_no_touch(tmp_path):
    root = Path(__file__).parents[1]
    words = ["--preset", "smoke", "--scenarios", "freefall", "--models", "mvae", "vae-tactile", "statespace"]
    words += ["--freefall.resolution", "32", "32", "--workdir", str(tmp_path / "run")]
    done = subprocess.run(
        [sys.executable, "-m", "experiments.table1", *words],
        cwd=root,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(root), os.environ.get("PYTHONPATH", "")])},
        capture_output=True,
        text=True,
        timeout=3600,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr.startswith("6 models, about ")
    assert "[6/6] freefall/statespace-step-seed0" in done.stderr
    assert "The state-space model, claim (b): **" in done.stdout
    drawn = {path.stem for path in (tmp_path / "run" / "figures" / "freefall").glob("*.png")}
    sheets = {f"{kind}-{model}" for kind in ("predictions", "rollout") for model in ("mvae", "statespace")}
    assert sheets | {"models", "errors"} <= drawn
    assert "# freefall: MVAE with pose, final-step" in (tmp_path / "run" / "probes.md").read_text()
    recomputed = recomputing.main(recomputing.Args(tmp_path / "run"))
    assert {line.split(" | ")[0] for line in recomputed.splitlines()[2:]} == {
        f"| freefall/{name}-seed0" for name in ("mvae-final", "mvae-step", "statespace-final")
    }


def discs(rng, count, side=32):
    """Pairs of images of a disc that moves by a third of the image, uint8 (count, 2, side, side, 3)."""
    centre = rng.uniform(0.2 * side, 0.5 * side, (count, 1, 2)) + np.array([[0, 0], [0.3 * side, 0.3 * side]])
    row, column = np.indices((side, side))
    far = np.hypot(row - centre[..., 0, None, None], column - centre[..., 1, None, None])
    return np.repeat(np.where(far < 5, 40, 180)[..., None], 3, -1).astype(np.uint8)


@pytest.mark.slow
@pytest.mark.parametrize("shuffled", [False, True])
def test_shuffled_targets_give_no_skill(shuffled, tmp_path):
    rng = np.random.default_rng(0)
    train, test, blank = discs(rng, 4096), discs(rng, 64), np.full((32, 32, 3), 180, np.uint8)
    if shuffled:
        train[:, 1] = train[rng.permutation(len(train)), 1]
    arrays, view = training.image_arrays(train, train, ("visual",), training.Preprocessing((32, 32)), blank)
    schedule = training.TrainConfig(steps=100, batch_size=16, learning_rate=2e-3, schedule="cosine", encoder_epsilon=3)
    training.save_blank(tmp_path, blank, blank)
    training.train(
        schedule,
        training.paper_model(("visual",), view),
        arrays,
        workdir=tmp_path,
        preprocessing=dataclasses.asdict(view),
    )
    predicted = np.asarray(table1.sts.Predictor.load(tmp_path)(visual=test[:, 0] / 255).visual)
    truth, constant = test[:, 1] / 255, np.broadcast_to(train[:, 1].mean(0) / 255, predicted.shape)
    errors, reference = (evaluation.metrics.image_error(x, truth).excess for x in (predicted, constant))
    found = claims.ratio(errors[None], reference[None], claims.resample(np.arange(64), 1))
    if shuffled:
        assert abs(1 - found.value) < 0.1
    else:
        assert 1 - found.value > 0.5


def test_the_table_is_written_after_each_seed_of_a_scenario(tmp_path, monkeypatch):
    written = []
    for name in ("scene", "references", "compute"):
        monkeypatch.setattr(cells, name, lambda *_: None)
    monkeypatch.setattr(table1, "write", lambda *_: written.append(1))
    monkeypatch.setattr(table1, "draw", lambda *_: None)
    monkeypatch.setattr(table1, "ending", lambda _: "")
    table1.main(small(scenarios=("freefall",), seeds=(0, 1), models=("vae-visual",)), tmp_path)
    assert len(written) == 2


def test_the_claims_say_how_long_the_models_of_the_paper_are_trained():
    one = claims.summarise(synthetic(levels()))
    text = claims.verdicts([one], equal_steps=False, split="trajectory")
    assert "with the same number of epochs, so one-step models make more steps, and batches" in text
    assert "The validation trajectories are the training trajectories." in text
