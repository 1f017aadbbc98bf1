"""Mesh files as bodies, in any format that trimesh reads, with textures or colours."""

import json
import os
import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import trimesh
from jaxtyping import Float
from PIL import Image
from scipy.spatial import ConvexHull, KDTree

from sts_jax.objects.body import FACE_CLASSES, TEXTURE_CLASSES, Body, check_category
from sts_jax.objects.solids import CONTENTS, WALL, assemble, convex_hull, decompose, linear, surface_samples

PAD = 0.15  # m, side of the sensor's pad, which larger objects do not fit
SMALLEST = 0.005  # m, longest side of the smallest object: a shorter file probably has another unit
PLAIN = 0.7  # sRGB grey of a mesh without colours

# Up and front of a file for which only the up axis is given. Front becomes -y. The front of a glTF is +z (glTF
# specification).
AXES = {
    "x": ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0)),
    "y": ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    "z": ((0.0, 0.0, 1.0), (0.0, -1.0, 0.0)),
}


def rotation(up: Sequence[float], front: Sequence[float]) -> Float[np.ndarray, "3 3"]:
    """Rotation R that takes a file's up axis to +z and the component of its front orthogonal to up to -y.

    Args:
        up: direction of any length.
        front: direction of any length, not parallel to `up`.

    Returns:
        R, a proper rotation: a point p becomes R p.

    Raises:
        ValueError: a direction is not finite or zero, or the two are parallel.
    """
    z, y = np.array(up, float), -np.array(front, float)
    if not (np.isfinite([z, y]).all() and np.linalg.norm(z) > 0):
        raise ValueError(f"up and front must be three finite numbers, not all zero, got {up} and {front}")
    z /= np.linalg.norm(z)
    across = y - (y @ z) * z
    if not np.linalg.norm(across) > 1e-3 * np.linalg.norm(y):
        raise ValueError(f"front is {tuple(front)} and up is {tuple(up)}, but they must not be parallel or zero")
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
    """Load a mesh file as a body. The meshes of a scene are merged into one.

    The albedo is texture times corner colour, in linear light. Textures, 8-bit colours and the `Kd` of an OBJ are read
    as sRGB, factors and vertex colours of a glTF as linear (glTF specification). The `Kd` of a textured OBJ and alpha
    are ignored. A texture is stretched to the next square of TEXTURE_CLASSES. Several textures are packed into one,
    where coordinates outside [0, 1] are clipped instead of repeated. The frame keeps the file's axes (see `up`), with
    the origin at the centroid of the collision hull, which is the convex hull reduced to at most 64 vertices
    (`hull_gap` gives the error). Surfaces that are not closed are visible from both sides.

    Args:
        path: the file. Its materials and images are looked up beside it.
        longest_side: m, longest side of the scaled bounding box. None keeps the file's size.
        scale: m, length of one unit of the file. None means one metre.
        largest: m, maximum of the longest side. A larger mesh is scaled down to it, with a warning.
        mass: kg, spread over the surface of a body without contents. None gives a shell of `density` whose contents
            have 1,000 kg/m^3 (`rigid` takes the fill level).
        density: kg/m^2 of the surface.
        hollow: whether the object has contents. False gives a solid object with all its mass on the surface.
        strict: whether to raise an error for defects that are otherwise repaired with a warning: a mesh that encloses
            no volume (its convex hull's is used), and missing materials and images of an OBJ (they are left out).
        up: axis of the file, or direction in it, that becomes +z. The convention of glTF files is "y".
        front: direction in the file that becomes -y, by default (0, -1, 0). Only with an `up` that is a direction.
        texture: image that replaces the file's own textures, with the file's texture coordinates.
        textures: additional folder in which to look up the file's images.
        faces: maximum number of faces and of vertices. A larger mesh is decimated with a warning, and its texture is
            replaced by one colour per corner. Needs the package fast-simplification.
        parts: whether the body collides as convex parts (`decompose`) instead of its hull. Needs the package coacd.
        category: index into CATEGORIES, or -1.

    Returns:
        The body.

    Raises:
        FileNotFoundError: the file or the texture does not exist, or with `strict` a file that the mesh refers to.
        ImportError: the package for decimation or decomposition is not installed.
        IsADirectoryError: the path is a folder.
        PermissionError: the file is not readable.
        ValueError: the file is empty, truncated or not a mesh. The mesh has no faces, NaN, too many faces, no extent
            in some direction, is larger than the pad or smaller than 5 mm, is not closed although `strict` is set, or
            cannot be decimated to `faces` or decomposed. `mass`, `density`, `category`, `faces`, a size or a direction
            is out of range.
    """
    path = Path(path)
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
            raise ValueError(f"{path}: {name} must be a positive number of {unit}, got {value!r}")
    for name, value in (("longest_side", longest_side), ("largest", largest)):
        if value is not None and value > PAD:
            raise ValueError(f"{path}: {name} is {value} m, but the pad is {PAD} m wide: give at most that")
        if value is not None and value < SMALLEST:
            raise ValueError(
                f"{path}: {name} is {value} m, but the smallest object is {SMALLEST} m long: give at least that"
            )
    try:
        check_category(category)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    if longest_side is not None and scale is not None:
        raise ValueError(f"{path}: give longest_side or scale, not both")
    if faces is not None and (isinstance(faces, bool) or not isinstance(faces, int | np.integer) or faces < 4):
        raise ValueError(f"{path}: faces must be a whole number, at least 4, got {faces!r}")
    if isinstance(up, str):
        if up not in AXES or front is not None:
            raise ValueError(f"{path}: up must be 'x', 'y' or 'z', or three numbers if front is given, got {up!r}")
        turn = rotation(*AXES[up])
    else:
        try:
            turn = rotation(up, AXES["z"][1] if front is None else front)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error
    _check_file(path)
    sheet = None if texture is None else _image(Path(texture))
    images = None if textures is None else Path(textures)
    if sheet is None:
        _check_materials(path, images, strict)
    try:
        # trimesh opens the images itself, so only a resolver can make it look in a separate folder of images.
        resolver = None if images is None else _Resolver(path, images)
        scene = trimesh.load_scene(path, process=False, resolver=resolver)
        pieces = [piece for piece in scene.dump() if isinstance(piece, trimesh.Trimesh) and len(piece.faces)]
    except ModuleNotFoundError as error:
        # For text that is not UTF-8, trimesh imports a package that is not among its requirements.
        damaged = "it is truncated or damaged: replace it" if error.name == "charset_normalizer" else "install it"
        raise ValueError(f"{path}: cannot be read as a mesh ({error}): {damaged}") from error
    except Exception as error:  # trimesh's many readers raise errors of many types
        raise ValueError(
            f"{path}: cannot be read as a mesh ({error}): check that it is complete and has the right suffix"
        ) from error
    if not pieces:
        raise ValueError(f"{path}: has no faces: give a mesh with triangles")
    for piece in pieces if sheet is not None else []:
        if getattr(piece.visual, "uv", None) is None:
            raise ValueError(
                f"{path}: has no texture coordinates, so {texture} cannot be applied to it: leave texture out"
            )
        material = trimesh.visual.material.PBRMaterial(baseColorTexture=sheet)
        piece.visual = trimesh.visual.TextureVisuals(uv=piece.visual.uv, material=material)
    number = sum(len(piece.faces) for piece in pieces)
    if faces is None and number > FACE_CLASSES[-1]:
        raise ValueError(
            f"{path}: has {number:,} faces, but at most {FACE_CLASSES[-1]:,} can be drawn: give faces= to decimate it"
        )
    corners = np.concatenate([_corners(path, piece) for piece in pieces]) @ turn.T
    if not np.isfinite(corners).all():
        bad = int((~np.isfinite(corners)).any(axis=(1, 2)).sum())
        raise ValueError(f"{path}: {bad} faces have NaN or infinite vertices: repair the mesh")
    surface = _surface(path, corners * _factor(path, corners, longest_side, scale, largest), *_albedo(path, pieces))
    if faces is not None and max(len(surface.faces), len(surface.vertices)) > faces:
        surface = _decimated(path, surface, faces)
    body = _body(path, surface, mass, density, hollow, strict, category)
    try:
        return decompose(body) if parts else body
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _check_file(path: Path) -> None:
    """Raise an error unless a file exists, is readable and not empty. An STL file must also be complete."""
    if path.is_dir():
        raise IsADirectoryError(f"{path}: is a folder: give a mesh file in it, or pass it to objects.library")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such mesh file")
    try:
        with path.open("rb") as file:
            head = file.read(1024)
            size = file.seek(0, os.SEEK_END)
            file.seek(max(0, size - 1024))
            tail = file.read()
    except OSError as error:
        raise type(error)(f"{path}: cannot be opened ({error.strerror}): check its permissions") from error
    if not size:
        raise ValueError(f"{path}: is empty: replace it")
    if path.suffix.lower() != ".stl":
        return
    if head.lstrip().startswith(b"solid") and b"facet" in head:
        if b"endsolid" not in tail:
            raise ValueError(f"{path}: is truncated, because its text ends without endsolid: replace it")
        return
    number = int.from_bytes(head[80:84], "little")  # triangles of 50 bytes each
    if size < 84 + 50 * number or size < 84:
        raise ValueError(
            f"{path}: is truncated or not an STL. It has {size:,} bytes, but a binary STL of {number:,} triangles has "
            f"{84 + 50 * number:,}: replace it"
        )


