"""Reader of the dataset ShapeNetSem. Its table metadata.csv defines the class, size and orientation of each mesh."""

import csv
import io
from pathlib import Path

import numpy as np

from sts_jax.objects.items import Item, Vector
from sts_jax.objects.meshes import rotation

# Class of each category of ShapeNetSem that is used (column `category` of metadata.csv, names in taxonomy.txt). "Mouse"
# is left out because it can be the animal, unlike "ComputerMouse".
CLASSES = {
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
# Required columns, as in ShapeNetSem's README: id, categories, directions up and front, and metres per unit.
_COLUMNS = ("fullId", "category", "up", "front", "unit")
# Defaults of ShapeNet's own viewer for missing directions (ShapeNet/shapenet-viewer, Constants.scala).
_UP, _FRONT = (0.0, 0.0, 1.0), (0.0, -1.0, 0.0)


def find_root(folder: Path) -> Path | None:
    """Return the folder with ShapeNetSem's table `metadata.csv`, `folder` or a direct sub-folder, or None."""
    for table in (folder / "metadata.csv", *sorted(folder.glob("*/metadata.csv"))):
        if table.is_file():
            with table.open(encoding="utf-8", errors="replace", newline="") as lines:
                header = next(csv.reader(lines), [])
            if "fullId" in header or len(set(_COLUMNS) & set(header)) > 2 or (table.parent / "models-OBJ").is_dir():
                return table.parent
    return None


def items(root: Path) -> tuple[list[Item], list[tuple[str, str]]]:
    """List the models of ShapeNetSem that have a category in `CLASSES`, and (name, reason) of each skipped model."""
    rows = _rows(root / "metadata.csv")
    usable: list[Item] = []
    skipped: list[tuple[str, str]] = []
    meshes = [root / "models-OBJ" / "models", root / "models-OBJ", root / "models"]
    textures = [root / "models-textures" / "textures", root / "models-textures", root / "textures"]
    images = next((place for place in textures if place.is_dir()), None)
    others, seen = 0, set()
    for row in rows:
        name = row["fullId"].strip().rpartition(".")[2]  # "wss.<id>"
        categories = [part.strip() for part in row["category"].split(",") if part.strip()]
        labels = {CLASSES[part] for part in categories if part in CLASSES}
        if "webcam" in labels:
            labels.discard("camera")
        if not labels or not name:
            others += 1
            continue
        try:
            if name in seen:
                raise ValueError("an earlier row of metadata.csv describes the same model: remove one of them")
            seen.add(name)
            if "_BAD" in categories:
                raise ValueError("the model has the category _BAD in metadata.csv, so it is not used")
            if len(labels) > 1:
                classes = ", ".join(sorted(labels))
                raise ValueError(f"its categories in metadata.csv belong to several classes ({classes}): keep one")
            path = next((place / f"{name}.obj" for place in meshes if (place / f"{name}.obj").is_file()), None)
            if path is None:
                raise ValueError(f"the mesh models-OBJ/models/{name}.obj does not exist: download it")
            usable.append(_item(row, path, name, labels.pop(), images))
        except ValueError as error:
            skipped.append((name, str(error)))
    if others:
        skipped.append(("metadata.csv", f"{others:,} of {len(rows):,} models are of none of the eight classes"))
    return usable, skipped


def _rows(table: Path) -> list[dict[str, str]]:
    """Read the rows of the table as dictionaries by column."""
    text = table.read_text(encoding="utf-8", errors="replace")
    for escape in (None, "\\"):  # commas inside a value are quoted, escaped or both
        reader = csv.DictReader(io.StringIO(text), escapechar=escape, restkey="rest", restval="")
        missing = [name for name in _COLUMNS if name not in (reader.fieldnames or ())]
        if missing:
            raise ValueError(
                f"{table}: the table lacks columns of ShapeNetSem ({', '.join(missing)}): download it again"
            )
        try:
            rows = list(reader)
        except csv.Error as error:
            raise ValueError(f"{table}: the file cannot be read as a table ({error}): download it again") from error
        if not any("rest" in row for row in rows):
            return rows
    raise ValueError(f"{table}: some rows have more cells than the header has columns: download the table again")


def _item(row: dict[str, str], path: Path, name: str, label: str, images: Path | None) -> Item:
    """Make the item of a row, or raise a ValueError with the reason why the row cannot be used."""
    unit = row["unit"].strip()
    if not unit:
        raise ValueError("the row of the model in metadata.csv has no unit: write the length of 1 mesh unit (m) there")
    try:
        scale = float(unit)
    except ValueError:
        scale = float("nan")
    if not (np.isfinite(scale) and scale > 0):
        raise ValueError(f"the model's unit is {unit!r} in metadata.csv, but it must be a positive number of metres")
    missing = [key for key in ("up", "front") if not row[key].strip()]
    notes = [f"metadata.csv has no {key}: ShapeNet's default is used" for key in missing]
    up, front = _vector(row["up"], "up") or _UP, _vector(row["front"], "front") or _FRONT
    rotation(up, front)  # raises an error if they do not define a rotation
    return Item(path, name, label, up, front, scale=scale, textures=images, notes=tuple(notes))


def _vector(text: str, key: str) -> Vector | None:
    """Read three numbers from the text of a cell, or return None if the cell is empty."""
    text = text.strip().strip('"')
    if not text:
        return None
    try:
        x, y, z = (float(part) for part in text.replace("\\", "").split(","))
    except ValueError as error:
        raise ValueError(f"metadata.csv has {text!r} in the column {key!r}, but it must be three numbers") from error
    return x, y, z
