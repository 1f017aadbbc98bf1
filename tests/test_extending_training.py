"""Another loss, optimiser, logger and modality, from outside the library, in a training and in a whole experiment."""

import struct

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from extending_page import blocks
from flax import nnx
from statespace_config import SMALL, Killed, arrays, kill_at, same
from tensorboardX.proto import event_pb2

from sts_jax import training

CONFIG = training.TrainConfig(steps=6, batch_size=8, log_every=2, checkpoint_every=4, beta_warmup=0.5)


def half_square(graphdef, params, stats, key, batch, beta):
    """A loss whose gradient is the parameters themselves."""
    total = 0.5 * optax.tree.norm(params, squared=True)
    return total, (stats, {"loss": total, "beta": beta})


def with_penalty(model, weight):
    """The library's loss and a penalty on the size of the parameters."""
    usual = training.learner(model).loss

    def loss(graphdef, params, stats, key, batch, beta):
        total, (stats, parts) = usual(graphdef, params, stats, key, batch, beta)
        penalty = weight * optax.tree.norm(params, squared=True)
        return total + penalty, (stats, {**parts, "loss": total + penalty, "penalty": penalty})

    return loss


def test_gradient_descent_on_half_the_square_shrinks_the_parameters_geometrically(tmp_path):
    learner = training.learner(SMALL)
    _, first = training.initial(CONFIG, learner, 6)
    model = training.train(CONFIG, SMALL, arrays(), workdir=tmp_path, loss=half_square, optimiser=optax.sgd(0.1))
    last = nnx.split_state(model.state, nnx.Param, nnx.BatchStat)[0]
    for before, after in zip(jax.tree.leaves(first.params), jax.tree.leaves(last), strict=True):
        np.testing.assert_allclose(after, 0.9**6 * before, rtol=1e-5)
    size = sum(float(jnp.sum(x**2)) for x in jax.tree.leaves(first.params))
    losses = [0.5 * size * 0.81**step for step in range(6)]
    for record, step in zip(training.records(tmp_path), (2, 4, 6), strict=True):
        assert record["step"] == step
        np.testing.assert_allclose(record["loss"], np.mean(losses[step - 2 : step]), rtol=1e-5)
        np.testing.assert_allclose(record["beta"], np.mean([min(s / 3, 1) for s in (step - 2, step - 1)]), rtol=1e-6)


def test_a_folder_is_not_resumed_with_another_loss_optimiser_or_note(tmp_path):
    def run(**more):
        return training.train(CONFIG, SMALL, arrays(), workdir=tmp_path, **more)

    def no_loss(graphdef, params, stats, key, batch, beta):
        return optax.tree.norm(params), (stats, {"size": optax.tree.norm(params)})

    with pytest.raises(ValueError, match=r"returned the parts \['size'\], but one must have the name 'loss'"):
        run(loss=no_loss)
    tmp_path = tmp_path / "adam"
    adam, notes = optax.adam(1e-3), {"optimiser": "Adam, 1e-3"}
    with pytest.raises(Killed):
        run(optimiser=adam, notes=notes, progress=kill_at(5))
    for changes, message in (
        ({"optimiser": None}, r"made with optimiser = 'given as optimiser=', but .* None"),
        ({"loss": half_square}, r"settings have loss = 'given as loss='"),
        ({"notes": {"optimiser": "Adam, 1e-2"}}, r"notes\.optimiser = 'Adam, 1e-3', but .* 'Adam, 1e-2'"),
        ({"optimiser": optax.lion(1e-3)}, r"has no state of this optimiser .* give the optimiser that the training"),
    ):
        with pytest.raises(ValueError, match=message):
            run(**({"optimiser": adam, "notes": notes} | changes))
    assert training.load(tmp_path).step == 4
    assert run(optimiser=adam, notes=notes).step == 6


def test_an_optimiser_with_a_random_key_is_resumed_with_the_same_noise(tmp_path):
    def run(folder, **more):
        noisy = optax.chain(optax.add_noise(0.01, 0.55, 0), optax.adam(1e-3))
        return training.train(CONFIG, SMALL, arrays(), workdir=tmp_path / folder, optimiser=noisy, **more)

    with pytest.raises(Killed):
        run("killed", progress=kill_at(5))
    whole, resumed = run("whole"), run("killed")
    assert whole.step == resumed.step == 6
    for one, other in zip(jax.tree.leaves(whole.state), jax.tree.leaves(resumed.state), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_killed_run_with_its_own_parts_has_the_same_bits_and_each_call_logs_every_record_once(tmp_path):
    """Also records of earlier calls, so that a log that starts empty is complete wherever the run was killed."""

    def run(folder, **more):
        received = []
        model = training.train(
            CONFIG,
            SMALL,
            arrays(),
            workdir=tmp_path / folder,
            loss=with_penalty(SMALL, 1e-3),
            optimiser=optax.chain(optax.clip_by_global_norm(1.0), optax.adamw(1e-2)),
            log=lambda *record: received.append(record),
            **more,
        )
        return model.state, received

    whole, logged = run("whole")
    assert [step for step, _ in logged] == [2, 4, 6]
    assert [{"step": step, **values} for step, values in logged] == training.records(tmp_path / "whole")
    with pytest.raises(Killed):
        run("killed", progress=kill_at(3))
    for _ in range(2):  # the second run is already finished
        state, received = run("killed")
        same(state, whole)
        assert received == logged
    same(training.load(tmp_path / "killed").state, whole)


def scalars(folder):
    """The names and steps in the event files of TensorBoard, which are records of the format TFRecord."""
    found = set()
    for path in folder.iterdir():
        data = path.read_bytes()
        while data:
            (size,) = struct.unpack("<Q", data[:8])
            event, data = event_pb2.Event.FromString(data[12 : 12 + size]), data[12 + size + 4 :]
            found |= {(value.tag, event.step) for value in event.summary.value}
    return found


@pytest.mark.slow
def test_the_code_of_the_page_trains_with_a_penalty_and_another_optimiser_and_writes_to_tensorboard(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    names = {"model": SMALL, "arrays": arrays(), "config": CONFIG}
    exec("\n".join(blocks("Another loss, another optimiser, another logger")), names)
    assert [record["step"] for record in training.records(tmp_path / "model")] == [2, 4, 6]
    assert all(record["penalty"] > 0 for record in training.records(tmp_path / "model"))
    logged = training.records(tmp_path / "logged")
    assert "penalty" not in logged[0]
    wanted = {(name, record["step"]) for record in logged for name in record if name != "step"}
    assert scalars(tmp_path / "tensorboard" / "logged") == wanted