class _Surface(NamedTuple):
    vertices: np.ndarray  # (v, 3), m, without duplicates, even at seams of the colours
    faces: np.ndarray  # (f, 3)
    colors: np.ndarray  # (f, 3, 3)
    uv: np.ndarray  # (f, 3, 2)
    texture: np.ndarray | None  # (t, t, 3)


def _factor(
    path: Path, corners: np.ndarray, longest_side: float | None, scale: float | None, largest: float | None
) -> float:
    extent = float(np.ptp(corners, axis=(0, 1)).max())
    if not extent > 0:
        raise ValueError(f"{path}: all vertices lie at one point")
    if longest_side is not None:
        return longest_side / extent
    factor = 1.0 if scale is None else scale
    extent *= factor
    if extent < SMALLEST:
        raise ValueError(
            f"{path}: its longest side is {extent * 1e3:.2g} mm, but the smallest object is {SMALLEST * 1e3:g} mm "
            "long: check its unit and give longest_side, or scale, the metres of one unit of the file"
        )
    if largest is not None and extent > largest:
        warnings.warn(f"{path}: its longest side is {extent:.3g} m, scaled down to {largest} m", stacklevel=3)
        return factor * largest / extent
    if extent > PAD:
        raise ValueError(
            f"{path}: its longest side is {extent:.3g} m, but the pad is {PAD} m wide: give longest_side in metres "
            "(the file may be in millimetres)"
        )
    return factor


