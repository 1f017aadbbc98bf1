"""Loading of mesh files as bodies, in any format that trimesh reads, with textures or colours."""

import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial import ConvexHull, QhullError

from sts_jax.objects.assembly import CONTENTS, WALL, assemble
from sts_jax.objects.body import FACE_CLASSES, PAD, SMALLEST, Body, check_category
from sts_jax.objects.decimation import decimate
from sts_jax.objects.hulls import convex_hull
from sts_jax.objects.materials import Resolver, albedo, check_materials, read_image
from sts_jax.objects.parts import decompose
from sts_jax.objects.surface import Surface, is_closed, merge

# Up and front directions of a file for which only the up axis is given. Up becomes +z, and front becomes -y. The front
# of a glTF file is +z (glTF specification).
AXES = {
    "x": ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0)),
    "y": ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    "z": ((0.0, 0.0, 1.0), (0.0, -1.0, 0.0)),
}


def rotation(up: Sequence[float], front: Sequence[float]) -> Float[np.ndarray, "3 3"]:
    """Compute the rotation that turns a file's up direction to +z and its front direction to -y.

    If the directions are not perpendicular, only the component of `front` perpendicular to `up` is turned to -y.

    Args:
        up: Direction in the file, of any length.
        front: Direction in the file, of any length, not parallel to `up`.

    Returns:
        Rotation matrix R. A point p of the file becomes R p.

    Raises:
        ValueError: A direction is zero or not finite, or the two directions are parallel.
    """
    try:
        z, y = np.array(up, float), -np.array(front, float)
        valid = z.shape == y.shape == (3,) and np.isfinite([z, y]).all() and np.linalg.norm(z) > 0
    except (TypeError, ValueError):  # not numbers
        valid = False
    if not valid:
        raise ValueError(
            f"up is {up} and front is {front}, but each must be three finite numbers, and up must not be (0, 0, 0)"
        )
    z /= np.linalg.norm(z)
    across = y - (y @ z) * z
    if not np.linalg.norm(across) > 1e-3 * np.linalg.norm(y):
        raise ValueError(
            f"front is {tuple(front)} and up is {tuple(up)}, but they must not be parallel, and front must not be "
            "(0, 0, 0): give a front direction perpendicular to up"
        )
    y = across / np.linalg.norm(across)
    return np.stack([np.cross(y, z), y, z])


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
) -> Body:
    """Load a mesh file as a body. All meshes of the file are merged into one.

    The mesh frame is the file's frame, rotated by `up` and `front`. Its origin is the centroid of the collision hull.
    The collision hull is the convex hull of the mesh, reduced to at most 64 vertices. If `parts` is False, the
    collision hull represents the body in collisions. `hull_gap` measures how far the surface lies outside the collision
    hull. Surfaces that are not closed are visible from both sides.

    The albedo at a point of a face is the texture's value times the interpolated colour of the face's corners, in
    linear light. Textures, 8-bit colours and the diffuse colour `Kd` of an OBJ file are read as sRGB. Colour factors
    and vertex colours of a glTF file are read as linear light (glTF specification). Alpha values are ignored. The `Kd`
    of an OBJ material that has a texture is ignored too. Textures are resized to a square with a side of 1 pixel, 256
    pixels or 1,024 pixels. Several textures are packed into one square. The repetitions of a texture within a face are
    then lost.

    Args:
        path: The mesh file. Its materials and images are looked up in the same folder.
        longest_side: Longest side of the bounding box after scaling (m), from 5 mm to 0.15 m. None keeps the file's
            size. Must be None if `scale` is given.
        scale: Length of one unit of the file (m). None is 1 m.
        largest: Upper limit of the longest side (m), from 5 mm to 0.15 m. A larger mesh is scaled down to this limit
            with a warning. None raises an error for a mesh that is longer than 0.15 m, the width of the pad. Has no
            effect if `longest_side` is given.
        mass: Mass of the body (kg), spread over its surface. The body then has no contents. None computes the mass of
            the shell from `density`.
        density: Mass of the shell per area (kg/m^2), if `mass` is None.
        hollow: If True and `mass` is None, the body has contents of 1,000 kg/m^3. The body does not store how full it
            is. The filled share of the interior is an argument of the function `rigid`. If False, the body has no
            contents.
        strict: If True, a mesh that is not closed or encloses no volume is an error, and so is a missing material or
            image of an OBJ file. If False, these defects are repaired with a warning. If a mesh is not closed or
            encloses no volume, the repair uses the convex hull of the mesh as the boundary of the contents. Missing
            materials and images are left out.
        up: Axis of the file, or direction in the file, that becomes +z. The convention of glTF files is "y".
        front: Direction in the file that becomes -y. If `up` is an axis such as "z", `front` must be None. If
            `up` is a direction (a tuple), the default None means (0, -1, 0).
        texture: Image file that replaces the file's own textures. It needs texture coordinates in the mesh.
        textures: Additional folder in which the file's images are looked up.
        faces: Largest number of faces and of vertices, at least 4. A larger mesh is decimated with a warning, and its
            texture is replaced by one colour at each corner of each face. This needs the package fast-simplification.
        parts: If True, the body collides as convex parts (`decompose`) instead of as its convex hull. This needs the
            package coacd.
        category: Index into CATEGORIES, or -1 for an object of no category.

    Returns:
        The body.

    Raises:
        FileNotFoundError: The file or the texture does not exist, or `strict` is True and a material or an image of an
            OBJ file is missing.
        ImportError: A package for the decimation or the decomposition of the mesh is needed and not installed.
        IsADirectoryError: The path is a folder.
        PermissionError: The file is not readable.
        ValueError: The file is empty, truncated or not a mesh, or an image cannot be read. The mesh is flat, has no
            faces, or has a vertex that is not finite. It has more faces or vertices than the renderer can draw, and
            `faces` is None. Its longest side is above 0.15 m or below 5 mm.
            The mesh lacks the texture coordinates that `texture` needs. `strict` is True, and the mesh is not closed or
            encloses no volume. The mesh cannot be decimated to `faces`, or cannot be decomposed into convex parts. An
            argument is out of range.
    """
    path = Path(path)
    _check_arguments(path, longest_side, scale, largest, mass, density, faces, category)
    turn = _attitude(path, up, front)
    _check_file(path)
    images = None if textures is None else Path(textures)
    if texture is None:
        check_materials(path, images, strict)
    pieces = _read(path, images, None if texture is None else Path(texture))
    number = sum(len(piece.faces) for piece in pieces)
    if faces is None and number > FACE_CLASSES[-1]:
        raise ValueError(
            f"{path}: the mesh has {number:,} faces, but at most {FACE_CLASSES[-1]:,} can be drawn: pass "
            f"faces={FACE_CLASSES[-1]} to decimate it"
        )
    corners = np.concatenate([_corners(path, piece) for piece in pieces]) @ turn.T
    if not np.isfinite(corners).all():
        bad = int((~np.isfinite(corners)).any(axis=(1, 2)).sum())
        raise ValueError(f"{path}: the mesh has NaN or infinite vertices in {bad} of its faces: repair the mesh")
    surface = merge(path, corners * _factor(path, corners, longest_side, scale, largest), *albedo(path, pieces))
    if faces is not None and max(len(surface.faces), len(surface.vertices)) > faces:
        surface = decimate(path, surface, faces)
    body = _body(path, surface, mass, density, hollow, strict, category)
    try:
        return decompose(body) if parts else body
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _check_arguments(
    path: Path, longest_side: Any, scale: Any, largest: Any, mass: Any, density: Any, faces: Any, category: Any
) -> None:
    """Raise a ValueError that names the first argument of `load` that is out of range."""
    for name, value, unit in (
        ("longest_side", longest_side, "metres"),
        ("scale", scale, "metres"),
        ("largest", largest, "metres"),
        ("mass", mass, "kilograms"),
        ("density", density, "kilograms per square metre"),
    ):
        if value is not None and not (
            np.asarray(value).dtype.kind in "iuf" and np.ndim(value) == 0 and np.isfinite(value) and value > 0
        ):
            raise ValueError(f"{path}: the argument `{name}` must be a positive number of {unit}, got {value!r}")
    for name, value in (("longest_side", longest_side), ("largest", largest)):
        if value is not None and value > PAD:
            raise ValueError(
                f"{path}: the argument {name} is {value} m, but the sensor's pad is {PAD} m wide: give at most {PAD}"
            )
        if value is not None and value < SMALLEST:
            raise ValueError(
                f"{path}: the argument {name} is {value} m, but an object must be at least {SMALLEST} m long: give at "
                f"least {SMALLEST}"
            )
    try:
        check_category(category)
    except ValueError as error:
        raise ValueError(f"{path}: the argument {error}") from None
    if longest_side is not None and scale is not None:
        raise ValueError(f"{path}: give longest_side or scale, not both")
    if faces is not None and (isinstance(faces, bool) or not isinstance(faces, int | np.integer) or faces < 4):
        raise ValueError(f"{path}: the argument `faces` must be a whole number >= 4, got {faces!r}")


