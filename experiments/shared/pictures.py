"""Draws simulated trajectories as pictures, and describes them in words."""

from collections.abc import Mapping
from pathlib import Path

import jax.numpy as jnp
import numpy as np

import sts_jax as sts
from sts_jax import dataset, evaluation


def draw_strip(path: Path, collection: dataset.Collection, sensor: sts.Sensor, data: dataset.Dataset) -> None:
    """Draw a trajectory of a dataset as a strip of pictures.

    The drawn trajectory is fully rendered, which means that the dataset has images of each of its frames. Among several
    such trajectories, the function chooses those whose outcome comes first in the list `collection.scenario.outcomes`.
    Among these, it draws the one with the smallest index.

    Args:
        path: Path of the picture.
        collection: Collection of the dataset.
        sensor: Sensor of the collection.
        data: Dataset with at least one fully rendered trajectory.
    """
    full = data.full_trajectories()
    rank = [collection.scenario.outcomes.index(o) for o in data.trajectory["outcome"][full]]
    index = int(full[np.argmin(rank)])
    one, hidden = ({name: leaf[index] for name, leaf in x.items()} for x in (data.trajectory, data.hidden))
    images = data.strip(index)
    body = dataset.make_bodies(collection, np.array([one["body"]]))[0]
    what = describe(collection.scenario, dataset.class_names(collection)[one["body"]], one, hidden)
    evaluation.figures.strip(
        path,
        one["time"],
        views(body, one["pose"], one["gravity"], sensor, collection.scenario.wall),
        images.visual / 255,
        images.tactile / 255,
        one["wrench"],
        title=f"trajectory {index}: {what}",
    )


def views(body: sts.objects.Body, pose: np.ndarray, gravity: np.ndarray, sensor: sts.Sensor, wall: float) -> np.ndarray:
    """Render the object and the pad obliquely from above, in one picture for each frame of a trajectory.

    The final direction of gravity points down in the pictures. An object that has fallen off the pad is drawn only
    while its pose changes.

    Args:
        body: The object.
        pose: Poses of the object in the sensor frame, position (m) and quaternion (w, x, y, z), shape (frames, 7).
        gravity: Gravity in the sensor frame (m/s^2), shape (frames, 3).
        sensor: Sensor, whose pad is drawn.
        wall: Height of the stop wall (m), 0 for none.

    Returns:
        Pictures of shape (frames, height, width, 3) in [0, 1].
    """
    size, up = jnp.array(sensor.gel.size), -jnp.asarray(gravity[-1])
    frozen = np.append(False, (pose[1:] == pose[:-1]).all(1)) & np.asarray(sts.physics.fell_off(jnp.asarray(pose)))
    pose = np.where(frozen[:, None], np.array([0, 0, -10, 1, 0, 0, 0], np.float32), pose)
    return np.stack([np.asarray(evaluation.outside(body, jnp.asarray(each), size, up, wall)) for each in pose])


def describe(
    scenario: sts.physics.Scenario, name: str, trajectory: Mapping[str, np.ndarray], hidden: Mapping[str, np.ndarray]
) -> str:
    """Describe a trajectory in words: class, outcome, hidden properties and known quantities of the scenario.

    Args:
        scenario: Scenario of the trajectory.
        name: Class of the object.
        trajectory: Fields of `physics.Trajectory` for one trajectory.
        hidden: Fields of `physics.Hidden` for the same trajectory.
    """
    words = [f"a {name} {scenario.named(int(trajectory['outcome']))}"]
    words += [f"{key.replace('_', ' ')} {hidden[key]:.2f}" for key in ("fill", "shell_scale", "friction")]
    if hidden["up"][2] < 1:
        words.append("contents' up ({:.1f}, {:.1f}, {:.1f})".format(*hidden["up"]))
    if len(trajectory["condition"]):
        words.append(scenario.described(trajectory["condition"]))
    return ", ".join(words)
