"""Checkpoints and their checksums: damage is found and named, and a kill at any moment loses nothing."""

import gc
import json
import resource
import shutil
import traceback

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from sts_jax import mvae, storage, training
from sts_jax.training import checkpoint, manifest, optimisers

SMALL = mvae.Config((mvae.Modality("a", "vector", (3,)), mvae.Modality("b", "vector", (2,))), latent=4, hidden=8)
CONFIG = training.TrainConfig(steps=4, batch_size=8, log_every=1, checkpoint_every=1)
IMAGE = np.arange(4 * 4 * 3, dtype=np.uint8).reshape(4, 4, 3)


def arrays():
    rng = np.random.default_rng(0)
    data = {"a": rng.random((20, 3), np.float32), "b": rng.random((20, 2), np.float32)}
    return training.Arrays(data, data)


def train(workdir, **more):
    return training.train(CONFIG, SMALL, arrays(), workdir=workdir, preprocessing={"position_scale": 0.05}, **more)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    workdir = tmp_path_factory.mktemp("run")
    training.save_blank(workdir, IMAGE, IMAGE)
    return workdir, train(workdir)


@pytest.fixture
def folder(finished, tmp_path):
    return shutil.copytree(finished[0], tmp_path / "model")


@pytest.fixture(scope="module")
def state():
    """A state as it is before the first step."""
    return training.initial(CONFIG, training.learner(SMALL), 4)[1]


def same(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


def listed(folder):
    return sorted(manifest.read(folder).files)


class Killed(BaseException):
    """Not caught by `except Exception`, like the end of a process."""


def test_every_single_bit_flip_is_found_and_named(folder):
    rng = np.random.default_rng(0)
    names = listed(folder)
    assert "config.json" in names
    assert "blank.npz" in names
    assert len([name for name in names if name.startswith("checkpoints/00000004/")]) >= 5
    sizes = np.array([(folder / name).stat().st_size for name in names])
    once = [name for name, size in zip(names, sizes, strict=True) if size]
    for name in [*once, *rng.choice(names, 30, p=sizes / sizes.sum())]:
        path = folder / name
        whole = path.read_bytes()
        flipped = bytearray(whole)
        flipped[rng.integers(len(whole))] ^= 1 << rng.integers(8)
        path.write_bytes(flipped)
        with pytest.raises(storage.DamagedFileError, match=f"{name}.*train again"):
            checkpoint.verified(folder)
        path.write_bytes(whole)
    assert checkpoint.verified(folder) == folder / "checkpoints/00000004"


def test_every_flip_in_the_manifest_is_found(folder):
    path = folder / "manifest.json"
    whole, rng = path.read_bytes(), np.random.default_rng(0)
    for place in rng.choice(len(whole), 300, replace=False):
        flipped = bytearray(whole)
        flipped[place] ^= 1 << rng.integers(7)
        path.write_bytes(flipped)
        try:
            found = manifest.read(folder)
        except storage.DamagedFileError:
            continue
        if found == manifest.Manifest(4, json.loads(whole)["files"]):  # a flip in white space
            continue
        with pytest.raises(storage.DamagedFileError, match="train again"):
            checkpoint.verified(folder)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda f: edit(f / "config.json", "0.05", "0.06"), r"config\.json is not the file .* edited"),
        (lambda f: (f / "config.json").write_bytes(b"\xff\xfe"), r"config\.json is not the file"),
        (lambda f: np.savez(f / "blank.npz", visual=IMAGE, tactile=IMAGE + 1), r"blank\.npz is not the file"),
        (lambda f: (f / "blank.npz").unlink(), r"blank\.npz is missing"),
        (lambda f: next((f / "checkpoints").rglob("_METADATA")).unlink(), "_METADATA is missing"),
        (lambda f: (f / "checkpoints/00000004/weights/more").write_bytes(b""), "more is not listed.*elsewhere"),
        (lambda f: (f / "manifest.json").write_text('{"step": '), r"manifest\.json cannot be read"),
        (lambda f: (f / "manifest.json").write_bytes(b"\x80"), r"manifest\.json cannot be read"),
        (lambda f: (f / "manifest.json").write_text("[]"), r"manifest\.json is damaged"),
    ],
)
def test_each_mismatch_with_the_manifest_is_named(folder, damage, message):
    damage(folder)
    with pytest.raises(storage.DamagedFileError, match=message) as caught:
        training.load(folder)
    assert "train again" in str(caught.value)


