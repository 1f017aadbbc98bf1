"""Contacts of convex hulls with the top and the sides of a box: `collide` finds them and keeps a fixed number.

MJX's own test of a mesh with a box compiles again for every mesh, and tests every edge of the mesh with every edge of
the box. The edges of a small object on a large pad then have contacts with the distant rims of the pad, which push the
object, so that it never comes to rest or is thrown off.

The pad and the stop wall are boxes with sides parallel to the axes. The four edges of the top of a box are called its
rims. Of the four possible kinds of contacts, this module computes three:

- A vertex of the hull lies inside the box. The vertex is pushed out through the nearest of the top and the four sides.
- An edge of the hull crosses a rim. The edge is pushed along the common normal of edge and rim, or upwards if this
  normal points into the box.
- A corner of the top lies inside the hull. The hull is pushed along the normal of the nearest lower face of the hull.

The distance of each contact is exact along its normal. The fourth kind, an edge of the hull that crosses a vertical
edge of the box, is left out: only objects that have fallen off the pad meet these edges.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial import ConvexHull, QhullError

from sts_jax import geometry

PAD_CONTACTS, WALL_CONTACTS = 8, 4  # multiples of four, because MJX reserves four contacts for each pair of boxes
STEEP = 5.0  # weight of a point's depth relative to its reach in a direction, for the choice of contact points
APART = 0.001  # m, least distance between the two deepest points, measured in the `plane` of `collide`
SKIN = 0.001  # m, points up to this height above the deepest one can be contacts


class Hull(NamedTuple):
    """The p convex parts of an object in the mesh frame, padded by repetition to h vertices, e edges and f faces each.

    The last axis of each array runs over the vertices, edges or faces, because XLA vectorises along it.
    """

    vertices: Float[Array | np.ndarray, "*n 3 p h"]  # m
    edges: Float[Array | np.ndarray, "*n 2 3 p e"]  # m, both ends. Diagonals of flat faces are included and harmless
    planes: Float[Array | np.ndarray, "*n 4 p f"]  # outward unit normal and offset (m), with normal . x < offset inside


class Contacts(NamedTuple):
    """k contact points of an object with a box, with fields as in MuJoCo's `mjContact`.

    `collide` returns them in the frame of the box's top, and `scene.step` takes them in the sensor frame.
    """

    dist: Float[Array, "k"]  # m, negative for penetration, 1 where there is no contact
    pos: Float[Array, "k 3"]  # m, halfway between the two surfaces
    frame: Float[Array, "k 3 3"]  # rows: normal from pad to object, two tangents


def hull(parts: np.ndarray) -> Hull:
    """Hull of p convex parts, (p, n, 3) (m), padded to n vertices, 3 n - 6 edges and 2 n - 4 faces per part."""
    return jax.tree.map(lambda *x: np.stack(x, axis=-2), *(_part(part) for part in parts))


def _part(vertices: np.ndarray) -> Hull:
    points = np.asarray(vertices, np.float64)
    try:
        convex = ConvexHull(points)
    except QhullError as error:
        raise ValueError("the collision hull spans no volume: the points of a convex part are in one plane") from error
    sides = np.sort(convex.simplices[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges = points[np.unique(sides, axis=0)]
    planes = convex.equations * [1, 1, 1, -1]

    def pad(x: np.ndarray, count: int) -> np.ndarray:
        padded = np.concatenate([x, np.repeat(x[-1:], count - len(x), axis=0)])
        return np.moveaxis(padded, 0, -1).astype(np.float32)

    n = len(points)
    return Hull(pad(points, n), pad(edges, 3 * n - 6), pad(planes, 2 * n - 4))


class _Candidates(NamedTuple):
    """Possible contact points of one kind."""

    depth: Float[Array, "c"]  # m, negative where there is no contact
    point: Float[Array, "3 c"]  # m
    normal: Float[Array, "3 c"]  # from pad to object


class _Crossing(NamedTuple):
    """Intersections of the edges of a hull with one side plane of the box. The plane contains one rim of the top."""

    crosses: Bool[Array, "e"]  # True if the two ends of an edge lie on different sides of the plane
    point: Float[Array, "3 e"]  # m, intersection of the edge and the plane
    inner: Float[Array, "3 e"]  # m, end on the inner side of the plane, cut off at the box's neighbouring side
    beyond: Bool[Array, "e"]  # True if the inner end was beyond the neighbouring side and has been cut off
    to_corner: Float[Array, "e"]  # m, signed, along the rim from `point` to the corner on the side of the inner end


def turned(rotation: Float[Array, "3 3"], points: Float[Array | np.ndarray, "*n 3 h"]) -> Float[Array, "*n 3 h"]:
    """Rotate the h points in the columns of `points` by a rotation matrix."""
    # A product of small matrices would be slow in XLA on a CPU.
    x, y, z = points[..., :1, :], points[..., 1:2, :], points[..., 2:, :]
    return rotation[:, :1] * x + rotation[:, 1:2] * y + rotation[:, 2:] * z


def _vertices(points: Float[Array, "3 h"], half: Float[Array, "2"]) -> _Candidates:
    """Find the vertices of the hull inside the box. The normal is that of the nearest of the top and the four sides."""
    x, y, z = points
    side_x, side_y = half[0] - jnp.abs(x), half[1] - jnp.abs(y)
    top = -z <= jnp.minimum(side_x, side_y)
    through_x, through_y = ~top & (side_x <= side_y), ~top & (side_x > side_y)
    normal = [jnp.where(through_x, jnp.where(x < 0, -1.0, 1.0), 0.0)]
    normal += [jnp.where(through_y, jnp.where(y < 0, -1.0, 1.0), 0.0), jnp.where(top, 1.0, 0.0)]
    return _Candidates(jnp.minimum(-z, jnp.minimum(side_x, side_y)), points, jnp.stack(normal))


def _crossing(ends: Float[Array, "2 3 e"], half: Float[Array, "2"], axis: int, sign: float) -> _Crossing:
    """Intersect the edges with the side plane of the box on one side (`sign`, 1 or -1) of an axis."""
    out = sign * ends[:, axis] - half[axis]
    crosses = out[0] * out[1] < 0
    share = jnp.where(crosses, out[0] / jnp.where(crosses, out[0] - out[1], 1.0), 0.0)
    point = ends[0] + share * (ends[1] - ends[0])
    inner, other = jnp.where(out[0] < out[1], ends[0], ends[1]), 1 - axis
    beyond = jnp.abs(inner[other]) > half[other]
    to_corner = jnp.where(inner[other] < 0, -half[other], half[other]) - point[other]
    whole = jnp.where(beyond & (inner[other] != point[other]), inner[other] - point[other], 1.0)
    inner = jnp.where(beyond, point + to_corner / whole * (inner - point), inner)
    return _Crossing(crosses, point, inner, beyond, to_corner)


def _through_top(edges: _Crossing, half: Float[Array, "2"], axis: int, sign: float) -> Bool[Array, "e"]:
    """Whether each edge entered the box through the top and not through a side."""
    # Its inner end lies above the box, inside it and nearer to the top than to a side, or beyond its far side.
    inner = edges.inner
    cut = jnp.abs(sign * half[axis] - inner[axis])
    aside = jnp.abs(edges.to_corner) * cut / jnp.sqrt(jnp.maximum(edges.to_corner**2 + cut**2, 1e-12))
    inside = jnp.where(edges.beyond, aside, jnp.minimum(half[0] - jnp.abs(inner[0]), half[1] - jnp.abs(inner[1])))
    return (-inner[2] <= jnp.maximum(0, inside)) | (sign * inner[axis] < -half[axis])


def _rim_normal(along: Float[Array, "3 e"], axis: int, sign: float) -> Float[Array, "3 e"]:
    """Unit vector perpendicular to each edge (direction `along`) and to the rim on a side (`sign`) of an axis."""
    across, up = along[2], -along[axis]
    length = jnp.sqrt(across**2 + up**2)
    scale = jnp.where(up < 0, -1.0, 1.0) / jnp.where(length > 0, length, 1.0)
    across, up = scale * across, scale * up
    # If the inner end is lower, it is itself a contact, and the rim only supports the edge from below.
    tilted = sign * across >= 0
    across, up = jnp.where(tilted, across, 0.0), jnp.where(tilted, up, 1.0)
    none = jnp.zeros_like(up)
    return jnp.stack([across, none, up] if axis == 0 else [none, across, up])


def _rim(ends: Float[Array, "2 3 e"], half: Float[Array, "2"], axis: int, sign: float) -> _Candidates:
    """Find the edges of the hull that cross the rim of the top on one side (`sign`, 1 or -1) of an axis."""
    edges = _crossing(ends, half, axis, sign)
    normal = _rim_normal(ends[1] - ends[0], axis, sign)
    on_rim = jnp.abs(edges.point[1 - axis]) < half[1 - axis]
    touches = edges.crosses & _through_top(edges, half, axis, sign) & on_rim
    return _Candidates(jnp.where(touches, -edges.point[2] * normal[2], -1.0), edges.point, normal)


def _corners(planes: Float[Array, "4 f"], half: Float[Array, "2"]) -> _Candidates:
    """Find the corners of the top inside a convex part. The normal is that of the nearest of the part's lower faces."""
    corners = []
    for x, y in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        corner = jnp.stack([x * half[0], y * half[1], jnp.zeros(())])
        inside = planes[3] - corner[0] * planes[0] - corner[1] * planes[1]
        below = jnp.where(planes[2] < 0, inside, 1.0)
        nearest = jnp.argmin(below)
        depth = jnp.where(jnp.all(inside > 0), below[nearest], -1.0)
        normal = -planes[:3, nearest]
        corners.append(_Candidates(depth, corner - depth * normal, normal))
    return jax.tree.map(lambda *x: jnp.stack(x, axis=-1), *corners)


