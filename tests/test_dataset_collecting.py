"""A small dataset, collected and loaded: it is reproducible, it can be resumed, and damage is found."""

import dataclasses
import inspect
import json
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sts_jax as sts
from sts_jax import dataset, evaluation, storage
from sts_jax.dataset.symmetry import turn_wrench

SMALL = dataset.Collection(
    sts.physics.Freefall(frames=12), num_objects=4, num_per_object=2, num_full=1, objects_per_shard=2
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("dataset")
    dataset.collect(SMALL, sts.Sensor(), folder)
    return folder


SPARSE = dataclasses.replace(SMALL, num_rendered=1, num_views=2)


@pytest.fixture(scope="module")
def sparse(tmp_path_factory):
    """The same collection with images of half the trajectories, and with views."""
    folder = tmp_path_factory.mktemp("sparse")
    dataset.collect(SPARSE, sts.Sensor(), folder)
    return folder


@pytest.mark.slow
def test_stored_frames_are_those_that_sense_draws(folder):
    data = dataset.load(folder)
    assert data.trajectory["pose"].shape == (8, 12, 7)
    pairs = data.pairs(np.array([5, 0]), symmetries=True)
    assert pairs.visual.shape == (16, 2, 64, 64, 3)
    body = dataset.make_bodies(SMALL, np.array([2]))[0]
    sense = jax.jit(lambda body, pose, wrench: sts.sense(sts.Sensor(), body, pose, wrench))
    for symmetry in range(8):
        pose = pairs.pose[symmetry, 1]
        wrench = turn_wrench(jnp.asarray(data.trajectory["wrench"][5, -1]), symmetry)
        frame = sense(sts.objects.mirror(body) if symmetry >= 4 else body, jnp.asarray(pose), wrench)
        for stored, drawn in ((pairs.visual, frame.visual), (pairs.tactile, frame.tactile)):
            difference = np.abs(stored[symmetry, 1].astype(int) - np.round(np.asarray(drawn) * 255))
            assert np.mean(difference > 1) < 0.01
    np.testing.assert_array_equal(pairs.trajectory, [5] * 8 + [0] * 8)
    np.testing.assert_array_equal(pairs.object, data.trajectory["body"][pairs.trajectory])


def test_trajectories_do_not_depend_on_the_number_of_rendered_ones(folder, sparse):
    whole, data = dataset.load(folder), dataset.load(sparse)
    for name in ("pose", "outcome", "wrench", "body"):
        np.testing.assert_array_equal(data.trajectory[name], whole.trajectory[name])
    np.testing.assert_array_equal(data.rendered(), [0, 2, 4, 6])
    np.testing.assert_array_equal(data.full_trajectories(), [0])
    assert len(data.frames) == 12 + 3 * 2 + 4 * 14
    for part, objects in data.split.items():
        np.testing.assert_array_equal(data.members(part), 2 * objects)
        np.testing.assert_array_equal(data.members(part, rendered=False), whole.members(part))
    for one, other in zip(data.pairs(np.array([4])), whole.pairs(np.array([4])), strict=True):
        np.testing.assert_array_equal(one, other)
    with pytest.raises(ValueError, match=r"`trajectories` contains 3, which has no images: .* images for 1 of its"):
        data.pairs(np.array([2, 3]))
    rows = evaluation.rows_of(data, "trajectory")
    np.testing.assert_array_equal(np.sort(np.concatenate([rows["train"], rows["test"]])), data.rendered())
    ends = data.ends(np.array([3, 0]))
    np.testing.assert_array_equal(ends.pose, whole.trajectory["pose"][[3, 0]][:, [0, -1]])
    np.testing.assert_array_equal(ends.object, [1, 0])
    np.testing.assert_array_equal(ends.trajectory, [3, 0])
    assert [leaf.shape for leaf in ends[1:6]] == [(2, 0), (2,), (2, 128), (2,), (2, 3)]


def test_the_true_shape_and_mass_are_those_of_the_body_with_its_hidden_values(folder):
    data = dataset.load(folder)
    pairs, ends = data.pairs(np.arange(8), symmetries=True), data.ends(np.arange(8))
    bodies, rigid = dataset.make_bodies(SMALL, np.arange(4)), jax.jit(sts.objects.rigid)
    for row, (number, trajectory) in enumerate(zip(pairs.object, pairs.trajectory, strict=True)):
        made = sts.objects.mirror(bodies[number]) if row % 8 >= 4 else bodies[number]
        hidden = {name: leaf[trajectory] for name, leaf in data.hidden.items()}
        up = hidden["up"] * (np.array([1, -1, 1], np.float32) if row % 8 >= 4 else 1)
        mass, com, _ = rigid(made, hidden["fill"], hidden["shell_scale"], up)
        np.testing.assert_array_equal(pairs.support[row], sts.objects.support(made))
        np.testing.assert_allclose(pairs.mass[row], mass, rtol=1e-5)
        np.testing.assert_allclose(pairs.com[row], com, atol=1e-7)
    np.testing.assert_allclose(ends.pose, pairs.pose[::8], atol=1e-6)
    for name in ("support", "mass", "com", "outcome", "object", "condition"):
        np.testing.assert_array_equal(getattr(ends, name), getattr(pairs, name)[::8])
    assert {leaf.dtype for leaf in (pairs.support, pairs.mass, pairs.com, pairs.pose)} == {np.dtype(np.float32)}


@pytest.mark.slow
def test_views_are_drawn_by_sense_at_starts_of_no_trajectory(sparse):
    data = dataset.load(sparse)
    sense = jax.jit(lambda body, pose: sts.sense(sts.Sensor(), body, pose, jnp.zeros(6)).visual)
    seen = 0
    for part, members in data.split.items():
        views = data.views(part)
        np.testing.assert_array_equal(views.object, np.repeat(members, 2))
        assert views.visual.shape == (len(views.object), 64, 64, 3)
        for visual, pose, support, mass, com, number in zip(*views, strict=True):
            (body,) = dataset.make_bodies(SPARSE, np.array([number]))
            assert np.mean(np.abs(visual.astype(int) - np.round(np.asarray(sense(body, pose)) * 255)) > 1) < 0.01
            np.testing.assert_array_equal(support, sts.objects.support(body))
            assert 0 < mass < 5
            assert (sts.objects.DIRECTIONS @ com < support).all()
            others = data.trajectory["pose"][data.trajectory["body"] == number, 0]
            assert np.abs(others - pose).max(1).min() > 1e-3
            seen += 1
    assert seen == 8
    assert len(np.unique(data.view["pose"], axis=0)) == 8
    assert dataset.load(sparse).views("test")._fields == dataset.Views._fields


def test_a_collection_without_views_has_none(folder):
    views = dataset.load(folder).views("train")
    assert [leaf.shape for leaf in views] == [(0, 64, 64, 3), (0, 7), (0, 128), (0,), (0, 3), (0,)]
    with pytest.raises(ValueError, match="unknown part 'all'"):
        dataset.load(folder).views("all")


def test_the_sensor_of_a_dataset_can_be_loaded(folder):
    assert sts.Sensor.load(folder / "sensor.json").constants() == sts.Sensor().constants()


def test_full_trajectories_have_all_frames_and_others_two(folder):
    data = dataset.load(folder)
    np.testing.assert_array_equal(data.full_trajectories(), [0])
    assert data.strip(0).visual.shape == (12, 64, 64, 3)
    assert len(data.frames) == 12 + 7 * 2 + 8 * 14


def test_a_resumed_collection_has_the_same_bytes(folder, tmp_path):
    names = sorted(path.name for path in folder.iterdir())
    for name in names:  # a kill after the first shard, with a half-written second one
        if "00001-of" not in name:
            (tmp_path / name).write_bytes((folder / name).read_bytes())
    second = next(name for name in names if name.startswith("shard-00001") and name.endswith("array_record"))
    (tmp_path / second).write_bytes((folder / second).read_bytes()[:1000])
    with pytest.raises(FileNotFoundError, match="not finished"):
        dataset.load(tmp_path)
    before = (tmp_path / "shard-00000-of-00002.npz").stat().st_mtime_ns
    seen = []
    dataset.collect(SMALL, sts.Sensor(), tmp_path, progress=seen.append)
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    for name in names:
        assert (tmp_path / name).read_bytes() == (folder / name).read_bytes(), name
    assert (tmp_path / "shard-00000-of-00002.npz").stat().st_mtime_ns == before
    assert seen[-1].done == seen[-1].total
    stamps = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    dataset.collect(SMALL, sts.Sensor(), tmp_path)
    assert stamps == {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}


@pytest.mark.slow
def test_a_scenario_without_quarter_turns_accepts_any_pad(tmp_path, monkeypatch):
    monkeypatch.setattr(sts.physics.Freefall, "symmetries", (0, 6))
    sensor = sts.Sensor()
    sensor = dataclasses.replace(sensor, gel=dataclasses.replace(sensor.gel, size=(0.15, 0.1)))
    collection = dataclasses.replace(SMALL, num_objects=1, num_per_object=1, num_full=0)
    dataset.collect(collection, sensor, tmp_path)
    pose = dataset.load(tmp_path).pairs(np.array([0]), symmetries=True).pose
    np.testing.assert_allclose(pose[1, :, :3], pose[0, :, :3] * [-1, 1, 1], atol=1e-7)


def test_another_collection_in_the_same_folder_is_refused(folder):
    other = dataclasses.replace(SMALL, scenario=sts.physics.Freefall(frames=12, spread=0.02))
    with pytest.raises(ValueError, match=r"spread = 0\.05, but the current settings have scenario\.spread = 0\.02"):
        dataset.collect(other, sts.Sensor(), folder)


SHARDS = ("shard-00000-of-00002", "shard-00001-of-00002")


@pytest.fixture
def copied(folder, tmp_path):
    """A dataset that may be damaged."""
    return shutil.copytree(folder, tmp_path / "copy")


def swap(one, other):
    between = one.with_name("between")
    one.rename(between)
    other.rename(one)
    between.rename(other)


@pytest.mark.parametrize(
    ("endings", "message"),
    [
        ((".array_record",), r"00000-of-00002\.array_record is damaged or belongs to another shard"),
        ((".npz",), r"00000-of-00002\.npz contains the data of shard 1 instead of shard 0"),
        ((".array_record", ".npz"), r"00000-of-00002\.npz contains the data of shard 1 instead of shard 0"),
    ],
)
def test_swapped_shards_are_refused(copied, endings, message):
    for ending in endings:
        swap(*(copied / f"{name}{ending}" for name in SHARDS))
    with pytest.raises(storage.DamagedFileError, match=message):
        dataset.load(copied)
    with pytest.raises(storage.DamagedFileError, match=message):
        dataset.collect(SMALL, sts.Sensor(), copied)


def test_images_copied_over_others_and_a_flipped_bit_are_refused(copied):
    one, other = (copied / f"{name}.array_record" for name in SHARDS)
    whole = one.read_bytes()
    one.write_bytes(other.read_bytes())
    with pytest.raises(storage.DamagedFileError, match=r"00000.*is damaged or belongs to another shard"):
        dataset.load(copied)
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 4
    one.write_bytes(flipped)
    with pytest.raises(storage.DamagedFileError, match=r"00000.*is damaged or belongs to another shard"):
        dataset.load(copied)
    one.write_bytes(whole)
    assert dataset.load(copied).identity


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda split: split["test"].append(split["train"][0]),
            "object . must be in exactly one of train, validation, test, but it occurs 2 times",
        ),
        (lambda split: split["train"].pop(), "in exactly one of train, validation, test, but it occurs 0 times"),
        (lambda split: split["test"].append(4), "test contains object 4, but the objects are 0 to 3"),
        (lambda split: split["test"].append(-1), "test contains object -1"),
        (lambda split: split["test"].append(1.5), "test must be a list of whole numbers"),
        (lambda split: split.pop("validation"), "must have the parts train, validation, test, got 'train', 'test'"),
        (lambda split: split.update(other=[]), "must have the parts train, validation, test, got .*'other'"),
    ],
)
def test_an_invalid_split_is_refused(copied, change, message):
    path = copied / "split.json"
    split = json.loads(path.read_text())
    change(split)
    path.write_text(json.dumps(split))
    for use in (dataset.load, lambda folder: dataset.collect(SMALL, sts.Sensor(), folder)):
        with pytest.raises(storage.DamagedFileError, match=rf"split\.json.*{message}"):
            use(copied)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("sensor.json", None, r"sensor\.json is missing"),
        ("sensor.json", b'{"gel"', r"sensor\.json cannot be read as JSON"),
        ("sensor.json", b"{}", r"npz was made with a sensor\.json that differs"),
        ("split.json", b"\xff", r"split\.json cannot be read as JSON .*delete .*split\.json and start the collection"),
        ("split.json", b"7", r"split\.json must have the parts train, validation, test, got a int"),
        ("collection.json", None, r"collection\.json is missing: .* is not a collected dataset"),
        ("collection.json", b"\xff", r"collection\.json cannot be read as JSON"),
        ("collection.json", b"[]", r"collection\.json does not describe a dataset"),
        (
            "collection.json",
            b'{"format": 4}',
            r"collection\.json: num_objects must be a whole number of at least 1, got N",
        ),
    ],
)
def test_a_damaged_or_exchanged_description_is_named(copied, name, content, message):
    (copied / name).unlink()
    if content is not None:
        (copied / name).write_bytes(content)
    with pytest.raises(OSError, match=message):
        dataset.load(copied)


