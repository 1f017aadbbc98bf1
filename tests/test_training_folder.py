"""The folder of a model: damage is found and named, a kill at any moment loses nothing, and weights are rounded."""

import gc
import json
import resource
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from statespace_config import SMALL, Killed, arrays, kill_at, same

from sts_jax import mvae, storage, training
from sts_jax.training import folder as model_folder

CONFIG = training.TrainConfig(steps=4, batch_size=8, log_every=1, checkpoint_every=1)
IMAGE = np.arange(4 * 4 * 3, dtype=np.uint8).reshape(4, 4, 3)


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


def listed(folder):
    return sorted(model_folder.manifest(folder).files)


def sign(folder):
    """Write the manifest for the files that are in the folder now."""
    manifest = model_folder.manifest(folder)
    files = [name for name in manifest.files if (folder / name).exists()]
    storage.write_manifest(folder, storage.checksums(folder, files), manifest.facts)


def read_all(folder):
    """What predictions and figures read of a folder."""
    training.load(folder)
    return training.records(folder)


def test_every_single_bit_flip_is_found_and_named(folder):
    rng = np.random.default_rng(0)
    names = [*listed(folder), "metrics.jsonl", "manifest.json"]
    assert {"config.json", "blank.npz"} <= set(names)
    assert len([name for name in names if name.startswith("checkpoints/00000004/")]) >= 5
    sizes = np.array([(folder / name).stat().st_size for name in names])
    once = [name for name, size in zip(names, sizes, strict=True) if size]
    for name in [*once, "metrics.jsonl", *["manifest.json"] * 20, *rng.choice(names, 20, p=sizes / sizes.sum())]:
        path = folder / name
        whole = path.read_bytes()
        flipped = bytearray(whole)
        flipped[rng.integers(len(whole))] ^= 1 << rng.integers(8)
        path.write_bytes(flipped)
        try:
            with pytest.raises(storage.DamagedFileError, match=f"{name}.*train again"):
                read_all(folder)
        except pytest.fail.Exception:
            assert name == "manifest.json"  # a flip in its white space
            assert json.loads(path.read_bytes()) == json.loads(whole)
        path.write_bytes(whole)
    assert len(read_all(folder)) == 4


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda f: edit(f / "config.json", "0.05", "0.06"), r"config\.json is not the file .* edited"),
        (lambda f: (f / "blank.npz").unlink(), r"blank\.npz is missing"),
        (lambda f: next((f / "checkpoints").rglob("_METADATA")).unlink(), "_METADATA is missing"),
        (lambda f: (f / "checkpoints/00000004/weights/more").write_bytes(b""), "more is not listed"),
        (lambda f: (f / "manifest.json").write_text("[]"), r"manifest\.json is damaged"),
        (lambda f: (f / "manifest.json").unlink(), r"has a checkpoint but no manifest\.json"),
        (lambda f: (f / "metrics.jsonl").unlink(), r"metrics\.jsonl is not the log that manifest\.json lists"),
    ],
)
def test_each_mismatch_with_the_manifest_is_named(folder, damage, message):
    damage(folder)
    with pytest.raises(storage.DamagedFileError, match=message) as caught:
        read_all(folder)
    assert "train again" in str(caught.value)
    with pytest.raises(storage.DamagedFileError, match=message):
        train(folder)


def edit(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("metrics.jsonl", '{"step": 4, "loss": "low"}\n', r"metrics\.jsonl is no training log .*terms\.loss.*is 'low'"),
        ("metrics.jsonl", '{"loss": 1.0}\n', r"metrics\.jsonl is no training log .*step is missing"),
        ("metrics.jsonl", "[]\n", r"metrics\.jsonl is no training log"),
        ("manifest.json", {"step": "four"}, r"manifest\.json is that of another folder .*facts\.step"),
        ("manifest.json", {"step": 4, "log": 3}, r"manifest\.json is that of another folder .*facts\.log is 3"),
        ("blank.npz", {"visual": np.zeros((4, 4), np.uint8), "tactile": IMAGE}, r"blank\.npz .*array visual is uint8"),
        ("blank.npz", {"visual": IMAGE}, r"blank\.npz .*array tactile is missing"),
    ],
)
def test_absurd_content_with_a_valid_checksum_is_named_with_its_field(folder, name, content, message):
    files, facts = model_folder.manifest(folder)
    if name == "manifest.json":
        facts = content
    elif isinstance(content, dict):
        np.savez(folder / name, **content)
        files |= storage.checksums(folder, [name])
    else:
        (folder / name).write_text(content)
        facts |= {"log": {"bytes": len(content), "sha256": storage.sha256(folder / name)}}
    storage.write_manifest(folder, files, facts)
    with pytest.raises(storage.DamagedFileError, match=message):
        read_all(folder) if name != "blank.npz" else training.load_blank(folder)


