"""Collections of mesh files: ShapeNetSem as downloaded, or any folder of meshes with one sub-folder per class.

`bodies` and `survey` continue after an object that cannot be loaded.
"""

import dataclasses
import os
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Literal

import numpy as np
import trimesh

from sts_jax._checked import checked
from sts_jax.objects import shapenet
from sts_jax.objects.assembly import STEEL, WALL
from sts_jax.objects.body import CATEGORIES, PAD, Body
from sts_jax.objects.checks import check_positive, check_thickness
from sts_jax.objects.items import (
    LARGEST,
    NUM_FACES,
    Entry,
    Item,
    Library,
    cache_path,
    read_cached,
    write_cached,
)
from sts_jax.objects.meshes import AXES, ScaledDown, load
from sts_jax.objects.parts import decompose, gaps

THINNEST = 0.0005  # m, an object thinner than this is refused, because its contacts are unstable
ROOM = 3.0  # m, a file without a stated unit that is longer than this is not in metres
HOLLOW = 0.002  # m, a hull that reaches farther outside the surface than this is worth decomposing

_SOLID = ("scissors", "fork", "spoon")  # classes of solid steel objects
# Formats other than meshes that trimesh reads: archives, points, drawings.
_NO_MESH = {"zip", "gz", "tar.gz", "bz2", "tar.bz2", "xyz", "dxf", "svg", "json", "dict", "dict64", "msgpack", "xml"}
# Mesh formats that trimesh reads only with further packages, or not at all.
_OTHERS = {".3ds", ".3mf", ".blend", ".dae", ".fbx", ".step", ".stp", ".usd", ".usdz", ".wrl", ".x3d"}


