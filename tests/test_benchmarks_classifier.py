"""The statistics of `benchmarks.instruments.classifier` against known truths."""

import math

import numpy as np
import pytest

from benchmarks.instruments import classifier
from sts_jax.evaluation import metrics

pytestmark = pytest.mark.slow


def test_gain_of_a_known_channel_and_folds_by_object():
    # The label is 1 if the seen and the felt bit differ, flipped in a tenth of the rows. One bit alone is useless.
    rng = np.random.default_rng(0)
    body = np.repeat(np.arange(60), 40)
    seen, felt = rng.integers(0, 2, (2, len(body)))
    label = (seen ^ felt) ^ (rng.uniform(size=len(body)) < 0.1)
    identity = rng.permutation(60)[body]  # identifies the object
    before = metrics.log_loss(classifier.probabilities(np.stack([seen, identity], 1), label, body), label)
    after = metrics.log_loss(classifier.probabilities(np.stack([seen, identity, felt], 1), label, body), label)
    entropy = -0.1 * math.log(0.1) - 0.9 * math.log(0.9)
    assert before.mean() == pytest.approx(math.log(2), abs=0.02)
    assert after.mean() == pytest.approx(entropy, abs=0.03)
    gain = classifier.interval(classifier.gain, before, after, groups=body)
    assert gain.low < 1 - entropy / math.log(2) < gain.high
    assert gain.high - gain.low < 0.1
    weight = np.ones(len(body))
    assert classifier.kept(before, after, before, weight) == pytest.approx(0, abs=1e-6)
    assert classifier.kept(before, after, after, weight) == pytest.approx(1)

    # The identity determines a coin that is thrown once for each object, but only for objects of the training folds.
    coin = rng.integers(0, 2, 60)[body]
    assert metrics.log_loss(classifier.probabilities(identity[:, None], coin, body), coin).mean() > 0.6


def test_interval_has_the_width_of_the_variation_between_objects():
    rng = np.random.default_rng(1)
    body = np.repeat(np.arange(100), 50)
    values = rng.normal(size=100)[body]
    figure = classifier.interval(classifier.mean, values, groups=body)
    assert figure.high - figure.low == pytest.approx(2 * 1.96 * values.std() / 10, rel=0.1)
