"""Triangulated surfaces of mesh files: merging of vertices, a test for holes, samples of points, and decimation."""

import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

_LARGEST, _PAIRS, _POINTS = 100, 16, 48  # of an overlap: parts, pairs of parts, and points in the box of each pair


class Surface(NamedTuple):
    """Triangles of a mesh, with a colour and texture coordinates at each corner of each triangle."""

    vertices: np.ndarray  # (v, 3), vertices (m), without duplicates, even where the colour changes
    faces: np.ndarray  # (f, 3), vertex indices
    colors: np.ndarray  # (f, 3, 3), colour at each corner, in linear light, [0, 1]
    uv: np.ndarray  # (f, 3, 2), texture coordinates at each corner
    texture: np.ndarray | None  # (t, t, 3), texture in linear light, [0, 1], or None


def merge(corners: np.ndarray, colors: np.ndarray, uv: np.ndarray, texture: np.ndarray | None) -> Surface:
    """Make a surface from the corners (f, 3, 3) of separate faces (m). Corners at the same place become one vertex."""
    grain = np.ptp(corners, axis=(0, 1)).max() * 1e-7
    _, first, index = np.unique(
        np.round(corners.reshape(-1, 3) / grain), axis=0, return_index=True, return_inverse=True
    )
    return proper(Surface(corners.reshape(-1, 3)[first], index.reshape(-1, 3), colors, uv, texture))


def proper(surface: Surface) -> Surface:
    """Remove faces that use a vertex twice, and vertices that no face uses. At least one face must remain."""
    faces = surface.faces
    kept = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    if not kept.any():
        raise ValueError(
            "every face has two corners at the same place: give a mesh whose faces have three different corners"
        )
    used, faces = np.unique(faces[kept], return_inverse=True)
    return surface._replace(
        vertices=surface.vertices[used],
        faces=faces.reshape(-1, 3),
        colors=surface.colors[kept],
        uv=surface.uv[kept],
    )


def repaired(path: Path, surface: Surface) -> Surface:
    """Drop repeated faces, and turn the faces of each closed part outwards, or inwards around a cavity.

    A part is a set of faces that are connected by edges of exactly two faces. The two sides of an open sheet both stay.
    """
    faces = surface.faces
    _, first, place = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_inverse=True)
    place = place.reshape(-1)
    odd = (faces > np.roll(faces, 1, axis=1)).sum(axis=1) == 1  # an odd permutation of the sorted corners
    part, turned, closed = _parts(faces[first])
    corners = surface.vertices[faces[first]] - surface.vertices.mean(axis=0)
    corners[turned] = corners[turned, ::-1]
    volume = np.bincount(part, np.linalg.det(corners)) / 6
    inverted = np.bincount(part, np.where(turned, 1, -1)) > 0  # an open part keeps the direction of most faces
    shells = np.split(corners[np.argsort(part, kind="stable")], np.cumsum(np.bincount(part))[:-1])
    cavity = _depths([shell for shell, whole in zip(shells, closed, strict=True) if whole]) % 2 == 1
    inverted[closed] = (volume[closed] < 0) != cavity
    kept = np.zeros(len(faces), bool)
    kept[first] = True
    kept |= ~closed[part[place]] & (odd != odd[first][place])
    _, sides = np.unique(np.stack([place, odd], axis=1)[kept], axis=0, return_index=True)
    kept = np.flatnonzero(kept)[np.sort(sides)]
    if len(kept) < len(faces):
        warnings.warn(f"{path}: {len(faces) - len(kept):,} repeated faces are dropped", stacklevel=3)
    flip = (turned != inverted[part])[place]
    turn = np.where(flip[:, None], [2, 1, 0], [0, 1, 2])[kept]
    return surface._replace(
        faces=np.take_along_axis(faces[kept], turn, axis=1),
        colors=np.take_along_axis(surface.colors[kept], turn[..., None], axis=1),
        uv=np.take_along_axis(surface.uv[kept], turn[..., None], axis=1),
    )


