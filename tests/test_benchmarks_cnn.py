"""The small network on images with a known truth."""

import jax
import numpy as np
import pytest

from benchmarks.instruments import cnn
from sts_jax.evaluation import metrics

pytestmark = pytest.mark.slow


def test_network_predicts_the_strength_and_the_presence_of_a_faint_blob():
    rng = np.random.default_rng(3)
    size = rng.uniform(0, 1, 400)
    images = np.full((400, 32, 32, 3), 150.0) + rng.normal(scale=2, size=(400, 32, 32, 3))
    for image, (row, column), s in zip(images, rng.integers(2, 24, (400, 2)), size, strict=True):
        image[row : row + 6, column : column + 6] -= 40 * s
    images = images.round().astype(np.uint8)
    strength = cnn.fit(jax.random.key(0), images[:300], size[:400, None], steps=80)
    assert np.std(strength(images[300:])[:, 0] - size[300:]) < 0.1
    presence = cnn.fit(jax.random.key(0), images[:300], size[:400, None] > 0.5, steps=80)
    assert metrics.auc(size[300:] > 0.5, presence(images[300:])[:, 0]) > 0.95
