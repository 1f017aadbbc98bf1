"""Objects of a collection that come from mesh files."""

import dataclasses
import functools
import hashlib
import os
from collections.abc import Callable
from typing import Literal

import numpy as np
from scipy import spatial

from sts_jax import objects, physics

SAME = 1e-5  # m, largest difference between files of one mesh in several formats


@dataclasses.dataclass(frozen=True)
class Meshes:
    """Objects from files, see `survey_meshes`."""

    folder: str
    names: tuple[str, ...]  # names of items of `objects.library`
    labels: tuple[str, ...]  # class of each
    digest: str  # SHA-256 of the names and files
    cache: str | None = None  # folder, see `objects.library`
    scale: float | None = None  # m, length of one unit of the files
    up: Literal["x", "y", "z"] | None = None


def survey_meshes(
    folder: str | os.PathLike[str],
    scenario: physics.Scenario,
    *,
    classes: tuple[str, ...] = (),
    scale: float | None = None,
    up: Literal["x", "y", "z"] | None = None,
    parts: bool = False,
    cache: str | os.PathLike[str] | None = None,
    progress: Callable[[str], None] | None = None,
) -> tuple[Meshes, str]:
    """List the objects of a folder of meshes, or of ShapeNetSem, that a scenario can use.

    Args:
        folder: See `objects.library`.
        scenario: The scenario that the objects are for.
        classes: The classes to use, see `mesh_classes`. Empty means all.
        scale: Length of one unit of the files (m). Default: the value in ShapeNetSem's table, or 1 m for other files.
        up: The files' axis that becomes +z. Default: the axis in ShapeNetSem's table, y for glTF, z for other files.
        parts: Whether objects whose hull fits badly collide as convex parts.
        cache: Folder that keeps the processed objects.
        progress: Called with a line for each object.

    Returns:
        The usable objects, and a listing of them and of the objects that were left out, with the reasons. Files with
        the same mesh count as one object, whatever their names and formats, so that no mesh is in two parts of the
        split.

    Raises:
        FileNotFoundError: The folder does not exist.
        ValueError: The folder holds no mesh, no usable mesh, or no mesh of one of the classes.
    """
    library = objects.library(folder, cache=cache, scale=scale, up=up, parts=parts)
    unknown = sorted(set(classes) - set(library.classes))
    if unknown:
        raise ValueError(f"{folder} holds no {', '.join(unknown)}: choose among {', '.join(library.classes)}")
    items = tuple(item for item in library.items if not classes or item.label in classes)
    library, listing = objects.survey(dataclasses.replace(library, items=items), progress=progress)
    usable, digest = [], hashlib.sha256()
    seen: dict[int, list[tuple[str, np.ndarray]]] = {}  # name and `_triangles`, by the number of triangles
    for index, item in enumerate(library.items):
        body = objects.read(library, index).body
        reason = physics.refusal(body, scenario)
        if reason is not None:
            listing += f"{item.name}: left out of {type(scenario).__name__}: {reason}\n"
            continue
        triangles = _triangles(body)
        alike = seen.setdefault(len(triangles), [])
        twin = next((name for name, other in alike if _same(triangles, other)), None)
        if twin is not None:
            listing += f"{item.name}: the same mesh as {twin}, left out\n"
            continue
        alike.append((item.name, triangles))
        usable.append(item)
        digest.update(item.name.encode() + hashlib.sha256(item.path.read_bytes()).digest())
    if not usable:
        raise ValueError(f"{folder} holds no object that can be used:\n{listing}")
    names, labels = tuple(item.name for item in usable), tuple(item.label for item in usable)
    kept = None if cache is None else str(cache)
    return Meshes(str(folder), names, labels, digest.hexdigest(), kept, scale, up), listing


def _triangles(body: objects.Body) -> np.ndarray:
    """The centres of a body's triangles (n, 3), without the padding."""
    corners = np.asarray(body.vertices)[np.asarray(body.faces)]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1)
    return corners[area > 0].mean(1)


def _same(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether two meshes with the same number of triangles have them at the same places, in any order."""
    box = [np.stack([x.min(0), x.max(0)]) for x in (one, other)]
    if np.abs(box[0] - box[1]).max() > SAME:
        return False
    pairs = ((one, other), (other, one))
    return all(spatial.cKDTree(x).query(y)[0].max() <= SAME for x, y in pairs)


def mesh_classes(folder: str | os.PathLike[str]) -> tuple[str, ...]:
    """The classes of the objects of a folder (see `objects.library`). No mesh is opened."""
    return objects.library(folder).classes


@functools.lru_cache
def open_library(meshes: Meshes, parts: bool) -> tuple[objects.Library, dict[str, int]]:
    """The library of some meshes, and the index of each of its items by name."""
    library = objects.library(meshes.folder, cache=meshes.cache, scale=meshes.scale, up=meshes.up, parts=parts)
    return library, {item.name: index for index, item in enumerate(library.items)}
