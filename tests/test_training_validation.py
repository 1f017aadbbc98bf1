"""The validation loss, and the weights with the least one: which, complete, and the same after a kill."""

import dataclasses
import json
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from statespace_config import SMALL, Killed, arrays, kill_at, same

from sts_jax import mvae, storage, training
from sts_jax.training import folder as model_folder

CONFIG = training.TrainConfig(steps=10, batch_size=8, log_every=1, checkpoint_every=2, learning_rate=0.1)
ONES = np.ones((2, 3), np.float32)
IMAGE = np.arange(4 * 4 * 3, dtype=np.uint8).reshape(4, 4, 3)
ROWS = {"train": np.arange(6), "test": np.array([6, 7])}


def train(workdir, **more):
    given = {"validation": arrays(11, seed=1)} | more
    return training.train(CONFIG, SMALL, arrays(), workdir=workdir, **given)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run, with the state at each checkpoint."""
    workdir, states = tmp_path_factory.mktemp("run"), {}
    training.save_blank(workdir, IMAGE, IMAGE)
    training.claim_split(workdir, ROWS)
    train(workdir, progress=lambda done, *_: done % 2 or states.update({done: training.load(workdir).state}))
    return workdir, states


def best_of(workdir):
    """The step with the least validation loss in the log."""
    losses = {record["step"]: record["validation"] for record in training.records(workdir) if "validation" in record}
    assert list(losses) == [2, 4, 6, 8, 10]
    return min(losses, key=losses.get)


def test_the_best_weights_are_those_of_the_checkpoint_with_the_least_loss(finished):
    workdir, states = finished
    best = training.load(workdir / "best")
    assert best.step == best_of(workdir)
    same(best.state, states[best.step])
    same(training.load(workdir).state, states[10])


def test_the_best_weights_are_a_complete_model_folder(finished, tmp_path):
    workdir, _ = finished
    moved = shutil.copytree(workdir / "best", tmp_path / "moved")
    same(training.load_blank(moved), (IMAGE, IMAGE))
    assert training.load(moved).settings == training.load(workdir).settings
    training.claim_split(moved, ROWS)
    with pytest.raises(ValueError, match="was trained with another split"):
        training.claim_split(moved, {"train": np.arange(3)})
    (path,) = moved.glob("checkpoints/*")
    assert [part.name for part in path.iterdir() if part.is_dir()] == ["weights"]
    content = (moved / "config.json").read_bytes()
    (moved / "config.json").write_bytes(content.replace(b"latent", b"latenT"))
    with pytest.raises(storage.DamagedFileError, match=r"moved/config\.json is not the file"):
        training.load(moved)


def test_best_weights_of_another_training_are_not_mixed_with_new_ones(finished, tmp_path):
    shutil.copytree(finished[0] / "best", tmp_path / "best")
    with pytest.raises(ValueError, match=r"best/config\.json is that of another training than .*: delete .*best$"):
        training.train(dataclasses.replace(CONFIG, seed=1), SMALL, arrays(), workdir=tmp_path, validation=arrays(5))


def test_a_blank_written_after_the_training_is_in_both_folders(tmp_path):
    train(tmp_path)
    training.save_blank(tmp_path, IMAGE, IMAGE)
    for folder in (tmp_path, tmp_path / "best"):
        same(training.load_blank(folder), (IMAGE, IMAGE))
        training.load(folder)


@pytest.mark.parametrize("step", [1, *(pytest.param(step, marks=pytest.mark.slow) for step in (3, 6, 9))])
def test_a_killed_run_has_the_same_log_and_the_same_best_weights(finished, tmp_path, step):
    training.save_blank(tmp_path, IMAGE, IMAGE)
    training.claim_split(tmp_path, ROWS)
    with pytest.raises(Killed):
        train(tmp_path, progress=kill_at(step))
    train(tmp_path)
    same_folders(tmp_path, finished[0])


@pytest.mark.parametrize("place", ["best", "model"])
@pytest.mark.parametrize("at", [4, *(pytest.param(at, marks=pytest.mark.slow) for at in (2, 10))])
def test_a_kill_while_weights_are_written_loses_nothing(finished, tmp_path, monkeypatch, place, at):
    """A killed process does not run `finally`, so the test also disables the cleaning."""
    write = storage.write_manifest

    def write_or_die(folder, files, facts):
        if facts["step"] == at and (folder.name == "best") == (place == "best"):
            patch.setattr(model_folder, "_keep_only", lambda *_: None)
            raise Killed
        return write(folder, files, facts)

    training.save_blank(tmp_path, IMAGE, IMAGE)
    training.claim_split(tmp_path, ROWS)
    with monkeypatch.context() as patch:
        patch.setattr(storage, "write_manifest", write_or_die)
        if place == "model" or at in improved(finished[0]):
            with pytest.raises(Killed):
                train(tmp_path)
    if (tmp_path / "best/manifest.json").exists() and model_folder.verified(tmp_path / "best"):
        training.load(tmp_path / "best")
    train(tmp_path)
    same_folders(tmp_path, finished[0])


def improved(workdir):
    """The steps at which the validation loss was less than before."""
    losses = {record["step"]: record["validation"] for record in training.records(workdir) if "validation" in record}
    return [step for step in losses if losses[step] < min([losses[s] for s in losses if s < step], default=np.inf)]


def same_folders(one, other):
    assert (one / "metrics.jsonl").read_bytes() == (other / "metrics.jsonl").read_bytes()
    for path in ("", "best"):
        a, b = training.load(one / path), training.load(other / path)
        same(a.state, b.state)
        assert a.step == b.step
        assert [each.name for each in (one / path / "checkpoints").iterdir()] == [f"{b.step:08d}"]
        same(training.load_blank(one / path), training.load_blank(other / path))


def test_the_validation_loss_is_the_mean_over_all_samples(tmp_path):
    """Also if the last batch is smaller, with a loss whose value is known."""

    def loss(graphdef, params, stats, key, batch, beta):
        value = jnp.mean(batch["targets"]["a"]) + beta
        return value, (stats, {"loss": value})

    data = arrays(11, seed=1)
    train(tmp_path, validation=data, loss=loss)
    for record in training.records(tmp_path):
        if "validation" in record:
            assert record["validation"] == pytest.approx(np.mean(data.targets["a"]) + 1, rel=1e-5)


def test_the_validation_loss_is_that_of_the_predictions_with_the_running_statistics(monkeypatch):
    """Without noise, the loss is the error of `mvae.predict` for each subset, and the divergence of its posterior."""
    config = mvae.Config((mvae.Modality("a", "image", (32, 32, 3)),), latent=4, hidden=8, widths=(4, 4, 4, 4))
    graphdef, params, stats = mvae.init(jax.random.key(0), config)
    stats = jax.tree.map(lambda x: x + 0.3, stats)
    x = jax.random.uniform(jax.random.key(1), (3, 32, 32, 3))
    logits, q = mvae.predict(graphdef, training.loop.nnx.merge_state(params, stats), {"a": x})
    cross = np.sum(np.logaddexp(0, logits["a"]) - logits["a"] * x, axis=(1, 2, 3))
    divergence = np.sum(q.mean**2 + np.exp(q.log_var) - 1 - q.log_var, axis=1) / 2
    monkeypatch.setattr(jax.random, "normal", lambda key, shape: jnp.zeros(shape))
    batch = {"inputs": {"a": x}, "targets": {"a": x}, "present": {}, "target_present": {}, "condition": None}
    score = jax.jit(training.learner(config).score, static_argnums=0)
    value, (after, _) = score(graphdef, params, stats, jax.random.key(0), batch, jnp.ones(()))
    np.testing.assert_allclose(value, np.mean(cross + divergence), rtol=1e-5)
    same(after, stats)


def test_a_validation_set_may_lack_an_input_of_the_model(tmp_path):
    data = arrays(6)
    lacking = training.Arrays({"a": data.inputs["a"]}, data.targets)
    train(tmp_path, validation=lacking)
    assert training.load(tmp_path / "best").step == best_of(tmp_path)


@pytest.mark.parametrize(
    ("validation", "message"),
    [
        (
            training.Arrays({"a": np.ones((2, 3))}, {"a": np.ones((2, 3))}),
            "`validation` does not fit .* `targets` have",
        ),
        (training.Arrays(*2 * [arrays(2).inputs], condition=ONES[:, :1]), "`validation` does not .* has width 1"),
    ],
)
def test_a_validation_set_of_another_model_is_refused(tmp_path, validation, message):
    with pytest.raises(ValueError, match=message):
        train(tmp_path, validation=validation)
    assert not list(tmp_path.iterdir())


def test_another_validation_set_or_none_is_refused_in_the_same_folder(finished):
    for other in (arrays(11, seed=2), None):
        with pytest.raises(ValueError, match=r"made with data\.validation"):
            train(finished[0], validation=other)


def test_a_validation_loss_that_is_not_finite_ends_the_run(tmp_path):
    data = arrays(4)
    bad = training.Arrays({name: x * np.float32(1e38) for name, x in data.inputs.items()}, data.targets)
    with pytest.raises(FloatingPointError, match=r"the validation loss is (nan|inf) at step 2"):
        train(tmp_path, validation=bad)


def test_a_folder_of_an_older_version_lacks_new_fields_that_have_their_defaults(tmp_path):
    view = {"resolution": [4, 4], "stride": None, "period": 0.0}
    train(tmp_path, preprocessing=view)
    path = tmp_path / "config.json"
    content = json.loads(path.read_text())
    for name in ("stride", "period"):
        del content["preprocessing"][name]
    del content["model"]["momentum"]
    path.write_text(json.dumps(content))
    manifest = model_folder.manifest(tmp_path)
    storage.write_manifest(tmp_path, storage.checksums(tmp_path, manifest.files), manifest.facts)
    train(tmp_path, preprocessing=view)
    with pytest.raises(ValueError, match=r"preprocessing\.stride = None, .* settings have .*stride = 2, "):
        train(tmp_path, preprocessing=view | {"stride": 2, "period": 0.1})


def test_a_loss_of_ones_own_is_scored_as_the_usual_one(finished, tmp_path):
    modes, usual = set(), training.learner(SMALL).loss

    def loss(*args, training=True):
        modes.add(training)
        return usual(*args, training=training)

    train(tmp_path, loss=loss)
    assert modes == {True, False}
    for one, other in zip(training.records(tmp_path), training.records(finished[0]), strict=True):
        assert one.get("validation") == other.get("validation")