def _attitude(
    path: Path, up: Literal["x", "y", "z"] | tuple[float, float, float], front: tuple[float, float, float] | None
) -> np.ndarray:
    """Return the rotation matrix for the arguments `up` and `front` of `load`."""
    if isinstance(up, str):
        if up not in AXES or front is not None:
            raise ValueError(
                f"{path}: `up` is {up!r} and `front` is {front}, but this combination is not allowed: pass 'x', 'y' or "
                "'z' as `up` and omit `front`, or pass a direction of three numbers as `up`, with or without `front`"
            )
        return rotation(*AXES[up])
    try:
        return rotation(up, AXES["z"][1] if front is None else front)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _read(path: Path, images: Path | None, texture: Path | None) -> list[trimesh.Trimesh]:
    """Read the meshes of a file. The image `texture` replaces their textures."""
    sheet = None if texture is None else read_image(texture)
    try:
        # trimesh opens the images itself, so only a resolver can make it look in a separate folder of images.
        resolver = None if images is None else Resolver(path, images)
        scene = trimesh.load_scene(path, process=False, resolver=resolver)
        pieces = [piece for piece in scene.dump() if isinstance(piece, trimesh.Trimesh) and len(piece.faces)]
    except ModuleNotFoundError as error:
        # For text that is not UTF-8, trimesh imports a package that is not one of its requirements.
        install = f"install the package {error.name}"
        remedy = "the file is truncated or damaged: replace it" if error.name == "charset_normalizer" else install
        raise ValueError(f"{path}: the file cannot be read as a mesh ({error}): {remedy}") from error
    except Exception as error:  # trimesh's many readers raise errors of many types
        raise ValueError(
            f"{path}: the file cannot be read as a mesh ({error}): check that it is complete and has the right suffix"
        ) from error
    if not pieces:
        raise ValueError(f"{path}: the mesh has no faces: give a mesh with triangles")
    for piece in pieces if sheet is not None else []:
        if getattr(piece.visual, "uv", None) is None:
            raise ValueError(
                f"{path}: the mesh has no texture coordinates, so {texture} cannot be applied to it: omit the argument "
                "texture"
            )
        material = trimesh.visual.material.PBRMaterial(baseColorTexture=sheet)
        piece.visual = trimesh.visual.TextureVisuals(uv=piece.visual.uv, material=material)
    return pieces


