"""Exports are read back with pyarrow, zarr and Pillow, and compared with what the native dataset stores."""

import csv
import dataclasses
import inspect
import io
import json
import multiprocessing
import os
import shutil
import signal
import time
from pathlib import Path

import fsspec
import native_dataset
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import zarr
from native_dataset import EACH, FRAMES, PER_SHARD, RESOLUTION, SHARDS
from PIL import Image

from experiments import export as command
from sts_jax import dataset, physics
from sts_jax.dataset import export, remote, split_objects

FORMATS = sorted(export.FORMATS)


@pytest.fixture(scope="module")
def native(tmp_path_factory):
    folder = tmp_path_factory.mktemp("native")
    return folder, *native_dataset.write(folder)


class Truth:
    """What an export must have: each exported frame (part, shard, trajectory in the shard, frame) in order."""

    def __init__(self, images, tables, frames):
        self.images, self.tables = images, tables
        whole = range(5) if frames == "all" else range(PER_SHARD * EACH - 1)
        chosen = range(FRAMES) if frames == "all" else (0, FRAMES - 1)
        self.frames = tuple(chosen)
        self.episodes = [
            (part, shard, i)
            for part, members in split_objects(native_dataset.COLLECTION).items()
            for shard in range(SHARDS)
            for i in whole
            if shard * PER_SHARD + i // EACH in members
        ]
        self.rows = [(*episode, t) for episode in self.episodes for t in self.frames]

    def image(self, stream, row):
        _, shard, i, t = row
        (place,) = np.flatnonzero((self.tables[shard]["frames"] == (i, t)).all(1))
        return getattr(self.images[shard], stream)[place]

    def value(self, group, name, row, *, per_frame):
        _, shard, i, t = row
        values = self.tables[shard][f"{group}/{name}"]
        return values[i, t] if per_frame else values[i]

    def check(self, row, field):
        """Compare the fields of one exported frame. `field` returns a field by name."""
        part, shard, i, t = row
        for name in ("pose", "velocity", "wrench", "gravity", "contact", "wall"):
            np.testing.assert_array_equal(field(name), self.value("trajectory", name, row, per_frame=True))
        for group, name in (("hidden", "fill"), ("hidden", "shell_scale"), ("hidden", "friction"), ("hidden", "up")):
            np.testing.assert_array_equal(field(f"hidden.{name}"), self.value(group, name, row, per_frame=False))
        for name in ("mass", "com"):
            np.testing.assert_array_equal(field(name), self.value("solid", name, row, per_frame=False))
        condition = self.value("trajectory", "condition", row, per_frame=False)
        np.testing.assert_array_equal(field("condition.acceleration"), condition[:2])
        np.testing.assert_array_equal(field("condition.duration"), condition[2])
        outcome = self.value("trajectory", "outcome", row, per_frame=False)
        number = shard * PER_SHARD + i // EACH
        assert int(field("outcome")) == outcome
        assert field("outcome_name") == str(physics.Outcome(outcome))
        assert int(field("object")) == number
        assert field("class") == ("bottle", "mouse", "fork")[number % 3]
        assert field("split") == part
        assert int(field("trajectory")) == shard * PER_SHARD * EACH + i
        assert int(field("frame_index")) == self.frames.index(t)
        assert int(field("episode_index")) == self.episodes.index((part, shard, i))


def decoded(data):
    return np.asarray(Image.open(io.BytesIO(data)))


def plain(value):
    return np.array(value, np.float32) if isinstance(value, float | list) else value


@pytest.fixture(params=["all", "ends"])
def frames(request):
    return request.param


