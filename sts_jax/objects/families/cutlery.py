"""Forks with three or four tines, and spoons with an egg-shaped bowl."""

import numpy as np
from scipy.interpolate import PchipInterpolator

from sts_jax.objects import colors, shapes
from sts_jax.objects.assembly import STEEL
from sts_jax.objects.colors import Color
from sts_jax.objects.shapes import Part

SHEET = 1.5  # mm, thickness of the steel


def fork(rng: np.random.Generator) -> list[Part]:
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
    grip, steel, neck = _handle(rng, length, end, drop)
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


def spoon(rng: np.random.Generator) -> list[Part]:
    """Return the parts (mm) of a random spoon that lies on the table with its bowl towards +x."""
    longest = rng.uniform(90, 130)  # mm
    length = 125.0
    bowl = length * rng.uniform(0.29, 0.38)  # length of the bowl
    width = bowl * rng.uniform(0.62, 0.82)  # width of the bowl
    sunk = rng.uniform(0.2, 0.32)  # depth of the bowl over its width
    egg = rng.uniform(0.05, 0.22)  # narrowing of the bowl towards the tip
    depth = sunk * width
    rim = depth + SHEET / 2  # height of the rim, so that bowl and handle touch the table
    grip, steel, _ = _handle(rng, length, length - bowl + 2.0, rim)
    c, s = shapes.circle(1.0, 14).T

    def ring(share: float, sink: float) -> np.ndarray:
        x = length - bowl / 2 + share * bowl / 2 * c
        return np.column_stack([x, share * width / 2 * s * (1 - egg * c), np.full(14, rim - sink)])

    outside = [(0.16, depth + SHEET), (0.53, 0.8 * depth + SHEET), (0.86, 0.38 * depth + 0.7 * SHEET)]
    inside = [(1.0, 0.0), (0.82, 0.4 * depth), (0.5, 0.8 * depth), (0.18, depth)]
    rings = np.stack([ring(*level) for level in (*outside, *inside)])
    scoop = shapes.loft(rings, [*[steel] * 3, *[0.75 * steel] * 3], density=STEEL)
    return shapes.scaled([grip, scoop], longest)


def _handle(rng: np.random.Generator, length: float, end: float, lift: float) -> tuple[Part, Color, float]:
    """Return a random handle from x = 0 to its neck at x = `end`, z = `lift`, its steel, and the width of the neck."""
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
