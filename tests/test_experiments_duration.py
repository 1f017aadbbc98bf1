"""The expected duration of an experiment, from rates that a fake clock measures."""

import dataclasses

import pytest
from experiments.shared.duration import Line, Rate

from experiments import freefall
from experiments.shared import duration
from sts_jax import dataset

CONFIG = dataclasses.replace(
    freefall.SMOKE,
    collection=dataclasses.replace(
        freefall.SMOKE.collection,
        num_objects=10,
        num_per_object=4,
        num_rendered=2,
        num_views=3,
        num_full=5,
        shares=(0.5, 0.1, 0.4),
    ),
    splits=("object", "trajectory"),
    rerolls=4,
    num_rerolled=6,
)


@pytest.fixture
def measured(monkeypatch):
    """Collecting takes 10 s and then 4 s for the trajectories, and 20 s and then 8 s for the frames."""
    now, collected = [0.0], []

    def collect(collection, sensor, folder, *, progress):
        first = not collected
        collected.append(collection)
        for stage, seconds in (("trajectories", 10 if first else 4), ("frames", 20 if first else 8)):
            now[0] += seconds
            progress(dataset.Progress(1, 1, stage))

    monkeypatch.setattr(duration.dataset, "collect", collect)
    monkeypatch.setattr(duration.dataset, "load", lambda folder: None)
    monkeypatch.setattr(duration.time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(duration, "_training", lambda *_: [Line("train model: 8 steps", 30.0, "note")])
    monkeypatch.setattr(duration, "_evaluating", lambda *_: Line("evaluate and draw", 5.0, "note"))
    return collected


def test_stages_are_extrapolated_from_the_measured_rates(measured):
    symmetries = len(CONFIG.collection.scenario.symmetries)
    lines = duration.plan(CONFIG, num=64).splitlines()
    assert [len(measured), measured[0].num_objects, measured[0].num_per_object] == [2, 8, 8]
    frames = 10 * 2 * 2 + 5 * (CONFIG.collection.scenario.frames - 2) + 10 * 3
    per_trajectory, per_frame = 4 / 64, 8 / (2 * symmetries * 64)
    expected = {
        "collect: 40 trajectories": 6 + 40 * per_trajectory,
        f"collect: {frames} frames": 12 + frames * per_frame,
        "ceilings: 24 trajectories": 2 * 24 * (per_trajectory + per_frame),  # of two splits
        "train model: 8 steps": 2 * 30.0,
        "evaluate and draw": 2 * 5.0,
    }
    found = {line[:36].strip(): float(line[36:45]) for line in lines}
    assert found.pop("together") == pytest.approx(sum(expected.values()), abs=0.5)
    assert found == {part: pytest.approx(seconds, abs=0.5) for part, seconds in expected.items()}


def test_a_program_that_compiles_in_no_time_costs_nothing():
    assert Rate(0.5, -1.0).of(10) == 5
    assert Rate(0.5, 2.0).of(10) == 7


def test_a_configuration_out_of_range_is_refused_before_anything_is_measured(measured):
    with pytest.raises(ValueError, match="image_size must be one of"):
        duration.plan(dataclasses.replace(CONFIG, image_size=50))
    assert not measured
