"""Moments of solids and surfaces in NumPy float64, on the host.

Triangles are counter-clockwise seen from outside. A row of moments contains the integrals of
`[1, x, y, z, xx, yy, zz, xy, xz, yz]` over a solid or a surface.
"""

import numpy as np
from jaxtyping import Float

PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))  # pairs of axes of the second moments, in the order of a row


def solid_moments(
    triangles: Float[np.ndarray, "f 3 3"], *, reference: Float[np.ndarray, "3"] | None = None
) -> Float[np.ndarray, "f 10"]:
    """Compute the moments of the signed tetrahedra between a reference point and each triangle.

    The moments of a solid are the sum of these moments over all triangles of its closed surface. Let a tetrahedron
    have the corners 0, a, b, c relative to the reference, and let s = a + b + c. The volume of the tetrahedron is
    v = a . (b x c) / 6. Let r be the position relative to the reference. The first moments (integral of r) are v s / 4.
    The second moments (integral of r r^T) are v (s s^T + a a^T + b b^T + c c^T) / 20. The function converts these
    moments to moments about the origin.

    Args:
        triangles: Corners of the triangles (m).
        reference: Reference point (m), by default the origin. For a solid that is clipped by a plane, give a point on
            the plane. `triangles` can then omit the cut face, because a tetrahedron on this face has no volume.

    Returns:
        Integrals of 1, x, y, z, xx, yy, zz, xy, xz and yz over the tetrahedron of each triangle. Coordinates are
        relative to the origin. Units are m^3 for 1, m^4 for x to z, and m^5 for products.
    """
    origin = np.zeros(3) if reference is None else reference
    r = triangles - origin
    volume = np.einsum("fi,fi->f", r[:, 0], np.cross(r[:, 1], r[:, 2])) / 6
    total = r.sum(axis=1)
    second = (np.einsum("fi,fj->fij", total, total) + np.einsum("fki,fkj->fij", r, r)) / 20
    return _shifted(volume, total / 4, second, origin)


def surface_moments(triangles: Float[np.ndarray, "f 3 3"]) -> Float[np.ndarray, "f 10"]:
    """Compute the area moments of triangles, for shells with a mass per area.

    Let r_i be the corners of a triangle, let s = sum_i r_i, and let A be the area of the triangle. The first moments of
    the triangle (integral of the position r) are A s / 3. The second moments (integral of r r^T) are
    A (s s^T + sum_i r_i r_i^T) / 12.

    Args:
        triangles: Corners of the triangles (m).

    Returns:
        Integrals of 1, x, y, z, xx, yy, zz, xy, xz and yz over the area of each triangle. Units are m^2 for 1, m^3 for
        x to z, and m^4 for products.
    """
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    area = np.linalg.norm(cross, axis=1) / 2
    total = triangles.sum(axis=1)
    second = (np.einsum("fi,fj->fij", total, total) + np.einsum("fki,fkj->fij", triangles, triangles)) / 12
    return _shifted(area, total / 3, second, np.zeros(3))


def _shifted(measure: np.ndarray, mean: np.ndarray, second: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Make rows of moments about 0 from the size, the mean and the mean square of r - origin."""
    second = (
        second + np.einsum("fi,j->fij", mean, origin) + np.einsum("i,fj->fij", origin, mean) + np.outer(origin, origin)
    )
    columns = [np.ones_like(measure), *(mean + origin).T, *(second[:, i, j] for i, j in PAIRS)]
    return measure[:, None] * np.stack(columns, axis=1)
