"""A small dataset, collected and loaded: it is reproducible, it can be resumed, and damage is found."""

import dataclasses
import inspect
import itertools
import json
import shutil

import fsspec
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sts_jax as sts
from sts_jax import dataset, evaluation, storage

SMALL = dataset.Collection(
    sts.physics.Freefall(frames=12), num_objects=4, num_per_object=2, num_full=1, objects_per_shard=2
)
SPARSE = dataclasses.replace(SMALL, num_rendered=1, num_views=2)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("dataset")
    dataset.collect(SMALL, sts.Sensor(), folder)
    return folder


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
    pairs = data.pairs(np.array([5, 0]))
    assert pairs.visual.shape == (2, 2, 64, 64, 3)
    sense = jax.jit(lambda body, pose, wrench: sts.sense(sts.Sensor(), body, pose, wrench))
    for row, (number, trajectory) in enumerate(((2, 5), (0, 0))):
        (body,) = dataset.make_bodies(SMALL, np.array([number]))
        for place in (0, -1):
            pose, wrench = (jnp.asarray(data.trajectory[name][trajectory, place]) for name in ("pose", "wrench"))
            frame = sense(body, pose, wrench)
            for stored, drawn in ((pairs.visual, frame.visual), (pairs.tactile, frame.tactile)):
                difference = np.abs(stored[row, place].astype(int) - np.round(np.asarray(drawn) * 255))
                assert np.mean(difference > 1) < 0.01
    np.testing.assert_array_equal(pairs.trajectory, [5, 0])
    np.testing.assert_array_equal(pairs.object, [2, 0])


@pytest.mark.slow
def test_trajectories_do_not_depend_on_the_number_of_rendered_ones(folder, sparse):
    whole, data = dataset.load(folder), dataset.load(sparse)
    for name in ("pose", "outcome", "wrench", "body"):
        np.testing.assert_array_equal(data.trajectory[name], whole.trajectory[name])
    np.testing.assert_array_equal(data.rendered(), [0, 2, 4, 6])
    for one, frames in ((data, 12 + 3 * 2), (whole, 12 + 7 * 2)):  # others have two frames
        np.testing.assert_array_equal(one.full_trajectories(), [0])
        assert one.strip(0).visual.shape == (12, 64, 64, 3)
        assert len(one.frames) == frames
    shapes = [leaf.shape for leaf in whole.views("train")]  # none
    assert shapes == [(0, 64, 64, 3), (0, 7), (0, 128), (0,), (0, 3), (0,)]
    for part, objects in data.split.items():
        np.testing.assert_array_equal(data.members(part), 2 * objects)
        np.testing.assert_array_equal(data.members(part, rendered=False), whole.members(part))
    for one, other in zip(data.pairs(np.array([4])), whole.pairs(np.array([4])), strict=True):
        np.testing.assert_array_equal(one, other)
    with pytest.raises(ValueError, match=r"`trajectories` contains 3, which has no images: use `ends`"):
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
    pairs, ends = data.pairs(np.arange(8)), data.ends(np.arange(8))
    bodies = dataset.make_bodies(SMALL, np.arange(4))
    for row, number in enumerate(pairs.object):
        hidden = {name: leaf[row] for name, leaf in data.hidden.items()}
        mass, com, _ = sts.objects.rigid(bodies[number], hidden["fill"], hidden["shell_scale"], hidden["up"])
        np.testing.assert_array_equal(pairs.support[row], sts.objects.support(bodies[number]))
        np.testing.assert_allclose(pairs.mass[row], mass, rtol=1e-5)
        np.testing.assert_allclose(pairs.com[row], com, atol=1e-7)
    np.testing.assert_allclose(ends.pose, pairs.pose, atol=1e-6)
    for name in ("support", "mass", "com", "outcome", "object", "condition"):
        np.testing.assert_array_equal(getattr(ends, name), getattr(pairs, name))
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


SHARDS = ("shard-00000-of-00002", "shard-00001-of-00002")