def _spread(depth: Float[Array, "c"], across: Float[Array, "2 c"], num: int) -> Int[Array, "k"]:
    """Choose the `num` contact points of `collide`, which lie far apart in the coordinates `across` (m).

    The object tips over the two deepest points. An index can occur more than once.
    """
    deepest = jnp.max(depth)
    candidate = depth > jnp.maximum(0, deepest - SKIN)

    def best(score: Float[Array, "s c"]) -> Int[Array, "s"]:
        # XLA's argmax is slow on a CPU, so find the largest value and then its first index.
        score = jnp.where(candidate, score, -jnp.inf)
        places = jnp.where(score == jnp.max(score, axis=1, keepdims=True), jnp.arange(len(depth)), len(depth) - 1)
        return jnp.min(places, axis=1)

    first = best(depth[None])
    elsewhere = jnp.sum((across - across[:, first]) ** 2, axis=0) > APART**2
    # An odd first angle, so that no symmetric object at rest has two equally good points.
    angle = 0.4 + 2 * np.pi * np.arange(num - 2) / (num - 2)
    reach = [x * across[0] + y * across[1] for x, y in zip(np.cos(angle), np.sin(angle), strict=True)]
    others = jnp.stack([jnp.where(elsewhere, depth, -1.0), *(r + STEEP * depth for r in reach)])
    return jnp.concatenate([first, best(others)])