def edit(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def test_a_torn_checkpoint_gives_one_short_message(folder, capfd, caplog):
    for path in (folder / "checkpoints").rglob("*"):
        if path.is_file():
            path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(storage.DamagedFileError, match="its SHA-256 differs") as caught:
        training.load(folder)
    out = capfd.readouterr()
    assert out.out + out.err + caplog.text == ""
    lines = "".join(traceback.format_exception(caught.value)).splitlines()
    assert len(lines) < 150  # Orbax alone prints 102,000. The type checks of these tests add frames.


def test_a_checkpoint_of_another_model_gives_one_short_message(folder, state, capfd):
    wider = training.initial(CONFIG, training.learner(mvae.Config(SMALL.modalities, latent=4, hidden=9)), 4)[1]
    with pytest.raises(ValueError, match=r"00000004 cannot be read .* belongs to another model") as caught:
        training.restore(folder, wider)
    assert caught.value.__suppress_context__
    assert len(capfd.readouterr().err.splitlines()) < 5
    assert int(training.restore(folder, state).step) == 4


def test_a_folder_without_a_manifest_can_be_sealed(folder, finished):
    (folder / "manifest.json").unlink()
    for read in (training.load, train):
        with pytest.raises(ValueError, match=r"no manifest\.json.*earlier version.*training\.seal\("):
            read(folder)
    training.seal(str(folder))  # as the message advises
    same(training.load(folder).state, finished[1].state)
    with pytest.raises(ValueError, match="has a manifest"):
        training.seal(folder)
    with pytest.raises(FileNotFoundError, match="no checkpoint"):
        training.seal(folder / "nowhere")


@pytest.mark.slow
@pytest.mark.parametrize("moment", ["before the checkpoint", "before the manifest", "before the older one goes"])
@pytest.mark.parametrize("at", [1, 3])
def test_a_kill_inside_a_save_loses_nothing(tmp_path, finished, monkeypatch, moment, at):
    """A killed process does not run `finally`, so the test also disables the cleaning."""
    write, keep, orbax = manifest.write, checkpoint._keep_only, checkpoint.ocp.save_checkpointables

    def die(*_):
        monkeypatch.setattr(checkpoint, "_keep_only", lambda *_: None)
        raise Killed

    def save(path, tree):
        if moment == "before the checkpoint" and path.endswith(f"{at}"):
            (tmp_path / f"checkpoints/{at:08d}.orbax-checkpoint-tmp").mkdir()
            die()
        orbax(path, tree)

    def seal(folder, step):
        if step == at and moment == "before the manifest":
            die()
        write(folder, step)
        if step == at and moment == "before the older one goes":
            die()
        return manifest.read(folder)

    monkeypatch.setattr(checkpoint.ocp, "save_checkpointables", save)
    monkeypatch.setattr(manifest, "write", seal)
    training.save_blank(tmp_path, IMAGE, IMAGE)
    with pytest.raises(Killed):
        train(tmp_path)
    monkeypatch.setattr(checkpoint, "_keep_only", keep)
    monkeypatch.setattr(checkpoint.ocp, "save_checkpointables", orbax)
    monkeypatch.setattr(manifest, "write", write)
    kept = at if moment == "before the older one goes" else at - 1
    assert manifest.read(tmp_path).step == (kept or None)
    if kept:
        assert training.load(tmp_path).step == kept
    same(train(tmp_path).state, finished[1].state)
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == ["00000004"]


def test_a_folder_of_the_user_beside_the_checkpoints_is_kept(tmp_path):
    own = tmp_path / "run" / "checkpoints" / "best"
    own.mkdir(parents=True)
    (own / "note.txt").write_text("keep")
    train(tmp_path / "run")
    assert (own / "note.txt").read_text() == "keep"
    assert sorted(path.name for path in own.parent.iterdir()) == ["00000004", "best"]


@pytest.mark.filterwarnings("ignore:.*never awaited:RuntimeWarning")  # Orbax leaves coroutines behind
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_full_disk_is_one_clear_error_and_keeps_the_checkpoint(folder, state):
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (300, limits[1]))  # a write beyond the limit fails, as on a full disk
    try:
        with pytest.raises(OSError, match=r"cannot write .*00000009.*Free some disk space.*step 4 is kept") as caught:
            training.save(folder, state._replace(step=jnp.int32(9)))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert len(str(caught.value)) < 1000
    assert caught.value.__suppress_context__
    assert training.load(folder).step == 4
    # Orbax's threads may still be removing their own temporary folder.
    assert [path.name for path in (folder / "checkpoints").iterdir() if path.name.isdigit()] == ["00000004"]
    del caught
    gc.collect()  # of the coroutines, whose warnings would fail a later test


