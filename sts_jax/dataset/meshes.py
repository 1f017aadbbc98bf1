"""Objects of a collection that come from mesh files."""

import dataclasses
import functools
import hashlib
import os
from collections.abc import Callable, Mapping
from typing import Literal

import numpy as np
from scipy import spatial

from sts_jax import objects, physics
from sts_jax._checked import in_32_bits
from sts_jax.objects.body import PAD

SAME = 1e-5  # m, largest distance between triangles of one mesh in two file formats, which round differently


@dataclasses.dataclass(frozen=True)
class Meshes:
    """The mesh files of a collection, listed by `survey_meshes`."""

    folder: str  # folder of the mesh files
    names: tuple[str, ...]  # path of each file within the folder, or its model id in ShapeNetSem
    labels: tuple[str, ...]  # class of each object
    digest: str  # SHA-256 of the names and contents of the files
    cache: str | None = None  # folder that keeps the processed objects (None: they are not kept)
    # length of one unit of the files (m), or pairs of the names of some and the length, None as in `survey_meshes`
    scale: float | tuple[tuple[str, float], ...] | None = None
    up: Literal["x", "y", "z"] | None = None  # axis of the files that becomes +z, None as in `survey_meshes`
    pad: float | None = None  # width of the sensor's pad (m), None: that of the default sensor


@in_32_bits
def survey_meshes(
    folder: str | os.PathLike[str],
    scenario: physics.Scenario,
    *,
    classes: tuple[str, ...] = (),
    scale: float | Mapping[str, float] | None = None,
    up: Literal["x", "y", "z"] | None = None,
    parts: bool = False,
    pad: float | None = None,
    cache: str | os.PathLike[str] | None = None,
    progress: Callable[[str], None] | None = None,
) -> tuple[Meshes, str]:
    """Search a folder for mesh files that a scenario can use.

    Of several files with the same mesh, whatever their names and formats, one is used. No object is therefore in both
    the training part and the test part of a dataset.

    Args:
        folder: A folder as in `objects.library`.
        scenario: The scenario in which the objects are simulated.
        classes: The classes to use, a subset of `objects.library(folder).classes`. Empty means all.
        scale: Length of one unit of the files (m), or a mapping from files to lengths as in `objects.library`. Default:
            the value in ShapeNetSem's table, or 1 m for other files.
        up: The files' axis that becomes +z. Default: the axis in ShapeNetSem's table, y for glTF, z for other files.
        parts: See `Collection.parts`.
        pad: Width of the sensor's pad (m), such as `float(min(sensor.gel.size))`. Default: that of the default sensor.
        cache: Folder that keeps the processed objects for later calls.
        progress: Called with a line of text after each object.

    Returns:
        The usable objects, and a text that describes each of them and the reason for each object that is left out.
    """
    width = PAD if pad is None else pad
    library = objects.library(folder, cache=cache, scale=scale, up=up, parts=parts, pad=width)
    unknown = sorted(set(classes) - set(library.classes))
    if unknown:
        raise ValueError(f"`classes` contains {', '.join(unknown)}, but {folder} has {', '.join(library.classes)}")
    items = tuple(item for item in library.items if not classes or item.label in classes)
    library, listing = objects.survey(dataclasses.replace(library, items=items), progress=progress)
    usable, digest = [], hashlib.sha256()
    seen: dict[int, list[tuple[str, np.ndarray]]] = {}  # names and `_triangles`, by number of triangles
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
        raise ValueError(f"{folder} has no object that can be used in {type(scenario).__name__}:\n{listing}")
    names, labels = tuple(item.name for item in usable), tuple(item.label for item in usable)
    kept = None if cache is None else str(cache)
    stated = tuple(scale.items()) if isinstance(scale, Mapping) else scale
    return Meshes(str(folder), names, labels, digest.hexdigest(), kept, stated, up, pad), listing


def _triangles(body: objects.Body) -> np.ndarray:
    """The centres of a body's triangles in the mesh frame (m), `(n, 3)`, without the padding."""
    corners = np.asarray(body.vertices)[np.asarray(body.faces)]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1)
    return corners[area > 0].mean(1)


def _same(one: np.ndarray, other: np.ndarray) -> bool:
    """Return whether two arrays of n triangle centres contain the same points up to SAME, in any order."""
    box = [np.stack([x.min(0), x.max(0)]) for x in (one, other)]
    if np.abs(box[0] - box[1]).max() > SAME:
        return False
    pairs = ((one, other), (other, one))
    return all(spatial.cKDTree(x).query(y)[0].max() <= SAME for x, y in pairs)


@functools.lru_cache
def open_library(meshes: Meshes, parts: bool) -> tuple[objects.Library, dict[str, int]]:
    """Library of all mesh files in `meshes.folder`, and the index of each object in its items, by name."""
    scale = dict(meshes.scale) if isinstance(meshes.scale, tuple) else meshes.scale
    pad = PAD if meshes.pad is None else meshes.pad
    library = objects.library(meshes.folder, cache=meshes.cache, scale=scale, up=meshes.up, parts=parts, pad=pad)
    return library, {item.name: index for index, item in enumerate(library.items)}
