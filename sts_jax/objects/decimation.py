"""Decimation of a surface to fewer faces. The surface's colours and texture become one colour per face corner."""

import warnings
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from sts_jax.objects.surface import Surface, proper, surface_samples


def decimate(path: Path, surface: Surface, target: int) -> Surface:
    """Reduce a surface to at most `target` faces and vertices, and warn with the old and the new number of faces.

    Args:
        path: Path of the mesh file, for the warning and the error messages.
        surface: Surface to reduce.
        target: Largest number of faces and of vertices.

    Returns:
        The reduced surface, with one colour for each corner of each face and without a texture.

    Raises:
        ImportError: The package fast-simplification is not installed.
        ValueError: The surface consists of too many separate parts to reach `target`.
    """
    try:
        import fast_simplification
    except ImportError as error:
        raise ImportError(
            f"{path}: decimating the mesh from {len(surface.faces):,} to {target:,} faces needs the package "
            "fast-simplification, which is not installed: pip install -e '.[meshes]'"
        ) from error
    # Slivers can block the decimation. If so, vertices are welded first, on a grid of 1/1000 of the size or coarser.
    for weld in (0.0, 1e-3, 2e-3, 4e-3, 8e-3):
        vertices, faces = _welded(surface, weld)
        if len(faces) > target:
            vertices, faces = fast_simplification.simplify(vertices, faces, target_count=target)
        if 0 < len(faces) <= target and len(vertices) <= target:
            break
    else:
        raise ValueError(
            f"{path}: the mesh of {len(surface.faces):,} faces cannot be decimated to {target:,} faces, because it "
            "consists of too many separate parts: allow more faces (argument faces)"
        )
    note = "" if surface.texture is None else ", and its texture replaced by one colour per corner of each face"
    warnings.warn(f"{path}: decimated from {len(surface.faces):,} to {len(faces):,} faces{note}", stacklevel=3)
    vertices, faces = np.asarray(vertices, float), np.asarray(faces, int)
    colors = _sampled(surface, vertices[faces], 20 * target)
    return proper(path, Surface(vertices, faces, colors, np.zeros((len(faces), 3, 2)), None))


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
