"""The items of a collection of mesh files, before and after loading."""

import dataclasses
from pathlib import Path

from sts_jax.objects.body import Body

LARGEST = 0.12  # m, longest side: larger objects are scaled down to it, so that they can lie on the 0.15 m pad
NUM_FACES = 4096  # largest padding class for which rendering stays cheap

Vector = tuple[float, float, float]


@dataclasses.dataclass(frozen=True)
class Item:
    """One mesh file and the settings for loading it."""

    path: Path
    name: str  # path within the folder, or ShapeNetSem's model id
    label: str  # class
    up: Vector  # direction in the file that becomes +z
    front: Vector  # direction in the file that becomes -y
    scale: float | None = None  # m, length of one unit of the file
    longest_side: float | None = None  # m, instead of a scale
    textures: Path | None = None  # folder of images that are not beside the file
    stated: float | None = None  # m, longest side according to ShapeNetSem's table
    notes: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class Library:
    """The objects of a folder in a fixed order, and the skipped files with the reasons."""

    folder: Path
    items: tuple[Item, ...]
    skipped: tuple[tuple[str, str], ...]  # (name, reason)
    classes: tuple[str, ...]  # of the items, sorted
    cache: Path | None = None  # folder of the cached bodies
    faces: int = NUM_FACES  # meshes with more are decimated
    largest: float = LARGEST  # m, longer objects are scaled down
    parts: bool = False  # whether objects that their hull fits badly collide as convex parts


@dataclasses.dataclass(frozen=True)
class Entry:
    """An item, loaded as a body."""

    item: Item
    body: Body
    gaps: tuple[float, float]  # m, how far the surface sticks out of the collision parts, and the reverse
    notes: tuple[str, ...]
