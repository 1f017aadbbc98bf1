"""The cache of loaded bodies: one file per object, named by a hash of the mesh file and of all settings."""

import dataclasses
import hashlib
import json
import zipfile
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from sts_jax.objects.body import FACE_CLASSES, HULL_CLASSES, PART_CLASSES, TEXTURE_CLASSES, Body
from sts_jax.objects.items import Entry, Item, Library
from sts_jax.objects.materials import references
from sts_jax.storage import write_arrays

_FORMAT = 1  # version of cached bodies, increased when the same file and settings lead to another body


def path_of(library: Library, item: Item) -> Path:
    """Return the path of the file that caches an item's loaded body, in the folder `library.cache`.

    The name of the file is a hash of the mesh file, the files to which it refers, and all settings for loading.

    Args:
        library: Library of the item. Its `cache` must not be None.
        item: Item of the library.

    Raises:
        FileNotFoundError: The mesh file no longer exists.
    """
    assert library.cache is not None
    digest = hashlib.sha256()
    fields = [field.name for field in dataclasses.fields(Body)]
    settings = [item.scale, item.longest_side, item.up, item.front, item.label, item.notes]
    layout = [_FORMAT, fields, FACE_CLASSES, HULL_CLASSES, PART_CLASSES, TEXTURE_CLASSES]
    digest.update(json.dumps([layout, settings, library.faces, library.largest, library.parts]).encode())
    try:
        named = references(item.path, item.textures)
    except (OSError, ValueError):
        named = {}  # `load` raises an error for the damaged file
    if not item.path.is_file():
        raise FileNotFoundError(
            f"{item.path}: no such mesh file: restore it, or call objects.library() again to list the existing files"
        )
    for name, path in [(item.path.name, item.path), *sorted(named.items())]:
        digest.update(name.encode() + b"\0" + (b"" if path is None else hashlib.sha256(path.read_bytes()).digest()))
    return library.cache / f"{digest.hexdigest()[:32]}.npz"


def write(path: Path, entry: Entry) -> None:
    """Write the body of a library item to a cache file. An interruption leaves no incomplete file."""
    about = json.dumps({"gaps": entry.gaps, "notes": entry.notes})
    leaves: dict[str, Any] = {field.name: getattr(entry.body, field.name) for field in dataclasses.fields(Body)}
    write_arrays(path, {"about": np.frombuffer(about.encode(), np.uint8), **leaves})


def read(path: Path, item: Item) -> Entry | None:
    """Read the body of an item from a cache file. Return None if the file is missing or damaged."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as data:
            body = Body(**{field.name: jnp.asarray(data[field.name]) for field in dataclasses.fields(Body)})
            about = json.loads(data["about"].tobytes())
        return Entry(item, body, tuple(about["gaps"]), tuple(about["notes"]))
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
