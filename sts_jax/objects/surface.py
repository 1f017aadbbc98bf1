"""Triangulated surfaces of mesh files: merging of vertices, a test for holes, and samples of points."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int


class Surface(NamedTuple):
    """Triangles of a mesh, with a colour and texture coordinates at each corner of each triangle.

    The albedo at a point of a face is the texture's value times the colour, in linear light. The colour is interpolated
    between the three corners of the face.
    """

    vertices: np.ndarray  # (v, 3), vertices (m), without duplicates, even where the colour changes
    faces: np.ndarray  # (f, 3), vertex indices
    colors: np.ndarray  # (f, 3, 3), colour at each corner, in linear light, [0, 1]
    uv: np.ndarray  # (f, 3, 2), texture coordinates at each corner
    texture: np.ndarray | None  # (t, t, 3), texture in linear light, [0, 1], or None


def merge(path: Path, corners: np.ndarray, colors: np.ndarray, uv: np.ndarray, texture: np.ndarray | None) -> Surface:
    """Make a surface from separate faces. Corners at the same place become one vertex.

    Faces that have two corners at the same place are removed.

    Args:
        path: Path of the mesh file, for error messages.
        corners: Corners of each face, (f, 3, 3) (m).
        colors: Colour at each corner, (f, 3, 3), in linear light.
        uv: Texture coordinates at each corner, (f, 3, 2).
        texture: Texture (t, t, 3) in linear light, or None.

    Raises:
        ValueError: Every face has two corners at the same place.
    """
    grain = np.ptp(corners, axis=(0, 1)).max() * 1e-7
    _, first, index = np.unique(
        np.round(corners.reshape(-1, 3) / grain), axis=0, return_index=True, return_inverse=True
    )
    return proper(path, Surface(corners.reshape(-1, 3)[first], index.reshape(-1, 3), colors, uv, texture))


def proper(path: Path, surface: Surface) -> Surface:
    """Remove faces that use a vertex twice, and vertices that no face uses.

    Args:
        path: Path of the mesh file, for error messages.
        surface: Surface to clean.

    Raises:
        ValueError: No face remains.
    """
    faces = surface.faces
    kept = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    if not kept.any():
        raise ValueError(
            f"{path}: every face has two corners at the same place and therefore no area: give a mesh whose faces have "
            "three different corners"
        )
    used, faces = np.unique(faces[kept], return_inverse=True)
    return surface._replace(
        vertices=surface.vertices[used],
        faces=faces.reshape(-1, 3),
        colors=surface.colors[kept],
        uv=surface.uv[kept],
    )


def is_closed(faces: np.ndarray) -> bool:
    """Return whether triangular faces form a closed surface.

    The face (a, b, c) has the directed edges a to b, b to c and c to a. A surface counts as closed if its faces have
    the edge a to b as often as the edge b to a, for all vertices a and b. A surface of a single part then has no holes,
    and all of its faces have the same orientation. Closed parts that touch and share vertices also count as closed,
    although more than two faces can meet at an edge.

    Args:
        faces: Vertex indices of each face, int (f, 3).
    """
    start, end = faces.reshape(-1).astype(np.int64), np.roll(faces, -1, axis=1).reshape(-1)
    edge = np.minimum(start, end) * (faces.max() + 1) + np.maximum(start, end)
    _, place = np.unique(edge, return_inverse=True)
    return not np.bincount(place.reshape(-1), np.where(start < end, 1, -1)).any()


def surface_samples(
    triangles: Float[np.ndarray, "f 3 3"], num: int
) -> tuple[Int[np.ndarray, "num"], Float[np.ndarray, "num 3"]]:
    """Sample points from triangles, evenly by area and with a fixed seed.

    Args:
        triangles: Corners of the triangles (m).
        num: Number of points.

    Returns:
        Index of the triangle of each point, and the barycentric weights of the three corners.
    """
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    share = np.cumsum(np.linalg.norm(cross, axis=1))
    face = np.searchsorted(share, (np.arange(num) + 0.5) / num * share[-1])
    u, v = np.random.default_rng(0).random((2, num))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return face, np.stack([1 - u - v, u, v], axis=1)
