"""Predictions without a trained model: the baselines, and the ceiling from re-rolls."""

import concurrent.futures
from collections.abc import Callable
from typing import Protocol, runtime_checkable

import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from sts_jax import dataset, physics
from sts_jax._checked import in_32_bits
from sts_jax._devices import cores
from sts_jax.dataset import Pairs
from sts_jax.evaluation import metrics
from sts_jax.evaluation.predictions import Predicted, in_unit, outcome_of_pose, shares
from sts_jax.sensor import Sensor

CONSTANT, COPY, NEIGHBOUR = "constant (mean training target)", "copy of the input", "nearest neighbour"
BELOW = "rests below its start"
BASELINES = (CONSTANT, COPY, NEIGHBOUR, BELOW)
CEILING, ONE_REROLL = "ceiling (mean of re-rolls)", "one re-roll"
CEILINGS = (CEILING, ONE_REROLL)


@runtime_checkable
class Streams(Protocol):
    """First and last images of n trajectories, such as `hardware.RecordedImages` and `dataset.Pairs`."""

    @property
    def visual(self) -> np.ndarray:
        """Images of the visual stream, uint8 `(n, 2, height, width, 3)`."""

    @property
    def tactile(self) -> np.ndarray:
        """Images of the tactile stream, uint8 `(n, 2, height, width, 3)`."""


def image_baselines(train: Streams, test: Streams) -> dict[str, Predicted]:
    """Predict the last images like the first three of `baselines`, without a condition."""
    return _images(train, test, _distance(train, test).argmin(1))


@in_32_bits
def baselines(scenario: physics.Scenario, train: Pairs, test: Pairs) -> dict[str, Predicted]:
    """Predict the last frame without a trained model, in four ways.

    - The constant is the mean last frame of the training trajectories, with their most frequent outcome and the
      frequencies of their outcomes.
    - The copy predicts that the last frame equals the first one.
    - The nearest neighbour is the last frame of the most similar training trajectory, by the squared distance between
      the first visual images. With a condition, this distance is divided by the mean squared distance of the images
      from their mean, and the mean of the squared differences of the condition, divided by their variances, is added.
    - The rule "rests below its start" keeps x, y and the orientation of the first pose. The height is the median of the
      training objects that stay on the pad. The rule predicts no images.

    The first three also predict the measurements, with the mean of the measured values where a value was not measured.

    Returns:
        The predictions for `test` by name, one of `BASELINES`.
    """
    distance = _distance(train, test)
    width = train.condition.shape[1]
    if width:
        inputs = _flat(train)
        variance = float(((inputs - inputs.mean(0)) ** 2).sum(1).mean())
        gap = test.condition[:, None] - train.condition[None]
        spread = train.condition.var(0)
        spread = np.where(spread > 0, spread, 1.0)  # a constant number of the condition does not distinguish items
        distance = distance / variance + (gap**2 / spread).sum(-1) / width
    nearest = distance.argmin(1)
    num = len(test.visual)

    def repeat(mean: np.ndarray) -> np.ndarray:
        return np.broadcast_to(mean, (num, *mean.shape))

    mean_pose = train.pose[:, 1].mean(0)
    mean_pose[3:] /= max(np.linalg.norm(mean_pose[3:]), 1e-6)
    majority = np.bincount(train.outcome).argmax()
    frequency = np.array([np.mean(train.outcome == outcome) for outcome in scenario.outcomes])
    rests = train.outcome != int(physics.Outcome.FELL_OFF)
    below = test.pose[:, 0].copy()
    below[:, 2] = np.median(train.pose[rests if rests.any() else slice(None), 1, 2])
    further = {name: in_unit(x[:, 1]) for name, x in train.measurements.items() if name in test.measurements}
    means = {name: _mean(last) for name, last in further.items()}

    def filled(name: str, values: np.ndarray) -> np.ndarray:
        return np.where(np.isnan(values), means[name], values)

    images = _images(train, test, nearest)
    return {
        CONSTANT: images[CONSTANT]._replace(
            pose=repeat(mean_pose),
            outcome=np.full(num, majority),
            outcome_probability=repeat(frequency),
            measurements={name: repeat(mean) for name, mean in means.items()} or None,
        ),
        COPY: images[COPY]._replace(
            pose=test.pose[:, 0],
            outcome=outcome_of_pose(scenario, test.pose[:, 0], test.pose[:, 0]),
            measurements={name: filled(name, in_unit(test.measurements[name][:, 0])) for name in further} or None,
        ),
        NEIGHBOUR: images[NEIGHBOUR]._replace(
            pose=train.pose[nearest, 1],
            outcome=train.outcome[nearest],
            measurements={name: filled(name, last[nearest]) for name, last in further.items()} or None,
        ),
        BELOW: Predicted(pose=below, outcome=outcome_of_pose(scenario, test.pose[:, 0], below)),
    }


def _flat(streams: Streams) -> np.ndarray:
    """First visual images as vectors."""
    return streams.visual[:, 0].reshape(len(streams.visual), -1).astype(np.float32)


def _distance(train: Streams, test: Streams) -> np.ndarray:
    """Squared distances of first visual images, `(test, train)`, up to a constant for each test image."""
    inputs = _flat(train)
    return (inputs**2).sum(1) - 2 * _flat(test) @ inputs.T


