"""Curves over training, each figure written to one file."""

import collections
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np

from sts_jax.evaluation.figures import drawing


class Trained(NamedTuple):
    """One trained model of a scaling curve."""

    name: str  # of the line, such as the inputs or the model
    trajectories: int  # number of training trajectories
    steps: int  # gradient steps
    minutes: float  # training time
    skill: float
    low: float  # of the 95 % interval
    high: float


def scaling(path: Path, points: Sequence[Trained], *, ceiling: float | None = None, title: str) -> None:
    """Draw visual skill on held-out objects against the number of training trajectories and against training time.

    In the left panel, a line joins the models that share a name and a number of gradient steps. In the right panel, it
    joins those that share a name and a number of trajectories.

    Args:
        path: The PNG to write.
        points: The trained models.
        ceiling: Skill of the best possible prediction, drawn as a line.
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
                continue  # other groups show how this model scales
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
    """Draw loss, KL and the reconstruction of each modality against the gradient step, one line per model.

    Args:
        path: The PNG to write.
        logs: The log of each model: dictionaries with `step`, `loss`, `kl` and one number per modality.
    """
    keys = [
        key
        for key in ("loss", "kl", "look", "visual", "tactile", "state", "outcome", "pose")
        if any(key in e for log in logs.values() for e in log)
    ]
    # A state-space model predicts a density of the final pose. Its squared error is that of the first pose, the state.
    squared = "state" if any("state" in entry for log in logs.values() for entry in log) else "pose"
    units = {squared: "squared error (scaled pose)"}
    figure, axes = plt.subplots(1, len(keys), figsize=(3.6 * len(keys), 3.2), squeeze=False)
    for axis, key in zip(axes[0], keys, strict=True):
        for name, log in logs.items():
            points = [(entry["step"], entry[key]) for entry in log if key in entry]
            if points:
                axis.plot(*zip(*points, strict=True), label=name, linewidth=1)
        axis.set_xlabel("gradient step")
        axis.set_ylabel(units.get(key, "nats an item"))
        axis.set_title(key, fontsize=9)
        if key == "loss" and all(entry[key] > 0 for log in logs.values() for entry in log if key in entry):
            axis.set_yscale("log")  # models with different numbers of subsets differ in scale
        axis.grid(alpha=0.3)
    axes[0, 0].legend(fontsize=7)
    drawing.save(figure, path)