def _check_file(path: Path) -> None:
    """Raise an error unless a file exists, can be read and is not empty. An STL file must also be complete."""
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder: give a mesh file in it, or pass the folder to objects.library")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such mesh file: check the path")
    try:
        with path.open("rb") as file:
            head = file.read(1024)
            size = file.seek(0, os.SEEK_END)
            file.seek(max(0, size - 1024))
            tail = file.read()
    except OSError as error:
        raise type(error)(f"{path}: the file cannot be opened ({error.strerror}): check its permissions") from error
    if not size:
        raise ValueError(f"{path}: the file is empty: replace it")
    if path.suffix.lower() != ".stl":
        return
    if head.lstrip().startswith(b"solid") and b"facet" in head:
        if b"endsolid" not in tail:
            raise ValueError(f"{path}: the file is truncated (its last line is not `endsolid`): replace the file")
        return
    number = int.from_bytes(head[80:84], "little")  # triangles of 50 bytes each
    if size < 84 + 50 * number or size < 84:
        raise ValueError(
            f"{path}: the file is truncated or not an STL. Its header announces {number:,} triangles, which need "
            f"{84 + 50 * number:,} bytes, but the file has {size:,} bytes: replace the file"
        )


def _factor(
    path: Path, corners: np.ndarray, longest_side: float | None, scale: float | None, largest: float | None
) -> float:
    """Return the factor from the file's units to metres, after a check of the size."""
    extent = float(np.ptp(corners, axis=(0, 1)).max())
    if not extent > 0:
        raise ValueError(f"{path}: all vertices lie at one point: repair the mesh")
    if longest_side is not None:
        return longest_side / extent
    factor = 1.0 if scale is None else scale
    extent *= factor
    if extent < SMALLEST:
        raise ValueError(
            f"{path}: the longest side is {extent * 1e3:.2g} mm, but it must be at least {SMALLEST * 1e3:g} mm: check "
            "the unit of the file, and give longest_side (in metres), or give scale (in metres per unit)"
        )
    if largest is not None and extent > largest:
        warnings.warn(f"{path}: the longest side of {extent:.3g} m is scaled down to {largest} m", stacklevel=3)
        return factor * largest / extent
    if extent > PAD:
        raise ValueError(
            f"{path}: the longest side is {extent:.3g} m, but it must be at most {PAD} m, the width of the sensor's "
            "pad: give longest_side (in metres), or give scale (in metres per unit, 0.001 if the file is in "
            "millimetres)"
        )
    return factor


