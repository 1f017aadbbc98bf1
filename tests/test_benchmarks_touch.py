"""The mass of objects on the gel can be read from their tactile images."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sts_jax as sts
from benchmarks import touch
from sts_jax import dataset, objects, physics

pytestmark = pytest.mark.slow


def test_uint8_touch_determines_the_mass_of_held_out_objects_and_rarely_saturates():
    collection = dataset.Collection(num_objects=64, num_per_object=3, seed=11)
    bodies = dataset.make_bodies(collection, np.arange(64))
    sensor = sts.Sensor()
    drops = physics.simulate(jax.random.key(5), bodies, sensor, physics.Freefall(rate=25.0, frames=36), 3)
    drops = jax.tree.map(np.asarray, drops)
    rests = (drops.outcome == physics.Outcome.RESTS) & drops.settled & drops.contact[:, -1]
    images, log_mass, owner = [], [], []
    for index, body in enumerate(bodies):
        rows = np.flatnonzero(drops.body == index)
        drawn = dataset.render_uint8(
            sensor, body, drops.pose[rows, -1], drops.wrench[rows, -1], resolution=(64, 64), crop=False
        )
        mass, _, _ = jax.vmap(objects.rigid, (None, 0, 0))(
            body, jnp.asarray(drops.hidden.fill[rows]), jnp.asarray(drops.hidden.shell_scale[rows])
        )
        keep = rests[rows]
        images.append(np.asarray(drawn[1])[keep])
        log_mass.append(np.log(np.asarray(mass))[keep])
        owner += [index] * int(keep.sum())
    tactile, y, held_out = np.concatenate(images), np.concatenate(log_mass), np.array(owner) >= 48
    gone = jnp.array([[0.0, 0, -1, 1, 0, 0, 0]])
    blank = np.asarray(
        dataset.render_uint8(sensor, bodies[0], gone, jnp.zeros((1, 6)), resolution=(64, 64), crop=False)[1]
    )[0]
    assert held_out.sum() > 30
    x = touch.features(tactile, blank)
    predicted = touch.ridge(x[~held_out], y[~held_out], x[held_out])
    assert 1 - np.mean((predicted - y[held_out]) ** 2) / y[held_out].var() > 0.8
    # Images of other objects do not predict the mass.
    shuffled = np.random.default_rng(0).permutation(x[held_out])
    predicted = touch.ridge(x[~held_out], y[~held_out], shuffled)
    assert 1 - np.mean((predicted - y[held_out]) ** 2) / y[held_out].var() < 0.3
    assert touch.saturated(tactile, blank).mean() < 0.05
