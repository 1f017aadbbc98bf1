"""Moments of solids and surfaces on the host, in NumPy float64.

Triangles are counter-clockwise seen from outside. A row of moments is `[1, x, y, z, xx, yy, zz, xy, xz, yz]`
integrated over a solid or a surface.
"""

import numpy as np
from jaxtyping import Float

PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))  # axes of the second moments in a row


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
    columns = [np.ones_like(measure), *(mean + origin).T, *(second[:, i, j] for i, j in PAIRS)]
    return measure[:, None] * np.stack(columns, axis=1)
