"""The classifier, the network and the features of `benchmarks.hidden`, compared with known truths."""

import math

import jax
import numpy as np
import pytest

from benchmarks.instruments import classifier, cnn, jerk_features, slope_features
from benchmarks.instruments.starts import Starts
from sts_jax import objects, physics
from sts_jax.evaluation import metrics
from sts_jax.physics.scenario import G

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

    # The identity determines a coin that is thrown once for each object, but only for objects of the training folds.
    coin = rng.integers(0, 2, 60)[body]
    assert metrics.log_loss(classifier.probabilities(identity[:, None], coin, body), coin).mean() > 0.6


def test_interval_has_the_width_of_the_variation_between_objects():
    rng = np.random.default_rng(1)
    body = np.repeat(np.arange(100), 50)
    values = rng.normal(size=100)[body]
    figure = classifier.interval(classifier.mean, values, groups=body)
    assert figure.high - figure.low == pytest.approx(2 * 1.96 * values.std() / 10, rel=0.1)


def test_network_predicts_the_strength_of_a_faint_blob():
    rng = np.random.default_rng(3)
    size = rng.uniform(0, 1, 400)
    images = np.full((400, 32, 32, 3), 150.0) + rng.normal(scale=2, size=(400, 32, 32, 3))
    for image, (row, column), s in zip(images, rng.integers(2, 24, (400, 2)), size, strict=True):
        image[row : row + 6, column : column + 6] -= 40 * s
    images = images.round().astype(np.uint8)
    strength = cnn.fit(jax.random.key(0), images[:300], size[:400, None], steps=80)
    assert np.std(strength(images[300:])[:, 0] - size[300:]) < 0.1


def test_features_are_invariant_under_the_symmetries_of_the_pad():
    body = objects.make(jax.random.key(4), "bottle")
    seen = jerk_features.sight([body])
    place, pad = np.array([0.004, -0.013]), np.array([-3.0, 5.0])
    turns = [np.array([[0.0, -1], [1, 0]]), np.diag([1.0, -1]), np.array([[0.0, 1], [1, 0]]), np.eye(2)]
    pose = np.stack([np.append(turn @ place, [0.05, 1, 0, 0, 0]) for turn in turns])
    condition = np.stack([np.append(turn @ pad, 0.1) for turn in turns])
    blank = np.zeros(4)
    starts = Starts(np.zeros(4, int), pose, np.zeros((4, 6)), condition, *[blank] * 5)
    mass, com, _ = objects.rigid(body, 0.5, 1.0)
    rows = jerk_features.shaken(physics.Perturbed(), [body], starts, np.full((4, 1), math.log(float(mass))))
    np.testing.assert_allclose(rows, rows[[0, 0, 0, 0]], rtol=1e-6)
    # In each case the push is 5 m/s^2 along one axis and 3 m/s^2 along the other.
    assert jerk_features.canonical(pose, condition)[1] == pytest.approx(np.array([[5.0, 3.0]] * 4))
    # The weight of a half full bottle determines the height of its centre of mass.
    half = float(com[2]) - seen.low[0]
    assert rows[0, -3] == pytest.approx(half, rel=1e-3)


def test_tipping_begins_at_g_b_over_h():
    rigid = np.tile([[0.1, 0.05, 1e-4]], (2, 1))
    at = G * 0.01 / 0.05
    ratio, energy = jerk_features.tipping(rigid, np.full(2, 0.01), np.array([0.99, 2.5]) * at, np.full(2, 0.1), 0.55).T
    assert ratio == pytest.approx([0.99, 2.5])
    assert energy[0] == pytest.approx(math.log(1e-3))
    assert energy[1] > 0  # more energy than toppling needs


def test_balance_of_a_block_on_the_slope():
    # A support of 20 x 40 mm. The centre of mass is 10 mm high, then at the limit of tipping, then beside the support.
    corners = np.array([[-0.01, -0.02], [0.01, -0.02], [0.01, 0.02], [-0.01, 0.02]])
    angle = math.radians(30)
    high = 0.02 / math.tan(angle)
    centre = np.array([[0, 0, 0.01], [0, 0, 0.01], [0, 0, 1.01 * high], [0, 0, 0.99 * high], [0.011, 0, 0.01]])
    end, pressure = slope_features.balance(corners, centre, np.array([0.7, 0.5, 0.7, 0.7, 0.7]), angle)
    assert end.tolist() == [2, 1, 0, 2, 0]
    ahead = 0.01 * math.tan(angle)
    expected = [[0, ahead], [0, 0.005], [0, 0.02], [0, 0.99 * 0.02], [0.01, ahead]]
    np.testing.assert_allclose(pressure, expected, atol=1e-9)
