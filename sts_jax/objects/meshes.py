"""Loading of mesh files as bodies, in any format that trimesh reads, with textures or colours."""

import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial import ConvexHull, QhullError

from sts_jax._checked import checked
from sts_jax.objects.assembly import CONTENTS, STEEL, WALL, assemble
from sts_jax.objects.body import FACE_CLASSES, PAD, Body, check_category
from sts_jax.objects.cavities import OPEN, find_cavity
from sts_jax.objects.checks import (
    ROUNDING,
    check_density,
    check_file,
    check_positive,
    check_side,
    check_thickness,
    checked_corners,
    limits,
)
from sts_jax.objects.files import Files, read_image
from sts_jax.objects.formats import read
from sts_jax.objects.hulls import convex_hull
from sts_jax.objects.materials import albedo
from sts_jax.objects.parts import decompose
from sts_jax.objects.surface import Surface, decimate, is_closed, merge, overlap, repaired

# Up and front directions of a file for which only the up axis is given. Up becomes +z, and front becomes -y. The front
# of a glTF file is +z (glTF specification).
AXES = {
    "x": ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0)),
    "y": ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    "z": ((0.0, 0.0, 1.0), (0.0, -1.0, 0.0)),
}


OVERLAP = 0.02  # share of the enclosed volume from which on parts that overlap are reported


class ScaledDown(UserWarning):
    """A mesh was scaled down, because it is longer than the argument `largest` of `load`."""

    length: float  # longest side before (m)


def rotation(up: Sequence[float], front: Sequence[float]) -> Float[np.ndarray, "3 3"]:
    """Rotation matrix that turns a file's up direction to +z and its front direction to -y.

    If the directions are not perpendicular, only the component of `front` perpendicular to `up` is turned to -y.
    """
    z, y = np.array(up, float), -np.array(front, float)
    if not (np.isfinite([z, y]).all() and np.linalg.norm(z) > 0):
        raise ValueError(f"up and front must be three finite numbers, and up not (0, 0, 0), got {up} and {front}")
    z /= np.linalg.norm(z)
    across = y - (y @ z) * z
    if not np.linalg.norm(across) > 1e-3 * np.linalg.norm(y):
        raise ValueError(f"up and front must not be parallel, and front not (0, 0, 0), got {up} and {front}")
    y = across / np.linalg.norm(across)
    return np.stack([np.cross(y, z), y, z])


