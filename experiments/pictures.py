"""The pictures of an experiment: what models predict, and a trajectory from outside and through the sensor."""

from collections.abc import Mapping
from pathlib import Path

import jax.numpy as jnp
import numpy as np

import sts_jax as sts
from sts_jax import dataset, evaluation


def draw_predictions(
    folder: Path,
    collection: dataset.Collection,
    sensor: sts.Sensor,
    test: dataset.Pairs,
    shown: Mapping[str, evaluation.Predicted],
    blank: np.ndarray,
    *,
    num: int,
    title: str,
) -> None:
    """The first held-out trajectories in `predictions.png`; `line_up.png`, with its answers in `line_up.json`.

    Args:
        folder: Where the pictures go.
        collection: What was collected.
        sensor: The sensor that saw it.
        test: Held-out trajectories.
        shown: Predictions of the same, by name; the last one, of both streams and the pose, is lined up.
        blank: The visual image of the empty sensor, in [0, 1].
        num: How many trajectories `predictions.png` shows.
        title: Of `predictions.png`.
    """
    if collection.scenario.condition_scale:
        title += "; red: where to, and how hard, the jerk drives it"
    evaluation.figures.predictions(folder / "predictions.png", test, shown, num=num, title=title)
    best = list(shown.values())[-1]
    assert best.pose is not None
    category = np.array(dataset.class_names(collection))[test.object]
    first = np.sort(np.unique(test.object, return_index=True)[1])[:10]  # the first one of each of the first objects
    samples = [dataset.sample_of_class(collection, name) for name in category[first]]
    stands = evaluation.stand_ins(sensor, samples, best.pose[first], collection.resolution)
    line_up = folder / "line_up.png"
    evaluation.figures.line_up(line_up, line_up.with_suffix(".json"), test, best, category, blank, stands, first)


def draw_strip(path: Path, collection: dataset.Collection, sensor: sts.Sensor, data: dataset.Dataset) -> None:
    """A fully rendered trajectory, the first with the most telling outcome, from outside and through the sensor."""
    full = data.full_trajectories()
    if not len(full):
        return
    rank = [collection.scenario.outcomes.index(o) for o in data.trajectory["outcome"][full]]
    index = int(full[np.argmin(rank)])
    one, hidden = ({name: leaf[index] for name, leaf in x.items()} for x in (data.trajectory, data.hidden))
    images = data.strip(index)
    body = dataset.make_bodies(collection, np.array([one["body"]]))[0]
    what = describe(dataset.class_names(collection)[one["body"]], one, hidden)
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
    """A trajectory from outside, `(frames, h, w, 3)` in [0, 1], with the gravity of its end drawn downwards.

    What fell off and was frozen is no longer drawn.
    """
    size, up = jnp.array(sensor.gel.size), -jnp.asarray(gravity[-1])
    frozen = np.append(False, (pose[1:] == pose[:-1]).all(1)) & np.asarray(sts.physics.fell_off(jnp.asarray(pose)))
    pose = np.where(frozen[:, None], np.array([0, 0, -10, 1, 0, 0, 0], np.float32), pose)
    return np.stack([np.asarray(evaluation.outside(body, jnp.asarray(each), size, up, wall)) for each in pose])


def describe(name: str, trajectory: Mapping[str, np.ndarray], hidden: Mapping[str, np.ndarray]) -> str:
    """One trajectory in words: class, outcome, hidden values and condition, from leaves of `physics.Trajectory`."""
    outcome = sts.physics.Outcome(int(trajectory["outcome"])).name.lower().replace("_", " ")
    words = [f"a {name} {outcome}"]
    words += [f"{key.replace('_', ' ')} {hidden[key]:.2f}" for key in ("fill", "shell_scale", "friction")]
    if hidden["up"][2] < 1:
        words.append("contents' up ({:.1f}, {:.1f}, {:.1f})".format(*hidden["up"]))
    if len(trajectory["condition"]):
        x, y, duration = trajectory["condition"]
        words.append(f"pad jerked by ({x:.1f}, {y:.1f}) m/s² for {1e3 * duration:.0f} ms")
    return ", ".join(words)
