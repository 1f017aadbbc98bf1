"""Figures of numbers: training, calibration and last positions. Each function writes one file."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Rectangle

from sts_jax.evaluation import metrics
from sts_jax.evaluation.catalogue import CALIBRATION, Scores
from sts_jax.evaluation.figures import pictures

_POSSIBLE, _PREDICTED = "tab:blue", "tab:orange"  # colours of simulated and of predicted last poses


def training_curves(path: Path, logs: Mapping[str, Sequence[Mapping[str, float]]]) -> None:
    """Draw the terms of the training loss over the gradient steps, with one panel per term and one line per model.

    Args:
        logs: The training logs by the name of the model. A log has one dictionary for each logged gradient step, with
            the number of the step as `step`, and the terms.
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
    pictures.save(figure, path)


def calibration(path: Path, scores: Mapping[str, Scores], *, title: str) -> None:
    """Draw how often the likeliest outcome is the true one, as a function of its predicted probability.

    Args:
        scores: Scores by the name of the predictor. Those without outcome probabilities are not drawn.
    """
    judged = {name: own[CALIBRATION].T for name, own in scores.items() if CALIBRATION in own}
    width = 1 / metrics.BINS
    edges = width * np.arange(metrics.BINS)
    figure, axes = plt.subplots(
        2,
        max(len(judged), 1),
        figsize=(max(3.6 * len(judged), 5), 5),
        height_ratios=[2.4, 1],
        sharex=True,
        sharey="row",
        squeeze=False,
    )
    for (above, below), (name, (confidence, right)) in zip(axes.T, judged.items(), strict=False):
        diagram = metrics.reliability(confidence, right)
        some = diagram.items > 0
        above.plot([0, 1], [0, 1], color="gray", linewidth=1, linestyle="--")
        above.bar(edges[some], diagram.accuracy[some], width, align="edge", color=_POSSIBLE, alpha=0.35, edgecolor="w")
        above.plot(diagram.confidence[some], diagram.accuracy[some], "o", color=_POSSIBLE, markersize=6)
        above.set_title(f"{name}\ncalibration error {metrics.calibration_error(confidence, right):.3f}", fontsize=10)
        bars = below.bar(edges, diagram.items, width, align="edge", color="0.6", edgecolor="w")
        below.bar_label(bars, [f"{count:.0f}" if count else "" for count in diagram.items], fontsize=8)
        below.set_xlabel("predicted probability\nof the likeliest outcome")
        above.grid(alpha=0.3)
    axes[0, 0].set_ylabel("frequency of this outcome\n(dashed: calibrated)")
    axes[1, 0].set_ylabel("number of\ntrajectories")
    axes[0, 0].set_xlim(0, 1)
    axes[0, 0].set_ylim(0, 1.02)
    axes[1, 0].margins(y=0.2)
    figure.suptitle(title, fontsize=11)
    pictures.save(figure, path)


def ends(
    path: Path,
    size: Sequence[float],
    start: np.ndarray,
    truth: np.ndarray,
    rerolled: np.ndarray,
    sampled: np.ndarray,
    *,
    title: str,
) -> None:
    """Draw the possible last positions of one trajectory beside the predicted ones, on the pad as the camera sees it.

    Args:
        size: Size of the pad along x and y (m).
        start: First pose, `(7,)`.
        truth: True last pose, `(7,)`.
        rerolled: Last poses of m re-rolls, `(m, 7)`.
        sampled: k samples of the last pose from a model, `(k, 7)`.
    """
    figure, axes = plt.subplots(1, 2, figsize=(9, 5.4), sharex=True, sharey=True)
    half = 500 * np.asarray(size)  # mm
    panels = (
        (f"simulator: {len(rerolled)} draws of hidden values", "simulated last position", rerolled, _POSSIBLE),
        (f"model: {len(sampled)} samples", "predicted last position", sampled, _PREDICTED),
    )
    for axis, (head, label, poses, colour) in zip(axes, panels, strict=True):
        axis.add_patch(Rectangle(tuple(-half), *(2 * half), facecolor="0.94", edgecolor="0.4"))
        axis.annotate("pad", -half, (4, -4), textcoords="offset points", va="top", fontsize=9, color="0.4")
        axis.plot(*(1e3 * start[:2]), "x", color="black", markersize=10, markeredgewidth=2, label="first position")
        axis.plot(*(1e3 * truth[:2]), "*", color="tab:green", markersize=18, label="true last position")
        axis.plot(*(1e3 * poses[:, :2].T), "o", color=colour, markersize=6, alpha=0.65, label=label)
        axis.set_title(head, fontsize=11)
        axis.set_xlabel("x (mm)")
        axis.set_aspect("equal")
    reach = 1.08 * max(half.max(), 1e3 * np.abs(np.concatenate([rerolled, sampled])[:, :2]).max())
    axes[0].set_xlim(-reach, reach)
    axes[0].set_ylim(reach, -reach)  # y points down, as in the images
    axes[0].set_ylabel("y (mm)")
    handles, labels = axes[0].get_legend_handles_labels()
    model, name = axes[1].get_legend_handles_labels()
    figure.legend([*handles, model[-1]], [*labels, name[-1]], loc="outside lower center", ncols=4, fontsize=10)
    figure.suptitle(title, fontsize=11)
    pictures.save(figure, path)