def test_parquet_has_images_for_datasets_and_one_file_per_part(native, tmp_path, frames):
    folder, *content = native
    truth = Truth(*content, frames)
    exported = export.to_parquet(folder, tmp_path / "out", frames=frames)
    assert exported == (len(truth.episodes), len(truth.rows), 6 if frames == "all" else 0)
    files = [f"{part}-00000-of-00001.parquet" for part in ("train", "validation", "test")]
    assert sorted(path.name for path in (tmp_path / "out/data").iterdir()) == sorted(files)
    table = pa.concat_tables([pq.read_table(tmp_path / "out/data" / name) for name in files])
    for row, one in zip(truth.rows, table.to_pylist(), strict=True):
        truth.check(row, lambda name, one=one: plain(one[name]))
        np.testing.assert_allclose(one["timestamp"], row[3] / 31.25, rtol=1e-6)
        assert one["task"] == "perturbed"
        for stream in export.STREAMS:
            np.testing.assert_array_equal(decoded(one[stream]["bytes"]), truth.image(stream, row))
    features = json.loads(table.schema.metadata[b"huggingface"])["info"]["features"]
    assert set(features) == set(table.column_names)
    assert features["tactile"] == {"_type": "Image"}
    assert features["pose"] == {"feature": {"dtype": "float32", "_type": "Value"}, "length": 7, "_type": "Sequence"}


def test_png_files_and_their_table(native, tmp_path, frames):
    folder, *content = native
    truth = Truth(*content, frames)
    export.to_png(folder, tmp_path / "out", frames=frames)
    with (tmp_path / "out/frames.csv").open() as file:
        rows = list(csv.DictReader(file))

    def field(one, name):
        inner = [one[key] for key in one if key.startswith(f"{name}.")]
        values = [{"True": "1", "False": "0"}.get(x, x) for x in ([one[name]] if name in one else inner)]
        if name in ("class", "split", "outcome_name"):
            return values[0]
        return np.float32(values if name not in one else values[0])

    for row, one in zip(truth.rows, rows, strict=True):
        truth.check(row, lambda name, one=one: field(one, name))
        for stream in export.STREAMS:
            np.testing.assert_array_equal(Image.open(tmp_path / "out" / one[stream]), truth.image(stream, row))
    assert {"pose.qw", "wrench.moment_z", "hidden.up.y", "condition.acceleration.x", "condition.duration"} <= {*rows[0]}


def test_zarr_stores_have_the_layout_of_open_x_tactile(native, tmp_path, frames):
    folder, *content = native
    truth = Truth(*content, frames)
    export.to_oxt(folder, tmp_path / "out", frames=frames)
    done = 0
    for part in ("train", "validation", "test"):
        path = tmp_path / "out" / part / "perturbed.zarr"
        assert json.loads((path / "data/timestamps/.zarray").read_text())["zarr_format"] == 2
        root = zarr.open_group(path, mode="r", zarr_format=2)
        arrays = {name: root[f"data/{name}"][:] for name in root["data"].array_keys()}
        episodes = sum(one[0] == part for one in truth.episodes)
        np.testing.assert_array_equal(root["meta/episode_ends"][:], len(truth.frames) * np.arange(1, episodes + 1))
        assert {len(x) for x in arrays.values()} == {episodes * len(truth.frames)}
        assert arrays["right_tactile_data_pad"].shape[1:] == (1, *RESOLUTION, 3)
        for i, row in enumerate(truth.rows[done : done + len(arrays["timestamps"])]):
            truth.check(row, lambda name, i=i, arrays=arrays: arrays[name][i])
            np.testing.assert_array_equal(arrays["camera_main_rgb"][i], truth.image("visual", row))
            np.testing.assert_array_equal(arrays["right_tactile_data_pad"][i, 0], truth.image("tactile", row))
            assert arrays["timestamps"][i] == row[3]
            named = [arrays[f"right_tactile_{name}_pad"][i] for name in ("sensor", "type")]
            assert [*named, arrays["sub_task_instruction"][i].strip()] == ["STS", "image", "perturbed"]
        done += len(arrays["timestamps"])
    assert done == len(truth.rows)