def test_the_split_of_a_training_is_recorded_and_compared(tmp_path, finished):
    rows = {"train": np.arange(6), "test": np.array([6, 7])}
    training.claim_split(tmp_path, rows)
    training.claim_split(tmp_path, {"train": np.array([0]), "test": np.array([1])})  # nothing is trained yet
    training.claim_split(tmp_path, rows)
    training.save_blank(tmp_path, IMAGE, IMAGE)
    train(tmp_path)
    training.claim_split(tmp_path, rows)
    with pytest.raises(ValueError, match="was trained with another split of the dataset"):
        training.claim_split(tmp_path, {"train": np.arange(1, 7), "test": np.array([0, 7])})
    training.claim_split(finished[0], rows)  # an older model has no record


def test_a_checkpoint_of_another_model_gives_one_short_message(folder, state, capfd):
    wider = training.initial(CONFIG, training.learner(mvae.Config(SMALL.modalities, latent=4, hidden=9)), 4)[1]
    with pytest.raises(ValueError, match=r"00000004 cannot be read .* [Bb]elongs to another model") as caught:
        training.restore(folder, wider)
    assert caught.value.__suppress_context__
    assert len(capfd.readouterr().err.splitlines()) < 5
    assert int(training.restore(folder, state).step) == 4


@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")  # when weights are rounded
@pytest.mark.parametrize(("compact", "number"), [(False, np.nan), (True, -np.inf)])
def test_weights_that_are_no_numbers_are_named_despite_their_checksum(folder, state, compact, number):
    state = training.restore(folder, state)
    leaves, tree = jax.tree.flatten(state.params)
    leaves[-1] = leaves[-1].at[..., 0].set(number)
    training.save(folder, state._replace(params=jax.tree.unflatten(tree, leaves), step=jnp.int32(5)), compact=compact)
    with pytest.raises(ValueError, match=r"00000005 has NaN or infinite weights in params/\S+: restore it"):
        training.load(folder)


@pytest.mark.slow
@pytest.mark.parametrize("moment", ["before the checkpoint", "before the manifest", "before the older one goes"])
@pytest.mark.parametrize("at", [1, 3])
def test_a_kill_inside_a_save_loses_nothing(tmp_path, finished, monkeypatch, moment, at):
    """A killed process does not run `finally`, so the test also disables the cleaning."""
    write, orbax = storage.write_manifest, model_folder.ocp.save_checkpointables

    def die(*_):
        patch.setattr(model_folder, "_keep_only", lambda *_: None)
        raise Killed

    def save(path, tree):
        if moment == "before the checkpoint" and path.endswith(f"{at}"):
            (tmp_path / f"checkpoints/{at:08d}.orbax-checkpoint-tmp").mkdir()
            die()
        orbax(path, tree)

    def write_or_die(folder, files, facts):
        if facts["step"] == at and moment == "before the manifest":
            die()
        manifest = write(folder, files, facts)
        if facts["step"] == at and moment == "before the older one goes":
            die()
        return manifest

    training.save_blank(tmp_path, IMAGE, IMAGE)
    with monkeypatch.context() as patch:
        patch.setattr(model_folder.ocp, "save_checkpointables", save)
        patch.setattr(storage, "write_manifest", write_or_die)
        with pytest.raises(Killed):
            train(tmp_path)
    kept = at if moment == "before the older one goes" else at - 1
    assert model_folder.verified(tmp_path) == (kept or None)
    assert len(training.records(tmp_path)) == kept
    if kept:
        assert training.load(tmp_path).step == kept
    same(train(tmp_path).state, finished[1].state)
    assert (tmp_path / "metrics.jsonl").read_bytes() == (finished[0] / "metrics.jsonl").read_bytes()
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == ["00000004"]


@pytest.mark.filterwarnings("ignore:.*never awaited:RuntimeWarning")  # Orbax leaves coroutines behind
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_full_disk_is_one_clear_error_and_keeps_the_checkpoint(folder, state):
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (300, limits[1]))  # a write beyond the limit fails, as on a full disk
    try:
        with pytest.raises(OSError, match=r"cannot write .*00000009.*Free some disk space.*from step 4") as caught:
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


def test_a_second_training_in_a_folder_is_refused(tmp_path):
    def again(done, total, record):
        with pytest.raises(storage.LockedError, match=f"{tmp_path} is in use by process"):
            train(tmp_path)
        raise Killed

    with pytest.raises(Killed):
        train(tmp_path, progress=again)


