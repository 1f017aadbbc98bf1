"""The best possible prediction, from repeated simulations of a start with other hidden values."""

import concurrent.futures
import os
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from sts_jax import dataset, physics
from sts_jax.evaluation import metrics
from sts_jax.evaluation.outcomes import shares
from sts_jax.evaluation.predictions import Predicted
from sts_jax.physics.scenario import Shape, Start
from sts_jax.physics.simulation import ATTEMPTS
from sts_jax.sensor import Sensor

RENDER_BATCH = 32  # frames rendered by one compiled call
_SAME = 1e-4  # largest difference of a first pose from the given start (m, or entries of a quaternion)


def ceiling(
    collection: dataset.Collection,
    sensor: Sensor,
    test: dataset.Pairs,
    times: int,
    key: PRNGKeyArray,
    *,
    progress: Callable[[int], object] | None = None,
) -> Predicted:
    """The best prediction from a first pose and condition alone: ends with newly drawn hidden values.

    Each item's object is released at rest from its first pose, `times` times. The true end is another such draw, so
    that this distribution is calibrated, and no predictor from shape, pose and condition has a better expected log loss
    or excess than infinitely many re-rolls. Touch in the first moment reveals a part of the hidden values, so that a
    model that uses it can exceed this ceiling.

    Args:
        collection: The collection of the items.
        sensor: The sensor that renders the ends.
        test: The items. Ends are rendered as in the collection, at the resolution of the items.
        times: Number of re-rolls per item.
        key: The random key of the re-rolls.
        progress: Called with the number of simulated re-rolls.

    Returns:
        Means over the re-rolls, `metrics.centre` of their poses, and the re-rolls as samples (images in `uint8`). The
        outcome probabilities are their `shares`.

    Raises:
        ValueError: `times` is below 1.
        RuntimeError: A re-roll did not begin at its item's first pose.
    """
    if times < 1:
        raise ValueError(f"times must be >= 1, got {times}")
    scenario = collection.scenario
    owners, place = np.unique(test.object, return_inverse=True)
    bodies = dataset.make_bodies(collection, owners)
    again = _replayed(scenario, test.pose[:, 0], test.condition, times, key)
    traj = physics.simulate(
        key, [bodies[i] for i in place], sensor, again, times, engine=collection.engine, progress=progress or False
    )
    first = np.asarray(traj.pose[:, 0]).reshape(len(test.object), times, 7)
    off = np.abs(first - test.pose[:, :1]).max()
    if not off <= _SAME:
        raise RuntimeError(f"a re-roll began {off:.3g} from its item's first pose: simulate changed its keys")
    pose, wrench = (np.asarray(leaf[:, -1]) for leaf in (traj.pose, traj.wrench))
    drawn = _drawn(collection, sensor, bodies, np.repeat(place, times), pose, wrench, test.visual.shape[2])

    def samples(leaf: np.ndarray) -> np.ndarray:
        return np.moveaxis(leaf.reshape(len(test.object), times, *leaf.shape[1:]), 1, 0)

    visual, tactile, pose, outcome = (samples(leaf) for leaf in (*drawn, pose, np.asarray(traj.outcome)))
    probability = shares(outcome, scenario.outcomes)
    return Predicted(
        visual=visual.mean(0, dtype=np.float32) / 255,
        tactile=tactile.mean(0, dtype=np.float32) / 255,
        pose=metrics.centre(pose),
        outcome=np.array([int(each) for each in scenario.outcomes])[probability.argmax(1)],
        samples=Predicted(visual, tactile, pose, outcome),
        outcome_probability=probability,
    )


def _replayed(
    scenario: physics.Scenario, pose: np.ndarray, condition: np.ndarray, times: int, key: PRNGKeyArray
) -> Any:
    """The scenario with given starts: every trajectory of body i begins at rest at `pose[i]`.

    `simulate` does not accept starts but draws them from keys. The scenario therefore finds the index of the body by
    comparing its key with the keys of all bodies.
    """

    @jax.jit
    @jax.vmap
    def key_of(body: Array, draw: Array, attempt: Array) -> Array:
        own = jax.random.fold_in(jax.random.fold_in(jax.random.fold_in(key, body), draw), attempt)
        return jax.random.key_data(jax.random.split(own)[0])

    index = np.indices((len(pose), times, ATTEMPTS)).reshape(3, -1)
    known, body = np.asarray(key_of(*index)), index[0]

    class Replayed(type(scenario)):  # type: ignore[misc]  # any of the scenarios
        """A scenario whose starts are given instead of drawn."""

        def start(self, key: PRNGKeyArray, shape: Shape, pad: tuple[float, float]) -> Start:
            """The start of the body with this key, not finite if there is none."""
            del shape, pad
            same = (jnp.asarray(known) == jax.random.key_data(key)).all(-1)
            mine = jnp.asarray(body)[jnp.argmax(same)]
            begin: Float[Array, "7"] = jnp.where(same.any(), jnp.asarray(pose)[mine], jnp.nan)
            return Start(begin, jnp.asarray(self.steps), jnp.asarray(condition)[mine])

    return Replayed(**vars(scenario))


def _drawn(
    collection: dataset.Collection,
    sensor: Sensor,
    bodies: list,
    owner: np.ndarray,
    pose: np.ndarray,
    wrench: np.ndarray,
    size: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Render both streams of all ends (`uint8`), object by object, in calls of equal size and one thread per core.

    The images have the resolution of the collection, or are reduced to `size` if that is not its height.
    """
    same = size == collection.resolution[0]
    jobs = [
        np.flatnonzero(owner == index)[start : start + RENDER_BATCH]
        for index in range(len(bodies))
        for start in range(0, int((owner == index).sum()), RENDER_BATCH)
    ]

    def work(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        padded = np.pad(rows, (0, RENDER_BATCH - len(rows)), "edge")
        images = dataset.render_uint8(
            sensor,
            bodies[owner[rows[0]]],
            pose[padded],
            wrench[padded],
            resolution=collection.resolution,
            crop=collection.crop,
        )
        drawn = {
            name: np.asarray(image)[: len(rows)] for name, image in zip(("visual", "tactile"), images, strict=False)
        }
        drawn = drawn if same else dataset.reduced_images(drawn, size)
        return drawn["visual"], drawn["tactile"]

    shape = collection.resolution if same else (size, size)
    out = tuple(np.empty((len(owner), *shape, 3), np.uint8) for _ in range(2))
    with concurrent.futures.ThreadPoolExecutor(os.cpu_count()) as pool:
        for rows, images in zip(jobs, pool.map(work, jobs), strict=True):
            for whole, part in zip(out, images, strict=True):
                whole[rows] = part
    return out[0], out[1]
