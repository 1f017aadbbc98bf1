"""Polygons of mesh files as triangles, by ear clipping, because trimesh splits concave polygons wrongly."""

import io
import struct
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from sts_jax.objects.files import Refusal

# Types of a PLY file, as codes of `struct`.
_CODES = {
    **{"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "float": "f", "double": "d"},
    **{"int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I", "int64": "q"},
    **{"uint64": "Q", "float16": "e", "float32": "f", "float64": "d"},
}
LONGEST = 2000  # corners of a concave polygon, whose cutting takes a time of the second order


def cut(points: Float[np.ndarray, "n 3"], sizes: Sequence[int] | Int[np.ndarray, "m"]) -> Int[np.ndarray, "_ 3"]:
    """Cut polygons, which may be concave, slightly bent, and touch themselves. Return the corners of the triangles.

    All corners remain, so that neighbouring polygons still share their edges. A repetition of a polygon has the same
    triangles, also with another first corner or in the opposite direction.

    Args:
        points: Corners of all polygons, one polygon after the other.
        sizes: Number of corners of each polygon. One of k corners has k - 2 triangles, which follow each other.
    """
    sizes = np.asarray(sizes, int)
    counts = np.maximum(sizes - 2, 0)
    starts, firsts = np.cumsum(sizes) - sizes, np.cumsum(counts) - counts
    triangles = np.empty((counts.sum(), 3), int)
    for size in np.unique(sizes[sizes > 2]):
        start, first = starts[sizes == size, None], firsts[sizes == size, None]
        triangles[first + np.arange(size - 2)] = start[..., None] + _cut_alike(points[start + np.arange(size)])
    return triangles


def _cut_alike(points: np.ndarray) -> np.ndarray:
    """Cut polygons of the same number of corners, `(m, n, 3)`, into triangles `(m, n - 2, 3)`."""
    num = points.shape[1]
    fan = np.stack([np.zeros(num - 2, int), np.arange(1, num - 1), np.arange(2, num)], axis=1)
    finite = np.isfinite(points).all(axis=(1, 2))
    if num == 3 or not finite.any():
        return np.broadcast_to(fan, (len(points), num - 2, 3))
    places = np.where(finite[:, None, None], points, 0)
    first = np.lexsort(np.moveaxis(places[..., ::-1], -1, 0))[:, 0]
    ring = (first[:, None] + np.arange(num)) % num
    rows = np.arange(len(points))
    backwards = np.sign(places[rows, ring[:, 1]] - places[rows, ring[:, -1]]) @ [4, 2, 1] > 0
    ring[backwards, 1:] = ring[backwards, :0:-1]
    corners = places[rows[:, None], ring] - places[rows, first][:, None]
    wedges = np.cross(corners[:, 1:-1], corners[:, 2:])
    normal = wedges.sum(axis=1)  # twice the area (Newell)
    area, grain = np.linalg.norm(normal, axis=1), 1e-12 * np.ptp(corners, axis=1).max(axis=1) ** 2
    convex = (np.einsum("mki,mi->mk", wedges, normal) >= -(grain * area)[:, None]).all(axis=1) & (area > grain)
    triangles = ring[:, fan]
    for k in np.flatnonzero(finite & ~convex):
        triangles[k] = ring[k][_cut_concave(corners[k], normal[k], area[k], grain[k], points[k, 0])]
    triangles[backwards] = triangles[backwards][..., ::-1]
    return np.where(finite[:, None, None], triangles, fan)


def _cut_concave(corners: np.ndarray, normal: np.ndarray, area: float, grain: float, place: np.ndarray) -> np.ndarray:
    """Cut a polygon by its projection along its normal, of the length `area`. `place` is for messages."""
    num = len(corners)
    if num > LONGEST:
        raise Refusal(f"a concave face has {num:,} corners, but at most {LONGEST:,} are cut: split it into triangles")
    x, y = np.linalg.svd(normal[None])[2][1:] if area > grain else np.linalg.svd(corners, full_matrices=False)[2][:2]
    plane = corners @ np.stack([x, y if np.cross(x, y) @ normal >= 0 else -y], axis=1)
    triangles = _ears(plane, grain)
    if np.abs(_areas(plane, triangles)).sum() > (1 + 1e-3) * area + 1e6 * grain:
        raise Refusal(f"a face of {num} corners near {place} crosses itself: split it into triangles")
    return triangles


def _areas(plane: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Twice the signed areas of triangles in a plane."""
    a, b, c = np.moveaxis(plane[triangles], -2, 0)
    return _cross(b - a, c - a)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _ears(plane: np.ndarray, grain: float) -> np.ndarray:
    """Triangles of a counter-clockwise polygon by ear clipping: cut off a convex corner that contains no other."""
    left, triangles = list(range(len(plane))), []
    while len(left) > 3:
        b = plane[left]
        a, c = np.roll(b, 1, axis=0), np.roll(b, -1, axis=0)
        turn = _cross(b - a, c - b)
        back = (np.abs(turn) <= grain) & (np.einsum("nk,nk->n", b - a, c - b) <= 0)  # repeated corners and spikes
        convex = np.flatnonzero(turn > grain)
        order = convex[np.argsort(((c - a) ** 2).sum(axis=1)[convex], kind="stable")]
        ears = np.flatnonzero(back)[:1].tolist()
        for margin in (-grain, grain):  # corners on an edge of the triangle only count at first
            ears = ears or next(([i] for i in order if not _contains(a[i], b[i], c[i], b, margin)), [])
        ear = ears[0] if ears else int(np.argmax(turn))
        triangles.append([left[ear - 1], left[ear], left[(ear + 1) % len(left)]])
        del left[ear]
    return np.array([*triangles, left])


def _contains(a: np.ndarray, b: np.ndarray, c: np.ndarray, points: np.ndarray, margin: float) -> bool:
    """Return whether a triangle contains any point that is not at its corners."""
    inside = [_cross(end - start, points - start) > margin for start, end in ((a, b), (b, c), (c, a))]
    corner = [np.abs(points - place).max(axis=1) <= np.sqrt(abs(margin)) for place in (a, b, c)]
    return bool((np.all(inside, axis=0) & ~np.any(corner, axis=0)).any())


def cut_off(content: bytes) -> bytes:
    """Cut the polygons of an OFF file."""
    lines = [line.split("#")[0].strip() for line in content.decode("latin-1").splitlines()]
    head, *lines = [line for line in lines if line]
    kind, *counts = head.split()
    if not counts:
        counts = lines.pop(0).split()
    num = int(counts[0])
    vertices, polygons = lines[:num], [line.split() for line in lines[num : num + int(counts[1])]]
    points = np.array([line.split()[:3] for line in vertices], float)
    polygons = [polygon[1:][: int(polygon[0])] for polygon in polygons]
    index = np.array([corner for polygon in polygons for corner in polygon], int)
    faces = [f"3 {a} {b} {c}" for a, b, c in index[cut(points[index], list(map(len, polygons)))].tolist()]
    return "\n".join([kind, f"{num} {len(faces)} 0", *vertices, *faces]).encode("latin-1")


def cut_ply(content: bytes) -> bytes:
    """Cut the polygons of a PLY file. Further lists of a face, such as texture coordinates, follow its corners."""
    head, _, body = content.partition(b"end_header")
    lines = [line.split() for line in head.decode("latin-1").splitlines()]
    layout: dict[str, list[list[str]]] = {}  # the words of each property: [list, uchar, int, name] or [float, name]
    count: dict[str, int] = {}
    for words in lines:
        if words[:1] == ["element"]:
            name, count[words[1]], layout[words[1]] = words[1], int(words[2]), []
        elif words[:1] == ["property"]:
            layout[name].append(words[1:])
    read = _reader(body[body.find(b"\n") + 1 :], next(words[1] for words in lines if words[:1] == ["format"]))

    def values(words: list[str]) -> list[Any]:
        return [read(words[-2]) for _ in range(read(words[1]) if words[0] == "list" else 1)]

    rows = {name: [[values(words) for words in layout[name]] for _ in range(count[name])] for name in layout}
    lists = [k for k, words in enumerate(layout.get("face", [])) if words[0] == "list"]
    corners = next((k for k in lists if layout["face"][k][-1].startswith("vertex_ind")), lists[0] if lists else None)
    if corners is None:
        raise ValueError("it has points, but no list of faces")
    if all(len(row[corners]) == 3 for row in rows.get("face", [])):
        return content
    names = [words[-1] for words in layout["vertex"]]
    places = np.array([[row[names.index(axis)][0] for axis in "xyz"] for row in rows["vertex"]], float)
    sizes = np.array([len(row[corners]) for row in rows["face"]])
    owner = np.repeat(np.arange(len(sizes)), np.maximum(sizes - 2, 0))
    triangles = cut(places[[number for row in rows["face"] for number in row[corners]]], sizes)
    triangles -= (np.cumsum(sizes) - sizes)[owner, None]  # corners of the polygon
    faces = []
    for row, triangle in zip([rows["face"][k] for k in owner], triangles.tolist(), strict=True):
        num, copy = len(row[corners]), list(row)
        for k in [k for k in lists if len(row[k]) % num == 0]:
            width = len(row[k]) // num
            copy[k] = [row[k][width * corner + j] for corner in triangle for j in range(width)]
        faces.append(copy)
    rows["face"] = faces
    top = [["format", "binary_little_endian", "1.0"] if words[:1] == ["format"] else words for words in lines]
    top = [["element", "face", str(len(faces))] if words[:2] == ["element", "face"] else words for words in top]
    out = ["\n".join(map(" ".join, top)).encode("latin-1"), b"\nend_header\n"]
    for name, kinds in layout.items():
        for words, value in ((words, value) for row in rows[name] for words, value in zip(kinds, row, strict=True)):
            size = struct.pack("<" + _CODES[words[1]], len(value)) if words[0] == "list" else b""
            out.append(size + struct.pack(f"<{len(value)}{_CODES[words[-2]]}", *value))
    return b"".join(out)


def _reader(body: bytes, form: str) -> Callable[[str], Any]:
    """Return a function that reads the next number of a type from the body of a PLY file."""
    if form == "ascii":
        tokens = iter(body.split())
        return lambda kind: (float if _CODES[kind] in "efd" else int)(float(next(tokens, b"")))
    stream, order = io.BytesIO(body), ">" if "big" in form else "<"
    return lambda kind: struct.unpack(order + _CODES[kind], stream.read(struct.calcsize(order + _CODES[kind])))[0]
