"""`benchmarks.reader` on images whose truth is known."""

import jax
import numpy as np
import pytest

from benchmarks import classify, reader

pytestmark = pytest.mark.slow


def test_reader_reads_a_faint_blob_and_its_presence():
    rng = np.random.default_rng(3)
    size = rng.uniform(0, 1, 400)
    images = np.full((400, 32, 32, 3), 150.0) + rng.normal(scale=2, size=(400, 32, 32, 3))
    for image, (row, column), s in zip(images, rng.integers(2, 24, (400, 2)), size, strict=True):
        image[row : row + 6, column : column + 6] -= 40 * s
    images = images.round().astype(np.uint8)
    read = reader.fit(jax.random.key(0), images[:300], size[:400, None], steps=80)
    assert np.std(read(images[300:])[:, 0] - size[300:]) < 0.1
    tell = reader.fit(jax.random.key(0), images[:300], size[:400, None] > 0.5, steps=80)
    assert classify.auc(size[300:] > 0.5, tell(images[300:])[:, 0]) > 0.95
