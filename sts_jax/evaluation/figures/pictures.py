"""Figures of images in rows and columns, and the functions that all figures use."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from sts_jax.evaluation.gap import Streams
from sts_jax.storage import write_whole

_PERCENTILE = 99.5  # percentile of the absolute differences at which their colour scale ends


def show(axis: Axes, image: np.ndarray) -> None:
    """Draw an image with values in [0, 1], without ticks on the axes."""
    axis.imshow(np.clip(image, 0, 1), interpolation="nearest")
    axis.set_xticks([])
    axis.set_yticks([])


def save(figure: plt.Figure, path: Path) -> None:
    """Write a figure as a PNG file, and close the figure."""
    figure.set_layout_engine("constrained")
    try:
        write_whole(path, lambda temporary: figure.savefig(temporary, format="png", dpi=130))
    finally:
        plt.close(figure)


def comparison(
    path: Path, groups: Sequence[Mapping[str, np.ndarray]], labels: Sequence[str], *, title: str, heads: Sequence[str]
) -> None:
    """Draw images of n trajectories as a grid. Each trajectory is a row, and neighbouring columns form groups.

    Args:
        groups: Images `(n, height, width, 3)` in [0, 1] by the title of their column, for each group from left to
            right.
        heads: Titles of the groups.
    """
    rows, widths = len(labels), [len(group) for group in groups]
    figure = plt.figure(figsize=(1.5 * sum(widths) + 0.8, 1.42 * rows + 1.3))
    parts = figure.subfigures(1, len(groups), width_ratios=widths, squeeze=False)[0]
    for number, (part, group, head) in enumerate(zip(parts, groups, heads, strict=True)):
        part.suptitle(head, fontsize=11, fontweight="bold")
        axes = part.subplots(rows, len(group), squeeze=False)
        for column, (name, images) in enumerate(group.items()):
            axes[0, column].set_title(name, fontsize=9)
            for row in range(rows):
                show(axes[row, column], images[row])
        if number == 0:
            for row, label in enumerate(labels):
                axes[row, 0].set_ylabel(label, fontsize=9)
    figure.suptitle(title, fontsize=11)
    save(figure, path)


def side_by_side(
    path: Path,
    real: Streams,
    simulated: Streams,
    labels: Sequence[str],
    *,
    matched: bool,
    title: str,
    names: tuple[str, str] = ("real", "simulated"),
) -> None:
    """Draw real and simulated images of both streams side by side, and for matched sets their differences.

    A difference (real minus simulated, averaged over the colour channels) is red where the real image is brighter.

    Args:
        simulated: Simulated images of the same shape.
        matched: True if the images of each row show the same object in the same pose.
    """
    rows, kinds = len(labels), 3 if matched else 2
    figure, grid = plt.subplots(
        rows, 2 * kinds, figsize=(1.75 * 2 * kinds + 0.4, 1.36 * rows + 1.3), squeeze=False, layout="constrained"
    )
    for place, stream in enumerate(("visual", "tactile")):
        axes = grid[:, place * kinds : (place + 1) * kinds]
        first, second = getattr(real, stream), getattr(simulated, stream)
        difference = (first.astype(np.float64) - second).mean(-1)
        reach = max(float(np.percentile(np.abs(difference), _PERCENTILE)), 1.0)
        for row in range(rows):
            show(axes[row, 0], first[row] / 255)
            show(axes[row, 1], second[row] / 255)
            if matched:
                drawn = axes[row, 2].imshow(difference[row], cmap="RdBu_r", vmin=-reach, vmax=reach)
                axes[row, 2].set_xticks([])
                axes[row, 2].set_yticks([])
        for axis, name in zip(axes[0], (*names, "difference"), strict=False):
            axis.set_title(f"{stream}:\n{name}", fontsize=10)
        if matched:
            bar = figure.colorbar(drawn, ax=axes[:, 2], location="bottom", shrink=0.95, aspect=14, pad=0.02)
            bar.set_label("grey levels (of 255)", fontsize=8)
            bar.ax.tick_params(labelsize=8)
    for axis, label in zip(grid[:, 0], labels, strict=True):
        axis.set_ylabel(label, fontsize=9)
    figure.suptitle(title, fontsize=11)
    save(figure, path)
