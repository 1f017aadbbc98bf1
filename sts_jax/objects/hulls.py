"""Convex hulls in NumPy float64, on the host: vertices, distances, support function and rest poses."""

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial import ConvexHull, QhullError

from sts_jax.objects.body import HULL_CLASSES, Body

FLAT = 0.02  # share of the surface of a hull, least area of a flat face whose corners are kept
HULL_TOLERANCE = 5e-5  # m, a hull is not refined further if no point is farther outside than this
SAME_FACE = np.deg2rad(0.5)  # rad, triangles of a hull whose normals differ by less than this form one face
REST_GRAIN = 2e-5  # m, points of a hull nearer to a face's plane than this are part of the face
REST_MARGIN = 5e-4  # m, the centre of mass of an object at rest lies at least this far inside the outline of the face
NUM_DIRECTIONS = 128


def lattice(num: int) -> Float[np.ndarray, "n 3"]:
    """Return `num` unit vectors that are spread evenly over the sphere in a Fibonacci lattice."""
    step = np.arange(num) + 0.5
    z, angle = 1 - 2 * step / num, np.pi * (1 + np.sqrt(5)) * step
    points = np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z], axis=1)
    return points.astype(np.float32)


DIRECTIONS = lattice(NUM_DIRECTIONS)  # (128, 3), unit vectors for which `support` is computed


