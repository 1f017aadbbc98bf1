"""Bottles with a label and a cap. The shape is straight, is tapered or has a thin neck."""

import numpy as np

from sts_jax.objects import colors, shapes
from sts_jax.objects.shapes import Part


def parts(rng: np.random.Generator) -> list[Part]:
    """Return the parts (mm) of a random bottle that stands upright, with a label and a cap."""
    radius = rng.uniform(11, 20)  # mm, radius of the base
    height = rng.uniform(80, 120)  # mm, with the cap
    style = rng.integers(3)  # straight, with a neck or tapered: a third each
    taper = rng.uniform(0.75, 1.3) if style == 2 else 1.0  # radius of the shoulder over radius of the base
    cap_height = height * rng.uniform(0.1, 0.2)
    neck = rng.uniform(0.32, 0.48) if style == 1 else rng.uniform(0.5, 0.8)
    slope = rng.uniform(0.22, 0.38) if style == 1 else rng.uniform(0.04, 0.14)  # shoulder over total height
    label = np.sort([rng.uniform(0.08, 0.3), rng.uniform(0.6, 0.92)])  # lower and upper end over height of the wall

    body, cap, paper, mark = colors.vivid(rng), colors.vivid(rng), colors.pale(rng), colors.vivid(rng)
    if rng.uniform() < 0.5:  # half of the bottles have a dark or white cap
        cap = colors.dark(rng) if rng.uniform() < 0.5 else colors.WHITE
    if rng.uniform() < 0.3:  # three of ten are pale with a vivid label
        body, paper, mark = colors.pale(rng), colors.vivid(rng), colors.WHITE

    top = radius * taper
    collar = height - cap_height
    shoulder = collar - height * slope

    def wall(share: float) -> tuple[float, float]:
        return radius + (top - radius) * share, shoulder * share

    middle, band = label.mean(), np.diff(label)[0]
    shares = [0.0, label[0], middle - 0.2 * band, middle + 0.2 * band, label[1], 1.0]
    cap_radius = max(top * neck, 6.0)
    profile = [
        (radius * 0.62, 1.2),
        (radius * 0.78, 0.0),
        *(wall(share) for share in shares),
        (top * 0.45 + cap_radius * 0.5, shoulder + 0.62 * (collar - shoulder)),
        (cap_radius * 0.88, collar),
        (cap_radius * 0.88, collar + 0.5),
    ]
    stripe = np.broadcast_to(paper, (16, 3)).copy()
    stripe[[0, 1, 2, 8, 9, 10]] = mark
    plain = [np.broadcast_to(color, (16, 3)) for color in (body, paper)]
    bands = [plain[0], plain[0], plain[0], plain[1], stripe, plain[1], *[plain[0]] * 4]
    ridged = np.repeat([cap, cap * 0.75], 8, axis=0).reshape(2, 8, 3).transpose(1, 0, 2).reshape(16, 3)
    return [
        shapes.lathe(profile, bands, interior=True),
        shapes.lathe(
            [(cap_radius, collar + 0.3), (cap_radius, height - 0.05 * cap_height), (cap_radius * 0.9, height)],
            [ridged, np.broadcast_to(cap, (16, 3))],
            ends=(cap, cap),
        ),
    ]
