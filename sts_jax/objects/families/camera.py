"""Cameras: a housing with a lens in front, a viewfinder on top, a grip, knobs and a screen."""

from typing import NamedTuple

import numpy as np

from sts_jax.objects import colors, shapes
from sts_jax.objects.colors import Color
from sts_jax.objects.shapes import Part


class _Size(NamedTuple):
    """Dimensions (mm) of the housing and the viewfinder before the camera is scaled to its final length."""

    width: float
    height: float
    depth: float
    hump: float  # height of the viewfinder above the housing
    side: float  # x of the centres of lens and viewfinder


def parts(rng: np.random.Generator) -> list[Part]:
    """Return the parts (mm) of a random camera whose lens faces -y."""
    longest = rng.uniform(70, 120)  # mm
    width = 100.0
    height = width * rng.uniform(0.55, 0.72)  # height of the housing
    depth = width * rng.uniform(0.26, 0.4)
    radius = height * rng.uniform(0.3, 0.4)  # radius of the lens
    length = width * rng.uniform(0.16, 0.5)  # length of the lens
    hump = height * rng.uniform(0.14, 0.26)  # height of the viewfinder
    side = width * rng.uniform(-0.02, 0.1)  # offset of the lens and the viewfinder
    corner = depth * rng.uniform(0.14, 0.3)
    size = _Size(width, height, depth, hump, side)

    retro = rng.uniform() < 0.5
    leather = rng.uniform() < 0.6
    skin = colors.dark(rng) if leather else colors.hsv(rng.uniform(0, 1), rng.uniform(0.5, 0.8), rng.uniform(0.3, 0.6))
    plate = colors.steel(rng) if retro else skin * 0.8 + 0.02
    barrel, ring = colors.dark(rng), colors.vivid(rng) if rng.uniform() < 0.5 else colors.steel(rng)

    front = -depth / 2
    outline = shapes.rectangle(width, depth, corner)
    levels = [(1.0, 0.0), (1.0, 0.1 * height), (1.0, 0.76 * height), (1.0, height)]
    housing = shapes.loft(shapes.rings(outline, levels), [plate, skin, plate], interior=True)
    lens = shapes.move(_lens(radius, length, 14, barrel, ring), (side, front, height * 0.46), axis="-y")
    # The grip is a ridge for the hand, on the left when seen from the front.
    ridge = shapes.rectangle(width * 0.13, depth * 0.34, depth * 0.1)
    grip = shapes.loft(
        shapes.rings(ridge, [(0.85, 0.03 * height), (1.0, 0.2 * height), (0.9, 0.74 * height)]), skin * 0.7
    )
    grip = shapes.move(grip, (-width * 0.4 + corner * 0.3, front + depth * 0.06, 0))
    everything = [housing, lens, *_viewfinder(size, plate), grip, *_controls(size, plate, rng)]
    return shapes.scaled(everything, longest)


def _lens(radius: float, length: float, num: int, barrel: Color, ring: Color) -> Part:
    """Return a lens barrel with rings and recessed glass, from z = 0 to z = `length`."""
    profile = [
        (radius * 0.96, 0),
        (radius * 0.96, length * 0.35),
        (radius, length * 0.36),
        (radius, length * 0.62),
        (radius, length * 0.72),
        (radius, length),
        (radius * 0.84, length),
        (radius * 0.66, length - min(0.3 * length, 0.25 * radius)),
        (radius * 0.3, length - min(0.3 * length, 0.25 * radius) + 0.02 * radius),
    ]
    bands = [barrel, barrel, barrel, ring, barrel, barrel, colors.BLACK, colors.GLASS]
    return shapes.lathe(profile, bands, num=num, ends=(None, colors.GLINT))


def _viewfinder(size: _Size, plate: Color) -> list[Part]:
    """Return the viewfinder's hump with a flash on its front, and a window beside it."""
    width, height, depth, hump, side = size
    front = -depth / 2
    lean = front * 0.7 * 0.95
    prism = shapes.rectangle(width * 0.32, depth * 0.7, 0.0)
    top = prism * [0.62, 0.9]
    rings = np.stack([np.column_stack([prism, np.full(4, height)]), np.column_stack([top, np.full(4, height + hump)])])
    roof = shapes.loft(rings, plate, ends=(None, plate))
    flash = shapes.rectangle(width * 0.15, hump * 0.5)
    window = shapes.rectangle(width * 0.1, height * 0.1)
    return [
        shapes.move(roof, (side, 0, 0)),
        shapes.box((width * 0.16, 0.8, hump * 0.55), (side, lean, height + hump * 0.5), colors.WHITE),
        shapes.decal(flash, colors.GLINT, (side, lean - 0.4, height + hump * 0.5), axis="-y"),
        shapes.decal(window, colors.GLINT, (width * 0.33, front, height * 0.88), axis="-y"),
    ]


def _controls(size: _Size, plate: Color, rng: np.random.Generator) -> list[Part]:
    """Return button and dial on top, screen and eyepiece on the back, tripod socket and battery lid at the bottom."""
    width, height, depth, hump, side = size
    back = depth / 2
    red = colors.linear(np.array([0.8, 0.1, 0.1])) if rng.uniform() < 0.6 else colors.steel(rng)
    knob, socket = colors.steel(rng), colors.steel(rng)
    button = shapes.lathe([(5.5, 0), (5.5, 1.6), (3.6, 1.7), (3.6, 3.2)], [knob, knob, red], num=12, ends=(None, red))
    dial = shapes.lathe([(8, 0), (8, 3.5)], plate * 0.5, num=12, ends=(None, colors.BLACK))
    frame = shapes.rectangle(width * 0.52, height * 0.62)
    screen = shapes.rectangle(width * 0.46, height * 0.54)
    eyepiece = shapes.rectangle(width * 0.16, hump * 0.5)
    lid = shapes.rectangle(width * 0.2, depth * 0.5)
    return [
        shapes.move(button, (-width * 0.36, 0, height)),
        shapes.move(dial, (width * 0.36, 0, height)),
        shapes.decal(frame, colors.BLACK, (-width * 0.04, back, height * 0.42), axis="y"),
        shapes.decal(screen, colors.GLASS, (-width * 0.04, shapes.PAINT + back, height * 0.42), axis="y"),
        shapes.decal(eyepiece, colors.BLACK, (side, depth * 0.345, height + hump * 0.4), axis="y"),
        shapes.decal(shapes.circle(7, 12), socket, (side, 0, 0), axis="-z"),
        shapes.decal(shapes.circle(4, 12), colors.BLACK, (side, 0, -shapes.PAINT), axis="-z"),
        shapes.decal(lid, plate * 0.6, (-width * 0.33, 0, 0), axis="-z"),
    ]
