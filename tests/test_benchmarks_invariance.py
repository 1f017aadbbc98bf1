"""Outcomes of the jerked pad, MJX against C MuJoCo: 300 runs a side, 15 points. `benchmarks.invariance` does 4,000."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import invariance
from sts_jax import physics

NUM = 300


def test_outcomes_of_shakes_are_c_mujoco_s() -> None:
    case = invariance.cases()[2]
    case = case._replace(scenario=dataclasses.replace(case.scenario, frames=20))
    ours = invariance.roll(case, NUM)
    first = ours.pose[:, 0]
    found = {
        "ours": invariance.named(case, first, ours.pose[:, -1]),
        "C MuJoCo": invariance.named(case, first, invariance.last_in_c(case, ours)),
        "C, every vertex": invariance.named(case, first, invariance.last_in_c(case, ours, every_vertex=True)),
    }
    assert len(first) == NUM
    assert min(np.mean(found["ours"] == o) for o in (physics.Outcome.STANDS, physics.Outcome.TOPPLES)) > 0.1
    assert invariance.compare(found, case.labels, margin=0.15)
    # With the same contacts it is the same engine: what differs are the four contacts that C keeps of a mesh.
    assert np.mean(found["ours"] == found["C, every vertex"]) >= 0.95


def test_a_mirrored_start_is_the_mirror_image() -> None:
    case = invariance.cases()[2]
    points = np.float32([[0.01, 0.02, -0.03], [0, -0.04, 0.05]])
    shape = physics.scenarios.Shape(points, np.eye(3), np.ones(3) / 3, np.float32([[0, 0.01, 0]]))
    key, pad = jax.random.key(3), (0.15, 0.15)
    seen = case.scenario.start(key, shape, pad)
    mirrored = case.mirrored.start(key, invariance.mirror_shape(shape), pad)
    np.testing.assert_allclose(mirrored.pose[:3], seen.pose[:3] * jnp.array([1, -1, 1]), atol=1e-7)
    np.testing.assert_allclose(mirrored.condition, seen.condition * jnp.array([1, -1, 1]), atol=1e-6)


def test_the_interval_of_a_paired_difference() -> None:
    a = np.zeros(4000, bool)
    b = a.copy()
    b[:400] = True
    middle, half = invariance.difference(a, b)
    np.testing.assert_allclose([middle, half], [0.1, 1.96 * np.sqrt(0.1 * 0.9 / 4000)], rtol=0.01)
    assert invariance.difference(a, a)[1] > 0
