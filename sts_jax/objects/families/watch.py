"""Wrist watches laid out flat: a case with a dial, and a strap in two halves."""

import numpy as np

from sts_jax.objects import colors, shapes
from sts_jax.objects.assembly import STEEL
from sts_jax.objects.colors import Color
from sts_jax.objects.shapes import Part

STRAP = 2.2  # mm, thickness of the strap before the watch is scaled to its length


def parts(rng: np.random.Generator) -> list[Part]:
    """Return the parts (mm) of a random watch whose dial faces up, with twelve o'clock towards +y."""
    longest = rng.uniform(95, 130)  # mm, shorter than most real watches, to fit on the pad
    radius = rng.uniform(15, 20)  # mm, radius of the case
    thick = rng.uniform(7, 11)  # mm, thickness of the case
    band = radius * rng.uniform(0.9, 1.25)  # width of the strap at the case
    narrow = rng.uniform(0.7, 0.95)  # width of the strap's ends over `band`
    power = 2.0 if rng.uniform() < 0.7 else rng.uniform(3.0, 4.5)  # round, or nearly square for a third
    uneven = rng.uniform(0.45, 0.6)  # share of the strap's length in the half with holes
    metal = colors.steel(rng) if rng.uniform() < 0.6 else colors.hsv(0.115, 0.55, 0.83)
    links = rng.uniform() < 0.35  # a third of the watches have a bracelet of links
    strap = metal * 0.8 if links else _leather(rng)
    face = colors.WHITE if rng.uniform() < 0.5 else colors.dark(rng) if rng.uniform() < 0.5 else colors.vivid(rng) * 0.7

    pieces = [*_case(radius, thick, power, metal, face), *_dial(radius, thick - 0.9, face, metal, rng)]
    pieces += _crown_and_back(radius, thick, power, metal)
    for side, share in ((1, uneven), (-1, 1 - uneven)):
        # Each half runs from the case down to the table. The half towards +y ends in a tip, the other in the buckle.
        reach = (longest - 2 * radius) * share
        t = np.linspace(0, 1, 9)
        y = side * (radius * 0.86 + (reach + radius * 0.14) * t)
        z = 0.5 * STRAP + (0.42 * thick - 0.5 * STRAP) * np.clip(1 - 2.2 * t, 0, 1) ** 2
        width = band * (1 + (narrow - 1) * t)
        if side > 0:
            width[-1] *= 0.55
        section = np.array([[0.5, -0.5], [0.5, 0.5], [-0.5, 0.5], [-0.5, -0.5]])
        rings = [
            np.column_stack([section[:, 0] * width[i], np.full(4, y[i]), z[i] + section[:, 1] * STRAP])
            for i in range(len(t))
        ]
        shades = [strap * (0.6 if links and i % 2 else 1.0) for i in range(len(t) - 1)]
        pieces.append(shapes.loft(np.stack(rings), shades))
        if side > 0 and not links:
            pieces += _holes([radius + reach * along for along in (0.5, 0.62, 0.74, 0.86)])
        if side < 0:
            pieces += _buckle(band * narrow + 4, y[-1], metal)
    return shapes.scaled(pieces, longest)


def _leather(rng: np.random.Generator) -> Color:
    """Draw the colour of a strap: brown, vivid or dark."""
    if rng.uniform() < 0.4:
        return colors.hsv(0.07, 0.7, 0.4)
    return colors.vivid(rng) if rng.uniform() < 0.6 else colors.dark(rng)


def _case(radius: float, thick: float, power: float, metal: Color, face: Color) -> list[Part]:
    """Return the case with a recessed dial."""
    outline = shapes.ellipse(radius, radius, 16, power)
    rim, dial = thick, thick - 0.9
    levels = [(0.86, 0.0), (1.0, 0.35 * thick), (1.0, 0.7 * thick), (0.92, rim), (0.8, rim), (0.78, dial)]
    bands = [metal, metal, metal, metal * 0.7, metal * 0.4]
    rings = shapes.rings(outline, levels)
    return [shapes.loft(rings, bands, ends=(metal * 0.8, face), density=STEEL, interior=True)]


def _dial(radius: float, height: float, face: Color, metal: Color, rng: np.random.Generator) -> list[Part]:
    """Return the marks of the hours and two hands that show a random time, on the dial at a height (mm)."""
    ink = colors.BLACK if face.mean() > 0.3 else colors.WHITE
    marks = []
    for hour in range(12):
        wide, long = (1.3, 3.4) if hour % 3 == 0 else (0.8, 2.0)
        mark = shapes.rectangle(wide, long) + np.array([0, 0.74 * radius - long / 2 - 0.6])
        marks.append(shapes.decal(mark, ink, (0, 0, height), spin=hour * np.pi / 6))
    time = rng.uniform(0, 2 * np.pi)
    for reach, broad, turn in ((0.4, 1.9, time / 12 + rng.integers(12) * np.pi / 6), (0.62, 1.3, time)):
        hand = shapes.rectangle(broad, reach * radius + 2) + np.array([0, reach * radius / 2 - 1])
        marks.append(shapes.decal(hand, ink, (0, 0, height + shapes.PAINT), spin=turn))
    return [*marks, shapes.decal(shapes.circle(1.3, 8), metal * 0.6, (0, 0, height + 2 * shapes.PAINT))]


def _crown_and_back(radius: float, thick: float, power: float, metal: Color) -> list[Part]:
    """Return the crown at three o'clock, and the plate below the case."""
    crown = shapes.lathe([(1.6, 0), (1.6, 1.2), (2.3, 1.3), (2.3, 3.4)], metal * 0.8, num=10, ends=(None, metal))
    return [
        shapes.move(crown, (radius - 0.4, 0, 0.52 * thick), axis="x"),
        shapes.decal(shapes.ellipse(radius * 0.72, radius * 0.72, 16, power), metal * 0.5, axis="-z"),
        shapes.decal(shapes.circle(radius * 0.6, 16), metal * 0.9, (0, 0, -shapes.PAINT), axis="-z"),
    ]


def _holes(places: list[float]) -> list[Part]:
    """Return holes of the strap at several y (mm), painted on both sides."""
    spot = shapes.circle(1.0, 8)
    return [
        shapes.decal(spot, colors.BLACK, (0, y, height), axis=axis)
        for y in places
        for axis, height in (("z", STRAP), ("-z", 0))
    ]


def _buckle(width: float, end: float, metal: Color) -> list[Part]:
    """Return the buckle, a frame of three bars and a pin around the strap's end at y = `end` (mm)."""
    bars = (
        ((width, 1.8, STRAP), (0, end - 5.0, STRAP / 2)),
        ((1.8, 7.0, STRAP), (width / 2 - 0.9, end - 2.0, STRAP / 2)),
        ((1.8, 7.0, STRAP), (0.9 - width / 2, end - 2.0, STRAP / 2)),
        ((1.2, 6.0, 1.2), (0, end - 2.0, STRAP - 0.6)),
    )
    return [shapes.box(size, centre, metal) for size, centre in bars]