def bytes_of(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("killed", ["write_images", "write_arrays", "finish_shard"])
def test_a_resumed_collection_has_the_same_bytes(folder, tmp_path, killed, monkeypatch):
    out = tmp_path / "dataset"

    def kill(*args):
        raise KeyboardInterrupt

    module = dataset.shards if killed == "write_arrays" else dataset.records
    write, calls = getattr(module, killed), itertools.count()
    monkeypatch.setattr(module, killed, lambda *args: write(*args) if next(calls) == 0 else kill())
    with pytest.raises(KeyboardInterrupt):
        dataset.collect(SMALL, sts.Sensor(), out)
    monkeypatch.undo()
    (out / f"{SHARDS[1]}.array_record").write_bytes(b"half")  # this shard has no manifest
    with pytest.raises(FileNotFoundError, match="not finished"):
        dataset.load(out)
    before = (out / f"{SHARDS[0]}.npz").stat().st_mtime_ns
    seen = []
    dataset.collect(SMALL, sts.Sensor(), out, progress=seen.append)
    assert bytes_of(out) == bytes_of(folder)
    assert (out / f"{SHARDS[0]}.npz").stat().st_mtime_ns == before
    assert seen[0] == dataset.Progress(4, 12 + 3 * 2, 8, 12 + 7 * 2)
    assert seen[-1] == dataset.Progress(8, 12 + 7 * 2, 8, 12 + 7 * 2)
    assert {path.name for path in out.iterdir() if path.name.startswith(".")} == {".lock"}
    stamps = {path: path.stat().st_mtime_ns for path in out.iterdir()}
    dataset.collect(SMALL, sts.Sensor(), out)
    assert stamps == {path: path.stat().st_mtime_ns for path in out.iterdir()}


def test_several_processes_make_the_same_bytes(folder, tmp_path):
    first = dataset.collect(SMALL, sts.Sensor(), tmp_path, process_index=1, process_count=2)
    assert sorted(path.name for path in tmp_path.glob("shard-*.npz")) == [f"{SHARDS[1]}.npz"]
    with pytest.raises(FileNotFoundError, match=r"manifest\.json is missing: the collection is not finished"):
        dataset.load(tmp_path)
    (tmp_path / f".{SHARDS[0]}.npz.7-00.partial").write_text("half")
    (tmp_path / f".{SHARDS[1]}.npz.8-00.partial").write_text("being written")
    with storage.lock(tmp_path, part=(1, 2)):
        second = dataset.collect(SMALL, sts.Sensor(), tmp_path, process_index=0, process_count=2)
    assert bytes_of(tmp_path) | {".lock": b""} == bytes_of(folder)
    assert dataset.Collected(first.resampled + second.resampled, ()) == dataset.collect(SMALL, sts.Sensor(), folder)


def test_a_dataset_whose_manifest_grew_with_every_shard_is_continued_and_read(folder, copied):
    (copied / f"{SHARDS[0]}.json").unlink()
    (copied / f"{SHARDS[1]}.json").unlink()
    identity = dataset.load(copied).identity
    whole = storage.read_manifest(copied, "")
    for ending in ("array_record", "npz"):
        (copied / f"{SHARDS[1]}.{ending}").unlink()
        del whole.files[f"{SHARDS[1]}.{ending}"]
    storage.write_manifest(copied, *whole)
    with pytest.raises(FileNotFoundError, match=f"{SHARDS[1]}.array_record is missing: the collection is not finished"):
        dataset.load(copied)
    dataset.collect(SMALL, sts.Sensor(), copied)
    assert bytes_of(folder) == bytes_of(copied) | {f"{SHARDS[0]}.json": (folder / f"{SHARDS[0]}.json").read_bytes()}
    assert dataset.load(copied).identity == identity


@pytest.fixture
def copied(folder, tmp_path):
    """A dataset that may be damaged."""
    return shutil.copytree(folder, tmp_path / "copy")


def rewrite(name, change):
    return lambda at: (at / name).write_bytes(change((at / name).read_bytes()))


def flip(name, place):
    return rewrite(name, lambda data: bytes(b ^ 4 * (i == int(place * len(data))) for i, b in enumerate(data)))


def edit(name, field, value):
    return rewrite(name, lambda data: (json.dumps({**json.loads(data), field: value}, indent=2) + "\n").encode())


def of_format(value):
    return lambda at: [(at / "manifest.json").unlink(), edit("collection.json", "format", value)(at)]


def swap_shards(*endings):
    def change(at):
        for one, other in ([at / f"{name}{ending}" for name in SHARDS] for ending in endings):
            content = one.read_bytes()
            one.write_bytes(other.read_bytes())
            other.write_bytes(content)

    return change


EDITED = r" is not the file that (manifest|shard-.*)\.json lists .*delete it \(of a shard all files\) and collect"


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (swap_shards(".array_record"), r"00000-of-00002\.array_record" + EDITED),
        (swap_shards(".array_record", ".npz"), r"00000-of-00002\.array_record" + EDITED),
        (flip(f"{SHARDS[0]}.array_record", 0.5), r"00000-of-00002\.array_record" + EDITED),
        (rewrite(f"{SHARDS[1]}.array_record", lambda data: data[:-1000]), r"00001-of-00002\.array_record" + EDITED),
        (lambda at: (at / f"{SHARDS[0]}.array_record").unlink(), r"00000-of-00002\.array_record is missing"),
        (edit("split.json", "test", [3, 1]), r"split\.json" + EDITED),
        (flip("sensor.json", 0.5), r"sensor\.json (is not the file|was made with|cannot be read)"),
        (flip("manifest.json", 0.5), r"manifest\.json (is damaged|cannot be read).*: restore it, or collect into"),
        (edit("manifest.json", "facts", {"shards": 1}), r"manifest\.json is damaged"),
        (
            lambda at: [path.unlink() for path in (at / "manifest.json", *at.glob("shard-*.json"))],
            r"manifest\.json is missing, but .* has shards: restore it, or",
        ),
        (rewrite("collection.json", lambda data: b"\xff"), r"collection\.json cannot be read as JSON"),
        (of_format(4), r"collection\.json is of a dataset of format 4, .* reads format 6: collect into another"),
    ],
)
def test_damage_is_named_and_nothing_is_overwritten(copied, damage, message):
    damage(copied)
    before = bytes_of(copied)
    for use in (dataset.load, lambda folder: dataset.collect(SMALL, sts.Sensor(), folder)):
        with pytest.raises((storage.DamagedFileError, ValueError), match=message):
            use(copied)
    assert bytes_of(copied) == before