def test_a_description_that_was_changed_afterwards_is_named(copied):
    path = copied / "collection.json"
    content = json.loads(path.read_text())
    path.write_text(json.dumps(content, indent=7))  # the layout does not matter
    assert dataset.load(copied).collection == content
    path.write_text(json.dumps({**content, "resolution": [32, 64]}))
    with pytest.raises(storage.DamagedFileError, match=r"was made with a collection\.json that differs"):
        dataset.load(copied)


@pytest.mark.parametrize("older", [1, 3])
def test_an_older_dataset_must_be_collected_again(copied, older):
    path = copied / "collection.json"
    content = json.loads(path.read_text())
    del content["format"]
    path.write_text(json.dumps(content if older == 1 else {**content, "format": older}))
    for use in (dataset.load, lambda folder: dataset.collect(SMALL, sts.Sensor(), folder)):
        with pytest.raises(
            ValueError,
            match=rf"is a dataset of format {older}, but this version of sts_jax reads format 4: delete .* and",
        ):
            use(copied)


@pytest.mark.parametrize("given", [[99], [-1], [0.5], [True, False], 0, "a"])
def test_trajectories_that_do_not_exist_are_named(folder, given):
    with pytest.raises(ValueError, match=r"`trajectories` (has the type|contains)"):
        inspect.unwrap(type(dataset.load(folder)).pairs)(dataset.load(folder), given)


def test_a_file_in_the_place_of_a_dataset_is_named(folder):
    with pytest.raises(NotADirectoryError, match=r"collection\.json is a file: give the folder"):
        dataset.load(folder / "collection.json")


def test_the_identity_of_a_dataset_follows_from_its_files(folder, copied):
    assert dataset.load(copied).identity == dataset.load(folder).identity
    path = copied / "split.json"
    split = json.loads(path.read_text())
    path.write_text(json.dumps({**split, "train": split["test"], "test": split["train"]}))
    assert dataset.load(copied).identity != dataset.load(folder).identity


def test_the_split_of_an_existing_dataset_is_kept(copied):
    path = copied / "split.json"
    split = json.loads(path.read_text())
    other = {**split, "train": split["test"], "test": split["train"]}
    path.write_text(json.dumps(other))
    dataset.collect(SMALL, sts.Sensor(), copied)
    assert json.loads(path.read_text()) == other


def test_a_folder_that_another_process_collects_into_is_refused(copied):
    with storage.lock(copied), pytest.raises(storage.LockedError, match="copy is in use by process"):
        dataset.collect(SMALL, sts.Sensor(), copied)
