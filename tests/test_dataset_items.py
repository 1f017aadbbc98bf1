"""Items of a dataset for data loaders, and the reader, the PyTorch dataset and the grain loader of docs/datasets.md."""

import contextlib
import json
import os
import pickle
import re
import resource
import sys

import numpy as np
import pytest
from extending_page import DOCS, blocks
from native_dataset import EACH, FRAMES, PER_SHARD, RESOLUTION, SHARDS, write

from sts_jax import dataset, storage


@pytest.fixture(scope="module")
def native(tmp_path_factory):
    folder = tmp_path_factory.mktemp("native")
    return folder, *write(folder)


@pytest.fixture(scope="module")
def data(native):
    return dataset.load(native[0])


def test_the_reader_of_the_page_reads_everything_with_numpy_and_array_record_alone(native, data):
    folder, images, tables = native
    (code,) = blocks("Native format", "datasets")
    assert set(re.findall(r"^(?:from|import) (\w+)", code, re.M)) == {"json", "pathlib", "numpy", "array_record"}
    names: dict = {}
    exec(code.replace('Path("falls")', repr(str(folder)).join(("Path(", ")"))), names)
    assert names["count"] == SHARDS
    for shard, (shown, table) in enumerate(zip(images, tables, strict=True)):
        arrays, frames, views = names["read_shard"](shard)
        assert set(arrays) == set(table)
        for name, values in table.items():
            np.testing.assert_array_equal(arrays[name], values)
        assert (len(frames), len(views)) == (len(table["frames"]), 0)
        for k, frame in enumerate(frames):
            for read, stored in zip(frame, shown, strict=True):
                np.testing.assert_array_equal(read, stored[k])


def test_the_page_lists_all_arrays_with_type_and_shape(native):
    table = native[2][0]
    rows = re.findall(r"^\| `([\w/]+)` \| (\w+) \((.*?)\) \|", (DOCS / "datasets.md").read_text(), re.M)
    assert {name for name, *_ in rows} == set(table)
    sizes = {"n": PER_SHARD * EACH, "f": FRAMES, "m": len(table["frames"]), "k": 0, "c": 3}
    for name, kind, shape in rows:
        assert kind == ("str" if table[name].dtype.kind == "U" else table[name].dtype.name), name
        if kind != "str":
            assert table[name].shape == tuple(sizes[n] if n in sizes else int(n) for n in shape.split(", ")), name


def test_some_shards_are_read_alone(native, data):
    part = dataset.load(native[0], shards=[2, 1])
    num = PER_SHARD * EACH
    for name, values in part.trajectory.items():
        whole = data.trajectory[name]
        np.testing.assert_array_equal(values, np.concatenate([whole[2 * num :], whole[num : 2 * num]]))
    np.testing.assert_array_equal(part.strip(0).visual, data.strip(2 * num).visual)
    np.testing.assert_array_equal(part.strip(num + 1).tactile, data.strip(num + 1).tactile)
    with pytest.raises(ValueError, match=r"shards is \[3\], but .* has the shards 0 to 2"):
        dataset.load(native[0], shards=[3])
    (native[0] / "shard-00000-of-00003.npz").rename(native[0] / "away")
    try:
        dataset.load(native[0], shards=[1])
        with pytest.raises(OSError, match=r"shard-00000-of-00003\.npz is missing"):
            dataset.load(native[0])
    finally:
        (native[0] / "away").rename(native[0] / "shard-00000-of-00003.npz")


@pytest.mark.parametrize("by", ["trajectory", "frame"])
def test_items_have_the_images_and_fields_of_the_dataset(data, by):
    chosen = np.array([9, 2, 6])  # all frames, all frames, the ends
    items = pickle.loads(pickle.dumps(dataset.Items(data, chosen, by)))
    stored = [(i, t) for i, frames in ((9, range(FRAMES)), (2, range(FRAMES)), (6, (0, FRAMES - 1))) for t in frames]
    assert len(items) == (3 if by == "trajectory" else len(stored))
    seen = []
    for item in (items[i] for i in range(len(items))):
        trajectory, frames = int(item["trajectory"]), np.atleast_1d(item["frame"]).tolist()
        seen += [(trajectory, t) for t in frames]
        for name in ("time", "pose", "wrench", "contact"):
            expected = data.trajectory[name][trajectory, frames]
            np.testing.assert_array_equal(item[name], expected if by == "trajectory" else expected[0])
        places = [[t for i, t in stored if i == trajectory].index(t) for t in frames]
        for name in ("visual", "tactile", "segmentation"):
            expected = getattr(data.strip(trajectory), name)[places]
            np.testing.assert_array_equal(item[name], expected if by == "trajectory" else expected[0])
        assert item["outcome"] == data.trajectory["outcome"][trajectory]
        assert item["hidden.friction"] == data.hidden["friction"][trajectory]
        assert item["object"] == data.trajectory["body"][trajectory]
    assert seen == stored
    items[0]["condition"][:] = items[0]["com"][:] = 99  # in place, as a loader may do
    assert (items[0]["condition"] < 99).all()
    assert (items[0]["com"] < 99).all()
    with pytest.raises(IndexError):
        items[len(items)]


