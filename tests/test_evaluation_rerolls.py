"""Re-rolls begin at the given starts, and their ends are samples of the prediction. The engine is replaced."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_evaluation_results import pairs

import sts_jax as sts
from sts_jax import dataset, evaluation, physics
from sts_jax.evaluation import references
from sts_jax.physics.arguments import check_start

TIMES, SIDE = 3, 4
COLLECTION = dataset.Collection(physics.Freefall(), num_objects=2, num_per_object=2, resolution=(2 * SIDE, 2 * SIDE))
OFF_FIRST = np.array([0.0, 1.0, -1.0])  # m, added to z in the re-rolls of an item


def starts():
    """Two starts of object 1, then one of object 0."""
    test = pairs([0, 0, 0], np.zeros((3, 0)))
    rng = np.random.default_rng(0)
    test.pose[:, 0, :3] = rng.uniform(0, 0.05, (3, 3))
    quat = rng.normal(size=(3, 4))
    test.pose[:, 0, 3:] = quat / np.linalg.norm(quat, axis=1, keepdims=True)
    return test._replace(object=np.array([1, 1, 0]))


@pytest.fixture
def engine(monkeypatch):
    """Replace the simulation by ends above or below the starts that `simulate` receives.

    The grey value of a picture depends on the object and on z. Pictures are twice as large as those of the items.
    """
    seen = {}

    def simulate(key, bodies, sensor, scenario, num, *, start, engine, progress):
        which, nth = np.repeat(np.arange(len(bodies)), num), np.tile(np.arange(num), len(bodies))
        start = check_start(start, scenario, len(which))
        seen.update(bodies=bodies, start=start)
        pose = jnp.stack([start.pose, start.pose + jnp.zeros(7).at[2].set(1) * OFF_FIRST[nth][:, None]], 1)
        nothing = jnp.zeros((len(which), 2, 6))
        rest = dict.fromkeys(physics.Trajectory._fields)
        outcome = jax.vmap(scenario.outcome)(pose[:, 0], pose[:, 1])
        return physics.Trajectory(**{**rest, "pose": pose, "wrench": nothing, "outcome": outcome})

    def render(sensor, body, pose, wrench, *, resolution, crop):
        grey = jnp.round(100 + 50 * pose[:, 2] + 10 * (body.shell_mass == seen["bodies"][0].shell_mass))
        image = jnp.broadcast_to(grey[:, None, None, None], (len(pose), *resolution, 3)).astype(jnp.uint8)
        return image, image, image[..., 0] > 0

    monkeypatch.setattr(references.physics, "simulate", simulate)
    monkeypatch.setattr(references.dataset, "render_uint8", render)
    return seen


def test_every_reroll_begins_at_the_start_of_its_item_and_its_end_is_a_sample(engine):
    test = starts()
    found = evaluation.ceiling(COLLECTION, sts.Sensor(), test, TIMES, jax.random.key(0))
    assert found.samples.pose.shape == (TIMES, 3, 7)
    for number, off in enumerate(OFF_FIRST):
        expected = test.pose[:, 0].copy()
        expected[:, 2] += off
        np.testing.assert_allclose(found.samples.pose[number], expected, atol=1e-6)
    np.testing.assert_allclose(found.pose[:, :3], test.pose[:, 0, :3], atol=1e-4)  # the median of -1, 0 and 1 m
    assert (np.asarray(engine["start"].held) == COLLECTION.scenario.steps).all()  # released at rest in frame 0
    assert not np.asarray(engine["start"].carried).any()
    # Each item is drawn with its own object: the first body of the engine is object 1.
    assert found.samples.tactile.shape == (TIMES, 3, SIDE, SIDE, 3)
    ends = 100 + 50 * found.samples.pose[..., 2]
    np.testing.assert_allclose(found.samples.visual[..., 0, 0, 0], ends + np.array([10, 10, 0]), atol=0.51)
    np.testing.assert_allclose(found.visual, found.samples.visual.mean(0) / 255, rtol=1e-6)
    # Two of three stay, and one falls off. One more re-roll is spread evenly.
    rests = [outcome == physics.Outcome.RESTS for outcome in COLLECTION.scenario.outcomes]
    np.testing.assert_allclose(found.outcome_probability[:, rests.index(True)], 2.5 / 4)
    assert found.outcome.tolist() == [physics.Outcome.RESTS] * 3


def test_at_least_one_reroll_is_required():
    with pytest.raises(ValueError, match="times must be >= 1, got 0"):
        evaluation.ceiling(COLLECTION, sts.Sensor(), starts(), 0, jax.random.key(0))
