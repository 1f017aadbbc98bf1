"""Triangulated surfaces: the merged surface of a mesh file, its boundary, and samples of it."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int


class Surface(NamedTuple):
    """Vertices, faces and the albedo of each corner: texture times colour, in linear light."""

    vertices: np.ndarray  # (v, 3), m, without duplicates, even at seams of the colours
    faces: np.ndarray  # (f, 3)
    colors: np.ndarray  # (f, 3, 3), of each corner
    uv: np.ndarray  # (f, 3, 2), texture coordinates of each corner
    texture: np.ndarray | None  # (t, t, 3)


def merge(path: Path, corners: np.ndarray, colors: np.ndarray, uv: np.ndarray, texture: np.ndarray | None) -> Surface:
    """Merge the vertices of faces that share them.

    Args:
        path: the file, which errors name.
        corners: m, (f, 3, 3), the corners of each face.
        colors: (f, 3, 3), see `Surface`.
        uv: (f, 3, 2), see `Surface`.
        texture: see `Surface`.

    Raises:
        ValueError: no face has any area.
    """
    grain = np.ptp(corners, axis=(0, 1)).max() * 1e-7
    _, first, index = np.unique(
        np.round(corners.reshape(-1, 3) / grain), axis=0, return_index=True, return_inverse=True
    )
    return proper(path, Surface(corners.reshape(-1, 3)[first], index.reshape(-1, 3), colors, uv, texture))


def proper(path: Path, surface: Surface) -> Surface:
    """Remove faces without area and unused vertices.

    Raises:
        ValueError: no face has any area.
    """
    faces = surface.faces
    kept = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    if not kept.any():
        raise ValueError(f"{path}: no face has any area: give a mesh with triangles")
    used, faces = np.unique(faces[kept], return_inverse=True)
    return surface._replace(
        vertices=surface.vertices[used],
        faces=faces.reshape(-1, 3),
        colors=surface.colors[kept],
        uv=surface.uv[kept],
    )


def is_closed(faces: np.ndarray) -> bool:
    """Whether faces have no boundary: each edge is traversed equally often in both directions.

    A single part is then watertight and consistently wound. Where touching parts have been welded, more than two faces
    may meet at an edge without leaving a hole.
    """
    start, end = faces.reshape(-1).astype(np.int64), np.roll(faces, -1, axis=1).reshape(-1)
    edge = np.minimum(start, end) * (faces.max() + 1) + np.maximum(start, end)
    _, place = np.unique(edge, return_inverse=True)
    return not np.bincount(place.reshape(-1), np.where(start < end, 1, -1)).any()


def surface_samples(
    triangles: Float[np.ndarray, "f 3 3"], num: int
) -> tuple[Int[np.ndarray, "num"], Float[np.ndarray, "num 3"]]:
    """Points spread evenly by area over triangles, with a fixed seed: the face and barycentric weights of each."""
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    share = np.cumsum(np.linalg.norm(cross, axis=1))
    face = np.searchsorted(share, (np.arange(num) + 0.5) / num * share[-1])
    u, v = np.random.default_rng(0).random((2, num))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return face, np.stack([1 - u - v, u, v], axis=1)