@checked
@np.errstate(all="ignore")  # what a damaged file makes of numbers is checked afterwards
def load(
    path: str | os.PathLike[str],
    *,
    longest_side: float | None = None,
    scale: float | None = None,
    largest: float | None = None,
    mass: float | None = None,
    density: float = WALL,
    hollow: bool = True,
    strict: bool = False,
    up: Literal["x", "y", "z"] | tuple[float, float, float] = "z",
    front: tuple[float, float, float] | None = None,
    texture: str | os.PathLike[str] | None = None,
    textures: str | os.PathLike[str] | None = None,
    faces: int | None = None,
    parts: bool = False,
    category: int = -1,
    pad: float = PAD,
) -> Body:
    """Load a mesh file as a body. All meshes of the file are merged into one.

    The mesh frame is the file's frame, rotated by `up` and `front`, with the origin at the centroid of the collision
    hull: the convex hull of the mesh, reduced to at most 64 vertices. `gaps` measures how far the surface lies outside.
    Surfaces that are not closed are visible from both sides. `Body.origin` has the place of the file's origin.

    Polygons are cut into triangles, also concave ones. Closed parts are turned outwards, or inwards around a cavity,
    and repeated faces are dropped with a warning.

    Textures, 8-bit colours and the diffuse colour `Kd` of an OBJ file are read as sRGB. Colour factors and vertex
    colours of a glTF file are read as linear light (glTF specification). Alpha values are ignored, and so is the `Kd`
    of a material with a texture. Textures are resized to a square of 1, 256 or 1,024 pixels, and several are packed
    into one square. The repetitions of a texture within a face are then lost.

    Args:
        path: The mesh file. Its materials and images are looked up in the same folder.
        longest_side: Longest side of the bounding box after scaling (m), from a thirtieth of the pad, but at
            most 5 mm, to the width of the pad. None keeps the file's size. Must be None if `scale` is given.
        scale: Length of one unit of the file (m). None is 1 m.
        largest: Upper limit of the longest side (m), to which a larger mesh is scaled down with a warning. None raises
            an error for a mesh that is longer than the pad.
        mass: Mass of the body (kg), spread over its surface. The body then has no contents. None computes the mass
            of the shell from `density`.
        density: Mass of the shell per area (kg/m^2), if `mass` is None. A thick wall, as of a cup, counts once.
        hollow: If True and `mass` is None, the body can hold contents of 1,000 kg/m^3. The filled share is an argument
            of `rigid`. In a closed mesh with thick walls, as of a cup, the contents fill the cavity, not the walls. The
            convex hull bounds the contents of a mesh that is not closed, with a warning.
        strict: If True, a mesh that is not closed or encloses no volume is an error, and so are missing images and
            materials, and parts of the file that are not supported.
        up: Axis of the file, or direction in the file, that becomes +z. The convention of glTF files is "y".
        front: Direction in the file that becomes -y, by default (0, -1, 0). Must be None if `up` is an axis.
        texture: Image file that replaces the file's own textures. It needs texture coordinates in the mesh.
        textures: Additional folder in which the file's images are looked up.
        faces: Largest number of faces and of vertices, at least 4. A larger mesh is decimated with a warning, and its
            texture is replaced by one colour at each corner of each face.
        parts: If True, the body collides as convex parts (`decompose`). This needs the package coacd.
        category: Index into CATEGORIES, or -1 for an object of no category.
        pad: Width of the sensor's pad (m), such as `min(sensor.gel.size)`.
    """
    path = Path(path)
    try:
        check_positive("scale", scale, "metres per unit of the file")
        check_positive("pad", pad, "metres")
        check_side("longest_side", longest_side, pad)
        check_side("largest", largest, pad)
        if longest_side is not None and scale is not None:
            raise ValueError("give longest_side or scale, not both")
        if faces is not None and faces < 4:
            raise ValueError(f"faces must be a whole number >= 4, got {faces!r}")
        check_positive("mass", mass, "kilograms")
        check_positive("density", density, "kilograms per square metre")
        check_category(category)
        turn = _attitude(up, front)
        check_file(path)
        images = None if textures is None else Path(textures)
        pieces = read(Files(path, images, plain=texture is not None), strict)
        corners = checked_corners(pieces, faces) @ turn.T
        if texture is not None:
            _wear(pieces, Path(texture))
        surface = merge(corners * _factor(path, corners, longest_side, scale, largest, pad), *albedo(path, pieces))
        surface = repaired(path, surface)
        if faces is not None and max(len(surface.faces), len(surface.vertices)) > faces:
            surface = decimate(path, surface, faces)
        body = _body(path, surface, mass, density, hollow, strict, category)
        check_thickness(body)
        if mass is not None:
            check_density("mass", mass, "kilograms", body)
        elif density > STEEL:
            check_density("density", density, "kilograms per square metre of the surface", body)
        return decompose(body) if parts else body
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _attitude(
    up: Literal["x", "y", "z"] | tuple[float, float, float], front: tuple[float, float, float] | None
) -> np.ndarray:
    """Return the rotation matrix for the arguments `up` and `front` of `load`."""
    if not isinstance(up, str):
        return rotation(up, AXES["z"][1] if front is None else front)
    if front is not None:
        raise ValueError(f"with up={up!r} and front={front}: give an axis x, y or z without front, or two directions")
    return rotation(*AXES[up])


def _wear(pieces: list[trimesh.Trimesh], texture: Path) -> None:
    """Replace the textures of meshes by an image."""
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=read_image(texture))
    for piece in pieces:
        if getattr(piece.visual, "uv", None) is None:
            raise ValueError(f"the mesh has no texture coordinates for {texture}: omit the argument texture")
        piece.visual = trimesh.visual.TextureVisuals(uv=piece.visual.uv, material=material)


