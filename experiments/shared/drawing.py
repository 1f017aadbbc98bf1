"""Draws the figures of an evaluation."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

import sts_jax as sts
from experiments.shared.config import TITLES, Config, main_model
from experiments.shared.rerolls import Ceilings
from sts_jax import dataset, evaluation

JUDGED_SUBSETS = ("visual", "visual and tactile", "all inputs")  # inputs for which outcome probabilities are drawn


def draw(
    config: Config,
    workdir: Path,
    figures: Path,
    sensor: sts.Sensor,
    test: dataset.Pairs,
    scores: Mapping[str, evaluation.Scores],
    shown: Mapping[str, evaluation.Predicted],
    possible: Ceilings,
) -> list[Path]:
    """Draw the main model's predictions from vision and from all inputs, and the calibration of outcome probabilities.

    The main model is the model that the main table of results shows. If it predicts samples of the pose, further
    figures show the predicted and the re-rolled positions at rest. A re-roll is another simulation from the same
    initial state, with new random hidden properties such as friction.

    Args:
        config: Configuration of the experiment.
        workdir: Work directory. Its name is part of the titles.
        figures: Folder for the figures.
        sensor: Sensor of the collection.
        test: Held-out trajectories.
        scores: Scores of the predictions. The keys are the titles of the rows in the tables.
        shown: Predictions of the first held-out trajectories. The keys are the titles of the rows.
        possible: Re-rolls of the first held-out trajectories.

    Returns:
        Paths of the figures.
    """
    drawn, model, scenario = [], TITLES[main_model(config)], config.collection.scenario
    num_shown = min(config.num_shown, len(test.object))
    for given, name in (("visual", "predictions"), ("all inputs", "predictions-all")):
        found = shown.get(f"{model}, from {given}")
        if found is None:
            continue
        title = f"{workdir.name}, from {given}: the first {num_shown} held-out trajectories"
        drawn.append(figures / f"{name}.png")
        evaluation.figures.predictions(drawn[-1], test, found, num=num_shown, title=title, scenario=scenario)
        if found.samples is not None and found.samples.pose is not None:
            drawn.append(figures / f"{name.replace('predictions', 'ends')}.png")
            head = f"{workdir.name}, from {given}"
            _ends(drawn[-1], head, sensor, test, found.samples.pose, possible.pose[:, : config.num_shown])
    judged = {f"from {given}": scores.get(f"{model}, from {given}") for given in JUDGED_SUBSETS}
    known = {given: own for given, own in judged.items() if own is not None and own.confidence is not None}
    if known:
        drawn.append(figures / "calibration.png")
        title = f"{workdir.name}: outcome probabilities of {model}"
        evaluation.figures.calibration(drawn[-1], known, title=title)
    return drawn


def _ends(
    path: Path, head: str, sensor: sts.Sensor, test: dataset.Pairs, sampled: np.ndarray, rerolled: np.ndarray
) -> None:
    """Draw the positions at rest for the start whose re-rolls have the widest spread.

    Args:
        path: Path of the figure.
        head: Begin of the title.
        sensor: Sensor of the collection.
        test: Held-out trajectories.
        sampled: Sampled poses at rest, shape (samples, n, 7).
        rerolled: Poses at rest of the re-rolls, shape (times, n, 7).
    """
    spread = np.linalg.norm(rerolled[..., :2] - rerolled[..., :2].mean(0), axis=-1).mean(0)
    item = int(spread.argmax())
    evaluation.figures.ends(
        path,
        (float(sensor.gel.size[0]), float(sensor.gel.size[1])),
        test.pose[item, 0],
        test.pose[item, 1],
        rerolled[:, item],
        sampled[:, item],
        title=f"{head}: ends of #{test.trajectory[item]}, the start with the widest spread among the first "
        f"{len(spread)}",
    )