def _frame(normal: Float[Array, "3"]) -> Float[Array, "3 3"]:
    other = jnp.where(jnp.abs(normal[1]) < 0.5, jnp.array([0.0, 1.0, 0.0]), jnp.array([0.0, 0.0, 1.0]))
    tangent = geometry.normalize(other - normal * (normal @ other))
    return jnp.stack([normal, tangent, jnp.cross(normal, tangent)])


def collide(
    body: Hull,
    pose: Float[Array, "7"],
    half: Float[Array, "2"],
    num: int = PAD_CONTACTS,
    plane: tuple[int, int] = (0, 1),
) -> Contacts:
    """Find `num` contacts between an object and a box whose top is centred at the origin.

    A candidate can become a contact if its depth is above 0 and above the largest depth minus `SKIN`. The first contact
    is the deepest candidate. The second is the deepest that is more than `APART` away from the first. For each of
    `num` - 2 evenly spaced directions, the candidate with the largest coordinate along it plus `STEEP` times its depth
    is a contact, unless it is one already.

    Args:
        body: Convex parts of the object.
        pose: Mesh frame in the frame of the box's top.
        half: Half the size of the box along x and y (m). It is infinitely deep.
        num: Number of contacts, >= 2.
        plane: The two axes along which distances and directions are measured.
    """
    rotation, place = geometry.quat_to_matrix(pose[3:]), pose[:3, None]
    points = turned(rotation, jnp.reshape(body.vertices, (3, -1))) + place
    ends = turned(rotation, jnp.reshape(body.edges, (2, 3, -1))) + place
    normals = turned(rotation, jnp.reshape(body.planes[:3], (3, -1)))
    offsets = jnp.reshape(body.planes[3], (1, -1)) + jnp.sum(normals * place, axis=0)
    planes = jnp.reshape(jnp.concatenate([normals, offsets]), body.planes.shape)
    rims = [_rim(ends, half, axis, sign) for axis in (0, 1) for sign in (-1.0, 1.0)]
    corners = [_corners(planes[:, part], half) for part in range(planes.shape[1])]
    kinds = [_vertices(points, half), *rims, *corners]
    depth, points, normal = jax.tree.map(lambda *x: jnp.concatenate(x, axis=-1), *kinds)
    chosen = _spread(depth, points[jnp.array(plane)], num)
    new = jnp.sum(jnp.tril(chosen == chosen[:, None]), axis=1) == 1
    depth, points, normal = depth[chosen], points[:, chosen].T, normal[:, chosen].T
    dist = jnp.where(new & (depth > 0), -depth, 1.0)
    return Contacts(dist, points + 0.5 * depth[:, None] * normal, jax.vmap(_frame)(normal))