def test_lerobot_has_the_layout_of_version_3(native, tmp_path, frames):
    folder, *content = native
    truth = Truth(*content, frames)
    out, length = tmp_path / "out", len(truth.frames)
    export.to_lerobot(folder, out, frames=frames)
    info = json.loads((out / "meta/info.json").read_text())
    bounds = [sum(one[0] in parts for one in truth.episodes) for parts in ((), ("train",), ("train", "validation"))]
    bounds.append(len(truth.episodes))
    assert info["splits"] == {
        part: f"{start}:{stop}"
        for part, start, stop in zip(("train", "validation", "test"), bounds[:-1], bounds[1:], strict=True)
    }
    counts = [info[f"total_{name}"] for name in ("episodes", "frames", "tasks")]
    assert counts == [len(truth.episodes), len(truth.rows), 1]
    assert info["codebase_version"] == "v3.0"
    assert info["fps"] == pytest.approx(31.25 if frames == "all" else 31.25 / (FRAMES - 1))
    assert info["video_path"] is None

    table = pq.read_table(out / info["data_path"].format(chunk_index=0, file_index=0))
    assert set(table.column_names) == set(info["features"])
    names = {"pose": "observation.state"}
    for index, (row, one) in enumerate(zip(truth.rows, table.to_pylist(), strict=True)):
        truth.check(row, lambda name, one=one: plain(one[names.get(name, name)]))
        assert (one["index"], one["task_index"]) == (index, 0)
        np.testing.assert_allclose(one["timestamp"], one["frame_index"] / info["fps"], atol=1e-6)
        for stream in export.STREAMS:
            image = one[f"observation.images.{stream}"]
            np.testing.assert_array_equal(decoded(image["bytes"]), truth.image(stream, row))
    for name, feature in info["features"].items():
        kind, shape = table.schema.field(name).type, tuple(feature["shape"])
        if feature["dtype"] == "image":
            assert shape == (*RESOLUTION, 3)
            assert kind == pa.struct({"bytes": pa.binary(), "path": pa.string()})
            continue
        value = pa.type_for_alias(feature["dtype"])
        assert kind == (value if shape == (1,) else pa.list_(value, shape[0]))
        assert feature["names"] is None or len(feature["names"]) == shape[0]

    tasks = pq.read_table(out / "meta/tasks.parquet")
    (index,) = json.loads(tasks.schema.metadata[b"pandas"])["index_columns"]  # pandas reads the task as the index
    assert tasks.to_pylist() == [{"task_index": 0, index: "perturbed"}]

    (path,) = (out / "meta/episodes").glob("*/*.parquet")
    assert path.parts[-2:] == ("chunk-000", "file-000.parquet")
    for number, episode in enumerate(pq.read_table(path).to_pylist()):
        files = [episode[f"{kind}/{name}_index"] for kind in ("data", "meta/episodes") for name in ("chunk", "file")]
        assert files == [0] * 4
        assert (episode["episode_index"], episode["length"], episode["tasks"]) == (number, length, ["perturbed"])
        start, stop = episode["dataset_from_index"], episode["dataset_to_index"]
        assert (start, stop) == (number * length, (number + 1) * length)
        part = {
            key: episode[f"stats/{key}"] for key in ("wrench/mean", "observation.images.tactile/max", "index/count")
        }
        wrench = np.array(table["wrench"][start:stop].to_pylist())
        np.testing.assert_allclose(part["wrench/mean"], wrench.mean(0), atol=1e-6)
        shown = np.stack([truth.image("tactile", row) for row in truth.rows[start:stop]])
        np.testing.assert_allclose(np.ravel(part["observation.images.tactile/max"]), shown.max((0, 1, 2)) / 255)
        assert part["index/count"] == [length]


