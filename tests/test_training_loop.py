"""Training: bit-exact resume, the order of samples, damaged folders and those of other runs, and learning."""

import dataclasses
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from statespace_config import SMALL, TINY, Killed, arrays, kill_at, random_codes, random_states, same

from sts_jax import mvae, objects, statespace, training

CONFIG = training.TrainConfig(steps=12, batch_size=8, log_every=2, checkpoint_every=4)


def files(folder):
    """Time of change and content of everything in a folder."""
    paths = [folder, *sorted(folder.rglob("*"))]
    return {str(p): (p.stat().st_mtime_ns, p.read_bytes() if p.is_file() else None) for p in paths}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    workdir = tmp_path_factory.mktemp("run")
    return workdir, training.train(CONFIG, SMALL, arrays(), workdir=workdir, preprocessing={"view": "pad"})


@pytest.mark.parametrize("step", [3, 6])
def test_a_killed_run_ends_with_the_same_bits(tmp_path, finished, step):
    with pytest.raises(Killed):
        training.train(CONFIG, SMALL, arrays(), workdir=tmp_path, preprocessing={"view": "pad"}, progress=kill_at(step))
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"step": 6, "lo')  # torn
    model = training.train(CONFIG, SMALL, arrays(), workdir=tmp_path, preprocessing={"view": "pad"})
    same(model.state, finished[1].state)
    for name in ("metrics.jsonl", "config.json"):
        assert (tmp_path / name).read_text() == (finished[0] / name).read_text()
    assert [record["step"] for record in training.records(tmp_path)] == [2, 4, 6, 8, 10, 12]


def test_a_finished_run_is_not_changed(finished):
    workdir, model = finished
    before = files(workdir)
    again = training.train(CONFIG, SMALL, arrays(), workdir=workdir, preprocessing={"view": "pad"})
    same(again.state, model.state)
    assert files(workdir) == before


def test_another_config_or_other_data_are_refused(finished):
    workdir, _ = finished
    with pytest.raises(
        ValueError, match=r"was made with training.steps = 12, .* but the current settings have training.steps = 13"
    ):
        training.train(training.TrainConfig(steps=13), SMALL, arrays(), workdir=workdir, preprocessing={"view": "pad"})
    with pytest.raises(ValueError, match=r"made with data.checksum"):
        training.train(CONFIG, SMALL, arrays(seed=1), workdir=workdir, preprocessing={"view": "pad"})


def test_a_state_keeps_its_structure_and_dtypes():
    graphdef, state = training.initial(CONFIG, training.learner(SMALL), 12)
    batch = arrays().take(np.arange(8))
    after, _ = jax.eval_shape(
        lambda s, b: training.step(training.learner(SMALL), graphdef, CONFIG, 12, s, b), state, batch
    )
    assert jax.tree.structure(after) == jax.tree.structure(state)
    for a, b in zip(jax.tree.leaves(after), jax.tree.leaves(state), strict=True):
        assert (a.shape, a.dtype, a.weak_type) == (b.shape, b.dtype, getattr(b, "weak_type", False))


def test_a_loss_that_is_not_finite_ends_the_run(tmp_path):
    config = training.TrainConfig(steps=40, batch_size=8, log_every=1, checkpoint_every=1, learning_rate=1e30)
    with pytest.raises(FloatingPointError, match="learning_rate"):
        training.train(config, SMALL, arrays(), workdir=tmp_path)


def squares(samples, seed):
    """A bright square at p moves to f(p) = (y, 31 - x). Images are uint8."""
    rng = np.random.default_rng(seed)
    at = rng.integers(0, 24, (samples, 2))
    images = [np.full((samples, 32, 32, 1), 40, np.uint8) for _ in range(2)]
    for i, (y, x) in enumerate(at):
        images[0][i, y : y + 8, x : x + 8] = 230
        images[1][i, x : x + 8, 24 - y : 32 - y] = 230
    return images[0], images[1]