def _depths(shells: list[np.ndarray]) -> np.ndarray:
    """Count the closed surfaces, each as triangles (f, 3, 3), in which each of them lies."""
    low, high = (np.array([edge(shell, (0, 1)) for shell in shells]).reshape(-1, 3) for edge in (np.amin, np.amax))
    depths = np.zeros(len(shells), int)
    for index, shell in enumerate(shells):
        points = shell.reshape(-1, 3)[:: 1 + 3 * len(shell) // 32]
        for other in np.flatnonzero((low < low[index]).all(axis=1) & (high > high[index]).all(axis=1)):
            depths[index] += all(abs(winding(point, shells[other])) > 0.5 for point in points)
    return depths


def _parts(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the part of each face, whether it must turn to agree with its part, and whether each part is closed."""
    number = len(faces)
    start, end = faces.reshape(-1).astype(np.int64), np.roll(faces, -1, axis=1).reshape(-1)
    edge = np.minimum(start, end) * (faces.max() + 1) + np.maximum(start, end)
    _, edge, count = np.unique(edge, return_inverse=True, return_counts=True)
    edge = edge.reshape(-1)
    order = np.argsort(edge, kind="stable")
    one, two = order[count[edge[order]] == 2].reshape(-1, 2).T
    same = (start < end)[one] == (start < end)[two]  # neighbours of opposite orientations
    one, two = one // 3, two // 3
    # Each face stands twice in a graph, as it is and turned, so that its component also says how it is turned.
    ends = np.concatenate(
        [[one, np.where(same, two + number, two)], [one + number, np.where(same, two, two + number)]], axis=1
    )
    graph = coo_array((np.ones(ends.shape[1], bool), tuple(ends)), shape=(2 * number, 2 * number))
    plain, other = connected_components(graph, directed=False)[1].reshape(2, number)
    _, part = np.unique(np.minimum(plain, other), return_inverse=True)
    part, turned = part.reshape(-1), plain > other
    forward = np.where((start < end) != np.repeat(turned, 3), 1, -1)
    sides = np.repeat(part, 3) * len(count) + edge
    sides, place = np.unique(sides, return_inverse=True)
    open_sides = np.bincount(place.reshape(-1), forward) != 0
    closed = np.bincount(sides // len(count), open_sides) == 0
    closed[part[plain == other]] = False  # a Moebius strip
    return part, turned, closed


def is_closed(faces: np.ndarray) -> bool:
    """Return whether triangular faces (f, 3) have the edge a to b as often as b to a, for all vertices a and b.

    A surface of a single part then has no holes, and all of its faces have the same orientation. Closed parts that
    share vertices also count as closed, although more than two faces can meet at an edge.
    """
    start, end = faces.reshape(-1).astype(np.int64), np.roll(faces, -1, axis=1).reshape(-1)
    edge = np.minimum(start, end) * (faces.max() + 1) + np.maximum(start, end)
    _, place = np.unique(edge, return_inverse=True)
    return not np.bincount(place.reshape(-1), np.where(start < end, 1, -1)).any()


def winding(point: np.ndarray, triangles: np.ndarray) -> float:
    """Compute the winding number of triangles around a point: 1 inside, 0 outside (van Oosterom and Strackee, 1983)."""
    a, b, c = np.moveaxis(triangles - point, 1, 0)
    one, two, three = (np.linalg.norm(side, axis=1) for side in (a, b, c))
    across = np.einsum("fi,fi->f", a, np.cross(b, c))
    dots = (np.einsum("fi,fi->f", left, right) for left, right in ((a, b), (b, c), (c, a)))
    along = one * two * three + sum(dot * size for dot, size in zip(dots, (three, one, two), strict=True))
    return float(np.arctan2(across, along).sum() / (2 * np.pi))


def overlap(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Estimate the volume (m^3) that the largest closed parts of a mesh have in common, from random points."""
    part, _, closed = _parts(faces)
    least, most = np.full((len(closed), 3), np.inf), np.full((len(closed), 3), -np.inf)
    np.minimum.at(least, part, vertices[faces].min(axis=1))
    np.maximum.at(most, part, vertices[faces].max(axis=1))
    largest = np.argsort(np.where(closed, -np.prod(most - least, axis=1), 0))[:_LARGEST]
    one, other = (largest[index] for index in np.triu_indices(len(largest), 1))
    low, high = np.maximum(least[one], least[other]), np.minimum(most[one], most[other])
    sizes = np.where((low < high).all(axis=1) & closed[one] & closed[other], np.prod(high - low, axis=1), 0)
    random, twice, triangles = np.random.default_rng(0), 0.0, vertices[faces]
    for pair in (pair for pair in np.argsort(-sizes)[:_PAIRS] if sizes[pair] > 0):
        points = random.uniform(low[pair], high[pair], (_POINTS, 3))
        twice += float(np.mean([winding(point, triangles) > 1.5 for point in points]) * sizes[pair])
    return twice


def surface_samples(
    triangles: Float[np.ndarray, "f 3 3"], num: int
) -> tuple[Int[np.ndarray, "num"], Float[np.ndarray, "num 3"]]:
    """Sample points from triangles, evenly by area and with a fixed seed: triangles and barycentric weights."""
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    share = np.cumsum(np.linalg.norm(cross, axis=1))
    face = np.searchsorted(share, (np.arange(num) + 0.5) / num * share[-1])
    u, v = np.random.default_rng(0).random((2, num))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return face, np.stack([1 - u - v, u, v], axis=1)


def decimate(path: Path, surface: Surface, target: int) -> Surface:
    """Reduce a surface to at most `target` faces and vertices, with one colour per corner of a face. Warns."""
    import fast_simplification  # takes half a second

    # Slivers can block the decimation. If so, vertices are welded first, on a grid of 1/1000 of the size or coarser.
    for weld in (0.0, 1e-3, 2e-3, 4e-3, 8e-3):
        vertices, faces = _welded(surface, weld)
        if len(faces) > target:
            vertices, faces = fast_simplification.simplify(vertices, faces, target_count=target)
        if 0 < len(faces) <= target and len(vertices) <= target:
            break
    else:
        raise ValueError(
            f"the mesh of {len(surface.faces):,} faces cannot be decimated to {target:,} faces, because it "
            "consists of too many separate parts: allow more faces (argument faces)"
        )
    note = "" if surface.texture is None else ", and its texture replaced by one colour per corner of each face"
    warnings.warn(f"{path}: decimated from {len(surface.faces):,} to {len(faces):,} faces{note}", stacklevel=3)
    vertices, faces = np.asarray(vertices, float), np.asarray(faces, int)
    colors = _sampled(surface, vertices[faces], 20 * target)
    return proper(Surface(vertices, faces, colors, np.zeros((len(faces), 3, 2)), None))


def _sampled(surface: Surface, corners: np.ndarray, num: int) -> np.ndarray:
    """Compute the colours (f, 3, 3) of a decimated surface's corners from `num` samples of the full surface."""
    triangles = surface.vertices[surface.faces]
    # Each corner gets the albedo of the nearest sample with a similar normal. The corner is first moved a little
    # towards the centre of its face.
    face, weight = surface_samples(triangles, num)
    albedo = np.einsum("nk,nkc->nc", weight, surface.colors[face])
    if surface.texture is not None:
        size = len(surface.texture)
        column, row = (np.einsum("nk,nkc->nc", weight, surface.uv[face]) % 1 * size).astype(int).T % size
        albedo = albedo * surface.texture[row, column]
    facing = 0.05 * np.ptp(surface.vertices, axis=0).max()
    tree = KDTree(np.hstack([np.einsum("nk,nkc->nc", weight, triangles[face]), facing * _normals(triangles)[face]]))
    place = (0.8 * corners + 0.2 * corners.mean(axis=1, keepdims=True)).reshape(-1, 3)
    nearest = tree.query(np.hstack([place, facing * np.repeat(_normals(corners), 3, axis=0)]))[1]
    return albedo[nearest].reshape(-1, 3, 3)


def _welded(surface: Surface, share: float) -> tuple[np.ndarray, np.ndarray]:
    """Merge the vertices in each cell of a grid, whose cells have the size `share` times the longest side."""
    if not share:
        return surface.vertices, surface.faces.astype(np.int32)
    cell = share * np.ptp(surface.vertices, axis=0).max()
    _, first, index = np.unique(np.round(surface.vertices / cell), axis=0, return_index=True, return_inverse=True)
    faces = index.reshape(-1)[surface.faces]
    return surface.vertices[first], faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)].astype(np.int32)


def _normals(triangles: np.ndarray) -> np.ndarray:
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    size = np.linalg.norm(cross, axis=1, keepdims=True)
    return cross / np.where(size > 0, size, 1)