def test_statistics_of_lerobot_are_those_of_numpy(native, tmp_path, monkeypatch):
    folder, *content = native
    truth = Truth(*content, "all")
    export.to_lerobot(folder, tmp_path / "out")
    stats = json.loads((tmp_path / "out/meta/stats.json").read_text())
    info = json.loads((tmp_path / "out/meta/info.json").read_text())
    assert set(stats) == {name for name, feature in info["features"].items() if feature["dtype"] != "string"}
    wrench = np.stack([truth.value("trajectory", "wrench", row, per_frame=True) for row in truth.rows]).astype(float)
    shown = np.stack([truth.image("visual", row) for row in truth.rows]).reshape(-1, 3) / 255
    quantiles = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
    for name, values in (("wrench", wrench), ("observation.images.visual", shown)):
        expected = {"min": values.min(0), "max": values.max(0), "mean": values.mean(0), "std": values.std(0)}
        expected |= {key: np.quantile(values, q, axis=0) for key, q in quantiles.items()}
        assert set(stats[name]) == {*expected, "count"}
        for key, value in expected.items():
            np.testing.assert_allclose(np.ravel(stats[name][key]), value, atol=1e-3)
        assert stats[name]["count"] == [len(truth.rows)]
    assert np.shape(stats["observation.images.visual"]["mean"]) == (3, 1, 1)
    monkeypatch.setattr(export, "_SAMPLE", 40)  # quantiles from evenly spaced frames
    export.to_lerobot(folder, tmp_path / "sampled")
    sampled = json.loads((tmp_path / "sampled/meta/stats.json").read_text())
    assert sampled["wrench"]["std"] == stats["wrench"]["std"]
    every = 2 ** int(np.ceil(np.log2(len(wrench) / 40)))
    np.testing.assert_allclose(sampled["wrench"]["q50"], np.quantile(wrench[::every], 0.5, axis=0))


def test_files_of_limited_size_and_small_batches_have_the_same_rows(native, tmp_path, monkeypatch):
    folder = native[0]
    for name in ("parquet", "lerobot", "oxt"):
        export.FORMATS[name](folder, tmp_path / f"{name}-whole")
    for name, value in (
        ("_BATCH", 1),
        ("_ROW_GROUP", 3000),
        ("_FILE", 8000),
        ("_CHUNK", 2000),
        ("_FILES_PER_CHUNK", 3),
    ):
        monkeypatch.setattr(export, name, value)
    for name in ("parquet", "lerobot", "oxt"):
        export.FORMATS[name](folder, tmp_path / name)
    monkeypatch.setattr(export, "_EPISODES", 5)  # 15 episodes: the last row group is full
    export.to_lerobot(folder, tmp_path / "groups")

    def tables(name, inner):
        paths = sorted((tmp_path / name / inner).rglob("*.parquet"), key=lambda path: path.as_posix())
        return [pq.read_table(path) for path in paths]

    parts = tables("parquet", "data")
    assert len(parts) > len(tables("parquet-whole", "data"))
    assert pa.concat_tables(parts) == pa.concat_tables(tables("parquet-whole", "data"))
    files = tables("lerobot", "data")
    assert pa.concat_tables(files) == pa.concat_tables(tables("lerobot-whole", "data"))
    for name, groups in (("lerobot", 1), ("groups", 3)):
        paths = sorted((tmp_path / name / "meta/episodes").rglob("*.parquet"), key=lambda path: path.as_posix())
        assert len(paths) == groups  # each group is larger than a file may be
        for path in paths:
            place = "chunk-{:03d}/file-{:03d}.parquet"
            for one in pq.read_table(path).to_pylist():
                numbers = (one[f"meta/episodes/{kind}_index"] for kind in ("chunk", "file"))
                assert path.as_posix().endswith(place.format(*numbers))
    episodes = pa.concat_tables(tables("groups", "meta/episodes")).to_pylist()
    assert [one["episode_index"] for one in episodes] == list(range(15))
    episodes = pa.concat_tables(tables("lerobot", "meta/episodes")).to_pylist()
    assert max(one["data/chunk_index"] for one in episodes) > 0
    for one in episodes:
        path = tmp_path / "lerobot/data/chunk-{:03d}/file-{:03d}.parquet".format(
            *(one[f"data/{name}_index"] for name in ("chunk", "file"))
        )
        found = pq.read_table(path, columns=["index", "episode_index"]).to_pydict()
        index = [i for i, e in zip(found["index"], found["episode_index"], strict=True) if e == one["episode_index"]]
        assert index == list(range(one["dataset_from_index"], one["dataset_to_index"]))
    for part in ("train", "validation", "test"):
        new, old = (
            zarr.open_group(tmp_path / name / part / "perturbed.zarr", mode="r") for name in ("oxt", "oxt-whole")
        )
        assert new["data/camera_main_rgb"].chunks[0] < new["data/camera_main_rgb"].shape[0]
        for name in old["data"].array_keys():
            np.testing.assert_array_equal(new[f"data/{name}"][:], old[f"data/{name}"][:])


