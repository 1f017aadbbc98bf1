"""Cavities of closed meshes with thick walls, such as cups: the space that the contents fill."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

LEVELS = 12  # levels at which the cavity of a mesh is measured first
OPEN, SEALED = 0.25, 1.0  # smallest volume of an open and of a sealed cavity, divided by the volume of the walls


class _Cavity(NamedTuple):
    """The cavities of a mesh below a level, and the triangles around them, counter-clockwise seen from outside."""

    volume: float  # (m^3)
    triangles: np.ndarray  # (f, 3, 3) (m)


def find_cavity(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], walls: float
) -> Float[np.ndarray, "_ 3 3"] | None:
    """Triangles (m) around the space in a closed mesh of the volume `walls` (m^3), or None for a mesh without walls.

    An open cavity is filled, with one of the six sides of the bounding box upwards, to the level at which it spills.
    """
    best = _Cavity(0.0, np.zeros((0, 3, 3)))
    for up in np.concatenate([np.eye(3)[::-1], -np.eye(3)]):
        height = vertices @ up
        sealed = _below(vertices, faces, up, 2 * height.max() - height.min())
        if sealed.volume > SEALED * walls:
            return sealed.triangles
        levels = np.unique(height) - 1e-7 * np.ptp(height)
        index = np.unique(np.linspace(0, len(levels) - 1, LEVELS).astype(int))
        volumes = [_below(vertices, faces, up, levels[i]).volume - sealed.volume for i in index]
        low, size = int(index[np.argmax(volumes)]), max(volumes)
        high = min([int(i) for i in index if i > low], default=len(levels))
        while high - low > 1:  # the cavity grows with the level until it spills
            middle = (low + high) // 2
            volume = _below(vertices, faces, up, levels[middle]).volume - sealed.volume
            low, high, size = (middle, high, volume) if volume >= size else (low, middle, size)
        if size > max(OPEN * walls, best.volume * (1 + 1e-6)):
            best = _below(vertices, faces, up, levels[low])._replace(volume=size)
    return best.triangles if best.volume else None


def _below(vertices: np.ndarray, faces: np.ndarray, up: np.ndarray, level: float) -> _Cavity:
    """Find the cavities below a level.

    The level cuts the mesh into pieces. With lids at the level, each encloses a volume, and it is negative if the piece
    is the surface of a cavity. The lids are fans of signed triangles, with which integrals over the cavity are exact.
    """
    height = vertices @ up - level
    under = height < 0
    pairs = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    pairs = pairs[under[pairs].all(axis=1)]
    graph = coo_array((np.ones(len(pairs), bool), tuple(pairs.T)), shape=(len(vertices), len(vertices)))
    piece = connected_components(graph, directed=False)[1]

    count = under[faces].sum(axis=1)
    lone = np.argmax(under[faces] == (count == 1)[:, None], axis=1)  # first corner of a face that the level cuts
    faces = np.take_along_axis(faces, (lone[:, None] + np.arange(3)) % 3, axis=1)
    label = piece[faces[np.arange(len(faces)), np.argmin(height[faces], axis=1)]]
    place = vertices - (vertices.mean(axis=0) @ -up + level) * up - vertices.mean(axis=0)  # from a point at the level
    corner, h = place[faces], height[faces]
    cut = (count == 1) | (count == 2)
    rise = np.where(cut[:, None], h[:, :1] - h[:, 1:], 1.0)
    p, q = np.moveaxis(corner[:, :1] + (h[:, :1] / rise)[..., None] * (corner[:, 1:] - corner[:, :1]), 1, 0)
    a, b, c = np.moveaxis(corner, 1, 0)
    middle = np.zeros_like(a)
    one, two = count == 1, count == 2
    kinds = ((count == 3, (a, b, c)), (one, (a, p, q)), (two, (p, b, c)), (two, (p, c, q)))
    lids = ((one, (q, p, middle)), (two, (p, q, middle)))
    triangles = np.concatenate([np.stack(corners, axis=1)[rows] for rows, corners in (*kinds, *lids)])
    owner = np.concatenate([label[rows] for rows, _ in (*kinds, *lids)])
    volume = np.bincount(owner, np.linalg.det(triangles) / 6, minlength=1)
    chosen = volume[owner] < 0
    return _Cavity(-volume[volume < 0].sum(), triangles[chosen, ::-1] + (vertices - place)[0])
