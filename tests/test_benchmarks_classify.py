"""The statistics of `benchmarks.classify` against known truths."""

import math

import numpy as np
import pytest

from benchmarks import classify

pytestmark = pytest.mark.slow


def test_gain_is_that_of_a_known_channel_and_folds_do_not_part_objects():
    # The outcome is whether what is seen and what is felt agree, except one time in ten: sight alone knows nothing.
    rng = np.random.default_rng(0)
    body = np.repeat(np.arange(60), 40)
    seen, felt = rng.integers(0, 2, (2, len(body)))
    label = (seen ^ felt) ^ (rng.uniform(size=len(body)) < 0.1)
    named = rng.permutation(60)[body]  # tells the object
    before = classify.log_loss(classify.chances(np.stack([seen, named], 1), label, body), label)
    after = classify.log_loss(classify.chances(np.stack([seen, named, felt], 1), label, body), label)
    entropy = -0.1 * math.log(0.1) - 0.9 * math.log(0.9)
    assert before.mean() == pytest.approx(math.log(2), abs=0.02)
    assert after.mean() == pytest.approx(entropy, abs=0.03)
    gain = classify.interval(classify.gain, before, after, groups=body)
    assert gain.low < 1 - entropy / math.log(2) < gain.high
    assert gain.high - gain.low < 0.1
    assert classify.kept(before, after, before) == pytest.approx(0, abs=1e-6)
    assert classify.kept(before, after, after) == pytest.approx(1)

    # A coin thrown once for each object is known by name to whoever has seen the object.
    coin = rng.integers(0, 2, 60)[body]
    assert classify.log_loss(classify.chances(named[:, None], coin, body), coin).mean() > 0.6


def test_interval_is_as_wide_as_differing_objects_make_it():
    rng = np.random.default_rng(1)
    body = np.repeat(np.arange(100), 50)
    values = rng.normal(size=100)[body]
    figure = classify.interval(np.mean, values, groups=body)
    assert figure.high - figure.low == pytest.approx(2 * 1.96 * values.std() / 10, rel=0.1)


def test_auc_of_two_shifted_normals_and_of_ties():
    rng = np.random.default_rng(2)
    label = rng.uniform(size=20000) < 0.3
    assert classify.auc(label, rng.normal(size=20000) + label) == pytest.approx(0.7602, abs=0.01)  # Phi(1 / sqrt(2))
    assert classify.auc(label, np.zeros(20000)) == 0.5
    assert classify.auc(label, label.astype(float)) == 1