def _surface(
    path: Path, corners: np.ndarray, colors: np.ndarray, uv: np.ndarray, texture: np.ndarray | None
) -> _Surface:
    grain = np.ptp(corners, axis=(0, 1)).max() * 1e-7
    _, first, index = np.unique(
        np.round(corners.reshape(-1, 3) / grain), axis=0, return_index=True, return_inverse=True
    )
    return _proper(path, _Surface(corners.reshape(-1, 3)[first], index.reshape(-1, 3), colors, uv, texture))


def _proper(path: Path, surface: _Surface) -> _Surface:
    """Remove faces without area and unused vertices."""
    faces = surface.faces
    proper = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    if not proper.any():
        raise ValueError(f"{path}: no face has any area")
    used, faces = np.unique(faces[proper], return_inverse=True)
    return surface._replace(
        vertices=surface.vertices[used],
        faces=faces.reshape(-1, 3),
        colors=surface.colors[proper],
        uv=surface.uv[proper],
    )


def _decimated(path: Path, surface: _Surface, target: int) -> _Surface:
    try:
        import fast_simplification
    except ImportError as error:
        raise ImportError(
            f"{path}: has {len(surface.faces):,} faces, and decimation needs the package fast-simplification, which is "
            "not installed: pip install 'sts_jax[meshes]'"
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
            f"{path}: {len(surface.faces):,} faces cannot be decimated to {target:,}, because they form too many loose "
            "parts: give a larger faces="
        )
    triangles, corners = surface.vertices[surface.faces], np.asarray(vertices, float)[faces]
    # Each corner, moved a little towards its face's centre, takes the albedo of the nearest sample of similar normal.
    face, weight = surface_samples(triangles, 20 * target)
    albedo = np.einsum("nk,nkc->nc", weight, surface.colors[face])
    if surface.texture is not None:
        size = len(surface.texture)
        column, row = (np.einsum("nk,nkc->nc", weight, surface.uv[face]) % 1 * size).astype(int).T % size
        albedo = albedo * surface.texture[row, column]
    facing = 0.05 * np.ptp(surface.vertices, axis=0).max()
    tree = KDTree(np.hstack([np.einsum("nk,nkc->nc", weight, triangles[face]), facing * _normals(triangles)[face]]))
    place = (0.8 * corners + 0.2 * corners.mean(axis=1, keepdims=True)).reshape(-1, 3)
    nearest = tree.query(np.hstack([place, facing * np.repeat(_normals(corners), 3, axis=0)]))[1]
    what = "" if surface.texture is None else ", and its texture to one colour per corner"
    warnings.warn(f"{path}: decimated from {len(surface.faces):,} to {len(faces):,} faces{what}", stacklevel=3)
    colors = albedo[nearest].reshape(-1, 3, 3)
    return _proper(
        path,
        _Surface(np.asarray(vertices, float), np.asarray(faces, int), colors, np.zeros((len(faces), 3, 2)), None),
    )