@pytest.mark.parametrize(
    "error", [RuntimeError("ABORTED\n" * 1000), ValueError("NO_SPACE"), ExceptionGroup("two", [OSError()])]
)
def test_every_error_of_orbax_becomes_an_os_error(tmp_path, state, monkeypatch, error):
    def save(*_):
        raise error

    monkeypatch.setattr(checkpoint.ocp, "save_checkpointables", save)
    with pytest.raises(OSError, match=f"cannot write {tmp_path}.*no earlier checkpoint") as caught:
        training.save(tmp_path, state)
    assert len(str(caught.value).splitlines()) == 1


def test_a_second_training_in_a_folder_is_refused(tmp_path):
    def again(done, total, record):
        with pytest.raises(storage.LockedError, match=f"{tmp_path} is in use by process"):
            train(tmp_path)
        raise Killed

    with pytest.raises(Killed):
        train(tmp_path, progress=again)


def test_a_load_beside_a_training_reads_the_new_checkpoint(folder, monkeypatch, state):
    verify, done = manifest.verify, []

    def slow(at, there):
        verify(at, there)
        if not done:  # a training saves between the check and the reading
            done.append(True)
            training.save(at, state._replace(step=jnp.int32(5)))

    monkeypatch.setattr(manifest, "verify", slow)
    assert training.load(folder).step == 5


def test_a_blank_written_after_the_training_is_listed(tmp_path):
    train(tmp_path)
    assert "blank.npz" not in listed(tmp_path)
    training.save_blank(tmp_path, IMAGE, IMAGE)
    assert "blank.npz" in listed(tmp_path)
    checkpoint.verified(tmp_path)
    (tmp_path / "blank.npz").unlink()
    training.save_blank(tmp_path, IMAGE, IMAGE + 1)  # written again, as the message about a damaged file advises
    checkpoint.verified(tmp_path)
    np.testing.assert_array_equal(training.load_blank(tmp_path)[1], IMAGE + 1)


@pytest.mark.parametrize("content", [b"", b"PK", b"no zip", b"\x80\x81"])
def test_a_damaged_blank_is_named(tmp_path, content):
    (tmp_path / "blank.npz").write_bytes(content)
    with pytest.raises(storage.DamagedFileError, match=r"blank\.npz is damaged.*delete it"):
        training.load_blank(tmp_path)


def test_a_missing_or_incomplete_blank_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"blank\.npz is missing.*save_blank"):
        training.load_blank(tmp_path)
    for content in (
        {"visual": IMAGE},
        {"visual": IMAGE, "tactile": IMAGE / 255},
        {"visual": IMAGE, "tactile": IMAGE[0]},
    ):
        np.savez(tmp_path / "blank.npz", **content)
        with pytest.raises(storage.DamagedFileError, match=r"blank\.npz is damaged"):
            training.load_blank(tmp_path)


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """A training that was killed after its second record."""
    workdir = tmp_path_factory.mktemp("stopped")

    def stop(done, total, record):
        if done == 2:
            raise Killed

    with pytest.raises(Killed):
        train(workdir, progress=stop)
    return workdir


