"""The ceiling: the best possible prediction of a last frame from the first pose.

The ceiling is computed from re-rolls. A re-roll is another simulation of a trajectory, with the same first pose and the
same condition (an input of some scenarios, such as an acceleration of the pad), but with newly drawn hidden values.
Hidden values are properties that a camera cannot see, such as the fill level and the friction.
"""

import concurrent.futures
import os
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from sts_jax import dataset, physics
from sts_jax.evaluation import metrics
from sts_jax.evaluation.outcomes import shares
from sts_jax.evaluation.predictions import Predicted
from sts_jax.sensor import Sensor


def ceiling(
    collection: dataset.Collection,
    sensor: Sensor,
    test: dataset.Pairs,
    times: int,
    key: PRNGKeyArray,
    *,
    progress: Callable[[int], object] | None = None,
) -> Predicted:
    """Compute the best possible prediction from the first pose and the condition, by repeated simulation.

    Each item (held-out trajectory) is simulated again `times` times. These simulations are the re-rolls. The object is
    released at rest in its first pose, with the same condition (an input of some scenarios, such as an acceleration of
    the pad). Each re-roll draws new values of the properties that a camera cannot see, such as fill level and friction.

    The re-rolls and the true trajectory are draws from the same distribution. The prediction is therefore calibrated.
    With infinitely many re-rolls, the prediction has the best expected log loss of the outcome and the best expected
    cross-entropy of the images among all predictions from the shape, the pose and the condition.

    The tactile image of the first frame reveals a part of the properties that a camera cannot see. A model that uses
    this image can therefore exceed the ceiling.

    Args:
        collection: The description of the dataset that contains the items.
        sensor: The sensor that renders the last frames.
        test: The items. The predicted images have the resolution of the items' images.
        times: Number of re-rolls per item, >= 1.
        key: The random key of the re-rolls.
        progress: Function that is called with the number of re-rolls simulated so far, over all items.

    Returns:
        A prediction with the re-rolls as samples (images in `uint8`). The predicted images are the means of the
        samples' images. The predicted pose is the central pose of the samples (`metrics.centre`). For a scenario with c
        outcomes, the probability of an outcome is `(count + 1 / c) / (times + 1)`, where `count` is the number of the
        item's re-rolls with this outcome.

    Raises:
        ValueError: `times` is below 1.
    """
    if times < 1:
        raise ValueError(f"times must be >= 1, got {times}")
    scenario = collection.scenario
    owners, place = np.unique(test.object, return_inverse=True)
    bodies = dataset.make_bodies(collection, owners)
    start = physics.Start(
        pose=jnp.asarray(np.repeat(test.pose[:, 0], times, axis=0)),
        held=jnp.asarray(scenario.steps),
        condition=jnp.asarray(np.repeat(test.condition, times, axis=0)),
    )
    traj = physics.simulate(
        key,
        [bodies[i] for i in place],
        sensor,
        scenario,
        times,
        start=start,
        engine=collection.engine,
        progress=progress or False,
    )
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


def _drawn(
    collection: dataset.Collection,
    sensor: Sensor,
    bodies: list,
    owner: np.ndarray,
    pose: np.ndarray,
    wrench: np.ndarray,
    size: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Render both streams of all last frames (`uint8`), object by object, with one thread per CPU core.

    The images have the resolution of the collection. They are reduced to `size` if its height is not `size`.
    """
    same, batch = size == collection.resolution[0], dataset.frames_per_call()
    jobs = [
        np.flatnonzero(owner == index)[start : start + batch]
        for index in range(len(bodies))
        for start in range(0, int((owner == index).sum()), batch)
    ]

    def work(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        padded = np.pad(rows, (0, batch - len(rows)), "edge")
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
