"""Mesh files and bodies that several tests of `objects` share."""

import dataclasses
from pathlib import Path

import numpy as np
import shapenet_folder as shapenet
import trimesh

from sts_jax import objects


def surface(body: objects.Body) -> trimesh.Trimesh:
    faces = np.asarray(body.faces)
    faces = faces[faces.any(axis=1)]
    return trimesh.Trimesh(np.asarray(body.vertices, float)[: faces.max() + 1], faces, process=False)


def volume(body: objects.Body) -> float:
    return float(objects.fill_moments(body.interior, 1.0)[0])


def same_points(found: np.ndarray, truth: np.ndarray) -> None:
    """Assert that two sets of vertices are equal."""
    distance = np.linalg.norm(found[:, None] - truth[None], axis=2)
    assert distance.min(axis=0).max() < 1e-6
    assert distance.min(axis=1).max() < 1e-6


def leaves(body: objects.Body) -> list[bytes]:
    return [np.asarray(getattr(body, field.name)).tobytes() for field in dataclasses.fields(body)]


def box(size=(0.06, 0.04, 0.03)) -> trimesh.Trimesh:
    return trimesh.creation.box(size)


def mixed_folder(root: Path) -> Path:
    """A folder with the same pyramid as four files, in two folders and beside them, and two files that are no mesh."""
    for place in ("cups/small/x.stl", "cups/y.ply", "boxes/z.glb", "loose.obj"):
        (root / place).parent.mkdir(parents=True, exist_ok=True)
        shapenet.wedge().export(root / place)
    (root / "notes.txt").write_text("no mesh")
    (root / "boxes" / "w.fbx").write_bytes(b"Kaydara")
    return root


def obj(*lines: str) -> bytes:
    return "\n".join(lines).encode()


TORN = trimesh.creation.icosphere(subdivisions=2).export(file_type="glb")[:3000]
SHEET = trimesh.Trimesh([[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0]], [[0, 1, 2], [0, 2, 3]])
RANDOM = np.random.default_rng(0).integers(128, 256, 2000, np.uint8).tobytes()
# A file, its content, and a part of the message.
BAD_FILES = {
    "torn.glb": (TORN, "cannot be read as a mesh"),
    "points.obj": (obj("v 0 0 0", "v 0 0 1", "v 0 1 0"), "has no faces"),
    "empty.stl": (b"", "the file is empty"),
    "text.xyzzy": (b"no mesh", "cannot be read as a mesh"),
    "damaged.off": (RANDOM, "cannot be read as a mesh"),
    "sheet.stl": (SHEET.export(file_type="stl"), "flat"),
    "point.obj": (obj("v 0 0 0", "v 0 0 0", "v 0 0 0", "f 1 2 3"), "all vertices lie at one point"),
    "nan.obj": (obj("v nan 0 0", "v 0 0 1", "v 0 1 0", "v 1 0 0", "f 1 2 3", "f 2 3 4"), "NaN .* in 1 of its faces"),
    "beyond.off": (
        obj("OFF", "4 4 0", "0 0 0", "0 0 1", "0 1 0", "1 0 0", "3 0 1 2", "3 0 1 9", "3 1 2 3", "3 0 2 3"),
        "",  # trimesh finds the missing vertex in some versions, and the library in others
    ),
    "millimetres.stl": (trimesh.creation.box((100, 60, 40)).export(file_type="stl"), "100 m, .*give longest_side"),
}