def _welded(surface: _Surface, share: float) -> tuple[np.ndarray, np.ndarray]:
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


def _body(
    path: Path, surface: _Surface, mass: float | None, density: float, hollow: bool, strict: bool, category: int
) -> Body:
    vertices, faces, colors, uv, texture = surface
    if max(len(faces), len(vertices)) > FACE_CLASSES[-1]:
        raise ValueError(
            f"{path}: has {len(faces):,} faces and {len(vertices):,} vertices, but at most {FACE_CLASSES[-1]:,} fit: "
            "give faces= to decimate it"
        )
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    closed = _is_closed(faces)
    if closed and mesh.volume < 0:
        faces, colors, uv = faces[:, ::-1], colors[:, ::-1], uv[:, ::-1]
    try:
        hull = ConvexHull(vertices)
    except Exception as error:
        raise ValueError(
            f"{path}: the mesh is flat, so even its convex hull has no volume: give it a thickness"
        ) from error
    interior = (vertices, faces)
    holds = hollow and mass is None
    if not (closed and abs(mesh.volume) > 1e-6 * hull.volume):
        what = "encloses no volume" if closed else "is not closed"
        if strict:
            raise ValueError(f"{path}: the mesh {what}: close it, or give strict=False to use its convex hull's volume")
        if holds:
            warnings.warn(
                f"{path}: the mesh {what}, so its volume is taken from its convex hull ({hull.volume * 1e6:.3g} ml)",
                stacklevel=3,
            )
        if len(hull.simplices) > max(len(faces), len(vertices)):  # keeps the body in its padding class
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


def _is_closed(faces: np.ndarray) -> bool:
    """Whether faces have no boundary: each edge is traversed equally often in both directions.

    A single part is then watertight and consistently wound. Where touching parts have been welded, more than two faces
    may meet at an edge without leaving a hole.
    """
    start, end = faces.reshape(-1).astype(np.int64), np.roll(faces, -1, axis=1).reshape(-1)
    edge = np.minimum(start, end) * (faces.max() + 1) + np.maximum(start, end)
    _, place = np.unique(edge, return_inverse=True)
    return not np.bincount(place.reshape(-1), np.where(start < end, 1, -1)).any()


