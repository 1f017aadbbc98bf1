"""Checks of mesh files: the settings of `load` and `library`, the file itself, and what trimesh returns for it.

The caller puts the path in front of the message of a ValueError.
"""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float

from sts_jax.objects.body import FACE_CLASSES, PAD, SMALLEST


def check_positive(name: str, value: Any, unit: str) -> None:
    """Raise a ValueError unless a setting is None or a positive, finite number."""
    array = np.asarray(value)
    if value is not None and not (array.dtype.kind in "iuf" and array.ndim == 0 and 0 < array < np.inf):
        raise ValueError(f"{name} must be a positive number of {unit}, got {value!r}")


def check_settings(*, longest_side: Any, scale: Any, largest: Any, faces: Any) -> None:
    """Raise a ValueError that names the first setting of size or detail that is out of range."""
    check_positive("scale", scale, "metres per unit of the file")
    for name, value in (("longest_side", longest_side), ("largest", largest)):
        check_positive(name, value, "metres")
        if value is not None and not SMALLEST <= value <= PAD:
            raise ValueError(f"{name} is {value} m, but it must be from {SMALLEST} to {PAD} m, the pad's width")
    if longest_side is not None and scale is not None:
        raise ValueError("give longest_side or scale, not both")
    if faces is not None and (isinstance(faces, bool) or not isinstance(faces, int | np.integer) or faces < 4):
        raise ValueError(f"faces must be a whole number >= 4, got {faces!r}")


def check_file(path: Path) -> None:
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
        raise ValueError("the file is empty: replace it")
    if path.suffix.lower() != ".stl":
        return
    if head.lstrip().startswith(b"solid") and b"facet" in head:
        if b"endsolid" not in tail:
            raise ValueError("the file is truncated (its last line is not `endsolid`): replace the file")
        return
    number = int.from_bytes(head[80:84], "little")  # triangles of 50 bytes each
    if size < 84 + 50 * number or size < 84:
        raise ValueError(
            f"the file is truncated or not an STL: its header announces {number:,} triangles, but the file has "
            f"{size:,} bytes. Replace the file"
        )


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
