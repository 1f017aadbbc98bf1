"""A small folder of generated shapes in the layout of ShapeNetSem (release v0: README.txt and its archives)."""

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

COLUMNS = ["fullId", "category", "wnsynset", "wnlemmas", "up", "front", "unit", "aligned.dims", "isContainerLike"]
COLUMNS += ["surfaceVolume", "solidVolume", "supportSurfaceArea", "weight", "staticFrictionForce", "name", "tags"]


def wedge() -> trimesh.Trimesh:
    """A pyramid without symmetries, in metres: X right, Y back, Z up. Its tip leans to +x and -y."""
    base = [[-0.02, -0.015, 0], [0.02, -0.015, 0], [0.02, 0.015, 0], [-0.02, 0.015, 0]]
    return trimesh.convex.convex_hull(np.array([*base, [0.012, -0.008, 0.09]]))


def in_file(mesh: trimesh.Trimesh, right: Sequence[float], back: Sequence[float], up: Sequence[float], unit: float):
    """The mesh in the axes and units of a file."""
    return trimesh.Trimesh(mesh.vertices @ np.array([right, back, up], float) / unit, mesh.faces, process=False)


def row(name: str, category: str, **values: str) -> dict[str, str]:
    """A line of the table. The commas of vectors are escaped as in the release."""
    line = dict.fromkeys(COLUMNS, "") | {"fullId": f"wss.{name}", "category": category, "name": name, "tags": "*"}
    line |= {"up": r"0.0\,0.0\,1.0", "front": r"0.0\,-1.0\,0.0", "unit": "0.0254"}
    return line | values


def build(
    root: Path,
    rows: list[dict[str, str]],
    meshes: dict[str, trimesh.Trimesh],
    images: dict[str, tuple[int, int, int]] | None = None,
) -> Path:
    """Write the folder. MTL files name the image of a mesh without its folder, as those of the release do."""
    models, textures = root / "models-OBJ" / "models", root / "models-textures" / "textures"
    models.mkdir(parents=True)
    textures.mkdir(parents=True)
    table(root, rows)
    (root / "categories.synset.csv").write_text("category,synset,synset words,synset gloss\n")
    (root / "densities.csv").write_text("Material,Density,Static\n")
    (root / "materials.csv").write_text("Category,Material,Ratio\n")
    (root / "taxonomy.txt").write_text("# parent\tchildren\nBottle\tBeerBottle\tDrinkBottle\tWineBottle\n")
    for name, mesh in meshes.items():
        paint = (images or {}).get(name)
        lines = [f"mtllib {name}.mtl", "usemtl m0", *(f"v {x} {y} {z}" for x, y, z in mesh.vertices), "vt 0.5 0.5"]
        lines += ["f " + " ".join(f"{i + 1}/1" for i in face) for face in mesh.faces]
        (models / f"{name}.obj").write_text("\n".join(lines) + "\n")
        picture = "" if paint is None else f"map_Kd {name}.png\n"
        (models / f"{name}.mtl").write_text(f"newmtl m0\nKd 0.5 0.5 0.5\nd 0\n{picture}")
        if paint is not None:
            Image.new("RGB", (8, 8), paint).save(textures / f"{name}.png")
    return root


def table(root: Path, rows: list[dict[str, str]], columns: Sequence[str] = COLUMNS) -> None:
    with (root / "metadata.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, columns, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)