def _factor(
    path: Path, corners: np.ndarray, longest_side: float | None, scale: float | None, largest: float | None, pad: float
) -> float:
    """Return the factor from the file's units to metres, after a check of the size."""
    extent = float(np.ptp(corners, axis=(0, 1)).max())
    if longest_side is not None:
        return longest_side / extent
    factor = 1.0 if scale is None else scale
    extent *= factor
    low, high = limits(pad)
    if extent < low * (1 - ROUNDING):
        raise ValueError(
            f"the longest side is {extent * 1e3:.4g} mm, but it must be at least {low * 1e3:g} mm: check "
            "the unit of the file, and give longest_side (in metres), or give scale (in metres per unit)"
        )
    if largest is not None and extent > largest:
        note = ScaledDown(f"{path}: the longest side of {extent:.3g} m is scaled down to {largest} m")
        note.length = extent
        warnings.warn(note, stacklevel=3)
        return factor * largest / extent
    if extent > high * (1 + ROUNDING):
        raise ValueError(
            f"the longest side is {extent:.4g} m, but it must be at most {high:g} m, the width of the sensor's pad: "
            "give longest_side (in metres), or give scale (in metres per unit, 0.001 if the file is in millimetres)"
        )
    return factor


def _body(
    path: Path, surface: Surface, mass: float | None, density: float, hollow: bool, strict: bool, category: int
) -> Body:
    """Make a body of a surface. If the surface encloses no volume, its convex hull bounds the contents."""
    vertices, faces, colors, uv, texture = surface
    if max(len(faces), len(vertices)) > FACE_CLASSES[-1]:
        raise ValueError(
            f"the mesh has {len(faces):,} faces and {len(vertices):,} vertices, but at most {FACE_CLASSES[-1]:,} "
            f"of each are allowed: pass faces={FACE_CLASSES[-1]} to limit both by decimation"
        )
    closed = is_closed(faces)
    enclosed = np.linalg.det(vertices[faces] - vertices.mean(axis=0)).sum() / 6
    try:
        hull = ConvexHull(vertices)
    except (QhullError, ValueError) as error:  # ValueError: there are too few vertices
        raise ValueError("the mesh is flat, so even its convex hull has no volume: give it a thickness") from error
    interior = (vertices, faces)
    holds = hollow and mass is None
    cavity = None
    if not (closed and enclosed > 1e-6 * hull.volume):
        fault = "encloses no volume" if closed else "is not closed"
        if strict:
            raise ValueError(f"the mesh {fault}: repair it, or give strict=False, and its hull bounds the contents")
        if holds:
            warnings.warn(
                f"{path}: the mesh {fault}, so its convex hull ({hull.volume * 1e6:.3g} ml) is used as the space that "
                "the contents can fill",
                stacklevel=3,
            )
        if len(hull.simplices) > max(len(faces), len(vertices)):  # keeps the body in its size class
            points = convex_hull(vertices, limit=256, tolerance=0.0)
            interior = (points, _outward(points, ConvexHull(points)))
        else:
            interior = (vertices, _outward(vertices, hull))
    elif holds:
        if (twice := overlap(vertices, faces)) > OVERLAP * enclosed:
            warnings.warn(
                f"{path}: parts of the mesh overlap, so that {twice * 1e6:.2g} of {enclosed * 1e6:.3g} ml of the "
                "contents count twice: unite the parts, or give the mass",
                stacklevel=3,
            )
        if hull.volume > (1 + OPEN) * enclosed:
            cavity = find_cavity(vertices, faces, enclosed)
            if cavity is not None:
                interior = (cavity.reshape(-1, 3), np.arange(3 * len(cavity)).reshape(-1, 3))
    return assemble(
        vertices,
        faces,
        colors,
        density=np.full(len(faces), density if cavity is None else density / 2),  # the wall has two sides
        interior=interior if holds else None,
        contents_density=CONTENTS if holds else 0.0,
        mass=mass,
        uv=uv,
        texture=texture,
        two_sided=not closed,
        category=category,
    )


def _outward(vertices: np.ndarray, hull: ConvexHull) -> np.ndarray:
    """Return the faces of a hull, counter-clockwise seen from outside."""
    triangles = vertices[hull.simplices]
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    inward = np.einsum("fi,fi->f", normal, hull.equations[:, :3]) < 0
    return np.where(inward[:, None], hull.simplices[:, ::-1], hull.simplices)