def test_a_model_learns_the_final_place_of_a_square(tmp_path: Path):
    """The skill is against the mean image, on held-out squares and with the running statistics."""
    model = mvae.Config((mvae.Modality("visual", "image", (32, 32, 1)),), latent=16, hidden=64, widths=(8, 16, 16, 32))
    x, y = squares(400, 0)
    config = training.TrainConfig(steps=200, batch_size=32, learning_rate=3e-3, log_every=25, checkpoint_every=200)
    trained = training.train(config, model, training.Arrays({"visual": x}, {"visual": y}), workdir=tmp_path)
    run = jax.jit(lambda x: mvae.predict(trained.graphdef, trained.state, {"visual": x})[0]["visual"])

    def excess(logits, y):
        entropy = -(y * np.log(y) + (1 - y) * np.log1p(-y))
        return float(np.mean(np.logaddexp(0, logits) - logits * y - entropy))

    def skill(x, y):
        mean = np.mean(squares(400, 0)[1] / 255.0, axis=0)
        constant = np.log(mean) - np.log1p(-mean)
        return 1 - excess(np.asarray(run(jnp.asarray(x, jnp.float32) / 255)), y / 255) / excess(constant, y / 255)

    assert skill(*squares(100, 1)) > 0.3
    # The bound of training (batch statistics, a sampled z) against the prediction (running ones, the mean).
    logits = np.asarray(run(jnp.asarray(x, jnp.float32) / 255))
    evaluated = np.mean(np.sum(np.logaddexp(0, logits) - logits * (y / 255), axis=(1, 2, 3)))
    last = json.loads((tmp_path / "metrics.jsonl").read_text().splitlines()[-1])
    assert evaluated < 1.02 * last["visual"]


STATE = dataclasses.replace(TINY, drawn=1.0, drawn_first=0.25)
STATE_CONFIG = training.TrainConfig(
    steps=6, batch_size=4, views=2, falls=3, learning_rate=1e-2, log_every=1, checkpoint_every=2, beta_warmup=0.5
)


def bars(samples=4, *, further=False):
    """A bar on a grey image ends elsewhere, turned by 90 degrees. It falls off in every second sample.

    `further` adds views and falls, which have other numbers of rows.
    """
    rng = np.random.default_rng(0)
    first, last = (np.full((samples, 16, 16, 3), 120, np.uint8) for _ in range(2))
    code = np.zeros((2, samples, 12), np.float32)
    code[:, :, 3:] = np.eye(3).ravel()
    code[:, :, :2] = rng.uniform(-0.5, 0.5, (2, samples, 2))
    for i in range(samples):
        place = np.floor((code[:, i, :2] * STATE.position_scale / STATE.view + 0.5) * 16).astype(int)
        first[i, place[0, 1] - 1 : place[0, 1] + 1, place[0, 0] - 3 : place[0, 0] + 3] = 40 * i + 10
        last[i, place[1, 1] - 3 : place[1, 1] + 3, place[1, 0] - 1 : place[1, 0] + 1] = 40 * i + 10
    grey = np.full((16, 16, 3), 120, np.uint8)
    corners = np.stack(np.meshgrid([-0.03, 0.03], [-0.01, 0.01], [-0.01, 0.01]), axis=-1).reshape(-1, 3)
    support = np.tile((corners @ objects.DIRECTIONS.T).max(0), (samples, 1)).astype(np.float32)
    solid = support, np.full(samples, 0.1, np.float32), np.zeros((samples, 3), np.float32)
    state = np.asarray(statespace.encode(jnp.asarray(code[0]), *(jnp.asarray(x) for x in solid)))
    targets = {"visual": last, "tactile": last, "state": state, "pose": code[1]}
    views, ends = {}, {}
    if further:
        views = {"visual": first[:3], "state": state[:3]}
        states, poses = np.asarray(random_states(rng, 5)), np.asarray(random_codes(rng, 5))
        ends = {"state": states, "pose": poses, "outcome": np.array([0, 1, 0, 1, 1], np.int32)}
    return training.Arrays(
        {"visual": first, "pose": code[0]},
        targets | {"outcome": np.arange(samples, dtype=np.int32) % 2},
        empty={"visual": grey, "tactile": grey},
        views=views,
        falls=ends,
    )