def convex_hull(
    points: Float[np.ndarray, "n 3"], *, limit: int = HULL_CLASSES[-1], tolerance: float = HULL_TOLERANCE
) -> Float[np.ndarray, "h 3"]:
    """Vertices of an approximate convex hull of points.

    The hull starts as a tetrahedron of four points. Then the point farthest outside the hull is added
    repeatedly, until no point is more than `tolerance` (m) outside, or until the hull has `limit` vertices. If these
    are too few, as for a die with round edges, the hull starts with corners of the large flat faces, on which the
    object rests.
    """
    try:
        candidates = points[ConvexHull(points).vertices]
    except (QhullError, ValueError) as error:
        raise ValueError("the points lie in a plane, so their convex hull has no volume: thicken the object") from error
    chosen, remains = _refined(candidates, [], limit, tolerance)
    if remains > tolerance > 0:
        chosen, _ = _refined(candidates, _flat_corners(candidates, max(limit // 2, 24)), limit, tolerance)
    corners = candidates[chosen]
    return corners[np.sort(ConvexHull(corners).vertices)]


def _refined(candidates: np.ndarray, seeds: list[int], limit: int, tolerance: float) -> tuple[list[int], float]:
    """Indices of the vertices of `convex_hull`, and the largest distance (m) of a candidate outside."""
    chosen = [int(np.argmax(candidates[:, 0]))]
    relative = candidates - candidates[chosen[0]]
    chosen.append(int(np.argmax(np.linalg.norm(relative, axis=1))))
    chosen.append(int(np.argmax(np.linalg.norm(np.cross(relative, relative[chosen[1]]), axis=1))))
    normal = np.cross(relative[chosen[1]], relative[chosen[2]])
    chosen.append(int(np.argmax(np.abs(relative @ normal))))
    chosen += [seed for seed in seeds if seed not in chosen]
    while True:
        planes = ConvexHull(candidates[chosen]).equations
        outside = (candidates @ planes[:, :3].T + planes[:, 3]).max(axis=1)
        furthest = int(np.argmax(outside))
        if len(chosen) >= limit or outside[furthest] <= tolerance:
            return chosen, float(outside[furthest])
        chosen.append(furthest)


def _flat_corners(candidates: np.ndarray, most: int) -> list[int]:
    """Indices of at most `most` corners of those flat faces of a hull that have at least FLAT of its surface."""
    hull, found = ConvexHull(candidates), []
    planes, plane = np.unique(hull.equations.round(6), axis=0, return_inverse=True)
    area = np.bincount(plane.reshape(-1), weights=trimesh.triangles.area(candidates[hull.simplices]))
    faces = np.flatnonzero(area >= FLAT * hull.area)
    each = max(3, most // max(len(faces), 1))
    for face in faces[np.argsort(-area[faces])][: most // 3]:
        corners = np.unique(hull.simplices[plane == face])
        across = np.linalg.svd(planes[face, None, :3])[2][1:]
        outline = corners[ConvexHull(candidates[corners] @ across.T).vertices]
        found += outline[np.linspace(0, len(outline), min(each, len(outline)), endpoint=False).astype(int)].tolist()
    return found


def outside_hull(points: Float[np.ndarray, "n 3"], hull: Float[np.ndarray, "h 3"]) -> Float[np.ndarray, "n"]:
    """Distance (m) of each point from the convex hull of the vertices `hull`, 0 inside."""
    shape = ConvexHull(hull)
    normals, offsets = shape.equations[:, :3], shape.equations[:, 3]
    sides = points @ normals.T + offsets
    plane = np.argmax(sides, axis=1)
    distance = np.maximum(sides[np.arange(len(points)), plane], 0.0)
    # The distance to the plane that a point is farthest beyond is exact if the foot of the perpendicular lies on the
    # hull. Otherwise the nearest point of the hull lies on an edge.
    feet = points - distance[:, None] * normals[plane]
    rows = np.nonzero((distance > 0) & ((feet @ normals.T + offsets).max(axis=1) > 1e-12))[0]
    triangles = hull[shape.simplices]
    for some in np.array_split(rows, -(-len(rows) * len(triangles) // 200_000)) if len(rows) else []:
        pairs = np.repeat(some, len(triangles))
        nearest = trimesh.triangles.closest_point(np.tile(triangles, (len(some), 1, 1)), points[pairs])
        distance[some] = np.linalg.norm(nearest - points[pairs], axis=1).reshape(len(some), -1).min(axis=1)
    return distance


def support(body: Body) -> Float[np.ndarray, "128"]:
    """Support function of a body: the largest v . d (m) over its collision vertices v, for each d in DIRECTIONS."""
    points = np.asarray(body.hulls, np.float64).reshape(-1, 3)
    return (points @ DIRECTIONS.T.astype(np.float64)).max(axis=0).astype(np.float32)


def rest_poses(
    points: Float[np.ndarray, "n 3"], com: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k"]]:
    """Find the orientations in which the convex hull of points rests on a level plane.

    Returns:
        For each of the k faces on which the hull can rest with the centre of mass `com`, the unit vector that then
        points up, in the frame of `points`, and the solid angle of the face seen from `com`, divided by the sum over
        the k faces. An object is more likely to land on a face with a larger share.
    """
    hull = ConvexHull(points)
    normals, offsets = hull.equations[:, :3], hull.equations[:, 3]
    r = points[hull.simplices] - com
    length = np.linalg.norm(r, axis=2)
    # Van Oosterom and Strackee (1983): the solid angle of a triangle.
    numerator = np.abs(np.einsum("fi,fi->f", r[:, 0], np.cross(r[:, 1], r[:, 2])))
    pairs = [np.einsum("fi,fi->f", r[:, i], r[:, j]) * length[:, k] for i, j, k in ((0, 1, 2), (0, 2, 1), (1, 2, 0))]
    angle = 2 * np.arctan2(numerator, length.prod(axis=1) + np.sum(pairs, axis=0))

    ups, weights = [], []
    left = np.ones(len(normals), bool)
    while left.any():
        first = np.flatnonzero(left)[np.argmax(angle[left])]
        face = left & (normals @ normals[first] > np.cos(SAME_FACE))
        left &= ~face
        normal = normals[first]
        support = points[points @ normal + offsets[first] > -REST_GRAIN]
        across = np.linalg.svd(normal[None])[2][1:]
        try:
            edges = ConvexHull(support @ across.T).equations
        except QhullError:  # the points form an edge or a corner
            continue
        above = normal @ com + offsets[first] < 0
        if above and np.max(edges[:, :2] @ (across @ com) + edges[:, 2]) < -REST_MARGIN:
            ups.append(-normal)
            weights.append(angle[face].sum())
    return np.array(ups).reshape(-1, 3), np.array(weights) / max(np.sum(weights), 1e-12)
