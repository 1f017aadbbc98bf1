"""Figures of numbers: training, calibration, last positions, and errors over time."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Rectangle

from sts_jax import physics
from sts_jax.dataset import Pairs
from sts_jax.evaluation import metrics
from sts_jax.evaluation.catalogue import CALIBRATION, Scores
from sts_jax.evaluation.figures import pictures
from sts_jax.evaluation.predictions import Predicted, in_unit

_POSSIBLE, _PREDICTED = "tab:blue", "tab:orange"  # colours of simulated and of predicted last poses
_ERRORS = {  # factor and title of the panel of each error over time
    "position": (1e3, "position, on the pad (mm)"),
    "visual": (1e4, "visual excess (1e-4 nats)"),
    "tactile": (1e4, "tactile excess (1e-4 nats)"),
}


def training_curves(path: Path, logs: Mapping[str, Sequence[Mapping[str, float]]]) -> None:
    """Draw the terms of the training loss over the gradient steps, with one panel per term and one line per model.

    Args:
        logs: The training logs by the name of the model. A log has one dictionary for each logged gradient step, with
            the number of the step as `step`, and the terms.
    """
    keys = [
        key
        for key in ("loss", "validation", "kl", "look", "visual", "tactile", "state", "outcome", "pose")
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


class Curve(NamedTuple):
    """Errors of n predicted trajectories over time, or of a prediction of the last frame only, which has one time."""

    time: np.ndarray  # (s,) times of the predicted frames (s)
    errors: dict[str, np.ndarray]  # (s, n) by name, see `error_curve`, NaN where an error does not count


def error_curve(time: Sequence[float] | np.ndarray, steps: Iterable[tuple[Predicted, Pairs]]) -> Curve:
    """Compute the errors of predicted frames: `position` (m), and `visual` and `tactile` excess (nats per value).

    The position counts for objects that stay on the pad. What is not predicted is left out.

    Args:
        time: Times of the predicted frames (s), `(s,)`.
        steps: For each time, the prediction and the pairs whose later frame it predicts, such as
            `(predicted, data.pairs(rows, frames=(0, t)))`. An iterator need not keep all images in memory.
    """
    errors: dict[str, list[np.ndarray]] = {}
    for predicted, pairs in steps:
        if predicted.pose is not None:
            position = metrics.position_error(predicted.pose, pairs.pose[:, 1])
            position = np.where(pairs.outcome == int(physics.Outcome.FELL_OFF), np.nan, position)
            errors.setdefault("position", []).append(position)
        for stream in ("visual", "tactile"):
            images = getattr(predicted, stream)
            if images is not None:
                error = metrics.image_error(in_unit(images), in_unit(getattr(pairs, stream)[:, 1]))
                errors.setdefault(stream, []).append(error.excess / error.pixels)
    if any(len(values) != len(time) for values in errors.values()):
        counts = {name: len(values) for name, values in errors.items()}
        raise ValueError(
            f"`time` has {len(time)} times, but the numbers of predictions are {counts}: give one per time"
        )
    return Curve(np.asarray(time), {name: np.stack(values) for name, values in errors.items()})


def error_curves(
    path: Path,
    curves: Mapping[str, Curve],
    objects: np.ndarray,
    *,
    plain: Sequence[str] = ("copy of the input",),
    title: str,
    num: int = 500,
) -> None:
    """Draw mean errors over time, with a panel for each quantity and a 95 % bootstrap interval over objects.

    Args:
        curves: From `error_curve`, by the name of the model. A curve with one time is drawn as a point. Names that are
            equal up to a comma, such as "MVAE, roll-out" and "MVAE, last frame", have the same colour.
        objects: Object of each trajectory, `(n,)`.
        plain: Names of the curves that are dashed and without interval, such as baselines.
    """
    panels = [name for name in _ERRORS if any(name in curve.errors for curve in curves.values())]
    figure, axes = plt.subplots(1, len(panels), figsize=(4.1 * len(panels), 3.6), squeeze=False)
    models = list(dict.fromkeys(name.partition(",")[0] for name in curves if name not in plain))
    for axis, panel in zip(axes[0], panels, strict=True):
        factor, label = _ERRORS[panel]
        for name, (time, errors) in curves.items():
            if panel not in errors:
                continue
            values = factor * errors[panel]

            def mean(weight: np.ndarray, values: np.ndarray = values) -> np.ndarray:
                w = weight * np.isfinite(values)
                total = w.sum(1)
                return np.where(total > 0, (w * np.nan_to_num(values)).sum(1) / np.maximum(total, 1), np.nan)

            line = mean(np.ones(len(objects)))
            if name in plain:
                axis.plot(time, line, "--", color="0.4", label=name, linewidth=1.3)
                continue
            colour, draws = f"C{models.index(name.partition(',')[0])}", metrics.bootstrap(objects, mean, num=num)
            low, high = np.transpose([metrics.interval(draw) for draw in draws.T])
            if len(time) == 1:
                axis.errorbar(time, line, (line - low, high - line), fmt="o", color=colour, label=name, capsize=3)
            else:
                axis.plot(time, line, color=colour, label=name, linewidth=1.5)
                axis.fill_between(time, low, high, color=colour, alpha=0.2, linewidth=0)
        axis.set_xlabel("time (s)")
        axis.set_title(label, fontsize=10)
        axis.set_ylim(bottom=0)
        axis.grid(alpha=0.3)
    every = {label: handle for axis in axes[0] for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    figure.legend(every.values(), every.keys(), loc="outside lower center", ncols=min(3, len(every)), fontsize=9)
    figure.suptitle(title, fontsize=11)
    pictures.save(figure, path)