@pytest.mark.slow
def test_a_killed_run_of_a_state_space_model_ends_with_the_same_bits(tmp_path):
    data = {"arrays": bars(further=True), "validation": bars(3)}
    whole = training.train(STATE_CONFIG, STATE, **data, workdir=tmp_path / "whole")
    with pytest.raises(Killed):
        training.train(STATE_CONFIG, STATE, **data, workdir=tmp_path / "killed", progress=kill_at(3))
    model = training.train(STATE_CONFIG, STATE, **data, workdir=tmp_path / "killed")
    same(model.state, whole.state)
    same(*(training.load(tmp_path / name / "best").state for name in ("whole", "killed")))
    log = (tmp_path / "whole" / "metrics.jsonl").read_text()
    assert (tmp_path / "killed" / "metrics.jsonl").read_text() == log
    losses = [json.loads(line)["loss"] for line in log.splitlines()]
    assert losses[-1] < losses[0]
    loaded = training.load(tmp_path / "killed")
    same(loaded.state, whole.state)
    assert (loaded.config, loaded.graphdef, loaded.step) == (STATE, whole.graphdef, 6)


@pytest.mark.slow
def test_a_state_space_model_memorises_four_samples(tmp_path):
    rate = {"learning_rate": 4e-3, "schedule": "cosine", "b2": 0.99, "clip": 200.0}
    config = training.TrainConfig(steps=800, batch_size=4, log_every=50, checkpoint_every=800, **rate)
    training.train(config, STATE, bars(), workdir=tmp_path)
    log = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    first, last = log[0], log[-1]
    assert last["visual"] < 0.2 * first["visual"]
    assert last["covered"] < 0.1 * first["covered"]
    assert last["state"] < 0.05 * first["state"]
    assert last["outcome"] < 0.75 * first["outcome"]
    assert last["pose"] < first["pose"] - 20


ONES = np.ones(4, np.float32)


@pytest.mark.parametrize(
    ("field", "change", "message"),
    [
        ("inputs", lambda x: x | {"visual": x["visual"][:, :8]}, "samples of `inputs` have the shapes"),
        ("targets", lambda x: x | {"pose": x["pose"][:, :7]}, "samples of `targets` have the shapes"),
        ("targets", lambda x: x | {"outcome": x["outcome"] + 1}, "`outcome` has the index 2, but the model has 2"),
        ("present", lambda _: {"sound": ONES > 0}, r"`present` has masks for \['sound'\]"),
        ("condition", lambda _: ONES[:, None], "`condition` has width 1, but the model has condition=0"),
        ("views", lambda x: x | {"state": x["state"][:2]}, "must have the same number of samples"),
    ],
)
def test_arrays_that_do_not_fit_are_named(field, change, message):
    data = bars(further=True)
    with pytest.raises(ValueError, match=message):
        training.learner(STATE).check(dataclasses.replace(data, **{field: change(getattr(data, field))}))


def test_an_absent_modality_is_no_input():
    training.learner(SMALL).check(arrays())
    with pytest.raises(ValueError, match=r"`inputs` have the shapes .* but the model needs \{'a'"):
        training.learner(SMALL, absent=("b",)).check(arrays())


# ---- Options and the default optimiser


def test_a_gradient_far_below_its_epsilon_moves_an_encoder_little_and_a_decoder_fully():
    config = training.TrainConfig(learning_rate=0.1, encoder_epsilon=2.0)
    adam = training.optimiser(config, 10)
    params = {"encoders": jnp.zeros(3), "decoders": jnp.zeros(3)}
    gradient = jax.tree.map(lambda x: x + 0.02, params)
    update, _ = adam.update(gradient, adam.init(params), params)
    np.testing.assert_allclose(update["decoders"], -0.1, rtol=1e-4)
    np.testing.assert_allclose(update["encoders"], -0.1 * 0.02 / 2.02, rtol=1e-4)  # lr g / (|g| + epsilon)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"log_every": 0}, "log_every must be >= 1, got 0"),
        ({"learning_rate": float("nan")}, "learning_rate must be finite, got nan"),
        ({"b2": 1.0}, r"b2 must be < 1\.0000, got 1\.0"),
        ({"log_every": 3, "checkpoint_every": 4}, r"checkpoint_every must be a multiple of log_every \(3\), got 4"),
        ({"schedule": "cosine", "warmup": 10}, r"warmup must be smaller than the number of steps \(10\)"),
    ],
)
def test_an_option_out_of_range_is_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        training.optimiser(training.TrainConfig(**fields), 10)
