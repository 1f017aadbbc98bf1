"""Figures of predictions of held-out trajectories. Each function writes one file."""

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Rectangle

from sts_jax import physics
from sts_jax.dataset import Pairs
from sts_jax.evaluation import metrics
from sts_jax.evaluation.figures import drawing
from sts_jax.evaluation.outcomes import OUTCOMES, named
from sts_jax.evaluation.predictions import Predicted, in_unit
from sts_jax.evaluation.records import Scores

SAMPLES = 4  # number of samples that are shown for each prediction
_POSSIBLE, _PREDICTED = "tab:blue", "tab:orange"  # colours of simulated and of predicted last poses


def predictions(
    path: Path,
    test: Pairs,
    predicted: Predicted,
    *,
    num: int,
    title: str,
    scenario: physics.Scenario | None = None,
) -> None:
    """Draw the first image, the true last image, the prediction and its samples for some held-out trajectories.

    Each stream (visual or tactile) of a trajectory is a row. The title of the row names the true outcome. A red arrow
    on the first image shows `Scenario.drift`, the velocity of a frictionless object relative to the pad. A velocity of
    0 has no arrow. An arrow for 1 m/s is as long as a quarter of the image's width.

    Args:
        path: The PNG file to write.
        test: The held-out trajectories.
        predicted: Predictions for all trajectories of `test`, or for the first trajectories of `test`. A stream that is
            not predicted has no rows.
        num: Maximum number of trajectories in the figure. The figure shows the first trajectories of `predicted`.
        title: Title of the figure.
        scenario: The scenario of the trajectories. It determines the velocities for the arrows and the names for the
            outcomes. If `scenario` is None, the figure has no arrows, and the names are those of `physics.Outcome`.
    """
    streams = [name for name in ("visual", "tactile") if getattr(predicted, name) is not None]
    samples, outcomes = predicted.samples or Predicted(), OUTCOMES if scenario is None else scenario.outcomes
    num = min(num, *(len(getattr(predicted, name)) for name in streams))
    drawn = 0 if samples.visual is None and samples.tactile is None else SAMPLES
    heads = ["input", "truth", "mean of samples" if drawn else "prediction", *(f"sample {k + 1}" for k in range(drawn))]
    rows = len(streams) * num
    drift = np.zeros((num, 2))
    if scenario is not None:
        drift = np.stack([scenario.drift(jnp.asarray(condition)) for condition in test.condition[:num]])
    figure, axes = plt.subplots(rows, len(heads), figsize=(1.25 * len(heads) + 0.7, 1.25 * rows + 0.8), squeeze=False)
    for row in range(rows):
        item, stream = row // len(streams), streams[row % len(streams)]
        truth, drawings = getattr(test, stream)[item], getattr(samples, stream)
        pictures = [truth[0], truth[1], getattr(predicted, stream)[item]]
        pictures += [] if drawings is None else list(drawings[:SAMPLES, item])
        for column, axis in enumerate(axes[row]):
            if column < len(pictures):
                drawing.show(axis, in_unit(pictures[column]))
            else:
                axis.axis("off")
            if row == 0:
                axis.set_title(heads[column], fontsize=10)
        label = stream
        if row % len(streams) == 0:
            outcome = named(int(test.outcome[item]), outcomes).replace("_", " ")
            label = f"#{test.trajectory[item]}: {outcome}\n{stream}"
        axes[row, 0].set_ylabel(label, fontsize=9)
        if stream == streams[0] and drift[item].any():
            height, width = test.visual.shape[2:4]
            middle = np.array([width - 1, height - 1]) / 2
            tip = middle + drift[item] * width / 4
            axes[row, 0].annotate("", tip, middle, arrowprops={"arrowstyle": "->", "color": "red"})
    arrows = "\nred arrow: velocity over the pad that a freely sliding object receives" if drift.any() else ""
    wrapped = textwrap.fill(title, int(11 * figure.get_figwidth()))  # about eleven letters fit into an inch
    figure.suptitle(wrapped + arrows, fontsize=11)
    drawing.save(figure, path)


def calibration(path: Path, scores: Mapping[str, Scores], *, title: str) -> None:
    """Draw how often a predictor is right, as a function of the predictor's confidence.

    The predictor is right if the outcome with the largest predicted probability is the true outcome. The confidence is
    this largest probability. If a predictor is calibrated, the frequency of right predictions equals the confidence. A
    second plot below shows the number of held-out trajectories in each bin of the confidence.

    Args:
        path: The PNG file to write.
        scores: Scores by the name of the predictor. Each predictor with outcome probabilities has a column in the
            figure.
        title: Title of the figure.
    """
    judged = {
        name: (own.confidence, own.right)
        for name, own in scores.items()
        if own.confidence is not None and own.right is not None
    }
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
        found = metrics.reliability(confidence, right)
        there = found.items > 0
        above.plot([0, 1], [0, 1], color="gray", linewidth=1, linestyle="--")
        above.bar(edges[there], found.accuracy[there], width, align="edge", color=_POSSIBLE, alpha=0.35, edgecolor="w")
        above.plot(found.confidence[there], found.accuracy[there], "o", color=_POSSIBLE, markersize=6)
        above.set_title(f"{name}\ncalibration error {metrics.calibration_error(confidence, right):.3f}", fontsize=10)
        bars = below.bar(edges, found.items, width, align="edge", color="0.6", edgecolor="w")
        below.bar_label(bars, [f"{count:.0f}" if count else "" for count in found.items], fontsize=8)
        below.set_xlabel("predicted probability\nof the likeliest outcome")
        above.grid(alpha=0.3)
    axes[0, 0].set_ylabel("frequency of this outcome\n(dashed: calibrated)")
    axes[1, 0].set_ylabel("number of\ntrajectories")
    axes[0, 0].set_xlim(0, 1)
    axes[0, 0].set_ylim(0, 1.02)
    axes[1, 0].margins(y=0.2)
    figure.suptitle(title, fontsize=11)
    drawing.save(figure, path)


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

    The y axis points down, as in the images.

    Args:
        path: The PNG file to write.
        size: Size of the pad along x and y (m).
        start: First pose, position (m) and quaternion, `(7,)`.
        truth: True last pose, `(7,)`.
        rerolled: Last poses of m simulations (re-rolls) from the same first pose, each with other random values of
            the properties that a camera cannot see (such as fill level and friction), `(m, 7)`.
        sampled: k samples of the last pose from a model, `(k, 7)`.
        title: Title of the figure.
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
    drawing.save(figure, path)
