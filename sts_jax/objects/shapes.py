"""Building blocks of procedural objects: outlines, surfaces through rings, and painted marks. Lengths are in mm.

An outline is an array (n, 2) of points in a plane, counter-clockwise. Rings are an array (k, n, 3) of k outlines in
space. `loft` connects each ring to the next one. Its result is a `Part`, and an object is a list of parts.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sts_jax.objects.assembly import WALL
from sts_jax.objects.colors import Color, Number

PAINT = 0.04  # mm, height of a painted mark above the surface below it, so that the mark is visible

Painted = Color | Sequence[Color]


class Part(NamedTuple):
    """One surface of an object, closed or open, with a colour for each face."""

    vertices: np.ndarray  # Vertices, (v, 3) (mm).
    faces: np.ndarray  # Vertex indices of each face, (f, 3), counter-clockwise seen from outside.
    colors: np.ndarray  # Colour of each face, (f, 3), in linear light, [0, 1].
    density: float  # Mass per area (kg/m^2).
    interior: bool  # True if the part is closed and bounds the contents. At most one part of an object can do so.


# Outlines.


def circle(radius: Number, num: int) -> np.ndarray:
    """Circle about the origin, as an outline of `num` points."""
    angle = 2 * np.pi * (np.arange(num) + 0.5) / num
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def ellipse(a: Number, b: Number, num: int, power: Number = 2.0) -> np.ndarray:
    """Superellipse |x / a|^power + |y / b|^power = 1, as an outline of `num` points.

    It is an ellipse for the power 2, and closer to a rectangle for larger powers.
    """
    angle = 2 * np.pi * (np.arange(num) + 0.5) / num
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([a * np.sign(c) * np.abs(c) ** (2 / power), b * np.sign(s) * np.abs(s) ** (2 / power)], axis=1)


def rectangle(width: Number, depth: Number, chamfer: Number = 0.0) -> np.ndarray:
    """Rectangle about the origin, as an outline of 4 points, or of 8 points if `chamfer` cuts off the corners."""
    w, d, c = width / 2, depth / 2, chamfer
    if c == 0:
        return np.array([[w, -d], [w, d], [-w, d], [-w, -d]])
    return np.array(
        [[w, c - d], [w, d - c], [w - c, d], [c - w, d], [-w, d - c], [-w, c - d], [c - w, -d], [w - c, -d]]
    )


# Rings.


def rings(outline: np.ndarray, levels: Sequence[tuple[Number, Number]]) -> np.ndarray:
    """Scaled copies of an outline in horizontal planes: `levels` has a factor and a height z for each ring."""
    return np.stack([np.column_stack([outline * scale, np.full(len(outline), z)]) for scale, z in levels])


def sweep(path: np.ndarray, section: np.ndarray, binormal: Sequence[Number], *, closed: bool = False) -> np.ndarray:
    """Copies of an outline along a path, as rings for `loft`. They can form a tube or a handle.

    Args:
        path: Points along the path, (k, 3).
        section: Outline (n, 2), or one for each point of the path, (k, n, 2). Its first coordinate is along the cross
            product of the path's direction and `binormal`, the second along `binormal`.
        binormal: Unit vector (3,), not parallel to the path.
        closed: True if the path continues from its last point to its first point, which it must not repeat.
    """
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
    """Build a surface by connecting rings. Its faces are counter-clockwise seen from outside.

    Args:
        rings: k rings of n points each, (k, n, 3). A band of the surface connects each ring to the next one.
        color: One colour (3,) for the whole surface, one colour for each band, or n colours for each band, in linear
            light. There are k - 1 bands, or k bands if `closed` is True.
        ends: Colours of the faces that close the first and the last ring, or None for an open end. By default, they are
            the first colour of the first band and the last colour of the last band.
        closed: True if a band also connects the last ring to the first, as in a hoop.
        density: Mass per area (kg/m^2).
        interior: True if the surface bounds the contents of the object, such as the water in a bottle.
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
    # Open ends are treated as closed until the sign of the volume has shown which side is outside.
    points, whole = np.concatenate(vertices), np.concatenate(faces)
    if _volume(points, whole) < 0:
        whole = whole[:, ::-1]
    kept = np.concatenate(keep)
    faces_kept = whole[kept]
    used, renumbered = np.unique(faces_kept, return_inverse=True)
    return Part(points[used], renumbered.reshape(faces_kept.shape), np.concatenate(colors)[kept], density, interior)


def _volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Return six times the volume of a closed surface, negative if its faces are clockwise seen from outside."""
    a, b, c = np.moveaxis(vertices[faces] - vertices.mean(axis=0), 1, 0)
    return float(np.einsum("fi,fi->", a, np.cross(b, c)))


def lathe(profile: Sequence[tuple[Number, Number]], color: Painted, *, num: int = 16, **kind: object) -> Part:
    """Surface of revolution about the z axis.

    Args:
        profile: Points (radius, z). A band of the surface connects each point to the next one.
        color: One colour (3,), one for each band, or `num` colours for each band, in linear light.
        num: Number of points around the axis.
        kind: Keyword arguments of `loft`: `ends`, `closed`, `density` and `interior`.
    """
    return loft(rings(circle(1.0, num), profile), color, **kind)  # type: ignore[arg-type]


def box(size: Sequence[Number], centre: Sequence[Number], color: Color) -> Part:
    """Box of one colour, with edges parallel to the axes."""
    x, y, z = size
    return move(loft(rings(rectangle(x, y), [(1.0, -z / 2), (1.0, z / 2)]), color), centre)


def decal(
    outline: np.ndarray, color: Color, shift: Sequence[Number] = (0, 0, 0), *, axis: str = "z", spin: Number = 0.0
) -> Part:
    """Painted mark without mass that faces +z, 0.04 mm above z = 0, and is then placed as in `move`.

    Each point of the outline must be visible from the mean of all points.
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
    """Rotation matrix (3, 3) of an angle (rad) about the z axis."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def move(part: Part, shift: Sequence[Number] = (0, 0, 0), *, axis: str = "z", spin: Number = 0.0) -> Part:
    """Rotate a part about z by `spin` (rad), then turn its z axis to `axis`, then shift it.

    `axis` is "x", "y", "z", "-x", "-y" or "-z".
    """
    return part._replace(vertices=part.vertices @ (_TURNS[axis] @ rotation_about_z(spin)).T + np.asarray(shift, float))


def mirrored(part: Part) -> Part:
    """Mirror a part: change the sign of all x coordinates."""
    return part._replace(vertices=part.vertices * [-1.0, 1.0, 1.0], faces=part.faces[:, ::-1])


def scaled(parts: list[Part], longest: Number) -> list[Part]:
    """Scale all parts of an object so that the longest side of their common bounding box is `longest`."""
    points = np.concatenate([part.vertices for part in parts])
    scale = longest / np.ptp(points, axis=0).max()
    return [part._replace(vertices=part.vertices * scale) for part in parts]
