"""Atomic writes, JSON files that cannot change unnoticed, checksums, and the lock on a folder."""

import contextlib
import dataclasses
import errno
import json
import os
import re
import subprocess
import sys
import threading
from pathlib import Path

import filelock
import numpy as np
import pytest

from sts_jax import storage


def test_an_interrupted_write_keeps_the_previous_file(tmp_path):
    path = tmp_path / "deep" / "a.txt"
    storage.write_bytes(path, b"before")

    def killed(temporary: Path) -> None:
        temporary.write_bytes(b"half of")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        storage.write_whole(path, killed)
    assert path.read_bytes() == b"before"
    assert [p.name for p in path.parent.iterdir()] == ["a.txt"]


@pytest.mark.parametrize(
    ("number", "remedy"),
    [
        (errno.ENOSPC, "Free some disk space, then"),
        (errno.EACCES, "Check the permissions, then"),
        (errno.EISDIR, "Remove the file or folder that is in the way, or choose another path, then"),
        (errno.EIO, "Free some disk space or check the permissions, then"),
    ],
)
def test_a_failed_write_leaves_no_file_and_its_error_names_the_remedy(tmp_path, number, remedy):
    def fails(temporary: Path) -> None:
        temporary.write_bytes(b"half")
        raise OSError(number, os.strerror(number))

    with pytest.raises(OSError, match=rf"cannot write .*x\.npz: .*\. {remedy} start again"):
        storage.write_whole(tmp_path / "x.npz", fails)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_is_written_as_a_whole_or_not_at_all(tmp_path, monkeypatch):
    storage.write_folder(tmp_path / "deep" / "a", {"one": b"1", "two": b"2"})
    assert sorted(path.name for path in (tmp_path / "deep/a").iterdir()) == ["manifest.json", "one", "two"]
    storage.verify(tmp_path / "deep/a", storage.read_manifest(tmp_path / "deep/a", ""), "")
    with pytest.raises(OSError, match=r"cannot write .*a: .*Remove the file or folder that is in the way"):
        storage.write_folder(tmp_path / "deep" / "a", {"one": b"3"})
    monkeypatch.setattr(os, "fsync", lambda _: (_ for _ in ()).throw(OSError(errno.ENOSPC, "No space left on device")))
    with pytest.raises(OSError, match=r"cannot write .*b: .*No space left.*Free some disk space\."):
        storage.write_folder(tmp_path / "deep" / "b", {"one": b"1"})
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["a"]
    assert (tmp_path / "deep/a/one").read_bytes() == b"1"


@pytest.mark.parametrize("content", [b"", b'{"seed"', b"\xff\xfe{}", b"1" * 5000, b"[" * 100_000])
def test_damaged_json_is_named_with_the_remedy(tmp_path, content):
    path = tmp_path / "a.json"
    with pytest.raises(FileNotFoundError):
        storage.read_json(path, "delete it")
    path.write_bytes(content)
    with pytest.raises(storage.DamagedFileError, match=r"a\.json cannot be read as JSON .*: delete it\.$"):
        storage.read_json(path, "delete it")
    with pytest.raises(storage.DamagedFileError, match=r"a\.json"):
        storage.claim(path, {"seed": 0})
    assert path.read_bytes() == content


def test_other_settings_are_refused_and_equal_ones_are_not(tmp_path):
    path, content = tmp_path / "config.json", {"seed": 0, "gel": {"sizes": (1, 2)}, "name": None}
    storage.claim(path, content)
    assert storage.read_json(path, "delete it") == {"seed": 0, "gel": {"sizes": [1, 2]}, "name": None}
    before = path.stat().st_mtime_ns
    storage.claim(path, content | {"seed": np.int64(0)})
    assert path.stat().st_mtime_ns == before
    with pytest.raises(TypeError, match="a set cannot be written as JSON"):
        storage.claim(path, {"seed": {0}})
    for change, message in (
        ({"seed": 1}, "json was made with seed = 0, but the current settings have seed = 1"),
        ({"gel": {"sizes": (1, 3)}}, r"sizes = \[1, 2\], but the current settings have gel\.sizes = \[1, 3\]"),
    ):
        with pytest.raises(ValueError, match=message):
            storage.claim(path, content | change)