@checked
def library(
    folder: str | os.PathLike[str],
    *,
    cache: str | os.PathLike[str] | None = None,
    scale: float | Mapping[str, float] | None = None,
    up: Literal["x", "y", "z"] | None = None,
    parts: bool = False,
    pad: float = PAD,
) -> Library:
    """List the objects of a folder without opening a mesh, sorted by class and name.

    Objects longer than 0.8 times the pad (0.12 m) are scaled down to this length, and meshes of more than 4,096 faces
    or vertices are decimated.

    If the folder or one of its direct sub-folders contains ShapeNetSem's metadata.csv, this table lists the objects,
    with their size, orientation and class. Meshes are expected at models-OBJ/models/ID.obj, and images in
    models-textures/textures. In any other folder, every mesh file is an object. Its class is the name of the first
    sub-folder in its path, or of the folder itself.

    Args:
        folder: Folder of the objects.
        cache: Folder for the loaded bodies, which is created if it is missing. None loads the mesh files each time.
        scale: Length of one unit of the files (m), or a mapping from names of files or sub-folders to lengths, such as
            `{"gripper": 0.001, "*.glb": 1.0}`, of which the first that fits a file counts. None, or no fitting name,
            uses ShapeNetSem's table, or 1 m without a table. Loading then stops with an error if a file is longer than
            3 m, or if one is longer than 1 m and another would fit on the pad: not all can be in metres.
        up: Axis of the files that becomes +z. None uses ShapeNetSem's table. Without a table, None is "y" for glTF and
            "z" for other formats.
        parts: If True, objects whose convex hull reaches more than 2 mm outside the surface are decomposed into convex
            parts. This takes about ten seconds per object and needs the package coacd.
        pad: Width of the sensor's pad (m), such as `min(sensor.gel.size)`.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder of objects: check the path")
    scales = dict(scale) if isinstance(scale, Mapping) else {} if scale is None else {"*": scale}
    for length in scales.values():
        check_positive("scale", length, "metres per unit of the files")
    check_positive("pad", pad, "metres")
    root = shapenet.find_root(folder)
    items, skipped = _walked(folder) if root is None else shapenet.items(root)
    if not items:
        reasons = "".join(f"\n  {name}: {reason}" for name, reason in skipped[:5])
        raise ValueError(
            f"{folder}: the folder contains no usable mesh (number of skipped files: {len(skipped)}): give a folder "
            f"with mesh files that `objects.load` can read{reasons}"
        )
    for pattern, length in reversed(scales.items()):  # the first that fits is applied last
        fits = [fnmatchcase(item.name, pattern) or fnmatchcase(item.name, f"{pattern}/*") for item in items]
        if not any(fits):
            raise ValueError(f"scale has {pattern!r}, but {folder} has no such file or sub-folder: check the name")
        items = [
            dataclasses.replace(item, scale=length) if fit else item for item, fit in zip(items, fits, strict=True)
        ]
    if up is not None:
        items = [dataclasses.replace(item, up=AXES[up][0], front=AXES[up][1]) for item in items]
    items.sort(key=lambda item: (item.label, item.name))
    return Library(
        folder=folder,
        items=tuple(items),
        skipped=tuple(sorted(skipped)),
        classes=tuple(sorted({item.label for item in items})),
        cache=None if cache is None else Path(cache),
        parts=parts,
        pad=pad,
    )


def _walked(folder: Path) -> tuple[list[Item], list[tuple[str, str]]]:
    """List the mesh files of a folder as items, and (name, reason) of each mesh file that trimesh cannot read."""
    suffixes = {f".{name}" for name in trimesh.available_formats() - _NO_MESH}
    items, skipped = [], []
    for path in sorted(folder.rglob("*")):
        parts = path.relative_to(folder).parts
        if not path.is_file() or any(part.startswith(".") for part in parts):
            continue
        if path.suffix.lower() not in suffixes:
            if path.suffix.lower() in _OTHERS:
                skipped.append(("/".join(parts), "trimesh cannot read it here: export it as glb, ply, obj or stl"))
            continue
        above, front = AXES["y" if path.suffix.lower() in (".glb", ".gltf") else "z"]
        items.append(
            Item(
                path=path,
                name="/".join(parts),
                label=parts[0] if len(parts) > 1 else folder.resolve().name,
                up=above,
                front=front,
            )
        )
    return items, skipped


def read(collection: Library, index: int) -> Entry:
    """Load one item as a body, through the cache if the library has one. Warnings of `load` become notes.

    Scissors, forks and spoons are solid and of steel. All other objects are shells with contents.
    """
    entry = _read(collection, index)
    _check_metres(collection, [(entry.length, entry.item)] * 2)
    return entry


def _read(collection: Library, index: int) -> Entry:
    item = collection.items[index]
    if collection.cache is None:
        return _load(collection, item)
    path = cache_path(collection, item)
    entry = read_cached(path, item)
    if entry is None:
        entry = _load(collection, item)
        write_cached(path, entry)
    return entry


def bodies(collection: Library, indices: Iterable[int] | None = None) -> tuple[list[Body], list[tuple[str, str]]]:
    """Load the items with these indices, or all items: the bodies, and (name, reason) of each that cannot be loaded."""
    loaded, skipped = [], []
    for index, entry in _entries(collection, range(len(collection.items)) if indices is None else indices):
        if isinstance(entry, str):
            skipped.append((collection.items[index].name, entry))
        else:
            loaded.append(entry.body)
    return loaded, skipped


def survey(collection: Library, *, progress: Callable[[str], None] | None = None) -> tuple[Library, str]:
    """Load every item once. `progress` is called after each item with the line that describes it.

    Returns:
        The library, with the items that cannot be loaded moved to `skipped`, and a listing of all items.
    """
    items, skipped, lines = [], list(collection.skipped), []
    for index, entry in _entries(collection, range(len(collection.items))):
        item = collection.items[index]
        if isinstance(entry, str):
            skipped.append((item.name, entry))
            line = f"{item.label}  {item.name}: left out: {entry}"
        else:
            items.append(item)
            line = "; ".join([*facts(entry.body, entry.gaps), *entry.notes])
            line = f"{item.label}  {item.name}: {line}"
            lines.append(line)
        if progress is not None:
            progress(line)
    usable = dataclasses.replace(
        collection,
        items=tuple(items),
        skipped=tuple(sorted(skipped)),
        classes=tuple(sorted({item.label for item in items})),
    )
    number = Counter(item.label for item in items)
    head = [f"{len(items)} objects: " + ", ".join(f"{name} {number[name]}" for name in usable.classes)]
    if lines:
        head.append("class  name: size (mm); faces; collision hull; gaps (mm); notes")
        head.append(
            "gaps: how far the surface sticks out of the hull at most / how far the hull stands off the surface"
        )
    tail = [f"{len(usable.skipped)} lines on skipped files:", *(f"{name}: {why}" for name, why in usable.skipped)]
    return usable, "\n".join([*head, *lines, *(tail if usable.skipped else [])]) + "\n"


def facts(body: Body, apart: tuple[float, float]) -> list[str]:
    """Describe a body in four short texts: size (mm), number of faces, collision vertices, and gaps `apart` (mm)."""
    size = " x ".join(f"{side * 1e3:.0f}" for side in np.ptp(np.asarray(body.vertices), axis=0))
    drawn = int(np.asarray(body.faces).any(axis=1).sum())
    hulls = np.asarray(body.hulls)
    parts = f" in {len(np.unique(hulls, axis=0))} parts" if len(hulls) > 1 else ""
    hull = f"{len(np.unique(hulls.reshape(-1, 3), axis=0))} vertices{parts}"
    return [size, f"{drawn} faces", hull, " / ".join(f"{gap * 1e3:.2f}" for gap in apart)]


def _entries(collection: Library, indices: Iterable[int]) -> Iterator[tuple[int, Entry | str]]:
    """Read items, or the reasons why they cannot be loaded. Stops with an error if the files have different units."""
    span: list[tuple[float, Item]] = []  # the shortest and the longest file whose unit is not stated
    for index in indices:
        entry = _read_or_reason(collection, index)
        if isinstance(entry, Entry) and entry.item.scale is None:
            both = [*span, (entry.length, entry.item)]
            span = [pick(both, key=lambda one: one[0]) for pick in (min, max)]
            _check_metres(collection, span)
        yield index, entry


def _check_metres(collection: Library, span: list[tuple[float, Item]]) -> None:
    """Raise an error if the shortest and the longest of some files without a stated unit cannot both be in metres."""
    (low, short), (high, long) = span
    if long.scale is None and (high > ROOM or (high > 1 and low <= collection.pad)):
        other = "" if short == long else f" and {short.name} {low:.3g} m"
        raise ValueError(
            f"{collection.folder}: in metres, {long.name} would be {high:.3g} m long{other}. Give `scale`, the length "
            f"of a unit (m), such as --scale 0.001 for millimetres, --scale '{long.name}' 0.001 for some files or "
            "sub-folders, or --scale 1 if all are in metres"
        )


def _read_or_reason(collection: Library, index: int) -> Entry | str:
    """Read an item, or return the reason why it cannot be loaded."""
    item = collection.items[index]
    try:
        return _read(collection, index)
    except ImportError:
        raise  # a missing package is no fault of the object
    except Exception as error:  # the mesh libraries raise errors of many types for a damaged file
        return _short(error, item) or type(error).__name__


def _short(message: object, item: Item) -> str:
    """Remove the path of an item from a message, because a listing names the object anyway."""
    return str(message).removeprefix(f"{item.path}: ").replace(f"{item.path.parent}{os.sep}", "").replace("\n", " ")


def _load(collection: Library, item: Item) -> Entry:
    """Load an item from its mesh file. Warnings become notes."""
    solid = item.label in _SOLID
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        body = load(
            item.path,
            scale=item.scale,
            largest=LARGEST * (collection.pad / PAD),
            pad=collection.pad,
            density=STEEL if solid else WALL,
            hollow=not solid,
            up=item.up,
            front=item.front,
            textures=item.textures,
            faces=NUM_FACES,
            category=CATEGORIES.index(item.label) if item.label in CATEGORIES else -1,
        )
    notes = [_short(warning.message, item) for warning in caught]
    vertices = np.asarray(body.vertices, float)
    length = float(np.ptp(vertices, axis=0).max())
    length = max([length, *(one.message.length for one in caught if isinstance(one.message, ScaledDown))])
    check_thickness(body, THINNEST)
    apart = gaps(body)
    if collection.parts and apart[1] > HOLLOW:
        try:
            body = decompose(body)
            apart = gaps(body)
        except ValueError as error:
            notes.append(str(error))
    return Entry(item, body, apart, (*item.notes, *notes), length)
