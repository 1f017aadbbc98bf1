"""Dataclasses for a folder of mesh files: `Item` (one file), `Entry` (a loaded item) and `Library` (all items)."""

import dataclasses
from pathlib import Path

from sts_jax.objects.body import Body

LARGEST = 0.12  # m, larger objects are scaled down to this longest side, so that they can lie on the pad of 0.15 m
NUM_FACES = 4096  # the largest size class whose rendering is cheap

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
    longest_side: float | None = None  # Longest side after scaling (m), instead of `scale`.
    textures: Path | None = None  # Additional folder of images.
    stated: float | None = None  # Longest side according to ShapeNetSem's table (m).
    notes: tuple[str, ...] = ()  # Remarks on the item for the listing of the library.


@dataclasses.dataclass(frozen=True)
class Library:
    """The mesh files of a folder in a fixed order, and the files that are not used, each with the reason."""

    folder: Path  # Folder of the mesh files.
    items: tuple[Item, ...]  # Objects, sorted by class and name.
    skipped: tuple[tuple[str, str], ...]  # (name, reason) of each file or model that is not used.
    classes: tuple[str, ...]  # Classes of the items, sorted.
    cache: Path | None = None  # Folder of the cached bodies.
    faces: int = NUM_FACES  # Largest number of faces and of vertices. Larger meshes are decimated.
    largest: float = LARGEST  # Longest side (m) to which longer objects are scaled down.
    parts: bool = False  # True if objects that stand off their convex hull collide as convex parts.


@dataclasses.dataclass(frozen=True)
class Entry:
    """A loaded item: its body, the gaps between the body's surface and its collision parts, and notes on repairs."""

    item: Item  # The item that was loaded.
    body: Body  # The loaded body.
    # Largest distances (m) of the surface outside the collision parts, and of the collision parts outside the surface.
    gaps: tuple[float, float]
    notes: tuple[str, ...]  # Repairs of the mesh and remarks on the item.