@dataclasses.dataclass(frozen=True)
class Facts:
    step: int


@dataclasses.dataclass(frozen=True)
class Noted(Facts):
    note: str


@dataclasses.dataclass(frozen=True)
class Named:
    step: str


@pytest.mark.parametrize(
    "content",
    [[], 3, None, {}, {"files": [], "facts": {}}, {"files": {"a": 1}, "facts": {}}, {"files": {}, "facts": 3}],
)
def test_a_manifest_with_absurd_content_and_a_valid_checksum_is_named(tmp_path, content):
    if isinstance(content, dict):
        content = {**content, "checksum": storage.digest(content)}
    (tmp_path / storage.MANIFEST).write_text(json.dumps(content))
    with pytest.raises(
        storage.DamagedFileError, match=r"manifest\.json is damaged, or .*(content|files|facts).*: remedy"
    ):
        storage.read_manifest(tmp_path, "remedy")


def test_each_mismatch_of_a_folder_with_its_manifest_is_named(tmp_path):
    for name in "ab":
        (tmp_path / name).write_text(name)
    assert storage.read_manifest(tmp_path, "remedy") is None
    manifest = storage.write_manifest(tmp_path, storage.checksums(tmp_path, "ab"), {"step": 3})
    assert storage.read_manifest(tmp_path, "remedy") == storage.read_manifest(tmp_path, "remedy", Facts) == manifest
    for kind, field in ((Noted, "note is missing"), (Named, "step is 3")):
        with pytest.raises(
            storage.DamagedFileError, match=rf"manifest\.json is that of another folder .*{field}.*: remedy"
        ):
            storage.read_manifest(tmp_path, "remedy", kind)
    storage.verify(tmp_path, manifest, "remedy")
    (tmp_path / "a").write_text("b")
    for names, message in ((None, "a is not the file"), (["b", "c"], "c is not listed in")):
        with pytest.raises(storage.DamagedFileError, match=rf"{message}.*: remedy\."):
            storage.verify(tmp_path, manifest, "remedy", names)
    (tmp_path / "a").unlink()
    with pytest.raises(storage.DamagedFileError, match="a is missing, but"):
        storage.verify(tmp_path, manifest, "remedy")
    path = tmp_path / storage.MANIFEST
    for old, new in (('"step": 3', '"step": 4'), ('"facts"', '"face"'), (manifest.files["a"], manifest.files["b"])):
        path.write_text(path.read_text().replace(old, new))
        with pytest.raises(storage.DamagedFileError, match=r"manifest\.json is damaged, .*: remedy"):
            storage.read_manifest(tmp_path, "remedy")
        storage.write_manifest(tmp_path, *manifest)


