"""Geometry of solids on the host, in NumPy float64: moments, convex hulls, rest poses, corner normals, assembly.

Triangles are counter-clockwise seen from outside. A row of moments is `[1, x, y, z, xx, yy, zz, xy, xz, yz]`
integrated over a solid or a surface.
"""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int
from scipy.spatial import ConvexHull, KDTree, QhullError

from sts_jax.objects.body import FACE_CLASSES, HULL_CLASSES, PART_CLASSES, Body

WALL = 1.2  # kg/m^2, default shell of a hollow object: plastic about 1.2 mm thick
STEEL = 5.9  # kg/m^2 of each face: stainless steel, 7,900 kg/m^3 (EN 10088-1, grade 1.4301) x 1.5 mm, on two faces
CONTENTS = 1000.0  # kg/m^3, water
CREASE = np.deg2rad(40.0)  # rad, edges sharper than this stay sharp when corner normals are computed
HULL_TOLERANCE = 5e-5  # m, a hull is not refined where the surface sticks out by less than this
SAME_FACE = np.deg2rad(0.5)  # rad, triangles of a hull whose normals differ by less than this form one face
REST_GRAIN = 2e-5  # m, points of a hull this near a face's plane belong to the face
REST_MARGIN = 5e-4  # m, how far inside the outline of a face the centre of mass must lie for the object to rest on it

NUM_DIRECTIONS = 128


def lattice(num: int) -> Float[np.ndarray, "n 3"]:
    """`num` unit vectors spread evenly over the sphere: a Fibonacci lattice."""
    step = np.arange(num) + 0.5
    z, angle = 1 - 2 * step / num, np.pi * (1 + np.sqrt(5)) * step
    points = np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z], axis=1)
    return points.astype(np.float32)


DIRECTIONS = lattice(NUM_DIRECTIONS)  # (128, 3) unit vectors, at which `support` is evaluated

_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


def solid_moments(
    triangles: Float[np.ndarray, "f 3 3"], *, reference: Float[np.ndarray, "3"] | None = None
) -> Float[np.ndarray, "f 10"]:
    """Moments of the signed tetrahedra between a reference point and each triangle, which sum to the solid's.

    For a tetrahedron with corners `0, a, b, c` relative to the reference, v = a . (b x c) / 6, int r = v s / 4 and
    int r r^T = v (s s^T + a a^T + b b^T + c c^T) / 20 with s = a + b + c.

    Args:
        triangles: corners, m.
        reference: any point. For a clipped solid, a point on the cutting plane, so that the cut contributes nothing.

    Returns:
        One row per triangle: m^3, m^4, m^5.
    """
    origin = np.zeros(3) if reference is None else reference
    r = triangles - origin
    volume = np.einsum("fi,fi->f", r[:, 0], np.cross(r[:, 1], r[:, 2])) / 6
    total = r.sum(axis=1)
    second = (np.einsum("fi,fj->fij", total, total) + np.einsum("fki,fkj->fij", r, r)) / 20
    return _shifted(volume, total / 4, second, origin)


def surface_moments(triangles: Float[np.ndarray, "f 3 3"]) -> Float[np.ndarray, "f 10"]:
    """Moments of triangles as thin sheets: area A, int r = A s / 3, int r r^T = A (s s^T + sum r_i r_i^T) / 12."""
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    area = np.linalg.norm(cross, axis=1) / 2
    total = triangles.sum(axis=1)
    second = (np.einsum("fi,fj->fij", total, total) + np.einsum("fki,fkj->fij", triangles, triangles)) / 12
    return _shifted(area, total / 3, second, np.zeros(3))


def _shifted(measure: np.ndarray, mean: np.ndarray, second: np.ndarray, origin: np.ndarray) -> np.ndarray:
    second = (
        second + np.einsum("fi,j->fij", mean, origin) + np.einsum("i,fj->fij", origin, mean) + np.outer(origin, origin)
    )
    columns = [np.ones_like(measure), *(mean + origin).T, *(second[:, i, j] for i, j in _PAIRS)]
    return measure[:, None] * np.stack(columns, axis=1)


