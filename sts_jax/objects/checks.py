"""Checks of settings, of mesh files, and of what trimesh returns. The caller names the path in a ValueError."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial import ConvexHull

from sts_jax.objects.body import FACE_CLASSES, PAD, SMALLEST, Body

ROUNDING = 1e-5  # share by which a length may miss a limit, because float32 and decimals are rounded
THINNEST = 1e-4  # m, thickness of the thinnest object: convex hulls have a tolerance of half of it
LEAD = 11_340.0  # kg/m^3, density of lead (CRC Handbook of Chemistry and Physics)

LARGEST_UV = 1e4  # repetitions of a texture, beyond which float32 does not resolve its texels


def check_positive(name: str, value: float | None, unit: str) -> None:
    """Raise a ValueError unless a setting is None or a positive, finite number."""
    if value is not None and not 0 < value < np.inf:
        raise ValueError(f"{name} must be a positive number of {unit}, got {value!r}")


def limits(pad: float) -> tuple[float, float]:
    """Return the limits of the longest side of an object (m) on a pad of a width (m)."""
    return min(SMALLEST, pad * SMALLEST / PAD), pad


def check_side(name: str, value: float | None, pad: float = PAD) -> None:
    """Raise a ValueError unless a length is None or a possible longest side of an object (m)."""
    low, high = limits(pad)
    if value is not None and not low * (1 - ROUNDING) <= value <= high * (1 + ROUNDING):
        raise ValueError(f"{name} is {value} m, but it must be from {low:g} to {high:g} m, the pad's width")


def check_file(path: Path) -> None:
    """Raise an error unless a path is a regular file that is not empty."""
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder: give a mesh file in it, or pass the folder to objects.library")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such mesh file: check the path")
    if not path.stat().st_size:
        raise ValueError("the file is empty: replace it")


def checked_corners(pieces: Sequence[trimesh.Trimesh], limit: int | None) -> Float[np.ndarray, "f 3 3"]:
    """Return the corners of all faces that trimesh read, in the file's units, or raise a ValueError.

    `limit` is the number of faces to which the mesh will be decimated, or None.
    """
    if not pieces:
        raise ValueError("the mesh has no faces: give a mesh with triangles")
    number = sum(len(piece.faces) for piece in pieces)
    if limit is None and number > FACE_CLASSES[-1]:
        raise ValueError(
            f"the mesh has {number:,} faces, but at most {FACE_CLASSES[-1]:,} can be drawn: pass "
            f"faces={FACE_CLASSES[-1]} to decimate it"
        )
    for piece in pieces:
        faces = np.asarray(piece.faces)
        wrong = faces[(faces < 0) | (faces >= len(piece.vertices))]
        if wrong.size:
            raise ValueError(
                f"a face refers to vertex {wrong[0]}, but vertices are numbered from 0 to "
                f"{len(piece.vertices) - 1}: check that the file is complete"
            )
    corners = np.concatenate([np.asarray(piece.vertices, float)[np.asarray(piece.faces)] for piece in pieces])
    if not np.isfinite(corners).all():
        bad = int((~np.isfinite(corners)).any(axis=(1, 2)).sum())
        raise ValueError(f"the mesh has NaN or infinite vertices in {bad} of its faces: repair the mesh")
    if not np.ptp(corners, axis=(0, 1)).max() > 0:
        raise ValueError("all vertices lie at one point: repair the mesh")
    return corners


def check_appearance(colors: Float[np.ndarray, "f 3 3"], uv: Float[np.ndarray, "f 3 2"]) -> None:
    """Raise a ValueError unless colours are finite, and texture coordinates as well and of a possible size."""
    if not np.isfinite(colors).all():
        raise ValueError("the mesh has colours that are NaN or infinite: repair its colours or materials")
    if not (np.abs(uv) <= LARGEST_UV).all():
        raise ValueError(f"the mesh has texture coordinates that are NaN or beyond {LARGEST_UV:,.0f}: repair them")


def check_thickness(body: Body, least: float = THINNEST) -> None:
    """Raise a ValueError if a body is too thin for its collision hull."""
    points = np.asarray(body.vertices, float)
    hull = ConvexHull(points)
    a, b, c = np.moveaxis(points[hull.simplices], 1, 0)
    largest = np.argsort(-np.linalg.norm(np.cross(b - a, c - a), axis=1))[:100]
    thickness = float(np.ptp(points @ hull.equations[largest, :3].T, axis=0).min())
    if thickness < least * (1 - ROUNDING):
        raise ValueError(
            f"the object is {thickness * 1e3:.4g} mm thick, but stable contacts need at least {least * 1e3:g} mm: "
            "thicken the mesh"
        )


def check_density(name: str, value: float, unit: str, body: Body) -> None:
    """Raise a ValueError if the setting `name` makes a body denser than lead, over the volume of its hull."""
    volume = ConvexHull(np.asarray(body.vertices, float)).volume
    mean = float(body.shell_mass) / volume
    if mean > LEAD:
        raise ValueError(
            f"{name}={value:g} makes an object of {float(body.shell_mass):.3g} kg in {volume * 1e6:.3g} ml, which is "
            f"{mean / LEAD:.3g} times as dense as lead: {name} is in {unit}"
        )