def arrays(name, **changes):
    def change(at):
        with np.load(at / f"{name}.npz") as file:
            kept = dict(file)
        np.savez(at / f"{name}.npz", **(kept | {key: change(kept[key]) for key, change in changes.items()}))

    return change


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (edit("split.json", "test", "all"), r"split\.json .*test"),
        (edit("split.json", "test", [0, 1, 2, 3]), r"split\.json has an object in two parts"),
        (edit("split.json", "test", [99]), r"split\.json has an object in two parts, or one >= "),
        (rewrite("split.json", lambda _: b"{}"), r"split\.json .*train is missing"),
        (edit("collection.json", "resolution", 32), r"collection\.json .*resolution"),
        (edit("collection.json", "num_objects", None), r"collection\.json .*num_objects is None"),
        (arrays(SHARDS[0], **{"trajectory/pose": lambda x: x * np.nan}), r"npz .*trajectory/pose has values"),
        (arrays(SHARDS[0], **{"trajectory/pose": lambda x: x[:, 1:]}), r"npz .*array trajectory/"),
        (arrays(SHARDS[0], **{"hidden/fill": lambda x: x > 0}), r"npz .*hidden/fill is bool"),
        (arrays(SHARDS[1], **{"solid/com": lambda x: x[:, :2]}), r"npz .*solid/com is"),
        (arrays(SHARDS[1], frames=lambda x: x + 1000), r"npz .*array frames has values"),
        (arrays(SHARDS[1], **{"trajectory/body": lambda x: x - 100}), r"npz .*array trajectory/body has values"),
    ],
)
def test_absurd_content_with_a_valid_checksum_is_named(copied, damage, message):
    damage(copied)
    listed = storage.read_manifest(copied, "")
    storage.write_manifest(copied, storage.checksums(copied, listed.files), listed.facts)
    with pytest.raises(storage.DamagedFileError, match=message):
        dataset.load(copied)