def _images(train: Streams, test: Streams, nearest: np.ndarray) -> dict[str, Predicted]:
    """The images of three baselines: the constant, the copy, and those of the nearest neighbours."""

    def mean(stream: np.ndarray) -> np.ndarray:
        return np.broadcast_to(stream[:, 1].mean(0) / 255, (len(test.visual), *stream.shape[2:]))

    return {
        CONSTANT: Predicted(mean(train.visual), mean(train.tactile)),
        COPY: Predicted(test.visual[:, 0] / 255, test.tactile[:, 0] / 255),
        NEIGHBOUR: Predicted(train.visual[nearest, 1] / 255, train.tactile[nearest, 1] / 255),
    }


def _mean(values: np.ndarray) -> np.ndarray:
    """The mean over the items that were measured, or NaN if no item was measured."""
    measured = values[~np.isnan(values).reshape(len(values), -1).any(1)]
    return measured.mean(0) if len(measured) else np.full(values.shape[1:], np.nan)


@in_32_bits
def ceiling(
    collection: dataset.Collection,
    sensor: Sensor,
    test: Pairs,
    times: int,
    key: PRNGKeyArray,
    *,
    progress: Callable[[int], object] | None = None,
) -> Predicted:
    """Compute the best possible prediction from the first pose and the condition, by re-rolls of each item.

    It is that of the second frames of `test`. The outcomes are those of whole trajectories.

    The re-rolls and the true trajectory are draws from the same distribution, so the prediction is calibrated. With
    infinitely many re-rolls, it has the best expected log loss of the outcome and the best expected cross-entropy of
    the images among all predictions from the shape, the pose and the condition. A model that uses the first tactile
    image can exceed the ceiling, because touch reveals a part of the hidden properties.

    Args:
        times: Number of re-rolls per item, >= 1.
        progress: Called with the number of re-rolls simulated so far, over all items.

    Returns:
        A prediction with the re-rolls as samples (images in `uint8`, of the resolution of `test`). The images are the
        means of the samples' images, the pose is their central pose (`metrics.centre`), and the outcome probabilities
        are their `shares`.
    """
    if times < 1:
        raise ValueError(f"times must be >= 1, got {times}")
    if test.frame is not None and test.frame[:, 0].any():
        raise ValueError(
            f"`test` has pairs that begin at frame {test.frame[:, 0].max()}, but a re-roll begins at rest in frame 0: "
            "make it with Dataset.pairs(..., frames=(0, t))"
        )
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
    frame = np.full(len(place), -1) if test.frame is None else test.frame[:, 1]
    rows = np.arange(len(place) * times), np.repeat(frame, times)
    pose, wrench = (np.asarray(leaf)[rows] for leaf in (traj.pose, traj.wrench))
    images = _render(collection, sensor, bodies, np.repeat(place, times), pose, wrench, test.visual.shape[2])

    def samples(leaf: np.ndarray) -> np.ndarray:
        return np.moveaxis(leaf.reshape(len(test.object), times, *leaf.shape[1:]), 1, 0)

    visual, tactile, pose, outcome = (samples(leaf) for leaf in (*images, pose, np.asarray(traj.outcome)))
    probability = shares(outcome, scenario.outcomes)
    return Predicted(
        visual=visual.mean(0, dtype=np.float32) / 255,
        tactile=tactile.mean(0, dtype=np.float32) / 255,
        pose=metrics.centre(pose),
        outcome=np.array([int(each) for each in scenario.outcomes])[probability.argmax(1)],
        samples=Predicted(visual, tactile, pose, outcome),
        outcome_probability=probability,
    )


def _render(
    collection: dataset.Collection,
    sensor: Sensor,
    bodies: list,
    owner: np.ndarray,
    pose: np.ndarray,
    wrench: np.ndarray,
    size: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Render both streams of all last frames (`uint8`, `size` pixels), object by object, on all CPU cores."""
    same, batch = size == collection.resolution[0], dataset.frames_per_call()
    jobs = [
        np.flatnonzero(owner == index)[start : start + batch]
        for index in range(len(bodies))
        for start in range(0, int((owner == index).sum()), batch)
    ]

    def work(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        padded = np.pad(rows, (0, batch - len(rows)), "edge")
        visual, tactile, _ = dataset.render_uint8(
            sensor,
            bodies[owner[rows[0]]],
            pose[padded],
            wrench[padded],
            resolution=collection.resolution,
            crop=collection.crop,
        )
        images = {"visual": np.asarray(visual)[: len(rows)], "tactile": np.asarray(tactile)[: len(rows)]}
        images = images if same else dataset.reduced_images(images, size)
        return images["visual"], images["tactile"]

    shape = collection.resolution if same else (size, size)
    visual, tactile = (np.empty((len(owner), *shape, 3), np.uint8) for _ in range(2))
    with concurrent.futures.ThreadPoolExecutor(cores()) as pool:
        for rows, parts in zip(jobs, pool.map(in_32_bits(work), jobs), strict=True):
            visual[rows], tactile[rows] = parts
    return visual, tactile
