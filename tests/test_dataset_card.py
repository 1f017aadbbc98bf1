"""The data card of a dataset against a recount of made-up shards."""

import dataclasses

import numpy as np
import yaml

import sts_jax as sts
from sts_jax import dataset
from sts_jax.dataset.card import card

COLLECTION = dataset.Collection(
    sts.physics.Perturbed(frames=20), ("bottle", "fork"), num_objects=10, num_per_object=3, num_views=2, seed=4
)
SPLIT = dataset.split_objects(COLLECTION)


def shard(members, seed):
    """The arrays of a shard with random values, without those that the card does not need."""
    rng = np.random.default_rng(seed)
    num, frames = 3 * len(members), COLLECTION.scenario.frames
    outcomes = [int(outcome) for outcome in COLLECTION.scenario.outcomes]
    stored = [(i, t) for i in range(0, num, 2) for t in (range(frames) if i == 0 else (0, frames - 1))]
    return {
        "trajectory/time": np.tile(np.arange(frames, dtype=np.float32) / 31.25, (num, 1)),
        "trajectory/velocity": np.zeros((num, frames, 6), np.float32),
        "trajectory/wrench": rng.normal(size=(num, frames, 6)).astype(np.float32),
        "trajectory/outcome": rng.choice(outcomes, num).astype(np.int32),
        "trajectory/settled": rng.random(num) < 0.8,
        "trajectory/touches": rng.integers(1, 9, num).astype(np.int32),
        "trajectory/condition": rng.normal(size=(num, 3)).astype(np.float32),
        "trajectory/resampled": rng.integers(0, 2, num).astype(np.int32),
        "trajectory/body": np.repeat(members, 3).astype(np.int32),
        "hidden/fill": rng.random(num).astype(np.float32),
        "hidden/shell_scale": rng.random(num).astype(np.float32),
        "hidden/friction": rng.random(num).astype(np.float32),
        "solid/mass": rng.random(num).astype(np.float32),
        "view/body": np.repeat(members, 2).astype(np.int32),
        "frames": np.array(stored, np.int32),
        "left_out": np.array(["object 9 (fork): too flat"] if 8 in members else [], str),
    }


SHARDS = [shard(np.arange(5), 1), shard(np.arange(5, 9), 2)]
for moving in (0, 7):  # frame of the first shard's first trajectory that is the last to move, and of its second one
    SHARDS[0]["trajectory/velocity"][moving // 7, : moving + 1, 0] = 0.006


def written(shards=SHARDS, sensor=None, **changes):
    collection = dataclasses.replace(COLLECTION, **changes)
    return card(collection, sensor or sts.Sensor(), SPLIT, iter(shards), version="1.2.3")


def cells(text):
    """The cells of all rows of tables, by the first cell."""
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:1] == "|"]
    return {row[0]: row[1:] for row in rows}


def both(name):
    return np.concatenate([one[name] for one in SHARDS])


def test_counts_and_shares_are_those_of_a_recount():
    rows = cells(written())
    assert rows["trajectories"] == ["train", "validation", "test", "all"]
    body, outcome = both("trajectory/body"), both("trajectory/outcome")
    for number in COLLECTION.scenario.outcomes:
        for cell, part in zip(rows[str(number)], (*SPLIT.values(), np.arange(10)), strict=True):
            here = np.isin(body, part)
            count = int((here & (outcome == number)).sum())
            assert cell == f"{count} ({100 * count / here.sum():.1f}%)"
    for remainder, name in enumerate(("bottle", "fork")):
        for cell, part in zip(rows[name], (*SPLIT.values(), np.arange(10)), strict=True):
            assert int(cell.split()[0]) == (np.isin(body, part) & (body % 2 == remainder)).sum()
    frames = 2 * 20 + 2 * 7 + 2 * 5  # one full trajectory per shard, and every second one of 15 and of 12
    assert rows["with images"] == ["14"]
    assert rows["with images of every frame"] == ["2"]
    assert rows["stored frames"] == [str(frames)]
    assert rows["images"] == [str(2 * frames + 18)]
    assert rows["objects that could not be used"] == ["1"]
    assert rows["draws that were discarded and drawn again"] == [str(both("trajectory/resampled").sum())]
    assert rows["settled at the end"][0].split()[0] == str(both("trajectory/settled").sum())


def test_ranges_are_those_of_a_recount():
    rows = cells(written())
    force = np.sqrt((both("trajectory/wrench")[..., :3].astype(np.float64) ** 2).sum(-1))
    for name, values in (
        ("mass (kg)", both("solid/mass")),
        ("acceleration y (m/s²)", both("trajectory/condition")[:, 1]),
        ("duration (s)", both("trajectory/condition")[:, 2]),
        ("largest force (N)", force.max(1)),
        ("force in the last frame (N)", force[:, -1]),
        ("time until rest (s)", [1 / 31.25, 8 / 31.25, *[0.0] * 25]),
    ):
        stated = [float(cell) for cell in rows[name]]
        np.testing.assert_allclose(stated, [np.min(values), np.mean(values), np.max(values)], rtol=1e-3, atol=1e-6)


def test_the_front_matter_is_that_of_a_hugging_face_card():
    text = written()
    assert text.startswith("---\n")
    front = yaml.safe_load(text.split("---\n")[1])
    assert front["size_categories"] == ["n<1K"]
    assert front["license"] == "other"
    assert front["license_name"]
    assert front["pretty_name"].startswith("Perturbed")
    assert "robotics" in front["task_categories"]


def test_the_card_names_what_determines_the_data(tmp_path):
    text = written()
    assert text == written()
    assert "`sts_jax` 1.2.3" in text
    assert "seed 4" in text
    assert "| `frames` | 20 |" in text
    assert "default one." in text
    sensor = sts.Sensor()
    gel = dataclasses.replace(sensor.gel, stiffness=2 * sensor.gel.stiffness)
    changed = written(sensor=dataclasses.replace(sensor, gel=gel))
    assert f"| `gel.stiffness` | {2 * float(sensor.gel.stiffness):g} |" in changed
    meshes = dataset.Meshes(str(tmp_path / "mugs"), tuple("abcdefghij"), ("mug",) * 10, "0")
    of_files = written(meshes=meshes)
    assert "10 objects from mesh files (folder `mugs`), whose own licences" in of_files
    assert str(tmp_path) not in of_files