def test_an_edited_description_is_named_and_deleted_files_are_made_again_with_the_same_bytes(folder, sparse, copied):
    for name in ("sensor.json", "collection.json"):
        edit(name, "resolution", [32, 64])(copied)
        with pytest.raises(storage.DamagedFileError, match=f"{name}{EDITED}"):
            dataset.load(copied)
        (copied / name).unlink()
        with pytest.raises(storage.DamagedFileError, match=f"{name} is missing"):
            dataset.load(copied)
        shutil.copy(folder / name, copied)
    for name in (f"{SHARDS[0]}.npz", f"{SHARDS[0]}.array_record", "split.json", "sensor.json", "collection.json"):
        (copied / name).unlink()
    dataset.collect(SMALL, sts.Sensor(), copied)
    assert bytes_of(copied) == bytes_of(folder)
    assert dataset.load(copied).identity == dataset.load(folder).identity != dataset.load(sparse).identity


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (flip(f"{SHARDS[0]}.json", 0.5), r"00000-of-00002\.json (is damaged|cannot be read)"),
        (swap_shards(".json"), r"00000-of-00002\.json is that of another shard or dataset"),
        (swap_shards(".json", ".npz", ".array_record"), r"00000-of-00002\.json is that of another shard or dataset"),
        (lambda at: foreign(at), r"00000-of-00002\.json is that of another shard or dataset"),
        (flip(f"{SHARDS[1]}.npz", 0.5), r"00001-of-00002\.npz" + EDITED),
    ],
)
def test_damage_of_an_unfinished_dataset_is_named(copied, damage, message):
    (copied / "manifest.json").unlink()
    damage(copied)
    before = bytes_of(copied)
    with pytest.raises(storage.DamagedFileError, match=message):
        dataset.collect(SMALL, sts.Sensor(), copied)
    assert bytes_of(copied) == before


@pytest.mark.parametrize(
    ("damage", "number"),
    [
        (flip(f"{SHARDS[0]}.array_record", 0.5), 1),
        (rewrite(f"{SHARDS[1]}.npz", lambda data: data[:-1000]), 1),
        (lambda at: (at / f"{SHARDS[0]}.array_record").unlink(), 1),
        (swap_shards(".json", ".npz", ".array_record"), 2),
        (flip("manifest.json", 0.5), 1),
        (lambda at: [flip(name, 0.5)(at) for name in ("split.json", "sensor.json", f"{SHARDS[0]}.npz")], 3),
    ],
)
def test_damage_is_repaired(folder, copied, damage, number):
    damage(copied)
    repaired = dataset.collect(SMALL, sts.Sensor(), copied, repair=True).repaired
    assert bytes_of(copied) == bytes_of(folder)
    assert len(repaired) == number
    assert all(str(copied) in line for line in repaired)


def files_behind(url):
    system, path = fsspec.core.url_to_fs(url)
    return {name.rpartition("/")[2]: system.cat_file(name) for name in system.ls(path, detail=False)}