def test_few_shards_stay_open(data, monkeypatch):
    opened = []
    monkeypatch.setattr("sts_jax.dataset.loading._OPEN", 2)

    def noted(self, shard, open_shard=dataset.Dataset._opened):
        opened.append(shard)
        return open_shard(self, shard)

    monkeypatch.setattr(dataset.Dataset, "_opened", noted)
    items = dataset.Items(data, data.rendered())
    expected = [data.strip(i).visual for i in data.rendered().tolist()]
    opened.clear()
    for _ in range(2):
        for i, truth in enumerate(expected):
            np.testing.assert_array_equal(items[i]["visual"], truth)
        assert len(items._opened) == 2
    assert opened == [0, 1, 2, 0, 1, 2]


@pytest.mark.skipif(sys.platform != "linux", reason="counts open files")
def test_too_many_open_files_are_no_damage(data):
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with contextlib.ExitStack() as files:
        resource.setrlimit(resource.RLIMIT_NOFILE, (max(map(int, os.listdir("/proc/self/fd"))) + 10, hard))
        files.callback(resource.setrlimit, resource.RLIMIT_NOFILE, (soft, hard))
        with contextlib.suppress(OSError):
            while True:
                files.enter_context(open(os.devnull))
        with pytest.raises(OSError, match="Too many open files") as error:
            data.strip(0)
    assert not isinstance(error.value, storage.DamagedFileError)


def test_items_without_images_are_refused(data):
    with pytest.raises(ValueError, match=r"`trajectories` contains 7, which has no images: take indices from"):
        dataset.Items(data, np.array([1, 7]))
    with pytest.raises(ValueError, match=r"`trajectories` contains 99"):
        dataset.Items(data, np.array([99]))


@pytest.fixture
def batches():
    pytest.importorskip("grain")
    _, code = blocks("Read in PyTorch and grain", "datasets")
    names: dict = {}
    exec(code, names)
    return names["batches"]


def keys(batch):
    return list(zip(batch["trajectory"].tolist(), batch["frame"].tolist(), strict=True))


def test_two_processes_of_grain_cover_every_frame_once(native, data, batches):
    parts = [[key for b in batches(native[0], "train", i, 2) for key in keys(b)] for i in range(2)]
    members = data.members("train")
    stored = data.frames[np.isin(data.frames[:, 0], members)].tolist()
    assert sorted(parts[0] + parts[1]) == sorted(map(tuple, stored))
    assert abs(len(parts[0]) - len(parts[1])) <= 1
    assert parts[0] != sorted(parts[0])  # shuffled


def test_grain_resumes_in_the_middle_of_an_epoch(native, batches):
    iterator = batches(native[0], "train", 1, 2)
    for _ in range(2):
        next(iterator)
    state = json.loads(json.dumps(iterator.get_state()))
    rest = list(iterator)
    again = batches(native[0], "train", 1, 2)
    again.set_state(state)
    resumed = list(again)
    assert [keys(batch) for batch in resumed] == [keys(batch) for batch in rest]
    np.testing.assert_array_equal(resumed[0]["tactile"], rest[0]["tactile"])
    assert rest[0]["tactile"].shape == (4, *RESOLUTION, 3)


def test_the_pytorch_dataset_of_the_page(native, data):
    torch = pytest.importorskip("torch")
    code, _ = blocks("Read in PyTorch and grain", "datasets")
    names: dict = {}
    exec(code, names)
    falls = names["Falls"](native[0], "test")
    batch = next(iter(torch.utils.data.DataLoader(falls, batch_size=3)))
    first = int(data.members("test")[0])
    assert batch["trajectory"].tolist() == [first] * 3
    np.testing.assert_array_equal(batch["visual"].numpy(), data.strip(first).visual[:3])
