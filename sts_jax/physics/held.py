"""The wrench of the pad on an object that a hand holds against it."""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from sts_jax import tactile
from sts_jax.physics.contact import Hull

NEAR = 1e-6  # m, a vertex nearer to the plane of a face belongs to the face
STEEPEST = 1e-9  # smallest slope of a face, so that upright faces have a height over each cell
HALVINGS = 50  # of the interval in which the depth lies


def held_wrench(gel: tactile.Gel, hull: Hull, pose: Float[np.ndarray, "7"], force: float) -> Float[np.ndarray, "6"]:
    """The wrench of the pad on an object that is held in its attitude and pressed into the gel with a force.

    The hand balances all moments, so the object sinks without tilting until the gel's springs carry the force. Their
    pressure `p = k max(0, d - h)` on the gel's grid gives the centre of pressure. The wrench depends on the pose and
    the force only, not on the motion after the release.

    Args:
        gel: its springs and its grid.
        hull: convex parts of the object.
        pose: mesh frame in the sensor frame. Its height has no effect.
        force: N, normal force of the pad.

    Returns:
        Force (N) and moment about the sensor's origin (N m), without friction. The moment is that of a force at the
        lowest point of the object if this point touches no cell of the grid.
    """
    x, y, heights, lowest = _underside(gel, hull, np.asarray(pose, np.float64))
    limit = float(gel.max_depth)
    load = force / (float(gel.stiffness) * float(tactile.cell_area(gel)))
    heights = np.where(heights < limit, heights, np.inf)
    low, high = 0.0, limit
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if np.sum(np.maximum(middle - heights, 0)) < load else (low, middle)
    pressed = np.maximum(high - heights, 0)
    total = np.sum(pressed)
    centre = np.array([np.sum(pressed * x), np.sum(pressed * y)]) / total if total > 0 else lowest
    return np.array([0.0, 0.0, force, centre[1] * force, -centre[0] * force, 0.0])


def _underside(
    gel: tactile.Gel, hull: Hull, pose: Float[np.ndarray, "7"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Cells of the gel's grid (m), heights of the hull over its lowest point there, and the place of this point.

    Heights beyond the gel's largest depth may be too large, because only faces with a lower vertex are considered.
    """
    turn = Rotation.from_quat(pose[3:], scalar_first=True).as_matrix()
    points = np.einsum("ij,jph->iph", turn, np.asarray(hull.vertices, np.float64)) + pose[:3, None, None]
    normals = np.einsum("ij,jpf->ipf", turn, np.asarray(hull.planes[:3], np.float64))
    offsets = np.asarray(hull.planes[3], np.float64) + np.einsum("i,ipf->pf", pose[:3], normals)
    bottom = points[2].min()
    lowest = points.reshape(3, -1)[:2, points[2].argmin()]
    x, y = (np.asarray(part, np.float64) for part in tactile.cell_centres(gel))
    heights = np.full(x.shape, np.inf)
    for part in range(points.shape[1]):
        own, normal, offset = points[:, part], normals[:, part], offsets[part]
        deep = own[:, own[2] < bottom + float(gel.max_depth)]
        if not deep.size:
            continue
        faces = np.any(np.abs(normal.T @ deep - offset[:, None]) < NEAR, axis=1)
        (nx, ny, nz), offset = normal[:, faces, None, None], offset[faces, None, None]
        downward = nz < STEEPEST
        slope = np.where(downward, np.minimum(nz, -STEEPEST), np.maximum(nz, STEEPEST))
        height = (offset - nx * x - ny * y) / slope
        under = np.max(height, axis=0, initial=-np.inf, where=downward)
        over = np.min(height, axis=0, initial=np.inf, where=~downward)
        heights = np.minimum(heights, np.where((under <= over) & np.isfinite(under), under, np.inf))
    return x, y, heights - bottom, lowest