@pytest.fixture
def url(monkeypatch, tmp_path):
    """A place behind a URL, and a cache of its own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    yield "memory://bucket/falls"
    system, path = fsspec.core.url_to_fs("memory://bucket")
    system.rm(path, recursive=True)


def test_a_dataset_behind_a_url_has_the_same_bytes_and_is_read_from_a_copy(folder, url, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"falls/manifest\.json is missing: it is not a collected dataset"):
        dataset.load(url)
    dataset.collect(SMALL, sts.Sensor(), url, process_index=1, process_count=2)
    with pytest.raises(FileNotFoundError, match=r"falls/manifest\.json is missing: the collection is not finished"):
        dataset.load(url)
    system, path = fsspec.core.url_to_fs(url)
    system.pipe_file(f"{path}/{SHARDS[0]}.npz", b"of a killed process, which has not written the shard's manifest")
    whole = dataset.collect(SMALL, sts.Sensor(), url)
    assert files_behind(url) | {".lock": b""} == bytes_of(folder)
    assert whole == dataset.collect(SMALL, sts.Sensor(), url) == dataset.collect(SMALL, sts.Sensor(), folder)
    data = dataset.load(url)
    assert data.identity == dataset.load(folder).identity
    assert data.shards[0].is_relative_to(tmp_path / "cache")
    system.rm_file(f"{path}/{SHARDS[0]}.npz")  # the copy is read
    assert dataset.load(url).identity == data.identity
    data.shards[0].write_bytes(b"damaged")
    with pytest.raises(storage.DamagedFileError, match=r"00000-of-00002\.array_record is not the file"):
        dataset.load(url)


def test_a_dataset_behind_a_url_is_repaired(folder, url, tmp_path):
    system, path = fsspec.core.url_to_fs(url)
    for name, content in bytes_of(folder).items():
        system.pipe_file(f"{path}/{name}", content)
    system.pipe_file(f"{path}/{SHARDS[0]}.npz", b"damaged")
    system.rm_file(f"{path}/{SHARDS[1]}.array_record")
    with pytest.raises(storage.DamagedFileError, match=f"{url}/{SHARDS[1]}.array_record is missing"):
        dataset.collect(SMALL, sts.Sensor(), url)
    assert len(dataset.collect(SMALL, sts.Sensor(), url, repair=True).repaired) == 2
    assert files_behind(url) == bytes_of(folder)


def test_a_url_of_a_file_is_its_path_and_a_wrong_one_is_named(folder):
    assert dataset.load(f"file://{folder}").identity == dataset.load(folder).identity
    for wrong in ("no-such-protocol://a/b", "s3fs-is-missing://a"):
        with pytest.raises(OSError, match=rf"cannot open {wrong}: .*[Pp]rotocol.*Check the URL"):
            dataset.load(wrong)


def foreign(at):
    listed = storage.read_manifest(at, "", name=f"{SHARDS[0]}.json")
    storage.write_manifest(at, listed.files, {**listed.facts, "dataset": "0" * 64}, name=f"{SHARDS[0]}.json")


def test_a_lost_manifest_is_written_again(folder, copied):
    (copied / "manifest.json").unlink()
    with pytest.raises(FileNotFoundError, match=r"manifest\.json is missing: the collection is not finished"):
        dataset.load(copied)
    dataset.collect(SMALL, sts.Sensor(), copied)
    assert bytes_of(copied) == bytes_of(folder)


def test_the_work_directory_of_an_experiment_stands_for_its_dataset(folder, tmp_path):
    (tmp_path / "dataset").symlink_to(folder)
    storage.write_manifest(tmp_path, {}, {})  # of the evaluation
    assert dataset.load(tmp_path).identity == dataset.load(folder).identity


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda at: dataset.load(at).pairs([99]), ValueError, r"`trajectories` contains 99, .*trajectories 0 to 7"),
        (lambda at: dataset.load(at).pairs([0.5]), ValueError, r"`trajectories` has the type float64"),
        (lambda at: dataset.load(at).pairs([True, False]), ValueError, r"has the type bool.* np\.flatnonzero\(mask\)"),
        (lambda at: dataset.load(at).views("all"), ValueError, "unknown part 'all'"),
        (lambda at: dataset.load(at / "collection.json"), NotADirectoryError, r"is a file: give the folder"),
        (lambda at: dataset.load(at, shards=[]), ValueError, r"shards is empty, but .* has the shards 0 to \d+: name"),
        (lambda at: dataset.load(at / "no"), FileNotFoundError, r"no is not a collected dataset"),
    ],
)
def test_a_wrong_use_is_named(folder, call, error, message, monkeypatch):
    for name in ("pairs", "views"):  # without the annotations' check, which tests have and users do not
        monkeypatch.setattr(dataset.Dataset, name, inspect.unwrap(getattr(dataset.Dataset, name)))
    with pytest.raises(error, match=message):
        call(folder)


def test_a_folder_of_another_collection_or_another_process_is_refused(copied, monkeypatch):
    monkeypatch.setattr(storage, "_LOOK_S", 0.1)
    other = dataclasses.replace(SMALL, scenario=sts.physics.Freefall(frames=12, spread=0.02))
    with pytest.raises(ValueError, match=r"spread = 0\.05, but the current settings have scenario\.spread = 0\.02"):
        dataset.collect(other, sts.Sensor(), copied)
    for held, asked in (((0, 1), (0, 1)), ((0, 2), (0, 2)), ((1, 2), (0, 1)), ((0, 1), (1, 2)), ((0, 2), (1, 3))):
        with (
            storage.lock(copied, part=held),
            pytest.raises(storage.LockedError, match=r"copy is in use by process \d+ on"),
        ):
            dataset.collect(SMALL, sts.Sensor(), copied, process_index=asked[0], process_count=asked[1])
    with pytest.raises(ValueError, match=r"process_index must be from 0 to process_count - 1 = 1, got 2"):
        dataset.collect(SMALL, sts.Sensor(), copied, process_index=2, process_count=2)


def test_a_finished_dataset_has_a_card_that_its_owner_can_edit(folder, tmp_path):
    out = shutil.copytree(folder, tmp_path / "dataset")
    path, identity = out / "README.md", dataset.load(out).identity
    tables = [np.load(out / f"{shard}.npz") for shard in SHARDS]
    split = dataset.split_objects(SMALL)
    assert path.read_text() == dataset.card(SMALL, sts.Sensor(), split, tables, version=sts.__version__)
    path.write_text("mine")
    assert dataset.load(out).identity == identity
    dataset.collect(SMALL, sts.Sensor(), out)
    assert path.read_text() == "mine"
    path.unlink()
    assert dataset.load(out).identity == identity
