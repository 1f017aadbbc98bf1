"""Collections of mesh files: ShapeNetSem as its users download it, or any folder of meshes with a class a sub-folder.

`library` lists and opens no mesh; `read` makes a `Body` of one item; `survey` reads all once, into a cache if there is
one, and says in a line each what became of them. One bad object never stops a collection.
"""

import csv
import dataclasses
import hashlib
import io
import json
import math
import os
import tempfile
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
import trimesh
from scipy.spatial import ConvexHull

from sts_jax.objects.body import CATEGORIES, FACE_CLASSES, HULL_CLASSES, PART_CLASSES, TEXTURE_CLASSES, Body
from sts_jax.objects.meshes import AXES, PAD, load, references, rotation
from sts_jax.objects.procedural import STEEL
from sts_jax.objects.solids import WALL, decompose, gaps

LARGEST = 0.12  # m, longest side: what is larger is scaled down to it, so that it can lie on the 0.15 m pad
THINNEST = 0.0005  # m, a hull thinner than this is a sheet, on which no contact is stable
HOLLOW = 0.002  # m, a hull that stands off the surface by more is worth decomposing
NUM_FACES = 4096  # of the padding classes, the one up to which rendering stays cheap

# ShapeNetSem's categories (the `category` column of its metadata.csv, named in its taxonomy.txt) by class. Its "Mouse"
# is left out: it may be the animal, where "ComputerMouse" cannot.
SHAPENET_CLASSES = {
    "Bottle": "bottle",
    "BeerBottle": "bottle",
    "DrinkBottle": "bottle",
    "PillBottle": "bottle",
    "SoapBottle": "bottle",
    "WineBottle": "bottle",
    "Camera": "camera",
    "DSLRCamera": "camera",
    "WebCam": "webcam",
    "ComputerMouse": "mouse",
    "Scissors": "scissors",
    "Fork": "fork",
    "Spoon": "spoon",
    "Watch": "watch",
}
# Of the columns that its README names, those that are needed: id, categories, directions, metres per unit.
_COLUMNS = ("fullId", "category", "up", "front", "unit")
# What ShapeNet's own viewer takes where the table has no direction (ShapeNet/shapenet-viewer, Constants.scala).
_UP, _FRONT = (0.0, 0.0, 1.0), (0.0, -1.0, 0.0)

_SOLID = ("scissors", "fork", "spoon")  # classes that hold nothing and are of steel
# What trimesh reads beside meshes: archives, points, drawings.
_NO_MESH = {"zip", "gz", "tar.gz", "bz2", "tar.bz2", "xyz", "dxf", "svg", "json", "dict", "dict64", "msgpack", "xml"}
# Meshes that trimesh reads with further packages, or not.
_OTHERS = {".3ds", ".3mf", ".blend", ".dae", ".fbx", ".step", ".stp", ".usd", ".usdz", ".wrl", ".x3d"}
_FORMAT = 1  # of a cached object; one more whenever another body is made of the same file and settings

Vector = tuple[float, float, float]


@dataclasses.dataclass(frozen=True)
class Item:
    """One mesh file, and how it becomes a body."""

    path: Path
    name: str  # what it is listed by: the path within the folder, or ShapeNetSem's model id
    label: str  # class
    up: Vector  # direction in the file that becomes +z
    front: Vector  # direction in the file that becomes -y
    scale: float | None = None  # m, of one unit of the file
    longest_side: float | None = None  # m, instead of a scale
    textures: Path | None = None  # where images lie that are not beside the file
    stated: float | None = None  # m, the longest side by ShapeNetSem's table
    notes: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class Library:
    """The objects of a folder: what there is, in a fixed order, and what was left out and why."""

    folder: Path
    items: tuple[Item, ...]
    skipped: tuple[tuple[str, str], ...]  # (name, reason)
    classes: tuple[str, ...]  # of the items, sorted
    cache: Path | None = None  # folder of what is made of the files
    faces: int = NUM_FACES  # what has more is decimated
    largest: float = LARGEST  # m
    parts: bool = False  # whether what a hull fits badly collides as convex parts


