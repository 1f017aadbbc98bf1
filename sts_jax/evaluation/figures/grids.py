"""A figure that shows images of several predictors side by side."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from sts_jax.evaluation.figures import drawing


def comparison(
    path: Path, groups: Sequence[Mapping[str, np.ndarray]], labels: Sequence[str], *, title: str, heads: Sequence[str]
) -> None:
    """Draw images of n trajectories as a grid. Each trajectory is a row, and neighbouring columns form groups.

    Args:
        path: The PNG file to write.
        groups: The groups from left to right. A group maps the title of each column to images
            `(n, height, width, 3)` in [0, 1].
        labels: Labels of the n rows.
        title: Title of the figure.
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
                drawing.show(axes[row, column], images[row])
        if number == 0:
            for row, label in enumerate(labels):
                axes[row, 0].set_ylabel(label, fontsize=9)
    figure.suptitle(title, fontsize=11)
    drawing.save(figure, path)
