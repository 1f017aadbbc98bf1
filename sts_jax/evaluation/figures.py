"""Figures of predictions, training and simulation, each written to one file."""

import collections
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib import colors, font_manager
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle
from PIL import Image, ImageDraw, ImageFont

from sts_jax import physics
from sts_jax._files import write_whole
from sts_jax.dataset import Pairs
from sts_jax.evaluation import metrics
from sts_jax.evaluation.report import Predicted, Scores, in_unit

SLOWER = 2  # factor by which an animation is slower than the motion
_PANEL = 104  # pixels, height of one panel of curves below an animation


SAMPLES = 4  # samples shown of each prediction
_POSSIBLE, _PREDICTED = "tab:blue", "tab:orange"  # colours of possible and of predicted ends


def predictions(
    path: Path,
    test: Pairs,
    predicted: Predicted,
    *,
    num: int,
    title: str,
    scenario: physics.Scenario | None = None,
) -> None:
    """Draw input, truth, prediction and samples of the first `num` held-out trajectories, with a row for each stream.

    A red arrow on the input shows the velocity over the pad that a freely sliding object receives (`Scenario.drift`),
    unless it is 0. A quarter of the picture is 1 m/s.

    Args:
        path: The PNG to write.
        test: Held-out trajectories, in the dataset's order.
        predicted: Predictions of these, or of the first ones. A stream that is not predicted has no rows.
        num: Number of trajectories.
        title: Title of the figure.
        scenario: The scenario of the trajectories, for the names of its outcomes and the arrows (None: no arrows, and
            the names of `physics.Outcome`).
    """
    streams = [name for name in ("visual", "tactile") if getattr(predicted, name) is not None]
    samples = predicted.samples or Predicted()
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
                _show(axis, in_unit(pictures[column]))
            else:
                axis.axis("off")
            if row == 0:
                axis.set_title(heads[column], fontsize=10)
        label = stream
        if row % len(streams) == 0:
            number = int(test.outcome[item])
            outcome = physics.Outcome(number) if scenario is None else scenario.named(number)
            label = f"#{test.trajectory[item]}: {outcome}\n{stream}"
        axes[row, 0].set_ylabel(label, fontsize=9)
        if stream == streams[0] and drift[item].any():
            height, width = test.visual.shape[2:4]
            middle = np.array([width - 1, height - 1]) / 2
            tip = middle + drift[item] * width / 4
            axes[row, 0].annotate("", tip, middle, arrowprops={"arrowstyle": "->", "color": "red"})
    arrows = "\nred: the velocity over the pad that a freely sliding object receives" if drift.any() else ""
    figure.suptitle(title + arrows, fontsize=11)
    _save(figure, path)