def _corners(path: Path, piece: trimesh.Trimesh) -> np.ndarray:
    faces = np.asarray(piece.faces)
    wrong = faces[(faces < 0) | (faces >= len(piece.vertices))]
    if wrong.size:
        raise ValueError(
            f"{path}: a face refers to vertex {wrong[0]}, but vertices are numbered from 0 to "
            f"{len(piece.vertices) - 1}: check that the file is complete"
        )
    return np.asarray(piece.vertices, float)[faces]


def _outward(vertices: np.ndarray, hull: ConvexHull) -> np.ndarray:
    triangles = vertices[hull.simplices]
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    inward = np.einsum("fi,fi->f", normal, hull.equations[:, :3]) < 0
    return np.where(inward[:, None], hull.simplices[:, ::-1], hull.simplices)


def _image(path: Path) -> Image.Image:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such image file")
    try:
        with Image.open(path) as picture:
            return picture.convert("RGB")
    except (OSError, SyntaxError) as error:
        raise ValueError(f"{path}: cannot be read as an image ({error}): replace it") from error


class _Resolver(trimesh.resolvers.FilePathResolver):
    def __init__(self, path: Path, images: Path) -> None:
        super().__init__(str(path))
        self.images = images

    def get(self, name: str) -> bytes:
        found = _found(Path(self.parent), name, self.images)
        return super().get(name) if found is None else found.read_bytes()


def _found(folder: Path, name: str, images: Path | None) -> Path | None:
    """Find a file that a mesh file in `folder` refers to: by its relative path, or by its base name in `images`."""
    name = name.strip().replace("\\", "/")
    places = [folder / name] + ([] if images is None else [images / Path(name).name])
    return next((place for place in places if place.is_file()), None)


def _named(file: Path, word: str) -> list[str]:
    return re.findall(
        rf"^[ \t]*{word}[ \t]+(\S.*?)\s*$", file.read_text(errors="replace"), re.IGNORECASE | re.MULTILINE
    )


def references(path: Path, images: Path | None = None) -> dict[str, Path | None]:
    """Files that an OBJ or glTF file refers to, by name, or None for a missing file. Other formats are not read."""
    if path.suffix.lower() == ".gltf":
        tree = json.loads(path.read_text())
        names = [part.get("uri", "data:") for key in ("buffers", "images") for part in tree.get(key, [])]
        return {name: _found(path.parent, name, images) for name in names if not name.startswith("data:")}
    if path.suffix.lower() != ".obj":
        return {}
    files = {name: _found(path.parent, name, None) for name in _named(path, "mtllib")}
    for library in [library for library in files.values() if library is not None]:
        files |= {name: _found(path.parent, name, images) for name in _named(library, "map_kd")}
    return files


def _check_materials(path: Path, images: Path | None, strict: bool) -> None:
    """Check the materials and images of an OBJ, because trimesh silently ignores missing and damaged ones."""
    if path.suffix.lower() != ".obj":
        return
    files = references(path, images)
    missing = [str(path.parent / name) for name, file in files.items() if file is None]
    if missing and strict:
        raise FileNotFoundError(f"{path} refers to {', '.join(missing)}, not found: add it, or give texture=")
    if missing:
        warnings.warn(
            f"{path} refers to {', '.join(missing)}, not found: drawn without it unless texture= is given", stacklevel=3
        )
    for file in files.values():
        if file is not None and file.suffix.lower() != ".mtl":
            _image(file)


