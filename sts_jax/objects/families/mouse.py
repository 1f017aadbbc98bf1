"""Computer mice: a shell with buttons and a wheel. Some have the first centimetre of a cable."""

import numpy as np

from sts_jax.objects import colors, shapes
from sts_jax.objects.shapes import Part


def parts(rng: np.random.Generator) -> list[Part]:
    """Return the parts (mm) of a random computer mouse that lies on the table with its buttons towards -y."""
    longest = rng.uniform(60, 110)  # mm, including the first centimetre of a cable
    length = 100.0
    width = length * rng.uniform(0.54, 0.7)
    height = length * rng.uniform(0.3, 0.42)
    peak = rng.uniform(-0.35, 0.05)  # position of the highest point, -1 (back) to 1 (front)
    waist = rng.uniform(0.0, 0.12)  # narrowing of the sides, as a share of the width
    split = rng.uniform(0.0, 0.2)  # position where the keys begin, -1 (back) to 1 (front)
    corded = rng.uniform() < 0.5

    shell = colors.dark(rng) if rng.uniform() < 0.4 else colors.pale(rng) if rng.uniform() < 0.6 else colors.vivid(rng)
    dark = shell.mean() < 0.15
    keys = shell if rng.uniform() < 0.4 else colors.grey(0.6) if dark else colors.dark(rng)
    seam = colors.grey(0.45) if keys.mean() < 0.08 else colors.grey(0.04)
    wheel = colors.vivid(rng) if rng.uniform() < 0.5 else colors.grey(0.7 if keys.mean() < 0.15 else 0.15)

    # Cross-sections from the back to the front, of six points each. The first and the last point lie on the table.
    stations = np.array([-1.0, -0.86, -0.5, 0.0, 0.45, 0.78, 0.93, 1.0])
    across = np.radians([180, 146, 108, 72, 34, 0])

    def section(u: float) -> np.ndarray:
        half = width / 2 * (1 - np.abs(0.97 * u) ** 2.6) ** (1 / 2.6)
        half *= 1 - waist * np.exp(-(((u - 0.2) / 0.35) ** 2))
        swell = (u - peak) / (1 - peak if u > peak else 1 + peak)
        top = height * (1 - 0.6 * np.abs(swell) ** 2.3)
        c, s = np.cos(across), np.sin(across)
        x = half * np.sign(c) * np.abs(c) ** 0.75
        return np.stack([x, np.full(6, u * length / 2), top * np.abs(s) ** 0.7], axis=1)

    coarse = np.stack([section(u) for u in stations])

    def between(u: float) -> np.ndarray:
        i = int(np.clip(np.searchsorted(stations, u) - 1, 0, len(stations) - 2))
        share = (u - stations[i]) / (stations[i + 1] - stations[i])
        return coarse[i] * (1 - share) + coarse[i + 1] * share

    # Seams are cut into the coarse faces, so that no vertex lies outside their convex hull.
    along = np.sort([*stations, split, split + 0.02])
    rows = np.stack([between(u) for u in along])
    left, right = rows[:, 2:3], rows[:, 3:4]
    rings = np.concatenate(
        [rows[:, :3], left + (right - left) * 0.46, left + (right - left) * 0.54, rows[:, 3:]], axis=1
    )
    bands = np.broadcast_to(shell, (len(along) - 1, 8, 3)).copy()
    for i, u in enumerate((along[1:] + along[:-1]) / 2):
        if u > split + 0.02:
            bands[i, 1:6] = keys
            bands[i, 3] = seam
        elif u > split:
            bands[i, 0:7] = seam
    ridge = between(0.55)[2:4].mean(axis=0)
    tyre = shapes.lathe([(5.6, -3.2), (7.5, -1.8), (7.5, 1.8), (5.6, 3.2)], wheel, num=12)
    foot, rubber = shapes.ellipse(0.2 * width, 0.035 * length, 10, 3), colors.grey(0.8 if dark else 0.2)
    eye = colors.linear(np.array([0.95, 0.1, 0.1]))
    pieces = [
        shapes.loft(rings, bands, ends=(shell, keys), interior=True),
        shapes.move(tyre, (0, ridge[1], ridge[2] - 4.6), axis="x"),
        shapes.decal(foot, rubber, (0, -0.36 * length, 0), axis="-z"),
        shapes.decal(foot, rubber, (0, 0.38 * length, 0), axis="-z"),
        shapes.decal(shapes.circle(0.12 * width, 10), colors.BLACK, axis="-z"),
        shapes.decal(shapes.circle(0.05 * width, 8), eye, (0, 0, -shapes.PAINT), axis="-z"),
    ]
    if corded:
        t = np.linspace(0, 1, 5)
        path = np.stack([4 * t**2, length / 2 - 1 + 15 * t, 6 - 4 * t], axis=1)
        thin = shapes.circle(1.0, 6) * np.linspace(2.6, 1.8, 5)[:, None, None]
        pieces.append(shapes.loft(shapes.sweep(path, thin, (0, 0, 1)), colors.BLACK))
    return shapes.scaled([shapes.move(part, spin=np.pi) for part in pieces], longest)
