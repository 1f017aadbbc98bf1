"""The wrench of the pad on an object that a hand holds against it."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sts_jax import geometry, tactile
from sts_jax.objects.body import Body
from sts_jax.rendering.equilibrium import underside

DEEPEST = 0.98  # share of the gel's largest depth to which a hand presses an object at most
HALVINGS = 50  # of the interval in which the depth lies


def held_wrench(gel: tactile.Gel, body: Body, pose: Float[np.ndarray, "7"], force: float) -> Float[np.ndarray, "6"]:
    """The wrench of the pad on an object that is held in its attitude and pressed into the gel.

    The hand balances all moments, so the object sinks without tilting until the gel's springs carry the force. Their
    pressure `p = k max(0, d - h)` on the gel's grid determines the centre of pressure, and `sense` finds the same
    balance. A sharp corner would sink deeper than the gel allows. The hand then carries more, so that the depth stays
    below the limit. The wrench depends on the body, the pose and the force only, not on the motion after the release.

    Args:
        gel: its springs and its grid.
        body: the object.
        pose: mesh frame in the sensor frame. Its height has no effect.
        force: N, normal force that the pad is to exert.

    Returns:
        Force (N) and moment about the sensor's origin (N m), without friction. 0 for an object beside the pad.
    """
    x, y = (np.asarray(part, np.float64) for part in tactile.cell_centres(gel))
    heights = np.asarray(_heights(gel, body.vertices, body.faces, body.two_sided, jnp.asarray(pose)), np.float64)
    if not np.isfinite(heights).any():
        return np.zeros(6)
    heights = heights - heights.min()
    stiffness = float(gel.stiffness) * float(tactile.cell_area(gel))  # N/m of one cell
    low, high = 0.0, DEEPEST * float(gel.max_depth)
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if stiffness * np.sum(np.maximum(middle - heights, 0)) < force else (low, middle)
    push = stiffness * np.maximum(high - heights, 0)
    return np.array([0.0, 0.0, np.sum(push), np.sum(push * y), -np.sum(push * x), 0.0])


@jax.jit
def _heights(
    gel: tactile.Gel, vertices: Array, faces: Array, two_sided: Array, pose: Float[Array, "7"]
) -> Float[Array, "r c"]:
    """Heights of the object's underside over the gel's grid (m), `inf` where there is none within the gel's reach."""
    return underside(gel, faces, two_sided, geometry.transform(pose, vertices), jnp.bool_(True))[0]