def _body(
    path: Path, surface: Surface, mass: float | None, density: float, hollow: bool, strict: bool, category: int
) -> Body:
    """Make a body of a surface. If the surface encloses no volume, its convex hull bounds the contents."""
    vertices, faces, colors, uv, texture = surface
    if max(len(faces), len(vertices)) > FACE_CLASSES[-1]:
        raise ValueError(
            f"{path}: the mesh has {len(faces):,} faces and {len(vertices):,} vertices, but at most "
            f"{FACE_CLASSES[-1]:,} of each are allowed: pass faces={FACE_CLASSES[-1]} to limit both by decimation"
        )
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    closed = is_closed(faces)
    if closed and mesh.volume < 0:
        faces, colors, uv = faces[:, ::-1], colors[:, ::-1], uv[:, ::-1]
    try:
        hull = ConvexHull(vertices)
    except (QhullError, ValueError) as error:  # ValueError: there are too few vertices
        raise ValueError(
            f"{path}: the mesh is flat, so even its convex hull has no volume: give it a thickness"
        ) from error
    interior = (vertices, faces)
    holds = hollow and mass is None
    if not (closed and abs(mesh.volume) > 1e-6 * hull.volume):
        fault = "encloses no volume" if closed else "is not closed"
        if strict:
            raise ValueError(
                f"{path}: the mesh {fault}: repair the mesh, or give strict=False. With strict=False, the space that "
                "the object's contents can fill is the convex hull of the mesh"
            )
        if holds:
            warnings.warn(
                f"{path}: the mesh {fault}, so its interior is unknown. The convex hull of the mesh is used as the "
                f"space that the object's liquid or granular contents can fill ({hull.volume * 1e6:.3g} ml)",
                stacklevel=3,
            )
        if len(hull.simplices) > max(len(faces), len(vertices)):  # keeps the body in its size class
            points = convex_hull(vertices, limit=256, tolerance=0.0)
            interior = (points, _outward(points, ConvexHull(points)))
        else:
            interior = (vertices, _outward(vertices, hull))
    try:
        return assemble(
            vertices,
            faces,
            colors,
            density=np.full(len(faces), density),
            interior=interior if holds else None,
            contents_density=CONTENTS if holds else 0.0,
            mass=mass,
            uv=uv,
            texture=texture,
            two_sided=not closed,
            category=category,
        )
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _corners(path: Path, piece: trimesh.Trimesh) -> np.ndarray:
    """Return the corners (f, 3, 3) of the faces of a mesh, in the file's units."""
    faces = np.asarray(piece.faces)
    wrong = faces[(faces < 0) | (faces >= len(piece.vertices))]
    if wrong.size:
        raise ValueError(
            f"{path}: a face refers to vertex {wrong[0]}, but vertices are numbered from 0 to "
            f"{len(piece.vertices) - 1}: check that the file is complete"
        )
    return np.asarray(piece.vertices, float)[faces]


def _outward(vertices: np.ndarray, hull: ConvexHull) -> np.ndarray:
    """Return the faces of a hull, counter-clockwise seen from outside."""
    triangles = vertices[hull.simplices]
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    inward = np.einsum("fi,fi->f", normal, hull.equations[:, :3]) < 0
    return np.where(inward[:, None], hull.simplices[:, ::-1], hull.simplices)