HOLD = """
import sys
from pathlib import Path
from sts_jax import storage
with storage.lock(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_a_folder_is_locked_until_the_process_that_holds_it_ends(tmp_path):
    folder = tmp_path / "runs" / "one"
    command = [sys.executable, "-c", HOLD, str(folder)]
    root = str(Path(storage.__file__).parents[1])
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, env={**os.environ, "PYTHONPATH": root}, **pipes) as other:
        assert other.stdout.readline() == "held\n"
        message = rf"one is in use by process {other.pid} on .*: wait until that process"
        with pytest.raises(storage.LockedError, match=message), storage.lock(folder):
            pytest.fail("held twice")
        other.kill()  # without any cleaning
        other.wait()
    with storage.lock(folder), storage.lock(folder / "dataset"):  # one folder in another is another folder
        message = f"process {os.getpid()}"
        with pytest.raises(storage.LockedError, match=message), storage.lock(folder):
            pytest.fail("held twice")
    for _ in range(2):
        with pytest.raises(OSError, match=r"^of the block$"), storage.lock(folder):
            raise OSError("of the block")
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(OSError, match=r"cannot create or write to .*Choose a folder you can write to"):
            storage.lock(path).__enter__()


@dataclasses.dataclass(frozen=True)
class Inner:
    size: tuple[int, int]
    scale: float = 1.0


@dataclasses.dataclass(frozen=True)
class Outer:
    name: str
    inner: Inner
    parts: tuple[Inner, ...] = ()
    limit: float | None = None

    def __post_init__(self):
        if not self.name:
            raise ValueError("name must not be empty")


def test_a_dataclass_is_the_same_after_json():
    made = Outer("a", Inner((1, 2), 0.1), (Inner((3, 4)), Inner((5, 6))), limit=float("inf"))
    values = json.loads(json.dumps(dataclasses.asdict(made)))
    assert storage.decode(Outer, values, "outer") == made
    again = storage.decode(Outer, {"name": "b", "inner": {"size": [1, 2], "scale": 3}}, "outer")
    assert again == Outer("b", Inner((1, 2), 3.0))
    assert isinstance(again.inner.scale, float)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"name": 3}, "field outer.name is 3: Input should be a valid string"),
        ({"name": ""}, "name must not be empty"),
        ({"colour": 3}, "field outer.colour is unknown"),
        ({"inner": {}}, "field outer.inner.size is missing"),
        ({"inner": {"size": [1, "2"]}}, "field outer.inner.size[1] is '2': Input should be a valid integer"),
        ({"inner": {"size": [1, 2], "scale": True}}, "field outer.inner.scale is True: Input should be a valid number"),
        ({"parts": [{"size": [1]}]}, "field outer.parts[0].size[1] is missing"),
        ({"limit": "1"}, "field outer.limit is '1': Input should be a valid number"),
    ],
)
def test_a_wrong_field_of_json_values_is_named(values, message):
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        storage.decode(Outer, {"name": "a", "inner": {"size": [1, 2]}} | values, "outer")


def test_what_kills_have_left_is_deleted_with_the_lock_that_protects_it(tmp_path):
    leftovers = [".a.npz.7.partial", "figures/.b.png.1.partial", "models/one/.c.json.1.partial", "models/d.partial"]
    for name in leftovers:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("half")
    (tmp_path / ".pair.3.partial").mkdir()
    (tmp_path / ".pair.3.partial/a.png").write_text("half")
    with storage.lock(tmp_path / "models/one"), storage.lock(tmp_path / ".export.partial"):
        (tmp_path / "models/one/.e.json.2.partial").write_text("being written")
        with storage.lock(tmp_path):
            left = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.partial")}
    assert left == {"models/one/.e.json.2.partial", "models/d.partial", ".export.partial"}
    with storage.lock(tmp_path):
        assert not (tmp_path / ".export.partial").exists()


def test_processes_that_start_at_the_same_time_do_not_refuse_each_other(tmp_path):
    looked_at = filelock.FileLock(tmp_path / ".lock", thread_local=False)
    with storage.lock(tmp_path, part=(0, 3)), looked_at:
        timer = threading.Timer(0.3, looked_at.release)  # the other process has looked whether the folder is in use
        timer.start()
        with storage.lock(tmp_path, part=(1, 3)):
            timer.join()


def test_a_finished_folder_is_read_on_a_read_only_disk(tmp_path, monkeypatch):
    def refused(*_):
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr("filelock.FileLock.acquire", refused)
    with storage.lock(tmp_path, finished=True):
        assert list(tmp_path.iterdir()) == []
    with pytest.raises(OSError, match=r"cannot create or write to .*Choose a folder"), storage.lock(tmp_path):
        pytest.fail("locked")


@dataclasses.dataclass(frozen=True)
class _Inner:
    old: int = 1
    new: tuple[int, ...] = (2, 3)


@dataclasses.dataclass(frozen=True)
class _Outer:
    inner: _Inner
    needed: int
    later: str = "usual"


@pytest.mark.parametrize(
    ("changed", "message"),
    [({}, None), ({"later": "other"}, "later = 'usual'"), ({"inner": _Inner(1, (4,))}, r"inner\.new = \[2, 3\]")],
)
def test_a_field_that_an_older_version_lacked_counts_as_its_default(tmp_path, changed, message):
    path = tmp_path / "config.json"
    storage.write_json(path, {"inner": {"old": 1}, "needed": 5})
    now = dataclasses.replace(_Outer(_Inner(), 5), **changed)
    with pytest.raises(ValueError, match=message) if message else contextlib.nullcontext():
        storage.claim(path, dataclasses.asdict(now), storage.default_fields(now))
    assert storage.read_json(path, "") == {"inner": {"old": 1}, "needed": 5}
