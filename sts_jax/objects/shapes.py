"""Building blocks of procedural objects, in millimetres: outlines, surfaces lofted through rings, painted marks.

An outline is an array (n, 2) of points in a plane, counter-clockwise. Rings are an array (k, n, 3): k outlines in
space, through which `loft` draws a surface. A `Part` is such a surface with its colours. An object is a list of parts.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sts_jax.objects.assembly import WALL
from sts_jax.objects.colors import Color, Number

PAINT = 0.04  # mm, height of a painted mark, so that it is drawn in front of the surface below it

Painted = Color | Sequence[Color]


class Part(NamedTuple):
    """One closed or open surface with the colour of each face."""

    vertices: np.ndarray  # (v, 3) mm
    faces: np.ndarray  # (f, 3) indices of vertices, counter-clockwise seen from outside
    colors: np.ndarray  # (f, 3) linear light
    density: float  # kg/m^2
    interior: bool  # whether the part is closed and bounds the contents, which one part of an object may do


# Outlines.


def circle(radius: Number, num: int) -> np.ndarray:
    """A circle of `num` points about the origin."""
    angle = 2 * np.pi * (np.arange(num) + 0.5) / num
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def ellipse(a: Number, b: Number, num: int, power: Number = 2.0) -> np.ndarray:
    """A superellipse |x / a|^power + |y / b|^power = 1 of `num` points, which is an ellipse for a power of 2."""
    angle = 2 * np.pi * (np.arange(num) + 0.5) / num
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([a * np.sign(c) * np.abs(c) ** (2 / power), b * np.sign(s) * np.abs(s) ** (2 / power)], axis=1)


def rectangle(width: Number, depth: Number, chamfer: Number = 0.0) -> np.ndarray:
    """A rectangle about the origin, of four points, or of eight with corners cut off by `chamfer`."""
    w, d, c = width / 2, depth / 2, chamfer
    if c == 0:
        return np.array([[w, -d], [w, d], [-w, d], [-w, -d]])
    return np.array(
        [[w, c - d], [w, d - c], [w - c, d], [c - w, d], [-w, d - c], [-w, c - d], [c - w, -d], [w - c, -d]]
    )


# Rings.


def rings(outline: np.ndarray, levels: Sequence[tuple[Number, Number]]) -> np.ndarray:
    """Rings with an outline in x, y at each (scale, z)."""
    return np.stack([np.column_stack([outline * scale, np.full(len(outline), z)]) for scale, z in levels])


def sweep(path: np.ndarray, section: np.ndarray, binormal: Sequence[Number], *, closed: bool = False) -> np.ndarray:
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


# Parts.


def loft(
    rings: np.ndarray,
    color: Painted,
    *,
    ends: tuple[Color | None, Color | None] | None = None,
    closed: bool = False,
    density: Number = WALL,
    interior: bool = False,
) -> Part:
    """A surface through rings (k, n, 3), turned so that its faces are counter-clockwise from outside.

    Args:
        rings: mm, the rings.
        color: one colour, one per band between two rings (k - 1, or k if `closed`), or n per band.
        ends: colours of the faces that close the first and the last ring. An end of None stays open. By default both
            ends are closed and have the colours of their bands.
        closed: whether a band joins the last ring to the first, as in a ring or hoop, which has no ends.
        density: kg/m^2.
        interior: whether the surface bounds the contents of the object.
    """
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
    # An open end counts as closed until the sign of the volume has shown which side is outside.
    points, whole = np.concatenate(vertices), np.concatenate(faces)
    if _volume(points, whole) < 0:
        whole = whole[:, ::-1]
    kept = np.concatenate(keep)
    faces_kept = whole[kept]
    used, renumbered = np.unique(faces_kept, return_inverse=True)
    return Part(points[used], renumbered.reshape(faces_kept.shape), np.concatenate(colors)[kept], density, interior)


def _volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Six times the volume of a closed surface, negative if its faces are turned inside out."""
    a, b, c = np.moveaxis(vertices[faces] - vertices.mean(axis=0), 1, 0)
    return float(np.einsum("fi,fi->", a, np.cross(b, c)))


def lathe(profile: Sequence[tuple[Number, Number]], color: Painted, *, num: int = 16, **kind: object) -> Part:
    """A surface of revolution about z through (radius, z), with the keywords of `loft`."""
    return loft(rings(circle(1.0, num), profile), color, **kind)  # type: ignore[arg-type]


def box(size: Sequence[Number], centre: Sequence[Number], color: Color) -> Part:
    """A box with sides along the axes."""
    x, y, z = size
    return move(loft(rings(rectangle(x, y), [(1.0, -z / 2), (1.0, z / 2)]), color), centre)


def decal(
    outline: np.ndarray, color: Color, shift: Sequence[Number] = (0, 0, 0), *, axis: str = "z", spin: Number = 0.0
) -> Part:
    """A painted mark without mass in the plane z = PAINT, facing +z, then moved like a part.

    Args:
        outline: mm, star-shaped about its mean.
        color: linear light.
        shift: mm, see `move`.
        axis: see `move`.
        spin: rad, see `move`.
    """
    n = len(outline)
    points = np.column_stack([np.vstack([outline, outline.mean(axis=0)]), np.full(n + 1, PAINT)])
    faces = np.stack([np.full(n, n), np.arange(n), (np.arange(n) + 1) % n], axis=1)
    mark = Part(points, faces, np.broadcast_to(color, (n, 3)), 0.0, False)
    return move(mark, shift, axis=axis, spin=spin)


# Placement.

_TURNS = {
    "z": np.eye(3),
    "-z": np.diag([1.0, -1.0, -1.0]),
    "x": np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
    "-x": np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]),
    "y": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "-y": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
}


def rotation_about_z(angle: Number) -> np.ndarray:
    """The rotation matrix (3, 3) of an angle (rad) about z."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def move(part: Part, shift: Sequence[Number] = (0, 0, 0), *, axis: str = "z", spin: Number = 0.0) -> Part:
    """Turn a part by `spin` (rad) about z, then turn its z axis to `axis`, then shift it.

    Args:
        part: the part.
        shift: mm.
        axis: "x", "y", "z", "-x", "-y" or "-z".
        spin: rad.
    """
    return part._replace(vertices=part.vertices @ (_TURNS[axis] @ rotation_about_z(spin)).T + np.asarray(shift, float))


def mirrored(part: Part, axis: int = 0) -> Part:
    """The mirror image of a part, whose coordinate `axis` changes its sign."""
    flip = np.ones(3)
    flip[axis] = -1
    return part._replace(vertices=part.vertices * flip, faces=part.faces[:, ::-1])


def scaled(parts: list[Part], longest: Number) -> list[Part]:
    """All parts of an object, scaled so that the longest side of their common bounding box is `longest` (mm)."""
    points = np.concatenate([part.vertices for part in parts])
    scale = longest / np.ptp(points, axis=0).max()
    return [part._replace(vertices=part.vertices * scale) for part in parts]
