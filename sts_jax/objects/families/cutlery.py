"""The handle that forks and spoons share."""

import numpy as np
from scipy.interpolate import PchipInterpolator

from sts_jax.objects import colors, shapes
from sts_jax.objects.assembly import STEEL
from sts_jax.objects.colors import Color
from sts_jax.objects.shapes import Part

SHEET = 1.5  # mm, thickness of the steel


def handle(rng: np.random.Generator, length: float, end: float, lift: float) -> tuple[Part, Color, float]:
    """Return a random handle of a fork or a spoon, along the x axis, from the table at x = 0 to its neck.

    Args:
        rng: Generator of the random dimensions and colours.
        length: Length of the whole fork or spoon (mm).
        end: Coordinate x of the neck (mm).
        lift: Height of the neck above the table (mm).

    Returns:
        The handle, the colour of the steel, and the width of the neck (mm).
    """
    arch = length * rng.uniform(0.015, 0.05)  # rise of the handle in its middle
    wide = length * rng.uniform(0.075, 0.12)  # width of its end
    neck = length * rng.uniform(0.032, 0.045)  # width of its neck
    steel = colors.steel(rng)
    coloured = rng.uniform() < 0.35  # a third of the handles are coloured, and thicker than the steel
    tint = colors.vivid(rng) if coloured else steel

    profile = PchipInterpolator(np.array([0.0, 0.35, 0.8, 1.0]) * end, [0.0, arch, 0.95 * lift, lift])
    x = np.array([0.0, 0.02, 0.08, 0.25, 0.5, 0.62, 0.85, 1.02]) * end
    width = np.maximum(np.array([0.55, 0.85, 1.0, 0.86, 0.58, 0.5, 0.0, 0.0]) * wide, neck)
    depth = SHEET * np.where((x < 0.55 * end) & coloured, 1.8, 1.0)
    slim = np.array([[0.5, 0.0], [0.36, 0.5], [-0.36, 0.5], [-0.5, 0.0], [-0.36, -0.5], [0.36, -0.5]])
    rings = np.stack(
        [
            np.column_stack([np.full(6, s), slim[:, 0] * w, profile(min(s, end)) + slim[:, 1] * d])
            for s, w, d in zip(x, width, depth, strict=True)
        ]
    )
    return shapes.loft(rings, [*[tint] * 5, steel, steel], density=STEEL), steel, neck
