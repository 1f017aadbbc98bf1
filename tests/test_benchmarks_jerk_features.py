"""Features of a jerked bottle: invariance under the symmetries of the pad, and toppling at g b / h."""

import math

import jax
import numpy as np
import pytest

from benchmarks.instruments import jerk_features
from benchmarks.instruments.starts import Starts
from sts_jax import objects, physics
from sts_jax.physics.scenario import G

pytestmark = pytest.mark.slow


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
