"""Spoons with an egg-shaped bowl."""

import numpy as np

from sts_jax.objects import shapes
from sts_jax.objects.assembly import STEEL
from sts_jax.objects.families.cutlery import SHEET, handle
from sts_jax.objects.shapes import Part


def parts(rng: np.random.Generator) -> list[Part]:
    """Return the parts (mm) of a random spoon that lies on the table with its bowl towards +x."""
    longest = rng.uniform(90, 130)  # mm
    length = 125.0
    bowl = length * rng.uniform(0.29, 0.38)  # length of the bowl
    width = bowl * rng.uniform(0.62, 0.82)  # width of the bowl
    sunk = rng.uniform(0.2, 0.32)  # depth of the bowl over its width
    egg = rng.uniform(0.05, 0.22)  # narrowing of the bowl towards the tip
    depth = sunk * width
    rim = depth + SHEET / 2  # height of the rim, so that bowl and handle touch the table
    grip, steel, _ = handle(rng, length, length - bowl + 2.0, rim)
    c, s = shapes.circle(1.0, 14).T

    def ring(share: float, sink: float) -> np.ndarray:
        x = length - bowl / 2 + share * bowl / 2 * c
        return np.column_stack([x, share * width / 2 * s * (1 - egg * c), np.full(14, rim - sink)])

    outside = [(0.16, depth + SHEET), (0.53, 0.8 * depth + SHEET), (0.86, 0.38 * depth + 0.7 * SHEET)]
    inside = [(1.0, 0.0), (0.82, 0.4 * depth), (0.5, 0.8 * depth), (0.18, depth)]
    rings = np.stack([ring(*level) for level in (*outside, *inside)])
    scoop = shapes.loft(rings, [*[steel] * 3, *[0.75 * steel] * 3], density=STEEL)
    return shapes.scaled([grip, scoop], longest)
