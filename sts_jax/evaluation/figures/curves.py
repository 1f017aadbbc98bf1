"""Figures of training curves and of the skill of models over the amount of training.

The skill is a score of the predicted images (see `metrics.skill`). Each function writes one file.
"""

import collections
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np

from sts_jax.evaluation.figures import drawing


class Trained(NamedTuple):
    """One trained model, which `scaling` draws as a point."""

    name: str  # name of the curve in the legend, such as the inputs of the model
    trajectories: int  # number of training trajectories
    steps: int  # number of gradient steps
    minutes: float  # training time (minutes)
    skill: float  # visual skill on held-out objects
    low: float  # lower limit of the 95 % interval of the skill
    high: float  # upper limit of the 95 % interval of the skill


def scaling(path: Path, points: Sequence[Trained], *, ceiling: float | None = None, title: str) -> None:
    """Draw the visual skill of trained models over the number of training trajectories and over the training time.

    The skill is a score of the predicted images. Perfect images have the skill 1, and the mean training image has the
    skill 0 (see `metrics.skill`).

    The x axis of the left panel is the number of training trajectories. A line there connects models with the same name
    and number of gradient steps. The x axis of the right panel is the training time. A line there connects models with
    the same name and number of training trajectories.

    Args:
        path: The PNG file to write.
        points: The trained models.
        ceiling: Skill of the best possible prediction, drawn as a horizontal line. None draws no line.
        title: Title of the figure.
    """
    figure, axes = plt.subplots(1, 2, figsize=(10.5, 4.8), sharey=True)
    for axis, along, fixed, unit in (
        (axes[0], "trajectories", "steps", "{:,} steps"),
        (axes[1], "minutes", "trajectories", "{:,} trajectories"),
    ):
        groups = collections.Counter((point.name, getattr(point, fixed)) for point in points)
        sizes = [(name, count) for (name, _), count in groups.items()]
        ticks: set[float] = set()
        for group in groups:
            own = [point for point in points if (point.name, getattr(point, fixed)) == group]
            own = sorted(own, key=lambda point: getattr(point, along))
            if len(own) < 2 and any(count > 1 for name, count in sizes if name == group[0]):
                continue  # a single point shows no trend, and another line of the same name does
            skill = np.array([point.skill for point in own])
            spread = [skill - [point.low for point in own], [point.high for point in own] - skill]
            label = f"{group[0]}, {unit.format(group[1])}"
            place = [getattr(point, along) for point in own]
            ticks.update(place)
            axis.errorbar(place, skill, spread, fmt="o-", capsize=3, markersize=5, linewidth=1.2, label=label)
        if ceiling is not None:
            axis.axhline(ceiling, color="gray", linestyle="--", linewidth=1)
            axis.annotate(
                "ceiling (re-rolls)",
                (0.02, ceiling),
                (0, 3),
                xycoords=("axes fraction", "data"),
                textcoords="offset points",
                fontsize=9,
                color="0.4",
            )
        axis.set_xscale("log")
        axis.set_xticks(sorted(ticks), [f"{tick:,g}" for tick in sorted(ticks)])
        axis.set_xticks([], minor=True)
        axis.grid(alpha=0.3)
        axis.margins(y=0.12)
        axis.legend(fontsize=9, loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2)
    axes[0].set_xlabel("training trajectories")
    axes[1].set_xlabel("training time (minutes)")
    axes[0].set_ylabel("visual skill, held-out objects")
    figure.suptitle(title, fontsize=11)
    drawing.save(figure, path)


def training_curves(path: Path, logs: Mapping[str, Sequence[Mapping[str, float]]]) -> None:
    """Draw the terms of the training loss over the gradient steps, with one panel per term and one line per model.

    The figure has a panel for each of the following terms, except those that no log contains:

    - `loss`: The total loss.
    - `kl`: The KL divergence of the latent variables from their prior (only models of `sts_jax.mvae`).
    - `look`: The KL divergence of the appearance code from its prior (only models of `sts_jax.statespace`). This code
        describes all visible properties of the object other than its pose and shape.
    - `visual` and `tactile`: The errors of the predicted images.
    - `state`: The squared error of the estimated pose, shape and mass in the first frame (only models of
        `sts_jax.statespace`).
    - `outcome`: The negative log likelihood of the true outcome (only models of `sts_jax.statespace`).
    - `pose`: The squared error (`sts_jax.mvae`) or negative log likelihood (`sts_jax.statespace`) of the final pose.

    Args:
        path: The PNG file to write.
        logs: The training logs by the name of the model. A log has one dictionary for each logged gradient step. The
            dictionary contains the number of the step as `step`, and the terms.
    """
    keys = [
        key
        for key in ("loss", "kl", "look", "visual", "tactile", "state", "outcome", "pose")
        if any(key in e for log in logs.values() for e in log)
    ]
    # For a state-space model, `pose` is the nats of a density, and `state` is the squared error of the first pose.
    squared = "state" if any("state" in entry for log in logs.values() for entry in log) else "pose"
    units = {squared: "squared error (scaled pose)"}
    figure, axes = plt.subplots(1, len(keys), figsize=(3.6 * len(keys), 3.2), squeeze=False)
    for axis, key in zip(axes[0], keys, strict=True):
        for name, log in logs.items():
            points = [(entry["step"], entry[key]) for entry in log if key in entry]
            if points:
                axis.plot(*zip(*points, strict=True), label=name, linewidth=1)
        axis.set_xlabel("gradient step")
        axis.set_ylabel(units.get(key, "nats per item"))
        axis.set_title(key, fontsize=9)
        if key == "loss" and all(entry[key] > 0 for log in logs.values() for entry in log if key in entry):
            axis.set_yscale("log")  # the loss is a sum over subsets, whose number differs between models
        axis.grid(alpha=0.3)
    axes[0, 0].legend(fontsize=7)
    drawing.save(figure, path)
