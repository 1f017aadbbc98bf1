"""Mesh files as bodies: any format trimesh reads, with its texture or colours."""

import os
import warnings
from pathlib import Path
from typing import Literal

import numpy as np
import trimesh
from PIL import Image
from scipy.spatial import ConvexHull

from sts_jax.objects.body import FACE_CLASSES, TEXTURE_CLASSES, Body
from sts_jax.objects.solids import CONTENTS, WALL, assemble, linear

PAD = 0.15  # m, side of the sensor's pad: nothing larger fits
PLAIN = 0.7  # sRGB grey of a mesh that names no colour

_UP = {
    "x": np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]]),
    "y": np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "z": np.eye(3),
}


def load(
    path: str | os.PathLike[str],
    *,
    longest_side: float | None = None,
    mass: float | None = None,
    strict: bool = False,
    up: Literal["x", "y", "z"] = "z",
    texture: str | os.PathLike[str] | None = None,
) -> Body:
    """A mesh file as a body; a scene's meshes become one.

    The albedo is texture times corner colour, in linear light. Textures, 8-bit colours and an OBJ's `Kd` are taken as
    sRGB, a glTF's factors and vertex colours as linear (its specification); a textured OBJ's `Kd` is ignored, alpha
    too. Textures are stretched to the next square of TEXTURE_CLASSES; several are packed into one, where coordinates
    outside [0, 1] are clipped instead of repeated. The mesh's frame keeps its axes (see `up`), with its origin moved
    to the centroid of the collision hull: all of the convex hull, or the 64 vertices of it that matter most
    (`hull_gap` gives what then sticks out). Surfaces that are not closed are seen from both sides.

    Args:
        path: the file; what it refers to (materials, images) is found beside it.
        longest_side: m, of the bounding box, to which the mesh is scaled; None keeps the file's units as metres.
        mass: kg, spread over the surface, with no contents. None makes it a shell of 1.2 kg/m^2 that holds
            1,000 kg/m^3 (what of it is filled is given to `rigid`).
        strict: refuse what is otherwise mended with a warning: a mesh that encloses no volume (its convex hull's is
            taken), an OBJ that names a material or image that is not there (it is left out).
        up: the file's axis that becomes +z; glTF files are made with "y".
        texture: an image to use instead of what the file names, on the file's texture coordinates.

    Returns:
        The body, of category -1.

    Raises:
        FileNotFoundError: the file or the texture is not there; with `strict` also one that the file names.
        ValueError: the file cannot be read as a mesh, has no faces, NaN, too many faces, no extent in some direction,
            is larger than the pad; `mass` or `longest_side` is not positive; not closed and `strict`.
    """
    path = Path(path)
    for name, value in (("longest_side", longest_side), ("mass", mass)):
        if value is not None and not (np.isfinite(value) and value > 0):
            unit = {"longest_side": "metres", "mass": "kilograms"}[name]
            raise ValueError(f"{path}: {name} must be a positive number of {unit}, got {value}")
    if longest_side is not None and longest_side > PAD:
        raise ValueError(f"{path}: longest_side is {longest_side} m, the pad is {PAD} m wide: give at most that")
    if up not in _UP:
        raise ValueError(f"{path}: up must be 'x', 'y' or 'z', got {up!r}")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such mesh file")
    sheet = None if texture is None else _image(Path(texture))
    if sheet is None:
        _check_materials(path, strict)
    try:
        scene = trimesh.load_scene(path, process=False)
        pieces = [piece for piece in scene.dump() if isinstance(piece, trimesh.Trimesh) and len(piece.faces)]
    except Exception as error:  # trimesh raises whatever its many readers raise
        raise ValueError(
            f"{path}: cannot be read as a mesh ({error}); is it complete, and its suffix right?"
        ) from error
    if not pieces:
        raise ValueError(f"{path}: holds no faces; a mesh with triangles is needed")
    for piece in pieces if sheet is not None else []:
        if getattr(piece.visual, "uv", None) is None:
            raise ValueError(
                f"{path}: has no texture coordinates, so {texture} cannot be laid on it: leave texture out"
            )
        material = trimesh.visual.material.PBRMaterial(baseColorTexture=sheet)
        piece.visual = trimesh.visual.TextureVisuals(uv=piece.visual.uv, material=material)
    return _body(path, pieces, longest_side, mass, strict, up)


