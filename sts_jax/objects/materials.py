"""Colours and textures of mesh files."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from sts_jax.objects.body import TEXTURE_CLASSES
from sts_jax.objects.checks import check_appearance
from sts_jax.objects.colors import PLAIN, linear
from sts_jax.objects.files import rgb


def albedo(path: Path, pieces: list[trimesh.Trimesh]) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Colours (f, 3, 3), texture coordinates (f, 3, 2) and the common texture, if any, of a file, in linear light."""
    is_linear = path.suffix.lower() in (".glb", ".gltf")
    colors, uvs, images = [], [], []
    for piece in pieces:
        color, uv, image = _piece_albedo(piece, is_linear)
        check_appearance(color, uv)
        colors.append(np.clip(color, 0, 1))
        uvs.append(uv)
        images.append(image)
    try:
        sheets = [None if image is None else np.asarray(rgb(image)) for image in images]
    except (OSError, SyntaxError, ValueError) as error:
        raise ValueError(f"a texture of the mesh cannot be read ({error}): replace the texture") from error
    uv, texture = combined(sheets, uvs)
    return np.concatenate(colors), uv, texture


def combined(sheets: Sequence[np.ndarray | None], uvs: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray | None]:
    """Combine the textures of several pieces, sRGB with 8 bits or None, into one square texture in linear light.

    Returns:
        Texture coordinates of all faces, (f, 3, 2), and the texture, None if no piece has one.
    """
    distinct: list[np.ndarray] = []
    cell = []
    for sheet in sheets:
        if sheet is None:
            continue
        same = [i for i, other in enumerate(distinct) if np.array_equal(other, sheet)]
        cell.append(same[0] if same else len(distinct))
        if not same:
            distinct.append(sheet)
    if not distinct:
        return np.concatenate(uvs), None
    plain = len(distinct) if any(sheet is None for sheet in sheets) else -1
    if plain >= 0:  # the texture of untextured pieces is a white cell
        distinct.append(np.full((8, 8, 3), 255, np.uint8))
    if len(distinct) == 1:
        texture = _square(distinct[0], _texture_class(max(distinct[0].shape[:2])))
    else:
        cells = iter(cell)
        texture, uvs = _packed(distinct, uvs, [plain if sheet is None else next(cells) for sheet in sheets])
    return np.concatenate(uvs), linear(texture / 255.0)


def _packed(sheets: list[np.ndarray], uvs: list[np.ndarray], cells: list[int]) -> tuple[np.ndarray, list[np.ndarray]]:
    """Pack textures into cells of one texture. `cells` has the index of the texture of each piece."""
    # The packed texture has the size of a texture class, so that it is not resampled again.
    grid = int(np.ceil(np.sqrt(len(sheets))))
    size = _texture_class(grid * max(max(sheet.shape[:2]) for sheet in sheets))
    side = size // grid
    atlas = np.zeros((size, size, 3), np.uint8)
    for index, sheet in enumerate(sheets):
        row, column = divmod(index, grid)
        atlas[row * side : (row + 1) * side, column * side : (column + 1) * side] = _square(sheet, side)
    margin = 0.5 / side
    mapped = []
    for uv, cell in zip(uvs, cells, strict=True):
        inside = uv - np.floor(uv.min(axis=1, keepdims=True) + 1e-6)
        mapped.append((np.clip(inside, margin, 1 - margin) + np.array(divmod(cell, grid)[::-1])) * (side / size))
    return atlas, mapped


def _texture_class(longest: int) -> int:
    return next((size for size in TEXTURE_CLASSES if longest <= size), TEXTURE_CLASSES[-1])


def _square(sheet: np.ndarray, side: int) -> np.ndarray:
    """Stretch an image to a square."""
    if sheet.shape[:2] == (side, side):
        return sheet
    return np.asarray(Image.fromarray(sheet).resize((side, side), Image.Resampling.LANCZOS))


def _piece_albedo(piece: trimesh.Trimesh, is_linear: bool) -> tuple[np.ndarray, np.ndarray, Image.Image | None]:
    """Colours (f, 3, 3) in linear light, texture coordinates (f, 3, 2) and the image, if any, of one mesh."""
    faces = np.asarray(piece.faces)
    uv = np.zeros((len(faces), 3, 2))
    visual = piece.visual
    decode = (lambda x: x) if is_linear else linear
    if isinstance(visual, trimesh.visual.TextureVisuals):
        material = visual.material
        if isinstance(material, trimesh.visual.material.PBRMaterial):
            image, factor = material.baseColorTexture, piece.metadata.get("factor", material.baseColorFactor)
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
        painted = piece.vertex_attributes.get("color") if is_linear else None
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
    """Scale colours of any integer type to [0, 1]. Floats keep their values."""
    return color / np.iinfo(color.dtype).max if np.issubdtype(color.dtype, np.integer) else color.astype(float)