@pytest.mark.slow
@pytest.mark.parametrize("line", [b"\xff\xfe", b"[]", b"{}", b'{"step": "one"}', b'{"step"', b"7"])
def test_a_damaged_record_is_named_and_a_torn_last_one_is_dropped(tmp_path, finished, stopped, line):
    workdir = shutil.copytree(stopped, tmp_path / "run")
    log = workdir / "metrics.jsonl"
    first, second = log.read_bytes().splitlines()
    log.write_bytes(b"\n".join([first, line, second, b""]))
    with pytest.raises(storage.DamagedFileError, match=r"metrics\.jsonl, line 2, is damaged.*delete this line"):
        train(workdir)
    log.write_bytes(b"\n".join([first, second, line]))
    train(workdir)
    assert log.read_bytes() == (finished[0] / "metrics.jsonl").read_bytes()


@pytest.mark.parametrize(
    "change", [{"model": None}, {"model": {}}, {"model": {"modalities": 3}}, {"model": {"modalities": [], "colour": 1}}]
)
def test_a_config_of_another_version_is_named(folder, change):
    path = folder / "config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    (folder / "manifest.json").unlink()
    training.seal(folder)
    with pytest.raises(ValueError, match=r"config\.json does not describe a model that this version"):
        training.load(folder)


def test_the_repr_of_a_model_fits_on_one_line(finished):
    assert repr(finished[1]) == "Model(a vector (3,), b vector (2,); latent=4, condition=0, 325 numbers, step=4)"


def undivided(folder, state):
    """Rewrite the checkpoint of a folder as sts_jax 0.1 wrote it: weights and optimiser in one part."""
    shutil.rmtree(folder / "checkpoints")
    leaves, _ = jax.tree_util.tree_flatten_with_path(state)
    plain = {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}
    path = manifest.checkpoint(folder, int(state.step))
    path.parent.mkdir()
    checkpoint.ocp.save(str(path), plain)
    (folder / "manifest.json").unlink()
    training.seal(folder)
    assert (path / "state").is_dir()


@pytest.mark.parametrize("at", [2, 4])
def test_an_undivided_checkpoint_is_loaded_and_resumed_with_the_same_bits(folder, finished, stopped, tmp_path, at):
    if at == 2:
        folder = shutil.copytree(stopped, tmp_path / "stopped")
    whole = training.restore(folder, training.initial(CONFIG, training.learner(SMALL), 4)[1])
    assert int(whole.step) == at
    undivided(folder, whole)
    same(training.load(folder).state, nnx.merge_state(whole.params, whole.stats))
    same(train(folder).state, finished[1].state)
    same(training.load(folder).state, finished[1].state)
    parts = {path.name for path in (folder / "checkpoints/00000004").iterdir() if path.is_dir()}
    assert parts == ({"state"} if at == 4 else {"weights", "optimiser"})  # a finished run is not written


def test_a_model_is_loaded_without_any_optimiser(folder, finished, stopped, tmp_path, monkeypatch):
    begun = shutil.copytree(stopped, tmp_path / "stopped")
    for path in (folder, begun):
        shutil.rmtree(next(path.glob("checkpoints/*/optimiser")))
        (path / "manifest.json").unlink()
        training.seal(path)
    with pytest.raises(ValueError, match=r"no state of this optimiser .* Predictor\.load reads this model without"):
        train(begun)
    monkeypatch.setattr(optimisers, "optimiser", lambda *_: pytest.fail("an optimiser was built"))
    same(training.load(folder).state, finished[1].state)
    same(train(folder).state, finished[1].state)  # a finished run
    assert training.load(begun).step == 2