def _body(
    path: Path, pieces: list[trimesh.Trimesh], longest_side: float | None, mass: float | None, strict: bool, up: str
) -> Body:
    number = sum(len(piece.faces) for piece in pieces)
    if number > FACE_CLASSES[-1]:
        raise ValueError(
            f"{path}: {number:,} faces, at most {FACE_CLASSES[-1]:,} can be drawn: decimate it first, for example with "
            "trimesh's simplify_quadric_decimation (package fast-simplification)"
        )
    corners = np.concatenate([_corners(path, piece) for piece in pieces]) @ _UP[up].T
    if not np.isfinite(corners).all():
        bad = int((~np.isfinite(corners)).any(axis=(1, 2)).sum())
        raise ValueError(f"{path}: {bad} faces have NaN or infinite vertices: repair the mesh")
    extent = float(np.ptp(corners, axis=(0, 1)).max())
    if not extent > 0:
        raise ValueError(f"{path}: all vertices lie in one point")
    if longest_side is not None:
        corners *= longest_side / extent
    elif extent > PAD:
        raise ValueError(
            f"{path}: longest side is {extent:.3g} m, the pad is {PAD} m wide: give longest_side in metres "
            "(the file may be in millimetres)"
        )
    colors, uv, texture = _albedo(path, pieces)

    # Corners at one place are one vertex, whatever seams the colours have.
    grain = np.ptp(corners, axis=(0, 1)).max() * 1e-7
    _, first, index = np.unique(
        np.round(corners.reshape(-1, 3) / grain), axis=0, return_index=True, return_inverse=True
    )
    vertices, faces = corners.reshape(-1, 3)[first], index.reshape(-1, 3)
    proper = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    if not proper.any():
        raise ValueError(f"{path}: no face has any area")
    faces, colors, uv = faces[proper], colors[proper], uv[proper]
    used, faces = np.unique(faces, return_inverse=True)
    vertices, faces = vertices[used], faces.reshape(-1, 3)
    if len(vertices) > FACE_CLASSES[-1]:
        raise ValueError(f"{path}: {len(vertices):,} vertices, at most {FACE_CLASSES[-1]:,} fit: decimate it first")

    surface = trimesh.Trimesh(vertices, faces, process=False)
    closed = bool(surface.is_watertight and surface.is_winding_consistent)
    if closed and surface.volume < 0:
        faces, colors, uv = faces[:, ::-1], colors[:, ::-1], uv[:, ::-1]
    try:
        hull = ConvexHull(vertices)
    except Exception as error:
        raise ValueError(
            f"{path}: the mesh is flat, even its convex hull has no volume: give it a thickness"
        ) from error
    interior = (vertices, faces)
    if not (closed and abs(surface.volume) > 1e-6 * hull.volume):
        what = "encloses no volume" if closed else "is not closed"
        if strict:
            raise ValueError(f"{path}: the mesh {what}: close it, or take strict=False for its convex hull's volume")
        if mass is None:
            warnings.warn(
                f"{path}: the mesh {what}; its volume is taken from its convex hull ({hull.volume * 1e6:.3g} ml)",
                stacklevel=3,
            )
        interior = (vertices, _outward(vertices, hull))
    try:
        return assemble(
            vertices,
            faces,
            colors,
            density=np.full(len(faces), WALL),
            interior=interior if mass is None else None,
            contents_density=CONTENTS if mass is None else 0.0,
            mass=mass,
            uv=uv,
            texture=texture,
            two_sided=not closed,
        )
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _corners(path: Path, piece: trimesh.Trimesh) -> np.ndarray:
    faces = np.asarray(piece.faces)
    if faces.min() < 0 or faces.max() >= len(piece.vertices):
        raise ValueError(f"{path}: a face names vertex {faces.max()} of {len(piece.vertices)}: is the file complete?")
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


def _check_materials(path: Path, strict: bool) -> None:
    """trimesh passes in silence over an OBJ's materials and images that are missing or torn."""
    if path.suffix.lower() != ".obj":
        return

    def named(file: Path, word: str) -> list[Path]:
        lines = (line.split(maxsplit=1) for line in file.read_text(errors="replace").splitlines())
        return [file.parent / line[1].strip() for line in lines if len(line) == 2 and line[0].lower() == word]

    files = named(path, "mtllib")
    files += [image for library in files if library.is_file() for image in named(library, "map_kd")]
    missing = [str(file) for file in files if not file.is_file()]
    if missing and strict:
        raise FileNotFoundError(f"{path} names {', '.join(missing)}, not there: put it in place, or give texture=")
    if missing:
        warnings.warn(
            f"{path} names {', '.join(missing)}, not there: drawn without it; texture= gives one", stacklevel=3
        )
    for file in files:
        if file.suffix.lower() != ".mtl" and file.is_file():
            _image(file)


def _albedo(path: Path, pieces: list[trimesh.Trimesh]) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Corner colours, texture coordinates and the texture, of all pieces together."""
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

    # Cells side by side on a sheet of the class's own size, so that it is not resampled again.
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
