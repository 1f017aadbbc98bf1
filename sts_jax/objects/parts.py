"""Convex collision parts: decomposition of a body, and the distances between the parts and the visible surface."""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull, KDTree

from sts_jax.objects.body import HULL_CLASSES, PART_CLASSES, Body, pad, size_class
from sts_jax.objects.hulls import convex_hull, outside_hull
from sts_jax.objects.surface import surface_samples, winding


def convex_parts(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> list[Float[np.ndarray, "_ 3"]]:
    """Vertices (m) of the convex parts of a surface, the largest first (CoACD: Wei et al., 2022, SIGGRAPH).

    Equal meshes have equal parts, because the seed is fixed. CoACD first closes open surfaces, and thereby thickens
    them a little.
    """
    try:
        import coacd
    except ImportError as error:
        raise ImportError("convex parts need the package coacd, which is not installed: pip install coacd") from error
    coacd.set_log_level("off")
    try:
        pieces = coacd.run_coacd(
            coacd.Mesh(np.asarray(vertices, float), np.asarray(faces, np.int32)),
            max_convex_hull=PART_CLASSES[-1],
            resolution=1000,
            mcts_nodes=10,
            mcts_iterations=40,
            seed=0,
        )
        parts = [convex_hull(np.asarray(corners, float), limit=HULL_CLASSES[0]) for corners, _ in pieces]
        if not parts:
            raise ValueError("no parts")
    except (RuntimeError, ValueError) as error:
        raise ValueError(
            f"the surface cannot be decomposed into convex parts ({error}): use the body without a decomposition"
        ) from error
    return sorted(parts, key=lambda part: (-ConvexHull(part).volume, *part[0]))


def decompose(body: Body) -> Body:
    """Replace the collision hull of a body by at most 8 convex parts of at most 32 vertices each.

    A shape that is not convex, such as scissors or a bowl, is approximated better by several parts than by one hull. If
    a single part is enough, the body is returned unchanged. This needs the package coacd.
    """
    parts = convex_parts(*_surface(body))
    if len(parts) == 1:
        return body
    size = size_class(max(map(len, parts)), HULL_CLASSES)
    padded = np.stack([pad(part, size, part[-1]) for part in parts])
    hulls = pad(padded, size_class(len(parts), PART_CLASSES), padded[-1])
    return dataclasses.replace(body, hulls=jnp.asarray(hulls, np.float32))


def gaps(body: Body) -> tuple[float, float]:
    """Largest distances (m) between the visible surface of a body and its collision parts, see `surface_gaps`."""
    parts = np.asarray(body.hulls, float)
    new = np.array([True, *(parts[1:] != parts[:-1]).any(axis=(1, 2))])  # padding repeats the last part
    return surface_gaps(*_surface(body), [np.unique(part, axis=0) for part in parts[new]])


def surface_gaps(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], hulls: Sequence[Float[np.ndarray, "_ 3"]]
) -> tuple[float, float]:
    """Largest distances (m) of a visible surface outside its collision parts, and of the parts outside the surface.

    They are measured at the vertices of both and at 10,000 further points of each. A surface that is not closed has no
    outside: the second value is then the largest distance from the parts to it.
    """
    points = np.concatenate([np.unique(vertices[faces].reshape(-1, 3), axis=0), _points(vertices[faces], 10_000)])
    shapes = [ConvexHull(hull) for hull in hulls]
    for shape in shapes:
        points = points[(points @ shape.equations[:, :3].T + shape.equations[:, 3]).max(axis=1) > 1e-9]
    out = np.min([outside_hull(points, hull) for hull in hulls], axis=0).max(initial=0.0)

    triangles = np.concatenate([hull[shape.simplices] for hull, shape in zip(hulls, shapes, strict=True)])
    points = np.unique(np.concatenate([triangles.reshape(-1, 3), _points(triangles, 10_000)]), axis=0)
    closed = bool(trimesh.Trimesh(vertices, faces, process=False).is_watertight)
    return float(out), _reach(points, vertices[faces], closed)


def _surface(body: Body) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices and the faces of a body without padding faces."""
    faces = np.asarray(body.faces)
    return np.asarray(body.vertices, float), faces[faces.any(axis=1)]


def _points(triangles: np.ndarray, num: int) -> np.ndarray:
    """Sample `num` points (num, 3) evenly from triangles."""
    face, weight = surface_samples(triangles, num)
    return np.einsum("nk,nkc->nc", weight, triangles[face])


def _reach(points: np.ndarray, triangles: np.ndarray, closed: bool) -> float:
    """Compute the largest distance (m) from triangles, over the points outside them or over all if not `closed`.

    The distance to the nearest corner or sample of the triangles is an upper bound, which limits the exact search.
    """
    bound = KDTree(np.concatenate([_points(triangles, 10_000), triangles.reshape(-1, 3)])).query(points)[0]
    center = triangles.mean(axis=1)
    radius = np.linalg.norm(triangles - center[:, None], axis=2).max(axis=1)
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    order, largest = np.argsort(-bound, kind="stable"), 0.0
    for some in np.array_split(order, -(-len(order) // 128)):
        if bound[some[0]] <= largest:
            break
        apart = np.linalg.norm(center - points[some, None], axis=2)
        row, column = np.nonzero(apart - radius <= bound[some, None] * (1 + 1e-9))
        away = points[some][row] - trimesh.triangles.closest_point(triangles[column], points[some][row])
        lengths = np.linalg.norm(away, axis=1)
        distance = np.full(len(some), np.inf)
        np.minimum.at(distance, row, lengths)
        # The nearest faces of a closed surface show on which side a point is. If they disagree, the winding number
        # decides.
        nearest = lengths <= distance[row] + 1e-9
        front = np.zeros((2, len(some)), bool)
        np.logical_or.at(front, ((np.einsum("pi,pi->p", away, normals[column]) > 0).astype(int), row), nearest)
        for index in np.argsort(-distance, kind="stable"):
            if distance[index] <= max(largest, 1e-6):
                break
            behind, before = front[:, index]
            if not closed or (before and (not behind or winding(points[some[index]], triangles) < 0.5)):
                largest = float(distance[index])
                break
    return largest