def convex_hull(
    points: Float[np.ndarray, "n 3"], *, limit: int = HULL_CLASSES[-1], tolerance: float = HULL_TOLERANCE
) -> Float[np.ndarray, "h 3"]:
    """Vertices of a convex hull, simplified to a tolerance and a maximum number of vertices.

    Starting from a simplex, the point furthest outside is added until no point is outside by more than the tolerance.

    Args:
        points: m.
        limit: maximum number of vertices, which takes precedence over the tolerance.
        tolerance: m.

    Returns:
        A subset of the points.

    Raises:
        ValueError: the points lie in a plane.
    """
    try:
        candidates = points[ConvexHull(points).vertices]
    except (QhullError, ValueError) as error:
        raise ValueError("the points lie in a plane: their convex hull has no volume") from error
    chosen = [int(np.argmax(candidates[:, 0]))]
    relative = candidates - candidates[chosen[0]]
    chosen.append(int(np.argmax(np.linalg.norm(relative, axis=1))))
    chosen.append(int(np.argmax(np.linalg.norm(np.cross(relative, relative[chosen[1]]), axis=1))))
    normal = np.cross(relative[chosen[1]], relative[chosen[2]])
    chosen.append(int(np.argmax(np.abs(relative @ normal))))
    while len(chosen) < limit:
        planes = ConvexHull(candidates[chosen]).equations
        outside = (candidates @ planes[:, :3].T + planes[:, 3]).max(axis=1)
        furthest = int(np.argmax(outside))
        if outside[furthest] <= tolerance:
            break
        chosen.append(furthest)
    corners = candidates[chosen]
    return corners[np.sort(ConvexHull(corners).vertices)]


def support(body: Body) -> Float[np.ndarray, "128"]:
    """Support function of the collision parts' convex hull, about the mesh origin: h(d) = max over vertices v . d.

    Args:
        body: one body.

    Returns:
        float32, m, at DIRECTIONS in the mesh frame.

    Raises:
        ValueError: `body` has leading axes.
    """
    if np.ndim(body.hulls) != 3:
        raise ValueError(f"hulls has the shape {np.shape(body.hulls)}, but one body has (p, h, 3): pass a single body")
    points = np.asarray(body.hulls, np.float64).reshape(-1, 3)
    return (points @ DIRECTIONS.T.astype(np.float64)).max(axis=0).astype(np.float32)


