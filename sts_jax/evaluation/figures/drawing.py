"""Functions that all figures use."""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from sts_jax.storage import write_whole


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