@pytest.mark.parametrize(("width", "shape"), [(0, None), (2, [2])])
def test_a_condition_that_the_scenario_does_not_describe_is_kept_as_it_is(tmp_path, width, shape):
    collection = dataclasses.replace(native_dataset.COLLECTION, scenario=physics.Freefall(frames=FRAMES))
    native_dataset.write(tmp_path / "native", collection=collection, condition=width)
    export.to_lerobot(tmp_path / "native", tmp_path / "out")
    features = json.loads((tmp_path / "out/meta/info.json").read_text())["features"]
    assert {name: one["shape"] for name, one in features.items() if "condition" in name} == (
        {"condition": shape} if shape else {}
    )


def test_a_scenario_of_a_user_with_the_name_of_one_of_the_library_has_no_names_of_its_condition(tmp_path):
    @dataclasses.dataclass(frozen=True)
    class Perturbed(physics.Freefall):
        wind: float = 1.0

    collection = dataclasses.replace(native_dataset.COLLECTION, scenario=Perturbed(frames=FRAMES))
    native_dataset.write(tmp_path / "native", collection=collection, condition=3)
    export.to_lerobot(tmp_path / "native", tmp_path / "out")
    features = json.loads((tmp_path / "out/meta/info.json").read_text())["features"]
    assert [name for name in features if "condition" in name] == ["condition"]


def test_a_dataset_behind_a_url_is_exported(native, tmp_path, monkeypatch):
    monkeypatch.setattr("sts_jax.dataset.remote.cache_folder", lambda: tmp_path / "cache")
    files = fsspec.filesystem("memory")
    files.put(f"{native[0]}/*", "/export/falls/")
    line = command.main(command.Args("memory://export/falls", "png", str(tmp_path / "out")))
    assert line.startswith(f"{tmp_path / 'out'}: 90 frames")
    export.to_png(native[0], tmp_path / "local")
    with pytest.raises(ValueError, match="--out must be a folder of this computer, got memory://export/pngs"):
        command.main(command.Args(str(native[0]), "png", "memory://export/pngs"))
    assert (tmp_path / "out/frames.csv").read_bytes() == (tmp_path / "local/frames.csv").read_bytes()


def test_an_interrupted_download_goes_on(native, tmp_path, monkeypatch):
    monkeypatch.setattr("sts_jax.dataset.remote.cache_folder", lambda: tmp_path / "cache")
    files = fsspec.filesystem("memory")
    files.put(f"{native[0]}/*", "/export/more/")
    got, whole = [], remote.Remote.get

    def get(self, folder, names):
        if len(got) == 4:
            raise ConnectionError("lost")
        whole(self, folder, names)
        got.extend(name for name in names if folder.parent.name == "datasets")

    monkeypatch.setattr(remote.Remote, "get", get)
    with pytest.raises(ConnectionError):
        dataset.load("memory://export/more")
    first = got.copy()
    (folder,) = (tmp_path / "cache/datasets").iterdir()
    (folder / first[1]).write_bytes(b"another file")
    got.clear()
    monkeypatch.setattr(remote.Remote, "get", lambda self, *args: (got.extend(args[1]), whole(self, *args)))
    assert dataset.load("memory://export/more").identity == dataset.load(native[0]).identity
    assert [name for name in first if name in got] == [first[1]]