def test_a_load_beside_a_training_reads_the_new_checkpoint(folder, monkeypatch, state):
    verify, done = model_folder.verified, []

    def slow(at):
        step = verify(at)
        if not done:  # a training saves between the check and the reading
            done.append(True)
            training.save(at, state._replace(step=jnp.int32(5)))
        return step

    monkeypatch.setattr(model_folder, "verified", slow)
    assert training.load(folder).step == 5


def test_a_blank_written_after_the_training_is_listed(tmp_path):
    train(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"blank\.npz is missing.*save_blank"):
        training.load_blank(tmp_path)
    for image in (IMAGE, IMAGE + 1):  # written again, after the file was deleted
        (tmp_path / "blank.npz").unlink(missing_ok=True)
        training.save_blank(tmp_path, image, image)
        assert "blank.npz" in listed(tmp_path)
        np.testing.assert_array_equal(training.load_blank(tmp_path)[1], image)


def test_the_blank_of_a_trained_model_does_not_change(tmp_path, folder):
    for image in (IMAGE + 1, IMAGE):
        training.save_blank(tmp_path, image, image)
        np.testing.assert_array_equal(training.load_blank(tmp_path)[0], image)
    training.save_blank(folder, IMAGE, IMAGE)
    with pytest.raises(ValueError, match="was trained with another empty sensor: choose another folder"):
        training.save_blank(folder, IMAGE + 1, IMAGE)
    np.testing.assert_array_equal(training.load_blank(folder)[0], IMAGE)


def test_a_config_of_another_version_is_named(folder):
    path = folder / "config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"model": {"modalities": [], "colour": 1}}))
    sign(folder)
    with pytest.raises(ValueError, match=r"config\.json does not describe a model that this version"):
        training.load(folder)


def test_a_model_is_loaded_without_any_optimiser(folder, finished, tmp_path, monkeypatch):
    begun = tmp_path / "begun"
    with pytest.raises(Killed):
        train(begun, progress=kill_at(2))
    for path in (folder, begun):
        shutil.rmtree(next(path.glob("checkpoints/*/optimiser")))
        sign(path)
    with pytest.raises(ValueError, match="no state of this optimiser"):
        train(begun)
    monkeypatch.setattr("sts_jax.training.loop._default_optimiser", lambda *_: pytest.fail("an optimiser was built"))
    same(training.load(folder).state, finished[1].state)
    same(train(folder).state, finished[1].state)  # a finished run
    assert training.load(begun).step == 2


def trip(tmp_path, arrays):
    model_folder.write_rounded(tmp_path / "weights.npz", arrays)
    return model_folder.read_rounded(tmp_path / "weights.npz")


def test_a_rounded_weight_moves_by_at_most_half_a_step_of_its_channel(tmp_path):
    rng = np.random.default_rng(0)
    scale = 10.0 ** np.arange(-6, 6)
    kernels = {
        "dense/kernel": rng.normal(size=(64, 12)) * scale,
        "conv/kernel": rng.laplace(size=(3, 3, 16, 12)) * scale,
        "sparse/kernel": (rng.random((300, 12)) < 0.01) * scale,
        "zero/kernel": np.zeros((5, 12)),
        "one/kernel": rng.normal(size=(1, 12)),
    }
    kernels = {name: values.astype(np.float32) for name, values in kernels.items()}
    for name, values in trip(tmp_path, kernels).items():
        assert (values.shape, values.dtype) == (kernels[name].shape, np.float32)
        flat, exact = (x.reshape(-1, 12).astype(np.float64) for x in (values, kernels[name]))
        assert np.all(np.abs(flat - exact).max(0) <= 1.001 * np.sqrt(np.mean(exact**2, 0)) / 256)


def test_a_large_weight_and_whole_numbers_are_kept_and_weights_take_less_than_half_precision(tmp_path):
    rng = np.random.default_rng(0)
    arrays = {"bias": rng.normal(size=100).astype(np.float32), "step": np.int32(26000), "empty": np.zeros(0)}
    kernel, steep = rng.normal(size=(500, 500)).astype(np.float32), np.ones((100_000, 1), np.float32)
    steep[7] = 1e5  # 316 times the root mean square, beyond 16 bits of its 128th part
    again = trip(tmp_path, arrays | {"steep": steep})
    for name, values in arrays.items():
        assert again[name].dtype == values.dtype
        np.testing.assert_array_equal(again[name], values)
    np.testing.assert_allclose(again["steep"][7], 1e5, rtol=1e-4)
    assert np.abs(again["steep"] - steep).max() <= 1e5 / 2**15
    trip(tmp_path, {"kernel": kernel})
    np.savez_compressed(tmp_path / "half.npz", kernel=kernel.astype(np.float16))
    assert (tmp_path / "weights.npz").stat().st_size < 0.75 * (tmp_path / "half.npz").stat().st_size