def calibration(path: Path, scores: Mapping[str, Scores], *, title: str) -> None:
    """Draw how often the likeliest outcome came true against its probability, with the number of items below.

    Args:
        path: The PNG to write.
        scores: Scores by name. Each predictor with outcome probabilities gives one column.
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
    axes[0, 0].set_ylabel("share in which it came true\n(dashed: calibrated)")
    axes[1, 0].set_ylabel("number of items")
    axes[0, 0].set_xlim(0, 1)
    axes[0, 0].set_ylim(0, 1.02)
    axes[1, 0].margins(y=0.2)
    figure.suptitle(title, fontsize=11)
    _save(figure, path)


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
    """Draw the possible ends of one start beside the predicted ones, on the pad from above, oriented as the images.

    Args:
        path: The PNG to write.
        size: Size of the pad along x and y (m), `(2,)`.
        start: First pose, `(7,)`.
        truth: Last pose, `(7,)`.
        rerolled: Last poses with other hidden values, `(m, 7)`.
        sampled: Last poses that a model drew, `(k, 7)`.
        title: Title of the figure.
    """
    figure, axes = plt.subplots(1, 2, figsize=(9, 5.4), sharex=True, sharey=True)
    half = 500 * np.asarray(size)  # mm
    panels = (
        (f"simulator: {len(rerolled)} draws of the hidden values", "simulated end", rerolled, _POSSIBLE),
        (f"model: {len(sampled)} samples", "predicted end", sampled, _PREDICTED),
    )
    for axis, (head, label, poses, colour) in zip(axes, panels, strict=True):
        axis.add_patch(Rectangle(tuple(-half), *(2 * half), facecolor="0.94", edgecolor="0.4"))
        axis.annotate("pad", -half, (4, -4), textcoords="offset points", va="top", fontsize=9, color="0.4")
        axis.plot(*(1e3 * start[:2]), "x", color="black", markersize=10, markeredgewidth=2, label="start")
        axis.plot(*(1e3 * truth[:2]), "*", color="tab:green", markersize=18, label="true end")
        axis.plot(*(1e3 * poses[:, :2].T), "o", color=colour, markersize=6, alpha=0.65, label=label)
        axis.set_title(head, fontsize=11)
        axis.set_xlabel("x (mm)")
        axis.set_aspect("equal")
    reach = 1.08 * max(half.max(), 1e3 * np.abs(np.concatenate([rerolled, sampled])[:, :2]).max())
    axes[0].set_xlim(-reach, reach)
    axes[0].set_ylim(reach, -reach)  # y points to the image's bottom
    axes[0].set_ylabel("y (mm)")
    handles, labels = axes[0].get_legend_handles_labels()
    model, name = axes[1].get_legend_handles_labels()
    figure.legend([*handles, model[-1]], [*labels, name[-1]], loc="outside lower center", ncols=4, fontsize=10)
    figure.suptitle(title, fontsize=11)
    _save(figure, path)


class Trained(NamedTuple):
    """One trained model of a scaling curve."""

    name: str  # of the line, such as the inputs or the model
    trajectories: int  # number of training trajectories
    minutes: float  # training time
    skill: float
    low: float  # of the 95 % interval
    high: float


def scaling(path: Path, points: Sequence[Trained], *, ceiling: float | None = None, title: str) -> None:
    """Draw visual skill on held-out objects against the number of training trajectories and against training time.

    The left panel joins the models of one name and training time, the right panel those of one name and number of
    trajectories.

    Args:
        path: The PNG to write.
        points: The trained models.
        ceiling: Skill of the best possible prediction, drawn as a line.
        title: Title of the figure.
    """
    figure, axes = plt.subplots(1, 2, figsize=(10.5, 4.8), sharey=True)
    for axis, along, fixed, unit in (
        (axes[0], "trajectories", "minutes", "{:g} min"),
        (axes[1], "minutes", "trajectories", "{:,} trajectories"),
    ):
        groups = collections.Counter((point.name, getattr(point, fixed)) for point in points)
        sizes = [(name, count) for (name, _), count in groups.items()]
        for group in groups:
            own = [point for point in points if (point.name, getattr(point, fixed)) == group]
            own = sorted(own, key=lambda point: getattr(point, along))
            if len(own) < 2 and any(count > 1 for name, count in sizes if name == group[0]):
                continue  # other groups show how this model scales
            skill = np.array([point.skill for point in own])
            spread = [skill - [point.low for point in own], [point.high for point in own] - skill]
            label = f"{group[0]}, {unit.format(group[1])}"
            place = [getattr(point, along) for point in own]
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
        ticks = sorted({getattr(point, along) for point in points})
        axis.set_xticks(ticks, [f"{tick:,g}" for tick in ticks])
        axis.set_xticks([], minor=True)
        axis.grid(alpha=0.3)
        axis.margins(y=0.12)
        axis.legend(fontsize=9, loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2)
    axes[0].set_xlabel("training trajectories")
    axes[1].set_xlabel("training time (minutes)")
    axes[0].set_ylabel("visual skill, held-out objects")
    figure.suptitle(title, fontsize=11)
    _save(figure, path)


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
    _save(figure, path)


def strip(
    path: Path,
    time: np.ndarray,
    view: np.ndarray,
    visual: np.ndarray,
    tactile: np.ndarray,
    wrench: np.ndarray,
    *,
    num: int = 10,
    title: str = "",
) -> None:
    """Draw one trajectory over time: a view from outside, both streams, and the wrench of the pad on the object.

    The force is below the pictures, and its moment about the sensor's origin is below the force.

    Args:
        path: The PNG to write.
        time: Time of every frame (s), `(frames,)`.
        view: The scene from outside, `(frames, h, w, 3)`.
        visual: `(frames, height, width, 3)` in [0, 1].
        tactile: `(frames, height, width, 3)` in [0, 1].
        wrench: `(frames, 6)`, N and N m.
        num: Number of frames that are shown, from the first to the last, denser at the beginning.
        title: Title of the figure.
    """
    last = len(time) - 1
    chosen = np.unique(np.round(last * np.linspace(0, 1, num) ** 1.8).astype(int))
    figure, axes = plt.subplots(
        5, len(chosen), figsize=(1.5 * len(chosen), 7.8), height_ratios=[1, 1, 1, 0.8, 0.8], squeeze=False
    )
    for column, t in enumerate(chosen):
        for row, (name, images) in enumerate({"outside": view, "visual": visual, "tactile": tactile}.items()):
            _show(axes[row, column], images[t])
            if column == 0:
                axes[row, column].set_ylabel(name, fontsize=8)
        axes[0, column].set_title(f"{time[t]:.2f} s", fontsize=8)
        axes[3, column].remove()
        axes[4, column].remove()
    grid = axes[0, 0].get_gridspec()
    force = figure.add_subplot(grid[3, :])
    moment = figure.add_subplot(grid[4, :], sharex=force)
    for axis, symbol, values, unit in (
        (force, "F", wrench[:, :3], "force (N)"),
        (moment, "M", 1e3 * wrench[:, 3:], "moment about\norigin (mN m)"),
    ):
        for k, direction in enumerate("xyz"):
            axis.plot(time, values[:, k], label=f"${symbol}_{direction}$", linewidth=1)
        axis.set_ylabel(unit, fontsize=8)
        axis.tick_params(labelsize=8)
        axis.legend(fontsize=7, ncols=3)
        axis.grid(alpha=0.3)
    force.tick_params(labelbottom=False)
    moment.set_xlabel("time (s)", fontsize=8)
    figure.align_ylabels([force, moment])
    figure.suptitle(title, fontsize=9)
    _save(figure, path)


def animation(
    path: Path,
    time: np.ndarray,
    view: np.ndarray,
    visual: np.ndarray,
    tactile: np.ndarray,
    wrench: np.ndarray,
    gravity: np.ndarray,
    *,
    title: str = "",
    outcome: str = "",
    side: int = 240,
) -> None:
    """Write an animation of one trajectory: a view from outside, both streams, force and moment so far.

    An arrow on the visual stream is the component of gravity along the pad, which is due to the slope or to the jerk of
    the pad. The animation is SLOWER times slower than the motion.

    Args:
        path: The GIF to write.
        time: Time of every frame (s), `(frames,)`.
        view: The scene from outside, `(frames, h, w, 3)` in [0, 1].
        visual: `(frames, height, width, 3)` in [0, 1].
        tactile: `(frames, height, width, 3)` in [0, 1].
        wrench: `(frames, 6)`, N and N m.
        gravity: `(frames, 3)`, m/s^2, sensor frame.
        title: Title above the pictures.
        outcome: Text that is shown at the end.
        side: Side of each of the three pictures (pixels).
    """
    top, width = 44, 3 * side
    base = top + side
    across = np.interp(time, [time[0], max(time[-1], time[0] + 1e-6)], [50, width - 12])
    letters = font_manager.findfont("DejaVu Sans")  # comes with matplotlib (Pillow's own font has no "²")
    font, small = (ImageFont.truetype(letters, size=size) for size in (12, 11))
    curves = [
        ("force (N)", "F", wrench[:, :3]),
        ("moment about the sensor's origin (mN m)", "M", 1e3 * wrench[:, 3:]),
    ]
    pages = []
    for t in range(len(time)):
        page = Image.new("RGB", (width, base + 2 * _PANEL), "white")
        draw = ImageDraw.Draw(page)
        draw.text((6, 5), title, "black", small)
        said = f"{time[t]:.2f} s, at 1/{SLOWER:g} of its speed" + (f": {outcome}" if t == len(time) - 1 else "")
        draw.text((6, 23), said, "black", font)
        for column, (name, images) in enumerate({"outside": view, "visual": visual, "tactile": tactile}.items()):
            picture = Image.fromarray(np.round(255 * np.clip(images[t], 0, 1)).astype(np.uint8))
            page.paste(picture.resize((side, side), Image.Resampling.BICUBIC), (column * side, top))
            draw.text((column * side + 5, top + side - 16), name, "black", small)
        middle = np.array([1.5 * side, top + side / 2])
        tip = middle + 0.035 * side * gravity[t, :2]
        if np.linalg.norm(gravity[t, :2]) > 0.1:
            along = (tip - middle) / np.linalg.norm(tip - middle)
            barbs = [tip - 10 * along + sign * 6 * along[::-1] * [-1, 1] for sign in (-1, 1)]
            draw.text((side + 5, top + 3), "gravity's part along the pad", "red", small)
            draw.line([*middle, *(tip - 8 * along)], "red", 3)
            draw.polygon([tuple(tip), *map(tuple, barbs)], "red")
        for panel, (head, symbol, values) in enumerate(curves):
            _curves(draw, small, base + panel * _PANEL, across, values, t, head, symbol)
        pages.append(page)
    # A GIF counts hundredths of a second.
    step = 10 * max(round(100 * SLOWER * float(np.mean(np.diff(time)))), 2) if len(time) > 1 else 100
    durations = [step] * (len(pages) - 1) + [1500]

    def write(temporary: Path) -> None:
        pages[0].save(temporary, "GIF", save_all=True, append_images=pages[1:], duration=durations, loop=0)

    write_whole(path, write)


def _curves(
    draw: ImageDraw.ImageDraw,
    font: ImageFont.FreeTypeFont,
    top: int,
    across: np.ndarray,
    values: np.ndarray,
    last: int,
    title: str,
    symbol: str,
) -> None:
    low, high = min(float(values.min()), 0.0), max(float(values.max()), 0.0)
    floor, scale = top + _PANEL - 10, (_PANEL - 32) / max(high - low, 1e-3)
    heights = floor - scale * (values - low)
    zero = floor + scale * low
    draw.line([across[0], zero, across[-1], zero], "lightgray")
    marks = {0.0: zero}
    for value, height in ((high, floor - scale * (high - low)), (low, floor)):
        if abs(height - zero) > 12:
            marks[value] = height
    for value, height in marks.items():
        draw.text((across[0] - 6, height), f"{value:.3g}", "black", font, anchor="rm")
    draw.text((across[0], top + 3), title, "black", font)
    for k, (direction, colour) in enumerate({"x": "tab:blue", "y": "tab:orange", "z": "tab:green"}.items()):
        ink = colors.to_hex(colour)
        draw.text((across[-1] - 72 + 28 * k, top + 3), f"{symbol}{direction}", ink, font)
        draw.line([*zip(across[: last + 1], heights[: last + 1, k], strict=True)], ink, 2)


def _show(axis: Axes, image: np.ndarray) -> None:
    axis.imshow(np.clip(image, 0, 1), interpolation="nearest")
    axis.set_xticks([])
    axis.set_yticks([])


def _save(figure: plt.Figure, path: Path) -> None:
    figure.set_layout_engine("constrained")
    try:
        write_whole(path, lambda temporary: figure.savefig(temporary, format="png", dpi=130))
    finally:
        plt.close(figure)
