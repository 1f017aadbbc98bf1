"""The handle that forks and spoons share."""

import numpy as np
from scipy.interpolate import PchipInterpolator

from sts_jax.objects import colors, shapes
from sts_jax.objects.assembly import STEEL
from sts_jax.objects.colors import Color
from sts_jax.objects.shapes import Part

SHEET = 1.5  # mm, thickness of the steel


def handle(rng: np.random.Generator, length: float, end: float, lift: float) -> tuple[Part, Color, float]:
    """The handle from x = 0 on the table to x = `end` at height `lift`, its steel colour and the width of its neck."""
    arch = length * rng.uniform(0.015, 0.05)  # handle's rise over length
    wide = length * rng.uniform(0.075, 0.12)  # its end's width
    neck = length * rng.uniform(0.032, 0.045)  # its neck's width
    steel = colors.steel(rng)
    coloured = rng.uniform() < 0.35  # a third have a coloured handle, thicker than the steel
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
