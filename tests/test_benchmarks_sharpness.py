"""The benchmark of the conditions for sharp pictures: what each condition changes, and a tiny run."""

import dataclasses
import types

import numpy as np
import pytest

import sts_jax as sts
from benchmarks import sharpness
from experiments.shared import run

BASE = sharpness.World(sharpness.PRESETS["default"].collection)


def differing(one, other) -> set[str]:
    """Names of the fields of two worlds, collections or scenarios that differ."""
    fields = (field.name for field in dataclasses.fields(one))
    return {name for name in fields if getattr(one, name) != getattr(other, name)}


@pytest.mark.parametrize(
    ("name", "world", "collection", "scenario"),
    [
        ("default", set(), set(), set()),
        ("crop", {"collection"}, {"crop"}, set()),
        ("near", {"collection"}, {"scenario"}, {"spread"}),
        ("short", {"collection"}, {"scenario"}, {"frames"}),
        ("trajectory", {"split"}, set(), set()),
        ("few", {"collection", "split"}, {"num_objects", "num_per_object"}, set()),
        ("off", {"collection"}, {"scenario"}, {"fill", "shell_scale", "friction"}),
        ("clear", {"skin"}, set(), set()),
        ("training", {"schedule"}, set(), set()),
        ("last", {"frames"}, set(), set()),
    ],
)
def test_a_condition_changes_one_thing(name, world, collection, scenario):
    changed = sharpness.CONDITIONS[name][1](BASE)
    assert differing(changed, BASE) == world
    assert differing(changed.collection, BASE.collection) == collection
    assert differing(changed.collection.scenario, BASE.collection.scenario) == scenario


@pytest.mark.slow
def test_all_has_every_change_and_a_clear_skin_only_transmits():
    changed = sharpness.CONDITIONS["all"][1](BASE)
    assert differing(changed, BASE) == {"collection", "split", "skin"}
    assert changed.collection.num_trajectories == BASE.collection.num_trajectories // sharpness.FEW * sharpness.FEW
    assert differing(changed.collection, BASE.collection) == {"scenario", "crop", "num_objects", "num_per_object"}
    clear = run.sensor(changed.skin)
    clear.check()
    body = sts.objects.make(sharpness.jax.random.key(0), "scissors")
    pose = np.array([0, 0, 0.05, 1, 0, 0, 0], np.float32)
    frame, hazy = (sts.sense(sensor, body, pose) for sensor in (clear, run.sensor("hazy")))
    np.testing.assert_allclose(frame.visual[::63, ::63], np.broadcast_to(clear.room.background, (2, 2, 3)), atol=1e-3)
    assert np.all(hazy.visual[::63, ::63] < frame.visual[::63, ::63])  # the corners are dark
    contrast, pale = (np.ptp(np.asarray(one.visual)[one.segmentation], axis=0).max() for one in (frame, hazy))
    assert contrast > pale


def test_parts_of_both_splits_are_disjoint_and_equally_large(monkeypatch):
    data = types.SimpleNamespace(collection={"shares": (0.7, 0.1, 0.2)}, rendered=lambda: np.arange(100))
    both = {"train": np.arange(80), "validation": np.arange(80), "test": np.arange(80, 100)}
    monkeypatch.setattr(sharpness.evaluation, "rows_of", lambda *_: both)
    parts = sharpness.parts(data, "trajectory")
    assert [len(part) for part in parts] == [70, 10, 20]
    assert sorted(np.concatenate(parts)) == list(range(100))


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:visual shows no object")  # the control has the last image as input
def test_a_tiny_run_prints_a_table_and_resumes(tmp_path, capsys):
    args = sharpness.Args(("default", "last"), tmp_path, steps=2, trajectories=48, longer=("default",), repeated=())
    table = sharpness.main(args)
    assert [line.split()[1].rstrip(",") for line in table.splitlines()[2:7]] == ["default"] * 2 + ["last"] + [
        "default"
    ] * 2
    copies = [line.split("|")[-2] for line in table.splitlines() if line.startswith("| last")]
    assert [float(value) for value in copies] == [1.0]  # the input is the target
    assert (tmp_path / "sharpness.png").stat().st_size > 0
    written = sorted((path, path.stat().st_mtime_ns) for path in tmp_path.glob("*/*/*"))
    assert sharpness.main(args) == table
    assert sorted((path, path.stat().st_mtime_ns) for path in tmp_path.glob("*/*/*")) == written
