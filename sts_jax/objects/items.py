"""A folder of mesh files: `Item` (one file), `Library` (all items), `Entry` (a loaded item), and a cache of bodies."""

import dataclasses
import functools
import hashlib
import json
import warnings
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from sts_jax._checked import check_arrays
from sts_jax.objects.body import FACE_CLASSES, HULL_CLASSES, PAD, PART_CLASSES, TEXTURE_CLASSES, Body
from sts_jax.objects.formats import references
from sts_jax.storage import decode, write_arrays

LARGEST = 0.12  # m, larger objects are scaled down to this longest side, so that they can lie on the pad of 0.15 m
NUM_FACES = 4096  # the largest size class whose rendering is cheap, larger meshes are decimated
_FORMAT = 2  # version of cached bodies, increased when the same file and settings lead to another body

Vector = tuple[float, float, float]


@dataclasses.dataclass(frozen=True)
class Item:
    """One mesh file and the settings for loading it."""

    path: Path  # The mesh file.
    name: str  # Path within the folder, or ShapeNetSem's model id.
    label: str  # Class of the object.
    up: Vector  # Direction in the file that becomes +z.
    front: Vector  # Direction in the file that becomes -y.
    scale: float | None = None  # Length of one unit of the file (m).
    textures: Path | None = None  # Additional folder of images.
    notes: tuple[str, ...] = ()  # Remarks on the item for the listing of the library.


@dataclasses.dataclass(frozen=True)
class Library:
    """The mesh files of a folder in a fixed order, and the files that are not used, each with the reason."""

    folder: Path  # Folder of the mesh files.
    items: tuple[Item, ...]  # Objects, sorted by class and name.
    skipped: tuple[tuple[str, str], ...]  # (name, reason) of each file or model that is not used.
    classes: tuple[str, ...]  # Classes of the items, sorted.
    cache: Path | None = None  # Folder of the cached bodies.
    parts: bool = False  # True if objects that stand off their convex hull collide as convex parts.
    pad: float = PAD  # Width of the sensor's pad (m).


@dataclasses.dataclass(frozen=True)
class Entry:
    """A loaded item: its body, the gaps between the body's surface and its collision parts, and notes on repairs."""

    item: Item  # The item that was loaded.
    body: Body  # The loaded body.
    # Largest distances (m) of the surface outside the collision parts, and of the collision parts outside the surface.
    gaps: tuple[float, float]
    notes: tuple[str, ...]  # Repairs of the mesh and remarks on the item.
    length: float  # Longest side before a larger object was scaled down (m).


@dataclasses.dataclass(frozen=True)
class _About:
    """What a file of the cache says of a body beside its arrays."""

    gaps: tuple[float, float]
    notes: tuple[str, ...]
    length: float


def cache_path(library: Library, item: Item) -> Path:
    """Path of an item's body in the cache: a hash of the mesh file, the files to which it refers, and all settings."""
    assert library.cache is not None
    digest = hashlib.sha256()
    fields = [field.name for field in dataclasses.fields(Body)]
    settings = [item.scale, item.up, item.front, item.label, item.notes]
    layout = [_FORMAT, fields, FACE_CLASSES, HULL_CLASSES, PART_CLASSES, TEXTURE_CLASSES]
    digest.update(json.dumps([layout, settings, NUM_FACES, LARGEST, library.parts, library.pad]).encode())
    if not item.path.is_file():
        raise FileNotFoundError(
            f"{item.path}: no such mesh file: restore it, or call objects.library() again to list the existing files"
        )
    named = references(item.path, item.textures)
    for name, path in [(item.path.name, item.path), *sorted(named.items())]:
        digest.update(name.encode() + b"\0" + (b"" if path is None else hashlib.sha256(path.read_bytes()).digest()))
    return library.cache / f"{digest.hexdigest()[:32]}.npz"


def write_cached(path: Path, entry: Entry) -> None:
    """Write the body of an item to a file of the cache, atomically, with a warning if the cache cannot be written."""
    about = json.dumps({"gaps": entry.gaps, "notes": entry.notes, "length": entry.length})
    leaves: dict[str, Any] = {field.name: getattr(entry.body, field.name) for field in dataclasses.fields(Body)}
    try:
        write_arrays(path, {"about": np.frombuffer(about.encode(), np.uint8), **leaves})
    except OSError as error:
        _warn_once(f"objects are not kept, because {path.parent} cannot be written ({error.__cause__})")


@functools.cache  # `load` resets Python's own memory of warnings
def _warn_once(text: str) -> None:
    warnings.warn(text, stacklevel=4)


def read_cached(path: Path, item: Item) -> Entry | None:
    """Read the body of an item from a file of the cache. None if the file is missing or damaged."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as data:
            arrays = dict(data)
        about = decode(_About, json.loads(arrays.pop("about").tobytes()), "about")
        check_arrays(Body, arrays)
        body = Body(**{name: jnp.asarray(array) for name, array in arrays.items()})
        body.check()
        return Entry(item, body, about.gaps, about.notes, about.length)
    except Exception:  # a damaged zip file raises exceptions of many types
        return None
