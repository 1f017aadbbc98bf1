"""Pictures: checks of output paths, atomic writing, the figures of an evaluation, and trajectories from outside."""

import io
import tempfile
from collections.abc import Mapping
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from PIL import Image

import sts_jax as sts
from experiments.shared.config import TITLES, Run
from sts_jax import dataset, evaluation, storage

PICTURES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".pdf")  # formats that Pillow and Matplotlib write
JUDGED_SUBSETS = ("visual", "visual and tactile", "all inputs")  # inputs for which outcome probabilities are drawn


def check_picture(path: Path) -> None:
    """Check before any work that a picture can be written to a path."""
    if path.is_dir() or path.suffix.lower() not in PICTURES:
        raise ValueError(f"{path} must be the name of a picture that ends in one of {', '.join(PICTURES)}")
    make_folder(path.parent)


def make_folder(path: Path) -> None:
    """Make a folder if it does not exist, and check that it can be written to."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=path).close()
    except OSError as error:
        raise type(error)(f"cannot write to the folder {path} ({error.strerror}): give another path") from error


def write_picture(path: Path, picture: Image.Image) -> None:
    """Write a picture atomically, in the format of the suffix, which is one of `PICTURES`."""
    buffer = io.BytesIO()
    picture.save(buffer, Image.registered_extensions()[path.suffix.lower()])
    storage.write_bytes(path, buffer.getvalue())


def write_figure(path: Path, figure: Figure, *, dpi: float) -> None:
    """Write a figure atomically, in the format of the suffix, or as PNG without one."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format=path.suffix[1:] or "png", dpi=dpi)
    storage.write_bytes(path, buffer.getvalue())


def draw(
    run: Run,
    test: dataset.Pairs,
    scores: Mapping[str, evaluation.Scores],
    shown: Mapping[str, evaluation.Predicted],
    rerolled: np.ndarray,
) -> list[Path]:
    """Draw the main model's predictions, the calibration of its outcomes, and its sampled positions at rest.

    Args:
        test: The n held-out trajectories that are shown, with images of any resolution.
        shown: Their predictions, by title of the row.
        rerolled: Poses at rest of their re-rolls, (times, n, 7).
    """
    name, model, drawn = run.workdir.name, TITLES[run.main_model], []
    for given, stem in (("visual", ""), ("all inputs", "-all")):
        predicted, head = shown.get(f"{model}, from {given}"), f"{name}, from {given}"
        if predicted is None:
            continue
        drawn.append(run.figures / f"predictions{stem}.png")
        draw_predictions(
            drawn[-1], run.config.collection, run.sensor, test, predicted, f"{head}: held-out trajectories"
        )
        if predicted.samples is not None and predicted.samples.pose is not None:
            drawn.append(run.figures / f"ends{stem}.png")
            _draw_ends(drawn[-1], head, run.sensor, test, predicted.samples.pose, rerolled)
    judged = {f"from {given}": scores.get(f"{model}, from {given}", {}) for given in JUDGED_SUBSETS}
    if any(evaluation.CALIBRATION in errors for errors in judged.values()):
        drawn.append(run.figures / "calibration.png")
        evaluation.figures.calibration(drawn[-1], judged, title=f"{name}: outcome probabilities of {model}")
    return drawn


def draw_predictions(
    path: Path,
    collection: dataset.Collection,
    sensor: sts.Sensor,
    test: dataset.Pairs,
    predicted: evaluation.Predicted,
    title: str,
) -> None:
    """Draw the predictions of some trajectories of a collection, with the outlines of its objects."""
    width, height = sensor.gel.size
    evaluation.figures.pose_sheet(
        path,
        test,
        predicted,
        np.arange(len(test.object)),
        scenario=collection.scenario,
        names=dataset.class_names(collection),
        size=(float(width), float(height)),
        title=title,
        bodies=dataset.make_bodies(collection, test.object),
        camera=None if collection.crop else sensor.camera,
    )


def _draw_ends(
    path: Path, head: str, sensor: sts.Sensor, test: dataset.Pairs, sampled: np.ndarray, rerolled: np.ndarray
) -> None:
    """Draw sampled and re-rolled positions at rest for the start whose re-rolls have the widest spread."""
    spread = np.linalg.norm(rerolled[..., :2] - rerolled[..., :2].mean(0), axis=-1).mean(0)
    item, (width, height) = int(spread.argmax()), sensor.gel.size
    title = f"{head}: ends of #{test.trajectory[item]}, the start with the widest spread among those shown"
    poses = (*test.pose[item], rerolled[:, item], sampled[:, item])
    evaluation.figures.ends(path, (float(width), float(height)), *poses, title=title)


def draw_strip(path: Path, collection: dataset.Collection, sensor: sts.Sensor, data: dataset.Dataset) -> None:
    """Draw a fully rendered trajectory as a strip of pictures: the first one of the first outcome of the scenario."""
    full = data.full_trajectories()
    rank = [collection.scenario.outcomes.index(o) for o in data.trajectory["outcome"][full]]
    index = int(full[np.argmin(rank)])
    one, hidden = ({name: leaf[index] for name, leaf in x.items()} for x in (data.trajectory, data.hidden))
    images = data.strip(index)
    body = dataset.make_bodies(collection, np.array([one["body"]]))[0]
    outside = views(body, one["pose"], one["gravity"], sensor, collection.scenario.wall)
    words = describe(collection.scenario, dataset.class_names(collection)[one["body"]], one, hidden)
    streams, title = (images.visual / 255, images.tactile / 255), f"trajectory {index}: {words}"
    evaluation.figures.strip(path, one["time"], outside, *streams, one["wrench"], title=title)


def views(
    body: sts.objects.Body,
    pose: np.ndarray,
    gravity: np.ndarray,
    sensor: sts.Sensor,
    wall: float,
    side: int = 160,
) -> np.ndarray:
    """Render the object and the pad obliquely from above, (frames, side, side, 3), with final gravity downwards."""
    size, up = jnp.array(sensor.gel.size), -jnp.asarray(gravity[-1])
    frozen = np.append(False, (pose[1:] == pose[:-1]).all(1)) & np.asarray(sts.physics.fell_off(jnp.asarray(pose)))
    pose = np.where(frozen[:, None], np.array([0, 0, -10, 1, 0, 0, 0], np.float32), pose)
    drawn = (evaluation.outside(body, jnp.asarray(each), size, up, wall, resolution=(side, side)) for each in pose)
    return np.stack([np.asarray(image) for image in drawn])


def describe(
    scenario: sts.physics.Scenario, name: str, trajectory: Mapping[str, np.ndarray], hidden: Mapping[str, np.ndarray]
) -> str:
    """Describe a trajectory in words: class, outcome, hidden properties and condition."""
    words = [f"a {name} {scenario.named(int(trajectory['outcome']))}"]
    words += [f"{key.replace('_', ' ')} {hidden[key]:.2f}" for key in ("fill", "shell_scale", "friction")]
    if hidden["up"][2] < 1:
        words.append("contents' up ({:.1f}, {:.1f}, {:.1f})".format(*hidden["up"]))
    if len(trajectory["condition"]):
        words.append(scenario.described(trajectory["condition"]))
    return ", ".join(words)
