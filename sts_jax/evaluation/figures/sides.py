"""A figure of real and simulated images side by side."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from sts_jax.evaluation.figures import drawing
from sts_jax.evaluation.gap import Streams

_PERCENTILE = 99.5  # percentile of the absolute differences at which the colour scale ends


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
    """Draw real and simulated images of the visual and the tactile stream side by side.

    If `matched` is True, the figure also shows a difference image for each row and each stream. The difference image is
    the real minus the simulated image, averaged over the colour channels. The difference image is red where the real
    image is brighter than the simulated image.

    Args:
        path: The PNG file to write.
        real: Real images of both streams. Image i is drawn in row i.
        simulated: Simulated images of both streams, of the same shape as the real images.
        labels: Labels of the rows, one for each image.
        matched: True if the real and the simulated images of each row show the same object in the same pose. The
            figure then also shows the differences.
        title: Title of the figure.
        names: Titles of the columns of real and simulated images.
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
            drawing.show(axes[row, 0], first[row] / 255)
            drawing.show(axes[row, 1], second[row] / 255)
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
    drawing.save(figure, path)