@dataclasses.dataclass(frozen=True)
class Entry:
    """What became of an item."""

    item: Item
    body: Body
    gaps: tuple[float, float]  # m, by which the surface sticks out of what collides, and what collides off the surface
    notes: tuple[str, ...]


def library(
    folder: str | os.PathLike[str],
    *,
    cache: str | os.PathLike[str] | None = None,
    scale: float | None = None,
    longest_side: float | None = None,
    up: Literal["x", "y", "z"] | None = None,
    faces: int = NUM_FACES,
    largest: float = LARGEST,
    parts: bool = False,
) -> Library:
    """The objects of a folder, listed without opening a mesh.

    A folder with a metadata.csv of ShapeNetSem's is read by that table: `unit` gives the size, `up` and `front` the
    attitude, `category` one of CATEGORIES (see SHAPENET_CLASSES); the meshes are models-OBJ/models/ID.obj, the images
    in models-textures/textures. In any other folder every mesh file is an object, whose class is the first sub-folder
    on its way; files straight in the folder are of a class named after it.

    Args:
        folder: where the objects are.
        cache: a folder, made where it is missing, that keeps what is made of each file; None makes it each time.
        scale: m, of one unit of the files; None takes ShapeNetSem's table, or one metre.
        longest_side: m, to which every object is scaled; None keeps their sizes.
        up: the files' axis that becomes +z; None takes ShapeNetSem's table, or "z", for glTF "y".
        faces: what has more faces or vertices is decimated to so many.
        largest: m; what is longer is scaled down to it.
        parts: decompose into convex parts what its hull stands off by more than 2 mm; else all keep their hulls. It
            takes some ten seconds an object and the package coacd.

    Returns:
        The list, sorted by class and name.

    Raises:
        FileNotFoundError: no such folder.
        ValueError: it holds no mesh, the table lacks columns or cannot be read.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder of objects")
    if scale is not None and longest_side is not None:
        raise ValueError(f"{folder}: give scale or longest_side, not both")
    for name, value, most in (
        ("scale", scale, math.inf),
        ("longest_side", longest_side, PAD),
        ("largest", largest, PAD),
    ):
        if value is not None and not 0 < value <= most:
            raise ValueError(f"{folder}: {name} must be positive and at most {most} m, got {value}")
    if up is not None and up not in AXES:
        raise ValueError(f"{folder}: up must be 'x', 'y' or 'z', got {up!r}")
    if faces < 4:
        raise ValueError(f"{folder}: faces must be at least 4, got {faces}")
    root = _shapenet_root(folder)
    items, skipped = _walked(folder) if root is None else _tabled(root)
    if not items:
        reasons = "".join(f"\n  {name}: {reason}" for name, reason in skipped[:5])
        raise ValueError(f"{folder}: holds no mesh that can be used: give a folder with mesh files in it{reasons}")
    if scale is not None or longest_side is not None:
        items = [dataclasses.replace(item, scale=scale, longest_side=longest_side, stated=None) for item in items]
    if up is not None:
        items = [dataclasses.replace(item, up=AXES[up][0], front=AXES[up][1]) for item in items]
    items.sort(key=lambda item: (item.label, item.name))
    return Library(
        folder=folder,
        items=tuple(items),
        skipped=tuple(sorted(skipped)),
        classes=tuple(sorted({item.label for item in items})),
        cache=None if cache is None else Path(cache),
        faces=faces,
        largest=largest,
        parts=parts,
    )


def _walked(folder: Path) -> tuple[list[Item], list[tuple[str, str]]]:
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


# ShapeNetSem.


def _shapenet_root(folder: Path) -> Path | None:
    """The folder with the table: the one given or one in it, as the archive unpacks."""
    for table in (folder / "metadata.csv", *sorted(folder.glob("*/metadata.csv"))):
        if table.is_file():
            with table.open(encoding="utf-8", errors="replace", newline="") as lines:
                header = next(csv.reader(lines), [])
            if "fullId" in header or len(set(_COLUMNS) & set(header)) > 2 or (table.parent / "models-OBJ").is_dir():
                return table.parent
    return None


def _tabled(root: Path) -> tuple[list[Item], list[tuple[str, str]]]:
    rows = _rows(root / "metadata.csv")
    items: list[Item] = []
    skipped: list[tuple[str, str]] = []
    meshes = [root / "models-OBJ" / "models", root / "models-OBJ", root / "models"]
    textures = [root / "models-textures" / "textures", root / "models-textures", root / "textures"]
    images = next((place for place in textures if place.is_dir()), None)
    others, seen = 0, set()
    for row in rows:
        name = row["fullId"].strip().rpartition(".")[2]  # "wss.<id>"
        categories = [part.strip() for part in row["category"].split(",") if part.strip()]
        labels = {SHAPENET_CLASSES[part] for part in categories if part in SHAPENET_CLASSES}
        if "webcam" in labels:
            labels.discard("camera")
        if not labels or not name:
            others += 1
            continue
        try:
            if name in seen:
                raise ValueError("its id stands twice in the table: the first row is taken")
            seen.add(name)
            if "_BAD" in categories:
                raise ValueError("marked _BAD in the table")
            if len(labels) > 1:
                raise ValueError(f"of several classes ({', '.join(sorted(labels))})")
            path = next((place / f"{name}.obj" for place in meshes if (place / f"{name}.obj").is_file()), None)
            if path is None:
                raise ValueError(f"models-OBJ/models/{name}.obj is not there")
            items.append(_shapenet_item(row, path, name, labels.pop(), images))
        except ValueError as error:
            skipped.append((name, str(error)))
    if others:
        skipped.append(("metadata.csv", f"{others:,} of {len(rows):,} models are of none of the eight classes"))
    return items, skipped


def _rows(table: Path) -> list[dict[str, str]]:
    text = table.read_text(encoding="utf-8", errors="replace")
    for escape in (None, "\\"):  # commas inside a value are quoted, escaped or both
        reader = csv.DictReader(io.StringIO(text), escapechar=escape, restkey="rest", restval="")
        missing = [name for name in _COLUMNS if name not in (reader.fieldnames or ())]
        if missing:
            raise ValueError(
                f"{table}: lacks the columns {', '.join(missing)} of ShapeNetSem's table: download it again"
            )
        try:
            rows = list(reader)
        except csv.Error as error:
            raise ValueError(f"{table}: cannot be read as a table ({error}): download it again") from error
        if not any("rest" in row for row in rows):
            return rows
    raise ValueError(f"{table}: has rows with more cells than columns: download it again")


def _shapenet_item(row: dict[str, str], path: Path, name: str, label: str, images: Path | None) -> Item:
    unit = row["unit"].strip()
    if not unit:
        raise ValueError("its unit is missing, so that its size is unknown")
    try:
        scale = float(unit)
    except ValueError:
        scale = float("nan")
    if not (np.isfinite(scale) and scale > 0):
        raise ValueError(f"its unit is {unit!r}, not a positive number of metres")
    notes = [f"no {key} in the table: ShapeNet's default" for key in ("up", "front") if not row[key].strip()]
    up, front = _vector(row["up"], "up") or _UP, _vector(row["front"], "front") or _FRONT
    rotation(up, front)  # says where they do not give one
    # Its README calls these metres, the released table holds centimetres.
    sides = _vector(row.get("aligned.dims", ""), "aligned.dims")
    stated = None if sides is None else max(sides) / 100
    return Item(path, name, label, up, front, scale=scale, textures=images, stated=stated, notes=tuple(notes))


def _vector(text: str, key: str) -> Vector | None:
    text = text.strip().strip('"')
    if not text:
        return None
    try:
        x, y, z = (float(part) for part in text.replace("\\", "").split(","))
    except ValueError as error:
        raise ValueError(f"its {key} is {text!r}, not three numbers") from error
    return x, y, z


# Bodies.


def read(collection: Library, index: int) -> Entry:
    """One item as a body, from the cache where it is kept, which is filled where it is not.

    What had to be mended on the way (see `load`) is in the notes. Scissors, forks and spoons are solid and of steel;
    everything else is a shell that may hold something. The body's category is the class where that is one of
    CATEGORIES, else -1.

    Args:
        collection: of `library`.
        index: into its items.

    Returns:
        The body and what there is to say of it.

    Raises:
        ImportError: it has more faces than the library asks for, or is to be decomposed, without the package for it.
        FileNotFoundError: the file is gone.
        ValueError: no body can be made of it; the message says why.
    """
    item = collection.items[index]
    if collection.cache is None:
        return _made(collection, item)
    place = collection.cache / f"{_key(collection, item)}.npz"
    kept = _kept(place, item)
    if kept is None:
        kept = _made(collection, item)
        _keep(place, kept)
    return kept


def bodies(collection: Library, indices: Iterable[int] | None = None) -> tuple[list[Body], list[tuple[str, str]]]:
    """Several items as bodies, leaving out what none can be made of.

    Args:
        collection: of `library`.
        indices: into its items; None is all.

    Returns:
        The bodies, and (name, reason) of each item that was left out.
    """
    made, skipped = [], []
    for index in range(len(collection.items)) if indices is None else indices:
        entry = _tried(collection, index)
        if isinstance(entry, str):
            skipped.append((collection.items[index].name, entry))
        else:
            made.append(entry.body)
    return made, skipped


def survey(collection: Library, *, progress: Callable[[str], None] | None = None) -> tuple[Library, str]:
    """Reads every item once.

    Args:
        collection: of `library`.
        progress: called with each object's line as it is done.

    Returns:
        The library without what cannot be used, which has joined `skipped`; and a listing: how many there are of each
        class, a line for each object, a line for each that was left out.
    """
    items, skipped, lines = [], list(collection.skipped), []
    for index, item in enumerate(collection.items):
        entry = _tried(collection, index)
        if isinstance(entry, str):
            skipped.append((item.name, entry))
            line = f"{item.label}  {item.name}: left out: {entry}"
        else:
            items.append(item)
            line = describe(entry)
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
    tail = [f"{len(usable.skipped)} lines on what was left out:", *(f"{name}: {why}" for name, why in usable.skipped)]
    return usable, "\n".join([*head, *lines, *(tail if usable.skipped else [])]) + "\n"


def describe(entry: Entry) -> str:
    """The line of one object in a listing."""
    return f"{entry.item.label}  {entry.item.name}: " + "; ".join([*facts(entry.body, entry.gaps), *entry.notes])


def facts(body: Body, apart: tuple[float, float]) -> list[str]:
    """Size (mm), faces, collision hull and gaps (mm) of a body, in words; `apart` (m) is what `gaps` gives."""
    size = " x ".join(f"{side * 1e3:.0f}" for side in np.ptp(np.asarray(body.vertices), axis=0))
    drawn = int(np.asarray(body.faces).any(axis=1).sum())
    hulls = np.asarray(body.hulls)
    parts = f" in {len(np.unique(hulls, axis=0))} parts" if len(hulls) > 1 else ""
    hull = f"{len(np.unique(hulls.reshape(-1, 3), axis=0))} vertices{parts}"
    return [size, f"{drawn} faces", hull, " / ".join(f"{gap * 1e3:.2f}" for gap in apart)]


def _tried(collection: Library, index: int) -> Entry | str:
    item = collection.items[index]
    try:
        return read(collection, index)
    except ImportError:
        raise  # this machine's fault, not the object's
    except Exception as error:  # whatever else the many libraries underneath raise for a file nobody has checked
        return _short(error, item) or type(error).__name__


def _short(message: object, item: Item) -> str:
    """A message without the path that it begins with and that a listing names anyway."""
    return str(message).removeprefix(f"{item.path}: ").replace(f"{item.path.parent}{os.sep}", "").replace("\n", " ")


def _made(collection: Library, item: Item) -> Entry:
    solid = item.label in _SOLID
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        body = load(
            item.path,
            scale=item.scale,
            longest_side=item.longest_side,
            largest=collection.largest,
            density=STEEL if solid else WALL,
            hollow=not solid,
            up=item.up,
            front=item.front,
            textures=item.textures,
            faces=collection.faces,
            category=CATEGORIES.index(item.label) if item.label in CATEGORIES else -1,
        )
    notes = [_short(warning.message, item) for warning in said]
    vertices = np.asarray(body.vertices, float)
    longest = float(np.ptp(vertices, axis=0).max())
    if item.stated is not None and not 0.9 < longest / min(item.stated, collection.largest) < 1.1:
        notes.append(f"the table's aligned.dims give a longest side of {item.stated * 1e3:.0f} mm")
    shape = ConvexHull(np.asarray(body.hulls[0], float))
    thickness = float(np.ptp(vertices @ shape.equations[:, :3].T, axis=0).min())
    if thickness < THINNEST:
        raise ValueError(f"it is a sheet {thickness * 1e3:.2g} mm thick, too flat to lie or slide on anything")
    apart = gaps(body)
    if collection.parts and apart[1] > HOLLOW:
        try:
            body = decompose(body)
            apart = gaps(body)
        except ValueError as error:
            notes.append(str(error))
    return Entry(item, body, apart, (*item.notes, *notes))


# The cache: one file an object, under a name that changes with all it depends on.


def _key(collection: Library, item: Item) -> str:
    digest = hashlib.sha256()
    fields = [field.name for field in dataclasses.fields(Body)]
    settings = [item.scale, item.longest_side, item.up, item.front, item.label, item.notes]
    layout = [_FORMAT, fields, FACE_CLASSES, HULL_CLASSES, PART_CLASSES, TEXTURE_CLASSES]
    digest.update(json.dumps([layout, settings, collection.faces, collection.largest, collection.parts]).encode())
    try:
        named = references(item.path, item.textures)
    except (OSError, ValueError):
        named = {}  # `load` says what is wrong with it
    if not item.path.is_file():
        raise FileNotFoundError(f"{item.path}: no such mesh file")
    for name, path in [(item.path.name, item.path), *sorted(named.items())]:
        digest.update(name.encode() + b"\0" + (b"" if path is None else hashlib.sha256(path.read_bytes()).digest()))
    return digest.hexdigest()[:32]


def _keep(place: Path, entry: Entry) -> None:
    """Written under another name and renamed, so that a reader sees a whole file or none."""
    place.parent.mkdir(parents=True, exist_ok=True)
    about = json.dumps({"gaps": entry.gaps, "notes": entry.notes})
    leaves: dict[str, Any] = {field.name: getattr(entry.body, field.name) for field in dataclasses.fields(Body)}
    with tempfile.NamedTemporaryFile(dir=place.parent, prefix=".", suffix=".part", delete=False) as file:
        np.savez(file, about=np.frombuffer(about.encode(), np.uint8), **leaves)
    os.replace(file.name, place)


def _kept(place: Path, item: Item) -> Entry | None:
    try:
        with place.open("rb") as file, np.load(file, allow_pickle=False) as data:
            body = Body(**{field.name: jnp.asarray(data[field.name]) for field in dataclasses.fields(Body)})
            about = json.loads(data["about"].tobytes())
        return Entry(item, body, tuple(about["gaps"]), tuple(about["notes"]))
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None  # not there, or torn: it is made anew
