"""Forks with three or four tines."""

import numpy as np
from scipy.interpolate import PchipInterpolator

from sts_jax.objects import shapes
from sts_jax.objects.assembly import STEEL
from sts_jax.objects.families.cutlery import SHEET, handle
from sts_jax.objects.shapes import Part


def parts(rng: np.random.Generator) -> list[Part]:
    """Return the parts (mm) of a random fork that lies on the table with its tines towards +x."""
    longest = rng.uniform(90, 130)  # mm
    length = 125.0
    tines = int(rng.integers(3, 5))  # 3 or 4
    head = length * rng.uniform(0.15, 0.2)  # width of the head
    reach = length * rng.uniform(0.2, 0.28)  # length of the tines
    palm = length * rng.uniform(0.1, 0.15)  # from the neck to the roots of the tines
    curl = length * rng.uniform(0.035, 0.07)  # height of the tips above the table
    drop = length * rng.uniform(0.05, 0.09)  # height of the neck above the table
    end = length - reach - palm
    grip, steel, neck = handle(rng, length, end, drop)
    # The middle line runs from the neck down to the table, then up to the tips.
    line = PchipInterpolator([end, end + 0.75 * palm, end + palm, length], [drop, 0.04 * drop, 0.0, curl])
    square = shapes.rectangle(1.0, 1.0)

    def strip(x: np.ndarray, width: np.ndarray, depth: np.ndarray, y: float) -> Part:
        rings = [
            np.column_stack([np.full(4, s), y + square[:, 0] * w, line(s) + square[:, 1] * d])
            for s, w, d in zip(x, width, depth, strict=True)
        ]
        return shapes.loft(np.stack(rings), steel, density=STEEL)

    width = np.array([neck, 0.35 * neck + 0.45 * head, 0.86 * head, 0.98 * head, head])
    pieces = [grip, strip(end + palm * np.array([0.0, 0.2, 0.45, 0.75, 1.0]), width, np.full(5, SHEET), 0.0)]
    pitch = head / (tines - 0.42)
    along = end + palm - 1.0 + (reach + 1.0) * np.array([0.0, 0.3, 0.6, 0.85, 1.0])
    taper = np.array([1.0, 0.92, 0.85, 0.7, 0.3])
    for index in range(tines):
        y = (index - (tines - 1) / 2) * pitch
        pieces.append(strip(along, 0.58 * pitch * taper, SHEET * (0.4 + 0.6 * taper), y))
    return shapes.scaled(pieces, longest)
