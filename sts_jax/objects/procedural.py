"""Eight families of everyday objects, generated from a key by lofting sections into painted parts.

The geometry is built on the host in millimetres and returned in metres. An object collides as the convex hull of its
drawn vertices. Colours are chosen in sRGB and stored in linear light. A part may be open where it joins another. Marks
(`_decal`) are paint, raised by 0.04 mm and without mass.

The function of a family returns its parts. Its comments give the ranges that it draws from, where U(a, b) is uniform.
An object with a front (lens, keys) faces -y.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import PRNGKeyArray
from scipy.interpolate import PchipInterpolator

from sts_jax._keys import check_key
from sts_jax.objects.body import CATEGORIES, Body
from sts_jax.objects.solids import CONTENTS, WALL, assemble, linear

STEEL = 5.9  # kg/m^2 of each face: stainless steel, 7,900 kg/m^3 (EN 10088-1, grade 1.4301) x 1.5 mm, on two faces
SHEET = 1.5  # mm, thickness of cutlery
PAINT = 0.04  # mm, height of a painted mark, so that it is drawn in front of the surface below it

Number = float | int
Color = np.ndarray
Painted = Color | Sequence[Color]


class Part(NamedTuple):
    """One closed or open surface with the colour of each face."""

    vertices: np.ndarray  # (v, 3) mm
    faces: np.ndarray  # (f, 3)
    colors: np.ndarray  # (f, 3) linear light
    density: float  # kg/m^2
    interior: bool  # whether the part bounds the contents


def make(key: PRNGKeyArray, category: str) -> Body:
    """Generate an object of a category. Equal keys give equal objects.

    Args:
        key: from `jax.random.key`, consumed by the call.
        category: one of CATEGORIES.

    Returns:
        A body of the smallest face class, with a longest side of 50 to 130 mm and +z up as it usually stands or lies.

    Raises:
        TypeError: `key` is not a JAX key.
        ValueError: `category` is unknown.
    """
    check_key(key)
    if category not in CATEGORIES:
        raise ValueError(f"category is {category!r}, but it must be one of {', '.join(CATEGORIES)}")
    seed = np.asarray(jax.random.key_data(key)).ravel()
    rng = np.random.default_rng([*(int(word) for word in seed), CATEGORIES.index(category)])
    parts = _FAMILIES[category](rng)

    first = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = np.concatenate([part.vertices for part in parts]) * 1e-3
    faces = np.concatenate([part.faces + offset for part, offset in zip(parts, first[:-1], strict=True)])
    colors = np.concatenate([part.colors for part in parts])
    density = np.concatenate([np.full(len(part.faces), part.density) for part in parts])
    inner = [part for part in parts if part.interior]
    interior = (inner[0].vertices * 1e-3, inner[0].faces) if inner else None
    return assemble(
        vertices,
        faces,
        np.repeat(colors[:, None], 3, axis=1),
        density=density,
        interior=interior,
        contents_density=CONTENTS if inner else 0.0,
        category=CATEGORIES.index(category),
    )


# Sections and parts.


def _circle(radius: Number, num: int) -> np.ndarray:
    angle = 2 * np.pi * (np.arange(num) + 0.5) / num
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _ellipse(a: Number, b: Number, num: int, power: Number = 2.0) -> np.ndarray:
    angle = 2 * np.pi * (np.arange(num) + 0.5) / num
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([a * np.sign(c) * np.abs(c) ** (2 / power), b * np.sign(s) * np.abs(s) ** (2 / power)], axis=1)


def _rectangle(width: Number, depth: Number, chamfer: Number = 0.0) -> np.ndarray:
    w, d, c = width / 2, depth / 2, chamfer
    if c == 0:
        return np.array([[w, -d], [w, d], [-w, d], [-w, -d]])
    return np.array(
        [[w, c - d], [w, d - c], [w - c, d], [c - w, d], [-w, d - c], [-w, c - d], [c - w, -d], [w - c, -d]]
    )


def _rings(outline: np.ndarray, levels: Sequence[tuple[Number, Number]]) -> np.ndarray:
    """Rings with an outline in x, y at each (scale, z)."""
    return np.stack([np.column_stack([outline * scale, np.full(len(outline), z)]) for scale, z in levels])


def _volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = np.moveaxis(vertices[faces] - vertices.mean(axis=0), 1, 0)
    return float(np.einsum("fi,fi->", a, np.cross(b, c)))


def _loft(
    rings: np.ndarray,
    color: Painted,
    *,
    ends: tuple[Color | None, Color | None] | None = None,
    closed: bool = False,
    density: Number = WALL,
    interior: bool = False,
) -> Part:
    """A surface through rings (k, n, 3), with one colour, one per band or n per band. An end of None stays open."""
    k, n = rings.shape[:2]
    bands = k if closed else k - 1
    i, j = np.meshgrid(np.arange(bands), np.arange(n), indexing="ij")
    a, b = i * n + j, i * n + (j + 1) % n
    c, d = (i + 1) % k * n + (j + 1) % n, (i + 1) % k * n + j
    sides = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], axis=2).reshape(-1, 3)
    paint = np.asarray(color, float)
    if paint.ndim == 2:
        paint = paint[:, None]
    paint = np.repeat(np.broadcast_to(paint, (bands, n, 3)).reshape(-1, 3), 2, axis=0)

    vertices, faces, colors, keep = [rings.reshape(-1, 3)], [sides], [paint], [np.ones(len(sides), bool)]
    base = paint[0], paint[-1]
    for end in (0, 1) if not closed else ():
        shown = base[end] if ends is None else ends[end]
        ring = np.arange(n) + (k - 1) * n * end
        turned = np.roll(ring, -1)
        centre = np.full(n, k * n + len(vertices) - 1)
        faces.append(np.stack([centre, ring, turned] if end else [centre, turned, ring], axis=1))
        vertices.append(rings[-end].mean(axis=0)[None])
        colors.append(np.broadcast_to(np.zeros(3) if shown is None else shown, (n, 3)))
        keep.append(np.full(n, shown is not None))
    points, whole = np.concatenate(vertices), np.concatenate(faces)
    if _volume(points, whole) < 0:
        whole = whole[:, ::-1]
    kept = np.concatenate(keep)
    faces_kept = whole[kept]
    used, renumbered = np.unique(faces_kept, return_inverse=True)
    return Part(points[used], renumbered.reshape(faces_kept.shape), np.concatenate(colors)[kept], density, interior)


def _lathe(profile: Sequence[tuple[Number, Number]], color: Painted, *, num: int = 16, **kind: object) -> Part:
    """A surface of revolution about z through (radius, z)."""
    return _loft(_rings(_circle(1.0, num), profile), color, **kind)  # type: ignore[arg-type]


def _box(size: Sequence[Number], centre: Sequence[Number], color: Color) -> Part:
    x, y, z = size
    return _move(_loft(_rings(_rectangle(x, y), [(1.0, -z / 2), (1.0, z / 2)]), color), centre)


def _decal(outline: np.ndarray, color: Color) -> Part:
    """A painted mark in the plane z = PAINT, facing +z. `outline` is counter-clockwise about its middle."""
    n = len(outline)
    points = np.column_stack([np.vstack([outline, outline.mean(axis=0)]), np.full(n + 1, PAINT)])
    faces = np.stack([np.full(n, n), np.arange(n), (np.arange(n) + 1) % n], axis=1)
    return Part(points, faces, np.broadcast_to(color, (n, 3)), 0.0, False)


_TURNS = {
    "z": np.eye(3),
    "-z": np.diag([1.0, -1.0, -1.0]),
    "x": np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
    "-x": np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]),
    "y": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "-y": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
}


def _spin(angle: Number) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def _move(part: Part, shift: Sequence[Number] = (0, 0, 0), *, axis: str = "z", spin: Number = 0.0) -> Part:
    """Turn a part by `spin` about z, then turn its z axis to `axis`, then shift it."""
    return part._replace(vertices=part.vertices @ (_TURNS[axis] @ _spin(spin)).T + np.asarray(shift, float))


def _mirror(part: Part, axis: int = 0) -> Part:
    flip = np.ones(3)
    flip[axis] = -1
    return part._replace(vertices=part.vertices * flip, faces=part.faces[:, ::-1])


def _sweep(path: np.ndarray, section: np.ndarray, binormal: Sequence[Number], *, closed: bool = False) -> np.ndarray:
    """Rings of a section (n, 2) or (k, n, 2) along a path (k, 3): first axis outwards, second along the binormal."""
    ahead = np.roll(path, -1, 0) - np.roll(path, 1, 0)
    if not closed:
        ahead[0], ahead[-1] = path[1] - path[0], path[-1] - path[-2]
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    out = np.cross(ahead, np.asarray(binormal, float))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    section = np.broadcast_to(section, (len(path), *section.shape[-2:]))
    return (
        path[:, None] + section[:, :, :1] * out[:, None] + section[:, :, 1:] * np.asarray(binormal, float)[None, None]
    )


def _scaled(parts: list[Part], longest: Number) -> list[Part]:
    points = np.concatenate([part.vertices for part in parts])
    scale = longest / np.ptp(points, axis=0).max()
    return [part._replace(vertices=part.vertices * scale) for part in parts]


# Colours, from sRGB.


def _hsv(hue: Number, saturation: Number, value: Number) -> Color:
    wheel = np.clip(np.abs((hue * 6 + np.array([0.0, 4.0, 2.0])) % 6 - 3) - 1, 0, 1)
    return linear(value * (1 - saturation * (1 - wheel)))


def _grey(value: Number) -> Color:
    return linear(np.full(3, float(value)))


def _vivid(rng: np.random.Generator) -> Color:
    return _hsv(rng.uniform(), rng.uniform(0.65, 0.95), rng.uniform(0.6, 0.95))


def _pale(rng: np.random.Generator) -> Color:
    return _hsv(rng.uniform(), rng.uniform(0.0, 0.25), rng.uniform(0.8, 0.97))


def _dark(rng: np.random.Generator) -> Color:
    return _hsv(rng.uniform(), rng.uniform(0.0, 0.25), rng.uniform(0.12, 0.24))


def _steel(rng: np.random.Generator) -> Color:
    return _hsv(0.58, rng.uniform(0.0, 0.1), rng.uniform(0.58, 0.8))


_BLACK = _grey(0.1)
_WHITE = _grey(0.96)
_GLASS = linear(np.array([0.09, 0.13, 0.32]))
_GLINT = linear(np.array([0.75, 0.85, 1.0]))


def _lens(radius: Number, length: Number, num: int, barrel: Color, ring: Color) -> Part:
    """A lens barrel along +z from z = 0, with rings and recessed glass."""
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
    colors = [barrel, barrel, barrel, ring, barrel, barrel, _BLACK, _GLASS]
    return _lathe(profile, colors, num=num, ends=(None, _GLINT))


# The families.


def _bottle(rng: np.random.Generator) -> list[Part]:
    radius = rng.uniform(11, 20)  # mm, base radius: U(11, 20)
    height = rng.uniform(80, 120)  # mm, with the cap: U(80, 120)
    style = rng.integers(3)  # straight, necked, tapered: a third each
    taper = rng.uniform(0.75, 1.3) if style == 2 else 1.0  # shoulder's radius over the base's: U(.75, 1.3)
    cap_height = height * rng.uniform(0.1, 0.2)  # U(.1, .2)
    neck = rng.uniform(0.32, 0.48) if style == 1 else rng.uniform(0.5, 0.8)  # U(.32, .48), others U(.5, .8)
    slope = rng.uniform(0.22, 0.38) if style == 1 else rng.uniform(0.04, 0.14)  # shoulder: U(.22, .38), U(.04, .14)
    label = np.sort([rng.uniform(0.08, 0.3), rng.uniform(0.6, 0.92)])  # over straight height: U(.08, .3), U(.6, .92)

    body, cap, paper, mark = _vivid(rng), _vivid(rng), _pale(rng), _vivid(rng)
    if rng.uniform() < 0.5:  # half have a dark or white cap
        cap = _dark(rng) if rng.uniform() < 0.5 else _WHITE
    if rng.uniform() < 0.3:  # some are pale with a vivid label
        body, paper, mark = _pale(rng), _vivid(rng), _WHITE

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
        _lathe(profile, bands, interior=True),
        _lathe(
            [(cap_radius, collar + 0.3), (cap_radius, height - 0.05 * cap_height), (cap_radius * 0.9, height)],
            [ridged, np.broadcast_to(cap, (16, 3))],
            ends=(cap, cap),
        ),
    ]


def _camera(rng: np.random.Generator) -> list[Part]:
    longest = rng.uniform(70, 120)  # mm: U(70, 120)
    width = 100.0
    height = width * rng.uniform(0.55, 0.72)  # body's height over width: U(.55, .72)
    depth = width * rng.uniform(0.26, 0.4)  # U(.26, .4)
    radius = height * rng.uniform(0.3, 0.4)  # lens over height: U(.3, .4)
    length = width * rng.uniform(0.16, 0.5)  # U(.16, .5)
    hump = height * rng.uniform(0.14, 0.26)  # viewfinder: U(.14, .26)
    side = width * rng.uniform(-0.02, 0.1)  # offset of the lens over width: U(-.02, .1)
    corner = depth * rng.uniform(0.14, 0.3)  # U(.14, .3)

    retro = rng.uniform() < 0.5
    skin = _dark(rng) if rng.uniform() < 0.6 else _hsv(rng.uniform(0, 1), rng.uniform(0.5, 0.8), rng.uniform(0.3, 0.6))
    plate = _steel(rng) if retro else skin * 0.8 + 0.02
    barrel, ring = _dark(rng), _vivid(rng) if rng.uniform() < 0.5 else _steel(rng)

    front = -depth / 2
    lens_z = height * 0.46
    outline = _rectangle(width, depth, corner)
    levels = [(1.0, 0.0), (1.0, 0.1 * height), (1.0, 0.76 * height), (1.0, height)]
    prism = _rectangle(width * 0.32, depth * 0.7, 0.0)
    roof = _loft(
        np.stack(
            [
                np.column_stack([prism, np.full(4, height)]),
                np.column_stack([prism * [0.62, 0.9], np.full(4, height + hump)]),
            ]
        ),
        plate,
        ends=(None, plate),
    )
    parts = [
        _loft(_rings(outline, levels), [plate, skin, plate], interior=True),
        _move(_lens(radius, length, 14, barrel, ring), (side, front, lens_z), axis="-y"),
        _move(roof, (side, 0, 0)),
    ]
    # Flash on the front of the hump, and a finder window beside it.
    flash = _rectangle(width * 0.15, hump * 0.5)
    lean = front * 0.7 * 0.95
    parts.append(_move(_box((width * 0.16, 0.8, hump * 0.55), (0, 0, 0), _WHITE), (side, lean, height + hump * 0.5)))
    parts.append(_move(_decal(flash, _GLINT), (side, lean - 0.4, height + hump * 0.5), axis="-y"))
    window = _rectangle(width * 0.1, height * 0.1)
    parts.append(_move(_decal(window, _GLINT), (width * 0.33, front, height * 0.88), axis="-y"))
    # Grip: a ridge for the hand, on the left in the front view.
    grip = _rectangle(width * 0.13, depth * 0.34, depth * 0.1)
    parts.append(
        _move(
            _loft(_rings(grip, [(0.85, 0.03 * height), (1.0, 0.2 * height), (0.9, 0.74 * height)]), skin * 0.7),
            (-width * 0.4 + corner * 0.3, front + depth * 0.06, 0),
        )
    )
    # Shutter button, dial, screen, eyepiece, tripod socket.
    red = linear(np.array([0.8, 0.1, 0.1])) if rng.uniform() < 0.6 else _steel(rng)
    knob = _steel(rng)
    parts += [
        _move(
            _lathe([(5.5, 0), (5.5, 1.6), (3.6, 1.7), (3.6, 3.2)], [knob, knob, red], num=12, ends=(None, red)),
            (-width * 0.36, 0, height),
        ),
        _move(_lathe([(8, 0), (8, 3.5)], plate * 0.5, num=12, ends=(None, _BLACK)), (width * 0.36, 0, height)),
        _move(
            _decal(_rectangle(width * 0.52, height * 0.62), _BLACK), (-width * 0.04, -front, height * 0.42), axis="y"
        ),
        _move(
            _decal(_rectangle(width * 0.46, height * 0.54), _GLASS),
            (-width * 0.04, PAINT - front, height * 0.42),
            axis="y",
        ),
        _move(
            _decal(_rectangle(width * 0.16, hump * 0.5), _BLACK), (side, depth * 0.345, height + hump * 0.4), axis="y"
        ),
        _move(_decal(_circle(7, 12), _steel(rng)), (side, 0, 0), axis="-z"),
        _move(_decal(_circle(4, 12), _BLACK), (side, 0, -PAINT), axis="-z"),
        _move(_decal(_rectangle(width * 0.2, depth * 0.5), plate * 0.6), (-width * 0.33, 0, 0), axis="-z"),
    ]
    return _scaled(parts, longest)


def _webcam(rng: np.random.Generator) -> list[Part]:
    longest = rng.uniform(55, 90)  # mm: U(55, 90)
    ball = rng.uniform() < 0.5  # half have a ball as the head, half a bar
    head = rng.uniform(13, 18)  # mm, half the head's height: U(13, 18)
    stretch = rng.uniform(2.1, 3.2)  # a bar's half width over its half height: U(2.1, 3.2)
    neck = head * rng.uniform(0.4, 1.2)  # U(.4, 1.2)
    foot = head * rng.uniform(1.1, 1.7)  # half the foot's width: U(1.1, 1.7)
    foot_depth = rng.uniform(0.7, 1.0)  # its depth over its width: U(.7, 1)
    eye = head * rng.uniform(0.5, 0.68)  # lens radius: U(.5, .68)
    shell = _dark(rng) if rng.uniform() < 0.4 else _pale(rng) if rng.uniform() < 0.5 else _vivid(rng)
    trim, base = _vivid(rng) if rng.uniform() < 0.5 else _steel(rng), _dark(rng)

    thick, shallow = 5.0, 2.5
    h = head if ball else 0.65 * head
    centre = thick + neck + 0.93 * h
    if ball:
        front, back = -0.74 * h, 0.8 * h
        profile = [(0.52 * h, -0.84 * h), (0.93 * h, -0.36 * h), (0.97 * h, 0.25 * h), (0.72 * h, 0.74 * h)]
        skull = _lathe(profile, shell, num=12, interior=True)
    else:
        front, back, eye = -0.5 * head, 0.45 * head, min(eye, 0.8 * h)
        outline = _ellipse(stretch * h, h, 12, 3.5)
        levels = [(0.9, -0.5 * head), (1.0, -0.25 * head), (0.95, 0.5 * head)]
        skull = _loft(_rings(outline, levels), shell, interior=True)
    glass = [(eye, 0.0), (eye, shallow), (0.82 * eye, shallow), (0.62 * eye, 1.0), (0.3 * eye, 1.2)]
    lens = _lathe(glass, [trim, trim, _BLACK, _GLASS], num=12, ends=(None, _GLINT))
    parts = [_move(skull, (0, 0, centre), axis="-y"), _move(lens, (0, front, centre), axis="-y")]
    if not ball:
        lamp = _decal(_circle(1.5, 8), linear(np.array([0.1, 0.9, 0.25])))
        parts.append(_move(lamp, (eye + 3.0, front, centre), axis="-y"))
        slot = _decal(_rectangle(0.5 * h, 0.16 * h), _GLINT * 0.3 if shell.mean() < 0.1 else _BLACK)
        for side in (-1, 1):  # microphones
            for row in (-1, 0, 1):
                parts.append(_move(slot, (side * 0.66 * stretch * h, front, centre + row * 0.36 * h), axis="-y"))
    # A round stalk on a flat foot, and the cable behind.
    stalk = [(4.4, thick), (3.4, thick + 0.5 * neck), (4.6, centre - 0.6 * h)]
    plate = _rings(_ellipse(foot, foot * foot_depth, 12, 2.6), [(1.0, 0.0), (0.84, thick)])
    t = np.linspace(0, 1, 7)
    path = np.stack([0 * t, back + 7 * np.sin(2.2 * t), centre - (centre - 2) * t**1.3], axis=1)
    return _scaled(
        [
            *parts,
            _lathe(stalk, base, num=10, ends=(None, None)),
            _loft(plate, base, ends=(base, base * 1.5)),
            _move(_decal(_circle(0.45 * foot, 12), base * 2.5 + 0.03), axis="-z"),
            _loft(_sweep(path, _circle(1.5, 6), (1, 0, 0)), _BLACK),
        ],
        longest,
    )


def _mouse(rng: np.random.Generator) -> list[Part]:
    longest = rng.uniform(60, 110)  # mm, with a cable's first centimetre: U(60, 110)
    length = 100.0
    width = length * rng.uniform(0.54, 0.7)  # U(.54, .7)
    height = length * rng.uniform(0.3, 0.42)  # U(.3, .42)
    peak = rng.uniform(-0.35, 0.05)  # position of the highest point, -1 (back) to 1 (front): U(-.35, .05)
    waist = rng.uniform(0.0, 0.12)  # U(0, .12)
    split = rng.uniform(0.0, 0.2)  # where the keys begin: U(0, .2)
    corded = rng.uniform() < 0.5

    shell = _dark(rng) if rng.uniform() < 0.4 else _pale(rng) if rng.uniform() < 0.6 else _vivid(rng)
    dark = shell.mean() < 0.15
    keys = shell if rng.uniform() < 0.4 else _grey(0.6) if dark else _dark(rng)
    seam = _grey(0.45) if keys.mean() < 0.08 else _grey(0.04)
    wheel = _vivid(rng) if rng.uniform() < 0.5 else _grey(0.7 if keys.mean() < 0.15 else 0.15)

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

    # Seams are cut into the coarse faces, so that no vertex leaves their hull.
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
    tyre = _lathe([(5.6, -3.2), (7.5, -1.8), (7.5, 1.8), (5.6, 3.2)], wheel, num=12)
    foot = _decal(_ellipse(0.2 * width, 0.035 * length, 10, 3), _grey(0.8 if dark else 0.2))
    eye = linear(np.array([0.95, 0.1, 0.1]))
    parts = [
        _loft(rings, bands, ends=(shell, keys), interior=True),
        _move(tyre, (0, ridge[1], ridge[2] - 4.6), axis="x"),
        _move(foot, (0, -0.36 * length, 0), axis="-z"),
        _move(foot, (0, 0.38 * length, 0), axis="-z"),
        _move(_decal(_circle(0.12 * width, 10), _BLACK), axis="-z"),
        _move(_decal(_circle(0.05 * width, 8), eye), (0, 0, -PAINT), axis="-z"),
    ]
    if corded:
        t = np.linspace(0, 1, 5)
        path = np.stack([4 * t**2, length / 2 - 1 + 15 * t, 6 - 4 * t], axis=1)
        thin = _circle(1.0, 6) * np.linspace(2.6, 1.8, 5)[:, None, None]
        parts.append(_loft(_sweep(path, thin, (0, 0, 1)), _BLACK))
    return _scaled([_move(part, spin=np.pi) for part in parts], longest)


def _scissors(rng: np.random.Generator) -> list[Part]:
    longest = rng.uniform(80, 130)  # mm: U(80, 130)
    blade = rng.uniform(42, 66)  # mm, pivot to tip: U(42, 66)
    half = np.radians(rng.uniform(12, 40)) / 2  # degrees between the blades: U(12, 40)
    broad = rng.uniform(7, 11)  # mm, blade's width at the pivot: U(7, 11)
    ring = rng.uniform(8.5, 12)  # mm, half the finger hole's width: U(8.5, 12)
    oval = rng.uniform(1.0, 1.6)  # its length over its width: U(1, 1.6)
    shank = rng.uniform(10, 20)  # mm, pivot to the ring: U(10, 20)
    tube = rng.uniform(2.2, 3.0)  # mm, half the ring's breadth: U(2.2, 3)
    deep = rng.uniform(2.6, 3.6)  # mm, half the ring's height: U(2.6, 3.6)
    steel = _steel(rng)
    grip = _vivid(rng) if rng.uniform() < 0.8 else _dark(rng)

    thick = 2.0
    outline = np.array([[-0.45, -6], [0.45, -6], [0.5, 0.35 * blade], [-0.28, blade], [-0.42, blade]])
    outline[:, 0] *= broad
    cutting = _loft(_rings(outline, [(1.0, 0.0), (1.0, thick)]), steel, density=STEEL)
    # The finger ring, with upright outer walls, and the shank that joins it to the blade.
    hole = _ellipse(ring, ring * oval, 12) @ _spin(-0.6 * half)[:2, :2].T
    hole += [-0.95 * (ring + tube), -(shank + ring * oval)]
    path = np.column_stack([hole, np.zeros(12)])
    wall = np.array([[tube, -0.75 * deep], [tube, 0.75 * deep], [0.2 * tube, deep], [-tube, 0.5 * deep]])
    wall = np.vstack([wall, [[-tube, -0.5 * deep], [0.2 * tube, -deep]]])
    hoop = _loft(_sweep(path, wall, (0, 0, 1), closed=True), grip, closed=True)
    route = np.linspace(0, 1, 4)[:, None] * path[np.argmax(path @ [0.3, 1.0, 0.0])]
    widths, heights = np.linspace(0.9 * broad, 2.4 * tube, 4), np.linspace(thick, 1.5 * deep, 4)
    slim = np.stack([_rectangle(w, h) for w, h in zip(widths, heights, strict=True)])
    shaft = _loft(_sweep(route, slim, (0, 0, 1)), [steel, grip, grip])
    right = [_move(part, spin=-half) for part in (cutting, hoop, shaft)]
    left = [_mirror(part) for part in right]
    left[0] = _move(left[0], (0, 0, -thick))
    screw = _lathe([(2.9, -thick - 0.5), (2.9, thick + 0.5)], _grey(0.35), num=10, density=0.0)
    return _scaled([*right, *left, screw], longest)


def _cutlery(rng: np.random.Generator, length: Number, end: Number, lift: Number) -> tuple[Part, Color, float]:
    """The handle from x = 0 on the table to x = `end` at height `lift`, its steel colour and the width of its neck."""
    arch = length * rng.uniform(0.015, 0.05)  # handle's rise over length: U(.015, .05)
    wide = length * rng.uniform(0.075, 0.12)  # its end's width: U(.075, .12)
    neck = length * rng.uniform(0.032, 0.045)  # its neck's width: U(.032, .045)
    steel = _steel(rng)
    coloured = rng.uniform() < 0.35  # a third have a coloured handle, thicker than the steel
    tint = _vivid(rng) if coloured else steel

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
    handle = _loft(rings, [*[tint] * 5, steel, steel], density=STEEL)
    return handle, steel, neck


def _fork(rng: np.random.Generator) -> list[Part]:
    longest = rng.uniform(90, 130)  # mm: U(90, 130)
    length = 125.0
    tines = int(rng.integers(3, 5))  # 3 or 4
    head = length * rng.uniform(0.15, 0.2)  # head's width: U(.15, .2)
    reach = length * rng.uniform(0.2, 0.28)  # tines' length: U(.2, .28)
    palm = length * rng.uniform(0.1, 0.15)  # neck to the roots of the tines: U(.1, .15)
    curl = length * rng.uniform(0.035, 0.07)  # how far the tips curl up: U(.035, .07)
    drop = length * rng.uniform(0.05, 0.09)  # how far the neck stands above the table: U(.05, .09)
    end = length - reach - palm
    handle, steel, neck = _cutlery(rng, length, end, drop)
    # The middle line: from the neck down to the table, then up to the tips.
    line = PchipInterpolator([end, end + 0.75 * palm, end + palm, length], [drop, 0.04 * drop, 0.0, curl])
    square = _rectangle(1.0, 1.0)

    def strip(x: np.ndarray, width: np.ndarray, depth: np.ndarray, y: float) -> Part:
        rings = [
            np.column_stack([np.full(4, s), y + square[:, 0] * w, line(s) + square[:, 1] * d])
            for s, w, d in zip(x, width, depth, strict=True)
        ]
        return _loft(np.stack(rings), steel, density=STEEL)

    width = np.array([neck, 0.35 * neck + 0.45 * head, 0.86 * head, 0.98 * head, head])
    parts = [handle, strip(end + palm * np.array([0.0, 0.2, 0.45, 0.75, 1.0]), width, np.full(5, SHEET), 0.0)]
    pitch = head / (tines - 0.42)
    along = end + palm - 1.0 + (reach + 1.0) * np.array([0.0, 0.3, 0.6, 0.85, 1.0])
    taper = np.array([1.0, 0.92, 0.85, 0.7, 0.3])
    for index in range(tines):
        y = (index - (tines - 1) / 2) * pitch
        parts.append(strip(along, 0.58 * pitch * taper, SHEET * (0.4 + 0.6 * taper), y))
    return _scaled(parts, longest)


def _spoon(rng: np.random.Generator) -> list[Part]:
    longest = rng.uniform(90, 130)  # mm: U(90, 130)
    length = 125.0
    bowl = length * rng.uniform(0.29, 0.38)  # bowl's length: U(.29, .38)
    width = bowl * rng.uniform(0.62, 0.82)  # its width over its length: U(.62, .82)
    sunk = rng.uniform(0.2, 0.32)  # its depth over its width: U(.2, .32)
    egg = rng.uniform(0.05, 0.22)  # how much narrower towards the tip: U(.05, .22)
    depth = sunk * width
    rim = depth + SHEET / 2  # so that bowl and handle touch the table
    handle, steel, _ = _cutlery(rng, length, length - bowl + 2.0, rim)
    c, s = _circle(1.0, 14).T

    def ring(share: float, sink: float) -> np.ndarray:
        x = length - bowl / 2 + share * bowl / 2 * c
        return np.column_stack([x, share * width / 2 * s * (1 - egg * c), np.full(14, rim - sink)])

    outside = [(0.16, depth + SHEET), (0.53, 0.8 * depth + SHEET), (0.86, 0.38 * depth + 0.7 * SHEET)]
    inside = [(1.0, 0.0), (0.82, 0.4 * depth), (0.5, 0.8 * depth), (0.18, depth)]
    rings = np.stack([ring(*level) for level in (*outside, *inside)])
    return _scaled([handle, _loft(rings, [*[steel] * 3, *[0.75 * steel] * 3], density=STEEL)], longest)


def _watch(rng: np.random.Generator) -> list[Part]:
    longest = rng.uniform(95, 130)  # mm: U(95, 130), a lady's or child's watch laid out flat
    radius = rng.uniform(15, 20)  # mm, of the case: U(15, 20)
    thick = rng.uniform(7, 11)  # U(7, 11)
    band = radius * rng.uniform(0.9, 1.25)  # strap's width: U(.9, 1.25)
    narrow = rng.uniform(0.7, 0.95)  # its end's width over that: U(.7, .95)
    power = 2.0 if rng.uniform() < 0.7 else rng.uniform(3.0, 4.5)  # round, or squarish for a third: U(3, 4.5)
    uneven = rng.uniform(0.45, 0.6)  # share of the strap half with holes: U(.45, .6)
    metal = _steel(rng) if rng.uniform() < 0.6 else _hsv(0.115, 0.55, 0.83)
    links = rng.uniform() < 0.35  # a third have a bracelet of links
    strap = (
        metal * 0.8
        if links
        else (_hsv(0.07, 0.7, 0.4) if rng.uniform() < 0.4 else _vivid(rng) if rng.uniform() < 0.6 else _dark(rng))
    )
    face = _WHITE if rng.uniform() < 0.5 else _dark(rng) if rng.uniform() < 0.5 else _vivid(rng) * 0.7
    ink = _BLACK if face.mean() > 0.3 else _WHITE

    outline = _ellipse(radius, radius, 16, power)
    rim, dial = thick, thick - 0.9
    levels = [(0.86, 0.0), (1.0, 0.35 * thick), (1.0, 0.7 * thick), (0.92, rim), (0.8, rim), (0.78, dial)]
    parts = [
        _loft(
            _rings(outline, levels),
            [metal, metal, metal, metal * 0.7, metal * 0.4],
            ends=(metal * 0.8, face),
            density=STEEL,
            interior=True,
        )
    ]
    for hour in range(12):
        long = 3.4 if hour % 3 == 0 else 2.0
        mark = _decal(
            _rectangle(1.3 if hour % 3 == 0 else 0.8, long) + np.array([0, 0.74 * radius - long / 2 - 0.6]), ink
        )
        parts.append(_move(mark, (0, 0, dial), spin=hour * np.pi / 6))
    time = rng.uniform(0, 2 * np.pi)
    for reach, broad, turn in ((0.4, 1.9, time / 12 + rng.integers(12) * np.pi / 6), (0.62, 1.3, time)):
        hand = _rectangle(broad, reach * radius + 2) + np.array([0, reach * radius / 2 - 1])
        parts.append(_move(_decal(hand, ink), (0, 0, dial + PAINT), spin=turn))
    parts.append(_move(_decal(_circle(1.3, 8), metal * 0.6), (0, 0, dial + 2 * PAINT)))
    # Crown at three o'clock, back plate.
    crown = _lathe([(1.6, 0), (1.6, 1.2), (2.3, 1.3), (2.3, 3.4)], metal * 0.8, num=10, ends=(None, metal))
    parts.append(_move(crown, (radius - 0.4, 0, 0.52 * thick), axis="x"))
    parts.append(_move(_decal(_ellipse(radius * 0.72, radius * 0.72, 16, power), metal * 0.5), (0, 0, 0), axis="-z"))
    parts.append(_move(_decal(_circle(radius * 0.6, 16), metal * 0.9), (0, 0, -PAINT), axis="-z"))
    # Strap: from the lugs down to the table, one half with holes, the other with a buckle.
    total = longest - 2 * radius
    section = np.array([[0.5, -0.5], [0.5, 0.5], [-0.5, 0.5], [-0.5, -0.5]])
    tall = 2.2
    for side, share in ((1, uneven), (-1, 1 - uneven)):
        reach = total * share
        count = 9
        t = np.linspace(0, 1, count)
        y = side * (radius * 0.86 + (reach + radius * 0.14) * t)
        z = 0.5 * tall + (0.42 * thick - 0.5 * tall) * np.clip(1 - 2.2 * t, 0, 1) ** 2
        w = band * (1 + (narrow - 1) * t)
        if side > 0:
            w[-1] *= 0.55
        rings = np.stack(
            [
                np.column_stack([section[:, 0] * w[i], np.full(4, y[i]), z[i] + section[:, 1] * tall])
                for i in range(count)
            ]
        )
        shades = [strap * (0.6 if links and i % 2 else 1.0) for i in range(count - 1)]
        parts.append(_loft(rings, shades))
        if side > 0 and not links:
            for hole in (0.5, 0.62, 0.74, 0.86):
                spot = _decal(_circle(1.0, 8), _BLACK)
                parts.append(_move(spot, (0, side * (radius + reach * hole), tall)))
                parts.append(_move(spot, (0, side * (radius + reach * hole), 0), axis="-z"))
        if side < 0:
            wide = band * narrow + 4
            bar = y[-1]
            for size, centre in (
                ((wide, 1.8, tall), (0, bar - 5.0, tall / 2)),
                ((1.8, 7.0, tall), (wide / 2 - 0.9, bar - 2.0, tall / 2)),
                ((1.8, 7.0, tall), (0.9 - wide / 2, bar - 2.0, tall / 2)),
                ((1.2, 6.0, 1.2), (0, bar - 2.0, tall - 0.6)),
            ):
                parts.append(_box(size, centre, metal))
    return _scaled(parts, longest)


_FAMILIES: dict[str, Callable[[np.random.Generator], list[Part]]] = {
    "bottle": _bottle,
    "camera": _camera,
    "webcam": _webcam,
    "mouse": _mouse,
    "scissors": _scissors,
    "fork": _fork,
    "spoon": _spoon,
    "watch": _watch,
}