def _export_slowly(folder, target, name):
    export.FORMATS[name](folder, target, progress=lambda now: time.sleep(60) if now.done > now.total / 2 else None)


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMATS)
def test_a_killed_export_leaves_nothing_and_the_next_one_is_complete(native, tmp_path, name):
    folder, target = native[0], tmp_path / "out"
    process = multiprocessing.get_context("spawn").Process(target=_export_slowly, args=(folder, target, name))
    process.start()
    partial = tmp_path / ".out.partial"
    while not (partial.exists() and sum(path.is_file() for path in partial.rglob("*")) > 2):
        assert process.is_alive()
        time.sleep(0.05)
    with pytest.raises(RuntimeError, match="is in use by process"):
        export.FORMATS[name](folder, target)
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    assert not target.exists()
    export.FORMATS[name](folder, target)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert not any(path.name.startswith(".lock") for path in target.iterdir())


def test_an_export_has_the_data_card_with_the_licence_of_the_objects(native, tmp_path):
    shutil.copytree(native[0], tmp_path / "native")
    (tmp_path / "native" / "README.md").write_text("licence: CC BY 4.0, from elsewhere\n")
    export.to_png(tmp_path / "native", tmp_path / "out")
    assert (tmp_path / "out" / "README.md").read_text() == "licence: CC BY 4.0, from elsewhere\n"
    (tmp_path / "run").mkdir()
    (tmp_path / "run/README.md").write_text("of the work directory")
    (tmp_path / "run/dataset").symlink_to(tmp_path / "native")
    export.to_png(tmp_path / "run", tmp_path / "of-run")
    assert (tmp_path / "of-run" / "README.md").read_text() == "licence: CC BY 4.0, from elsewhere\n"


def test_another_export_or_folder_is_refused_and_the_same_export_is_kept(native, tmp_path, monkeypatch):
    folder, target = native[0], tmp_path / "out"
    target.mkdir()
    first = export.to_png(folder, target)
    stamps = {path: path.stat().st_mtime_ns for path in target.rglob("*")}
    assert export.to_png(folder, target) == first
    assert {path: path.stat().st_mtime_ns for path in target.rglob("*")} == stamps
    for call in (lambda: export.to_png(folder, target, frames="ends"), lambda: export.to_oxt(folder, target)):
        with pytest.raises(FileExistsError, match=r"out has another export: choose another folder"):
            call()
    other = tmp_path / "other"
    other.mkdir()
    (other / "mine.txt").write_text("mine")
    monkeypatch.setattr(export, "_planned", None)  # before the dataset is read
    with pytest.raises(FileExistsError, match=r"other exists, and is no finished export"):
        export.to_png(folder, other)


def test_faults_are_named_before_anything_is_written(tmp_path, monkeypatch):
    native_dataset.write(tmp_path / "native", full=0)
    with pytest.raises(ValueError, match=r"no trajectory with images of all frames: use frames='ends'"):
        export.to_png(tmp_path / "native", tmp_path / "out")
    with pytest.raises(ValueError, match="frames must be 'all' or 'ends', got 'every'"):
        inspect.unwrap(export._planned)(tmp_path / "native", "every", None)  # users have no check of annotations
    path = tmp_path / "native/shard-00002-of-00003.array_record"
    path.write_bytes(path.read_bytes()[:-1] + b"x")
    with pytest.raises(OSError, match=r"shard-00002-of-00003\.array_record is not the file"):
        export.to_png(tmp_path / "native", tmp_path / "out", frames="ends")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"needs the package zarr: pip install zarr"):
        export.to_oxt(tmp_path / "native", tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["native"]


def test_a_full_disk_is_named_and_leaves_nothing(native, tmp_path, monkeypatch):
    def full(*args):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(
        OSError, match=r"cannot write .*out: No space left on device\. Free some disk space, then start"
    ):
        export.to_png(native[0], tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_the_command_states_what_is_left_out(native, tmp_path):
    line = command.main(command.Args(str(native[0]), "png", str(tmp_path / "out")))
    assert line.startswith(f"{tmp_path / 'out'}: 90 frames of 15 trajectories. 6 trajectories are left out")
    assert command.main(command.Args(str(native[0]), "png", str(tmp_path / "ends"), "ends")).endswith(
        "42 frames of 21 trajectories"
    )