def rest_poses(
    points: Float[np.ndarray, "n 3"], com: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k"]]:
    """Attitudes in which a convex hull rests on a plane.

    The hull rests on a face if the centre of mass lies above the face and at least REST_MARGIN inside its outline.

    Args:
        points: m. Their convex hull is the object at rest.
        com: centre of mass, m.

    Returns:
        For each such face, the unit vector that points up when the hull rests on it, and a weight: the face's solid
        angle seen from the centre of mass, as a share of the sum over these faces.
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


def outside_hull(points: Float[np.ndarray, "n 3"], hull: Float[np.ndarray, "h 3"]) -> Float[np.ndarray, "n"]:
    """Distance (m) of each point from a convex hull, 0 inside."""
    shape = ConvexHull(hull)
    normals, offsets = shape.equations[:, :3], shape.equations[:, 3]
    sides = points @ normals.T + offsets
    plane = np.argmax(sides, axis=1)
    distance = np.maximum(sides[np.arange(len(points)), plane], 0.0)
    # The distance to the plane that a point is furthest beyond is exact if the foot of the perpendicular lies on the
    # hull. Otherwise the nearest point of the hull lies on an edge.
    feet = points - distance[:, None] * normals[plane]
    rows = np.nonzero((distance > 0) & ((feet @ normals.T + offsets).max(axis=1) > 1e-12))[0]
    triangles = hull[shape.simplices]
    for some in np.array_split(rows, -(-len(rows) * len(triangles) // 200_000)) if len(rows) else []:
        pairs = np.repeat(some, len(triangles))
        nearest = trimesh.triangles.closest_point(np.tile(triangles, (len(some), 1, 1)), points[pairs])
        distance[some] = np.linalg.norm(nearest - points[pairs], axis=1).reshape(len(some), -1).min(axis=1)
    return distance


def surface_samples(
    triangles: Float[np.ndarray, "f 3 3"], num: int
) -> tuple[Int[np.ndarray, "num"], Float[np.ndarray, "num 3"]]:
    """Points spread evenly by area over triangles, with a fixed seed: the face and barycentric weights of each."""
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    share = np.cumsum(np.linalg.norm(cross, axis=1))
    face = np.searchsorted(share, (np.arange(num) + 0.5) / num * share[-1])
    u, v = np.random.default_rng(0).random((2, num))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return face, np.stack([1 - u - v, u, v], axis=1)


def convex_parts(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    *,
    limit: int = PART_CLASSES[-1],
    vertices_per_part: int = HULL_CLASSES[0],
) -> list[Float[np.ndarray, "_ 3"]]:
    """Decompose a surface into convex parts, the largest first (CoACD: Wei et al., 2022, SIGGRAPH).

    The same mesh gives the same parts. CoACD first closes open surfaces, which thickens them a little.

    Args:
        vertices: m.
        faces: counter-clockwise from outside.
        limit: maximum number of parts.
        vertices_per_part: maximum number of vertices of each part.

    Returns:
        The vertices (m) of each part. A convex surface gives a single part.

    Raises:
        ImportError: coacd is not installed.
        ValueError: the surface cannot be decomposed.
    """
    try:
        import coacd
    except ImportError as error:
        raise ImportError(
            "convex parts need the package coacd, which is not installed: pip install 'sts_jax[meshes]'"
        ) from error
    coacd.set_log_level("off")
    try:
        pieces = coacd.run_coacd(
            coacd.Mesh(np.asarray(vertices, float), np.asarray(faces, np.int32)),
            max_convex_hull=limit,
            resolution=1000,
            mcts_nodes=10,
            mcts_iterations=40,
            seed=0,
        )
        parts = [convex_hull(np.asarray(corners, float), limit=vertices_per_part) for corners, _ in pieces]
    except (RuntimeError, ValueError) as error:
        raise ValueError(f"no convex parts were found ({error}): keep the convex hull") from error
    if not parts:
        raise ValueError("no convex parts were found: keep the convex hull")
    return sorted(parts, key=lambda part: (-ConvexHull(part).volume, *part[0]))


def decompose(body: Body) -> Body:
    """Let a body, such as scissors, a bowl or a mug, collide as several convex parts instead of its convex hull.

    Args:
        body: one body.

    Returns:
        The body with the parts as `hulls`, at most PART_CLASSES[-1] parts of at most HULL_CLASSES[0] vertices each.
        If a single part suffices, the body is returned unchanged.

    Raises:
        ImportError: coacd is not installed.
        ValueError: the surface cannot be decomposed.
    """
    parts = convex_parts(*_surface(body))
    if len(parts) == 1:
        return body
    size = _class(max(map(len, parts)), HULL_CLASSES)
    padded = np.stack([_pad(part, size, part[-1]) for part in parts])
    hulls = _pad(padded, _class(len(parts), PART_CLASSES), padded[-1])
    return dataclasses.replace(body, hulls=jnp.asarray(hulls, np.float32))


def gaps(body: Body) -> tuple[float, float]:
    """`surface_gaps` (m) of one body: how far its surface sticks out of the collision parts, and the reverse."""
    parts = np.asarray(body.hulls, float)
    new = np.array([True, *(parts[1:] != parts[:-1]).any(axis=(1, 2))])  # padding repeats the last part
    return surface_gaps(*_surface(body), [np.unique(part, axis=0) for part in parts[new]])


def _surface(body: Body) -> tuple[np.ndarray, np.ndarray]:
    faces = np.asarray(body.faces)
    return np.asarray(body.vertices, float), faces[faces.any(axis=1)]


def surface_gaps(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], hulls: Sequence[Float[np.ndarray, "_ 3"]]
) -> tuple[float, float]:
    """Largest distances (m) between the visible surface and the collision parts.

    Each is the maximum over the corners and 10,000 points of one surface of the exact distance to the other. A maximum
    between two points can be missed by about half their spacing. The first distance is exact for a single hull.

    Args:
        vertices: m.
        faces: of the visible surface, counter-clockwise from outside.
        hulls: the vertices of each convex part.

    Returns:
        How far the surface sticks out of all parts, which is how deep the drawn surface can sink in. How far the parts
        reach outside the surface, where the object collides although nothing is visible, as in a bowl's hollow.
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


def _points(triangles: np.ndarray, num: int) -> np.ndarray:
    face, weight = surface_samples(triangles, num)
    return np.einsum("nk,nkc->nc", weight, triangles[face])


def _reach(points: np.ndarray, triangles: np.ndarray, closed: bool) -> float:
    """Largest distance from the triangles over the points outside them, or over all points if they are not closed.

    The distance to the nearest corner or sample is an upper bound for a point. Therefore only points whose bound
    exceeds the largest distance so far are measured, each against the triangles within its bound.
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
        # The nearest faces of a closed surface decide which side a point is on. If they disagree, the winding decides.
        nearest = lengths <= distance[row] + 1e-9
        front = np.zeros((2, len(some)), bool)
        np.logical_or.at(front, ((np.einsum("pi,pi->p", away, normals[column]) > 0).astype(int), row), nearest)
        for index in np.argsort(-distance, kind="stable"):
            if distance[index] <= max(largest, 1e-6):
                break
            behind, before = front[:, index]
            if not closed or (before and (not behind or _turns(points[some[index]], triangles) < 0.5)):
                largest = float(distance[index])
                break
    return largest


def _turns(point: np.ndarray, triangles: np.ndarray) -> float:
    """Winding number of the triangles around a point (van Oosterom and Strackee, 1983): 1 inside, 0 outside."""
    a, b, c = np.moveaxis(triangles - point, 1, 0)
    one, two, three = (np.linalg.norm(side, axis=1) for side in (a, b, c))
    across = np.einsum("fi,fi->f", a, np.cross(b, c))
    dots = (np.einsum("fi,fi->f", left, right) for left, right in ((a, b), (b, c), (c, a)))
    along = one * two * three + sum(dot * size for dot, size in zip(dots, (three, one, two), strict=True))
    return float(np.arctan2(across, along).sum() / (2 * np.pi))


def hull_gap(body: Body) -> float:
    """Largest distance (m) by which the visible surface of one body sticks out of the collision parts."""
    surface = np.unique(np.asarray(body.vertices, float), axis=0)
    parts = [outside_hull(surface, np.unique(part, axis=0)) for part in np.asarray(body.hulls, float)]
    return float(np.min(parts, axis=0).max())


def corner_normals(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], *, crease: float = CREASE
) -> Float[np.ndarray, "f 3 3"]:
    """Unit normal of each corner: the angle-weighted mean over the faces at its vertex within the crease angle.

    Args:
        vertices: m.
        faces: indices. Faces must share the index of a vertex for the surface to be smooth there.
        crease: rad.

    Returns:
        Normals. A face without area counts as facing (0, 0, 1).
    """
    triangles = vertices[faces]
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    length = np.linalg.norm(cross, axis=1, keepdims=True)
    flat = np.where(length > 0, cross / np.where(length > 0, length, 1), np.array([0.0, 0.0, 1.0]))
    angle = trimesh.triangles.angles(triangles) * (length > 0)

    corner_vertex = faces.ravel()
    order = np.argsort(corner_vertex, kind="stable")
    count = np.bincount(corner_vertex, minlength=len(vertices))
    start = np.cumsum(count) - count
    # Pair every corner with all corners at its vertex.
    repeats = count[corner_vertex]
    first = np.repeat(np.arange(len(corner_vertex)), repeats)
    within = np.arange(len(first)) - np.repeat(np.cumsum(repeats) - repeats, repeats)
    second = order[start[corner_vertex[first]] + within]
    near = np.einsum("pi,pi->p", flat[first // 3], flat[second // 3]) > np.cos(crease)
    weight = near * angle.ravel()[second]
    normals = np.stack(
        [np.bincount(first, weight * flat[second // 3, axis], len(corner_vertex)) for axis in range(3)], axis=1
    )
    size = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(size > 1e-9, normals / np.where(size > 1e-9, size, 1), np.repeat(flat, 3, axis=0))
    return normals.reshape(-1, 3, 3)


def _class(count: int, classes: tuple[int, ...]) -> int:
    return next(size for size in classes if count <= size)


def _pad(array: np.ndarray, size: int, value: np.ndarray | float) -> np.ndarray:
    padding = np.broadcast_to(np.asarray(value, array.dtype), (size - len(array), *array.shape[1:]))
    return np.concatenate([array, padding])


def assemble(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    colors: Float[np.ndarray, "f 3 3"],
    *,
    density: Float[np.ndarray, "f"],
    interior: tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "g 3"]] | None,
    contents_density: float = 0.0,
    mass: float | None = None,
    uv: Float[np.ndarray, "f 3 2"] | None = None,
    texture: Float[np.ndarray, "t t 3"] | None = None,
    two_sided: Bool[np.ndarray, ""] | bool = False,
    category: int = -1,
) -> Body:
    """Assemble a padded `Body` from a surface and its material, with the hull's centroid as the origin.

    Args:
        vertices: m, +z up.
        faces: counter-clockwise from outside, at most FACE_CLASSES[-1] of them.
        colors: [0, 1], linear light, of each corner.
        density: kg/m^2 of each face.
        interior: a closed mesh in the same frame that bounds the contents, or None for a solid object.
        contents_density: kg/m^3.
        mass: kg, of the shell. None takes area times density.
        uv: texture coordinates of each corner, v = 0 at the texture's top row.
        texture: [0, 1], linear light, of one of TEXTURE_CLASSES.
        two_sided: whether the surface is visible from behind too.
        category: index into CATEGORIES, or -1.

    Returns:
        The body.

    Raises:
        ValueError: the convex hull or the interior has no volume.
    """
    hull = convex_hull(vertices)
    shape = ConvexHull(hull)
    middle = hull.mean(axis=0)
    outward = hull[shape.simplices] - middle
    sign = np.sign(np.einsum("fi,fi->f", outward[:, 0], np.cross(outward[:, 1], outward[:, 2])))
    moments = sign @ solid_moments(outward)
    origin = middle + moments[1:4] / moments[0]
    vertices, hull = vertices - origin, hull - origin

    shell = density @ surface_moments(vertices[faces])
    if mass is not None:
        shell *= mass / shell[0]
    com = shell[1:4] / shell[0]
    second = np.zeros((3, 3))
    for (i, j), value in zip(_PAIRS, shell[4:], strict=True):
        second[i, j] = second[j, i] = value
    second -= shell[0] * np.outer(com, com)

    contents = np.zeros((0, 3, 3)) if interior is None else (interior[0] - origin)[interior[1]]
    if interior is not None and not solid_moments(contents).sum(axis=0)[0] > 0:
        raise ValueError("the interior encloses no volume: close it, or turn its faces outwards")

    size = _class(max(len(faces), len(vertices), len(contents)), FACE_CLASSES)
    single = np.float32
    uv = np.zeros((len(faces), 3, 2)) if uv is None else uv
    texture = np.ones((1, 1, 3)) if texture is None else texture
    return Body(
        vertices=jnp.asarray(_pad(vertices, size, vertices[-1]), single),
        faces=jnp.asarray(_pad(faces, size, 0.0), np.int32),
        normals=jnp.asarray(_pad(corner_normals(vertices, faces), size, np.array([0.0, 0.0, 1.0])), single),
        colors=jnp.asarray(_pad(colors, size, 0.0), single),
        uv=jnp.asarray(_pad(uv, size, 0.0), single),
        texture=jnp.asarray(texture, single),
        two_sided=jnp.asarray(two_sided, bool),
        hulls=jnp.asarray(_pad(hull, _class(len(hull), HULL_CLASSES), hull[-1])[None], single),
        shell_mass=jnp.asarray(shell[0], single),
        shell_com=jnp.asarray(com, single),
        shell_inertia=jnp.asarray(np.trace(second) * np.eye(3) - second, single),
        interior=jnp.asarray(_pad(contents, size, 0.0), single),
        contents_density=jnp.asarray(contents_density, single),
        category=jnp.asarray(category, np.int32),
    )
