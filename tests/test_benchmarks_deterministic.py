"""The deterministic network fits simple trajectories, and the items of a batch do not influence each other."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from benchmarks import deterministic
from sts_jax import training

pytestmark = pytest.mark.slow

NUMBER, SIZE = 64, 128
NETWORK, INITIAL = nnx.split(deterministic.Network(1, 12, 2, nnx.Rngs(0)))


@pytest.fixture(scope="module")
def arrays():
    """Squares whose place determines the final pose, and whose colour determines the outcome."""
    rng = np.random.default_rng(0)
    grey = np.full((SIZE, SIZE, 3), 150, np.uint8)
    first, last = np.tile(grey, (NUMBER, 1, 1, 1)), np.full((NUMBER, 64, 64, 3), 150, np.uint8)
    place, bright = rng.integers(8, 88, (NUMBER, 2)), rng.random(NUMBER) < 0.5
    for i, (row, column) in enumerate(place):
        first[i, row : row + 32, column : column + 32] = 250 if bright[i] else 20
        last[i, row // 2 : row // 2 + 16, column // 2 : column // 2 + 16] = 250 if bright[i] else 20
    code = np.concatenate([place / 50, np.zeros((NUMBER, 10))], 1).astype(np.float32)
    return training.Arrays(
        inputs={"visual": first, "pose": np.zeros((NUMBER, 12), np.float32)},
        targets={"visual": last, "tactile": last, "pose": code, "outcome": bright.astype(np.int32)},
        empty={"visual": grey, "tactile": grey},
    )


@jax.jit
def run(params, batch):
    images, numbers = deterministic.features(batch["inputs"], batch["condition"], batch["empty"])
    return nnx.merge(NETWORK, params)(images, numbers)


def test_network_learns_pose_outcome_and_images(arrays, monkeypatch):
    ticks = itertools.count()
    monkeypatch.setattr(deterministic, "BATCH", 16)
    monkeypatch.setattr(deterministic.time, "perf_counter", lambda: next(ticks))  # each step takes a second
    params, steps = deterministic.fit(arrays, NETWORK, jax.tree.map(jnp.copy, INITIAL), seconds=90, seed=0)
    assert 80 < steps < 100
    batch = arrays.take(np.arange(NUMBER))
    picture, pose, outcome = run(params, batch)
    truth = batch["targets"]
    assert np.mean(np.argmax(outcome, axis=1) == truth["outcome"]) > 0.9
    assert np.mean((pose - truth["pose"]) ** 2) < 0.3 * np.mean(np.var(truth["pose"], axis=0))
    drawn, target = jax.nn.sigmoid(picture[..., :3]), truth["visual"] / 255
    assert np.mean((drawn - target) ** 2) < 0.7 * np.mean(np.var(target, axis=0))


def test_prediction_does_not_depend_on_other_items_of_the_batch(arrays):
    index = np.arange(NUMBER)  # one shape for both tests
    some, other = run(INITIAL, arrays.take(index)), run(INITIAL, arrays.take(np.append(0, index[:0:-1])))
    for a, b in zip(some, other, strict=True):
        np.testing.assert_allclose(a[0], b[0], atol=1e-5)
        assert np.abs(np.asarray(a[1]) - np.asarray(b[1])).max() > 1e-4
