"""The deterministic network learns what a first moment shows, and sees nothing of the end."""

import jax
import numpy as np
import pytest
from flax import nnx

from benchmarks import deterministic
from sts_jax import training

pytestmark = pytest.mark.slow

NUMBER, SIZE = 64, 128


@pytest.fixture(scope="module")
def arrays():
    """Squares of some colour and place; the final pose is a function of the place, the outcome one of the colour."""
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


def test_it_learns_the_pose_the_outcome_and_the_pictures(arrays):
    network, params = nnx.split(deterministic.Network(1, 12, 2, nnx.Rngs(0)))
    batch = arrays.take(np.arange(NUMBER))
    before = deterministic.loss(network, params, batch)
    params, steps = deterministic.fit(arrays, network, params, seconds=20.0, seed=0)
    assert steps > 1
    floor = deterministic.loss(network, params, batch | {"targets": {k: x[::-1] for k, x in batch["targets"].items()}})
    after = deterministic.loss(network, params, batch)
    assert after < before
    assert after < 0.8 * floor  # the ends of other items are predicted worse


def test_one_item_does_not_depend_on_its_neighbours(arrays):
    network, params = nnx.split(deterministic.Network(1, 12, 2, nnx.Rngs(0)))

    @jax.jit
    def run(batch):
        images, numbers = deterministic.features(batch["inputs"], batch["condition"], batch["empty"])
        return nnx.merge(network, params)(images, numbers)

    some, other = run(arrays.take(np.array([0, 1]))), run(arrays.take(np.array([0, 2])))
    for a, b in zip(some, other, strict=True):
        np.testing.assert_allclose(a[0], b[0], atol=1e-5)
        assert np.abs(np.asarray(a[1]) - np.asarray(b[1])).max() > 1e-4
