"""Triangulated surfaces of mesh files: merging of vertices, a test for holes, samples of points, and decimation."""

import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree


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


def is_closed(faces: np.ndarray) -> bool:
    """Return whether triangular faces (f, 3) have the edge a to b as often as b to a, for all vertices a and b.

    A surface of a single part then has no holes, and all of its faces have the same orientation. Closed parts that
    share vertices also count as closed, although more than two faces can meet at an edge.
    """
    start, end = faces.reshape(-1).astype(np.int64), np.roll(faces, -1, axis=1).reshape(-1)
    edge = np.minimum(start, end) * (faces.max() + 1) + np.maximum(start, end)
    _, place = np.unique(edge, return_inverse=True)
    return not np.bincount(place.reshape(-1), np.where(start < end, 1, -1)).any()


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
