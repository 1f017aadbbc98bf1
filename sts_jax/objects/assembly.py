"""Assembly of a `Body` from a surface, its colours and its masses, in NumPy float64 on the host."""

import jax
import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int
from scipy.spatial import ConvexHull

from sts_jax.objects.body import FACE_CLASSES, HULL_CLASSES, Body, pad, size_class
from sts_jax.objects.hulls import convex_hull

WALL = 1.2  # kg/m^2, default mass per area of the shell of a hollow object: plastic about 1.2 mm thick
STEEL = 5.9  # kg/m^2 on each side of a sheet: 1.5 mm of stainless steel, 7,900 kg/m^3 (EN 10088-1, grade 1.4301)
CONTENTS = 1000.0  # kg/m^3, density of the contents: water
CREASE = np.deg2rad(40.0)  # rad, faces that meet at a larger angle do not share a corner normal
PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))  # pairs of axes of the second moments, in the order of a row


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
    """Assemble a `Body` from a surface, its colours and its masses.

    The body collides as the convex hull of the vertices, reduced to at most 64 vertices. The centroid of this hull
    becomes the origin of the body's coordinates. The arrays are padded to size classes. `Body` describes the arguments
    of the same name.

    Args:
        density: Mass per area of each face (kg/m^2).
        interior: Vertices and faces of a closed mesh around the contents, in the frame of `vertices`, or None.
        mass: Mass of the object without contents (kg), to which the masses of all faces are scaled, or None.
        texture: Its side is one of TEXTURE_CLASSES. None is one white pixel.
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
    for (i, j), value in zip(PAIRS, shell[4:], strict=True):
        second[i, j] = second[j, i] = value
    second -= shell[0] * np.outer(com, com)

    contents = np.zeros((0, 3, 3)) if interior is None else (interior[0] - origin)[interior[1]]
    if interior is not None and not solid_moments(contents).sum(axis=0)[0] > 0:
        raise ValueError("the mesh `interior` encloses no volume: close it, or turn its faces outwards")

    size = size_class(max(len(faces), len(vertices), len(contents)), FACE_CLASSES)
    single = np.float32  # rounded by NumPy, because JAX would compile a program for each shape
    uv = np.zeros((len(faces), 3, 2)) if uv is None else uv
    texture = np.ones((1, 1, 3)) if texture is None else texture
    arrays = dict(
        vertices=single(pad(vertices, size, vertices[-1])),
        faces=pad(faces, size, 0.0).astype(np.int32),
        normals=single(pad(corner_normals(vertices, faces), size, np.array([0.0, 0.0, 1.0]))),
        colors=single(pad(colors, size, 0.0)),
        uv=single(pad(uv, size, 0.0)),
        texture=single(texture),
        two_sided=np.asarray(two_sided, bool),
        hulls=single(pad(hull, size_class(len(hull), HULL_CLASSES), hull[-1])[None]),
        shell_mass=single(shell[0]),
        shell_com=single(com),
        shell_inertia=single(np.trace(second) * np.eye(3) - second),
        interior=single(pad(contents, size, 0.0)),
        contents_density=single(contents_density),
        category=np.int32(category),
        origin=single(-origin),
    )
    return Body(**jax.device_put(arrays))


def corner_normals(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, "f 3 3"]:
    """Unit normal at each corner of each face, so that shading is smooth except at sharp edges.

    For a corner of the face F at the vertex v, the result is the normalised mean of the normals of faces that meet at
    v, weighted by their interior angles at v. Only faces whose normal is within CREASE of F's normal count.
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
    near = np.einsum("pi,pi->p", flat[first // 3], flat[second // 3]) > np.cos(CREASE)
    weight = near * angle.ravel()[second]
    normals = np.stack(
        [np.bincount(first, weight * flat[second // 3, axis], len(corner_vertex)) for axis in range(3)], axis=1
    )
    size = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(size > 1e-9, normals / np.where(size > 1e-9, size, 1), np.repeat(flat, 3, axis=0))
    return normals.reshape(-1, 3, 3)


def solid_moments(triangles: Float[np.ndarray, "f 3 3"]) -> Float[np.ndarray, "f 10"]:
    """Integrals of [1, x, y, z, xx, yy, zz, xy, xz, yz] over the tetrahedra between the origin and each triangle (m).

    Their sum over a closed surface gives the integrals over the solid. With the corners a, b and c of a triangle,
    counter-clockwise seen from outside, and s = a + b + c, the volume is v = a . (b x c) / 6, the first moments are
    v s / 4, and the second moments v (s s^T + a a^T + b b^T + c c^T) / 20.
    """
    volume = np.einsum("fi,fi->f", triangles[:, 0], np.cross(triangles[:, 1], triangles[:, 2])) / 6
    total = triangles.sum(axis=1)
    second = (np.einsum("fi,fj->fij", total, total) + np.einsum("fki,fkj->fij", triangles, triangles)) / 20
    return _rows(volume, total / 4, second)


def surface_moments(triangles: Float[np.ndarray, "f 3 3"]) -> Float[np.ndarray, "f 10"]:
    """Integrals of [1, x, y, z, xx, yy, zz, xy, xz, yz] over the area of each triangle (m).

    With the corners r_i of a triangle, s = sum_i r_i and the area A, the first moments are A s / 3, and the second
    moments A (s s^T + sum_i r_i r_i^T) / 12.
    """
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    area = np.linalg.norm(cross, axis=1) / 2
    total = triangles.sum(axis=1)
    second = (np.einsum("fi,fj->fij", total, total) + np.einsum("fki,fkj->fij", triangles, triangles)) / 12
    return _rows(area, total / 3, second)


def _rows(measure: np.ndarray, mean: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Make rows of moments from the size, the mean and the mean square."""
    columns = [np.ones_like(measure), *mean.T, *(second[:, i, j] for i, j in PAIRS)]
    return measure[:, None] * np.stack(columns, axis=1)
