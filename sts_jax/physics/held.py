"""The wrench of the pad on an object that a hand holds on the gel."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sts_jax import geometry, tactile
from sts_jax.objects.body import Body
from sts_jax.rendering.equilibrium import underside

DEEPEST = 0.98  # largest depth of a held object, as a share of the gel's largest depth
HALVINGS = 50  # bisection steps for the depth


def held_wrench(gel: tactile.Gel, body: Body, pose: Float[np.ndarray, "7"], force: float) -> Float[np.ndarray, "6"]:
    """Compute the wrench of the pad on an object that a hand holds on the gel.

    The hand balances all moments, so the object keeps its orientation. The object sinks until the pressure of the gel
    carries `force`. The pressure in a cell of the gel's grid is `p = k max(0, d - h)`. Here k is `gel.stiffness`, d is
    the depth of the object's lowest point, and h is the height of the object's underside above this point. The moment
    follows from the pressures of all cells. The function `sts_jax.sense` computes the same depth d from the returned
    wrench, if the object touches the gel or is close above it.

    If the object would have to sink deeper than the gel allows (`Gel.max_depth`), the object stops just before this
    depth. The returned force is then smaller than `force`. This happens, for instance, if only a sharp
    corner of the object touches the gel.

    Args:
        gel: Gel of the sensor.
        body: The object.
        pose: Mesh frame in the sensor frame, (7,): position (m), quaternion. The z of the position has no effect.
        force: Normal force that the pad exerts on the object (N).

    Returns:
        Force (N) and moment about the sensor's origin (N m), (6,), without friction. All six numbers are 0 for an
            object beside the pad.
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
    """Compute the height of the object's underside over each cell (m), `inf` where no face is in the gel's reach."""
    return underside(gel, faces, two_sided, geometry.transform(pose, vertices), jnp.bool_(True))[0]