def _albedo(path: Path, pieces: list[trimesh.Trimesh]) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Corner colours, texture coordinates and the texture of all pieces together."""
    is_linear = path.suffix.lower() in (".glb", ".gltf")
    colors, uvs, images = [], [], []
    for piece in pieces:
        color, uv, image = _piece_albedo(piece, is_linear)
        colors.append(color)
        uvs.append(uv)
        images.append(image)
    pictures = [image for image in images if image is not None]
    if not pictures:
        return np.concatenate(colors), np.concatenate(uvs), None
    try:
        sheets = [np.asarray(picture.convert("RGB")) for picture in pictures]
    except (OSError, SyntaxError) as error:
        raise ValueError(f"{path}: its texture cannot be read ({error}): replace it") from error
    distinct: list[np.ndarray] = []
    cell = []
    for sheet in sheets:
        same = [i for i, other in enumerate(distinct) if np.array_equal(other, sheet)]
        cell.append(same[0] if same else len(distinct))
        if not same:
            distinct.append(sheet)
    plain = len(distinct) if any(image is None for image in images) else -1
    if plain >= 0:  # untextured pieces look up a white cell
        distinct.append(np.full((8, 8, 3), 255, np.uint8))
    if len(distinct) == 1:
        return (
            np.concatenate(colors),
            np.concatenate(uvs),
            linear(_square(distinct[0], _texture_class(max(distinct[0].shape[:2]))) / 255.0),
        )

    # The cells tile a sheet of a texture class's size, so that it is not resampled again.
    grid = int(np.ceil(np.sqrt(len(distinct))))
    size = _texture_class(grid * max(max(sheet.shape[:2]) for sheet in distinct))
    side = size // grid
    atlas = np.zeros((size, size, 3), np.uint8)
    for index, sheet in enumerate(distinct):
        row, column = divmod(index, grid)
        atlas[row * side : (row + 1) * side, column * side : (column + 1) * side] = _square(sheet, side)
    cells = iter(cell)
    margin = 0.5 / side
    for index, uv in enumerate(uvs):
        place = plain if images[index] is None else next(cells)
        inside = uv - np.floor(uv.min(axis=1, keepdims=True) + 1e-6)
        uvs[index] = (np.clip(inside, margin, 1 - margin) + np.array(divmod(place, grid)[::-1])) * (side / size)
    return np.concatenate(colors), np.concatenate(uvs), linear(atlas / 255.0)


def _texture_class(longest: int) -> int:
    return next((size for size in TEXTURE_CLASSES if longest <= size), TEXTURE_CLASSES[-1])


def _square(sheet: np.ndarray, side: int) -> np.ndarray:
    if sheet.shape[:2] == (side, side):
        return sheet
    return np.asarray(Image.fromarray(sheet).resize((side, side), Image.Resampling.LANCZOS))


def _piece_albedo(piece: trimesh.Trimesh, is_linear: bool) -> tuple[np.ndarray, np.ndarray, Image.Image | None]:
    faces = np.asarray(piece.faces)
    uv = np.zeros((len(faces), 3, 2))
    visual = piece.visual
    decode = (lambda x: x) if is_linear else linear
    if isinstance(visual, trimesh.visual.TextureVisuals):
        material = visual.material
        if isinstance(material, trimesh.visual.material.PBRMaterial):
            image, factor = material.baseColorTexture, material.baseColorFactor
        else:
            image, factor = getattr(material, "image", None), getattr(material, "diffuse", None)
        if visual.uv is None or len(visual.uv) != len(piece.vertices):
            image = None
        if image is not None:
            uv = np.asarray(visual.uv, float)[faces]
            uv = np.stack([uv[..., 0], 1 - uv[..., 1]], axis=-1)
        if factor is None or (image is not None and not is_linear):
            color = np.ones(3) if image is not None or is_linear else linear(np.full(3, PLAIN))
        else:
            color = decode(_unit(np.asarray(factor))[:3])
        corner = np.broadcast_to(color, (len(faces), 3, 3))
        painted = visual.vertex_attributes.get("color") if is_linear else None
        if painted is not None and len(painted) == len(piece.vertices):
            corner = corner * _unit(np.asarray(painted))[faces][..., :3]
        return np.array(corner), uv, image
    if visual.kind == "vertex":
        return decode(_unit(np.asarray(visual.vertex_colors))[faces][..., :3]), uv, None
    if visual.kind == "face":
        corner = decode(_unit(np.asarray(visual.face_colors))[:, None, :3])
        return np.repeat(corner, 3, axis=1), uv, None
    return np.full((len(faces), 3, 3), linear(np.array(PLAIN))), uv, None


def _unit(color: np.ndarray) -> np.ndarray:
    return color / np.iinfo(color.dtype).max if np.issubdtype(color.dtype, np.integer) else color.astype(float)
