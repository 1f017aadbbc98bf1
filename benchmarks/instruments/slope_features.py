"""Features of objects laid on the slope, for a classifier: statics from vision and from the centre of pressure.

Downhill is +y.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from benchmarks.instruments.starts import Starts, filled, rigid
from sts_jax import geometry, objects, physics
from sts_jax.sensor import Sensor

NOISE = 0.001  # m, standard deviation of the measured centre of pressure
SEEN = (0.0001, 0.0017)  # m, rad, standard deviations of a pose from vision
DRAWS = 128  # draws of the hidden contents for the features of a start
FRICTIONS = 8  # coefficients of friction that are combined with each draw
LEVELS = (0.0001, 0.001)  # m, heights over the lowest point up to which points support at once, or after rocking
SNAP = 0.9986  # cosine of 3 degrees. An object that leans less from a stable face is taken to lie on it


def support(points: np.ndarray, level: float) -> np.ndarray:
    """Corners (k, 2), in order, of the support polygon of the points (n, 3) within `level` (m) of the lowest one."""
    low = np.unique(points[points[:, 2] < points[:, 2].min() + level, :2].round(7), axis=0)
    try:
        return low[ConvexHull(low).vertices]
    except (QhullError, ValueError):  # an edge or a corner
        far = low @ np.array([0.3, 1.0])
        return low[[far.argmin(), far.argmax()]]


def margins(corners: np.ndarray, place: np.ndarray) -> list[float]:
    """Stability margins of a place (2,) in a support polygon (k, 2), positive inside.

    Returns:
        Distance (m) from the nearest edge, distance (m) from the nearest downhill edge, length (m) of that edge, and y
        component of its outward unit normal.
    """
    along = np.roll(corners, -1, 0) - corners
    length = np.linalg.norm(along, axis=1) + 1e-9
    outward = np.stack([along[:, 1], -along[:, 0]], 1) / length[:, None]
    inside = ((corners - place) * outward).sum(1)
    below = np.flatnonzero(outward[:, 1] > 0.2)
    edge = below[inside[below].argmin()] if len(below) else inside.argmin()
    return [inside.min(), inside[edge], length[edge], outward[edge, 1]]


def balance(
    corners: np.ndarray, centre: np.ndarray, friction: np.ndarray, slope: float
) -> tuple[np.ndarray, np.ndarray]:
    """Motion and centre of pressure of a body on the slope by statics, for different hidden values.

    Args:
        corners: (k, 2) m, corners of the support polygon.
        centre: (m, 3) m, centres of mass, with z above the pad.
        friction: (m,) coefficients of friction.
        slope: rad, towards +y.

    Returns:
        Motion (m,), which is 0 for tipping, 1 for sliding and 2 for sticking, and centre of pressure (m, 2) in m. A
        body that tips presses on the edge over which it tips.
    """
    grip = np.minimum(friction, math.tan(slope))
    pressure = centre[:, :2] + (centre[:, 2] * grip)[:, None] * np.array([0.0, 1.0])
    along = np.roll(corners, -1, 0) - corners
    outward = np.stack([along[:, 1], -along[:, 0]], 1)
    tips = (((pressure[:, None] - corners) * outward).sum(-1) > 0).any(1)
    share = ((pressure[:, None] - corners) * along).sum(-1) / ((along**2).sum(1) + 1e-12)
    nearest = corners + np.clip(share, 0, 1)[..., None] * along
    edge = ((pressure[:, None] - nearest) ** 2).sum(-1).argmin(1)
    pressure = np.where(tips[:, None], nearest[np.arange(len(edge)), edge], pressure)
    return np.where(tips, 0, np.where(friction < math.tan(slope), 1, 2)), pressure


def drawn_centres(body: objects.Body, scenario: physics.Inclined) -> np.ndarray:
    """Centres of mass (DRAWS, 3) in m, mesh frame, of a body with draws of its hidden contents."""
    if not body.contents_density:
        return np.tile(np.asarray(body.shell_com), (DRAWS, 1))
    hidden = jax.vmap(scenario.hidden)(jax.random.split(jax.random.key(0), DRAWS))
    return np.asarray(rigid(body, hidden.fill, hidden.shell_scale, hidden.up)[1])


def levelled(rotation: np.ndarray, ups: np.ndarray) -> np.ndarray:
    """Snap a rotation (3, 3) to the nearest one with one of the object's directions (k, 3) up, if that is near."""
    up = rotation @ ups[(ups @ rotation[2]).argmax()]
    if up[2] < SNAP:
        return rotation
    return Rotation.align_vectors([[0.0, 0, 1]], [up])[0].as_matrix() @ rotation


def pressed(starts: Starts) -> np.ndarray:
    """The quantity that touch measures, (n, 2): the centre of pressure `(-My, Mx) / Fz` in m, nan without contact."""
    force = np.where(starts.wrench[:, 2] > 0, starts.wrench[:, 2], np.nan)
    return np.stack([-starts.wrench[:, 4], starts.wrench[:, 3]], 1) / force[:, None]


def laid(scenario: physics.Inclined, items: list[objects.Body], starts: Starts, touch: np.ndarray | None) -> np.ndarray:
    """Features (n, k) of starts on the slope, for objects of any shape.

    They include the results of `balance` for `DRAWS` random draws of the hidden contents. From vision, all of these
    draws are equally likely. Touch weighs them by their likelihood. Noise with the standard deviations `SEEN` is added
    to the pose, because an exact pose would reveal by micrometres which objects have begun to slip.

    Args:
        scenario: The scenario.
        items: The objects.
        starts: Their starts.
        touch: (n, 2) centre of pressure in m, or None for features from vision alone.
    """
    centres = [np.tile(drawn_centres(body, scenario), (FRICTIONS, 1)) for body in items]
    friction = np.repeat(np.linspace(*scenario.friction, 2 * FRICTIONS + 1)[1::2], DRAWS)
    rng = np.random.default_rng(1)
    seen = starts.pose + np.array([*[SEEN[0]] * 3, *[SEEN[1] / 2] * 4]) * rng.normal(size=starts.pose.shape)
    turns = np.asarray(jax.vmap(geometry.quat_to_matrix)(geometry.normalize(jnp.asarray(seen[:, 3:], jnp.float32))))
    full = [filled(body, np.ones(1))[1][0] for body in items]
    hulls = [np.asarray(b.hulls, float).reshape(-1, 3) for b in items]
    ups = [objects.rest_poses(hull, np.asarray(b.shell_com, float))[0] for hull, b in zip(hulls, items, strict=True)]
    downhill, pad = np.array([0, math.tan(scenario.slope)]), float(Sensor().gel.size[1])
    rows = []
    for row, (index, pose, turn) in enumerate(zip(starts.body, seen, turns, strict=True)):
        body, rotation = items[index], levelled(turn, ups[index])
        points = hulls[index] @ rotation.T
        low, high = points.min(0), points.max(0)
        face, wide = (support(points, height) for height in LEVELS)
        columns = [*pose[:2], *low[:2], *high, high[2] - low[2], pad / 2 - pose[1] - high[1]]
        columns += [int(body.category), body.shell_mass, body.contents_density, *np.ptp(face, axis=0), len(face)]
        columns += [*np.ptp(wide, axis=0), *rotation[2], *np.abs(rotation[:, 2]), np.abs(rotation[1]).max()]
        columns += list((turn @ rotation.T)[:2, 2])  # its lean from the face at the start
        felt = None if touch is None else touch[row] - pose[:2]
        (end, pressure), (rocked, _) = (
            balance(corners, centres[index] @ rotation.T - [0, 0, low[2]], friction, scenario.slope)
            for corners in (face, wide)
        )
        likely = np.ones(len(friction))
        if felt is not None and np.isfinite(felt).all():
            likely = np.exp(-((felt - pressure) ** 2).sum(1) / 2 / NOISE**2) + 1e-9
        columns += [*np.bincount(end, likely, 3) / likely.sum(), *np.bincount(rocked, likely, 3) / likely.sum()]
        for com in (body.shell_com, full[index]):
            centre = rotation @ com
            beneath = centre[:2] + (centre[2] - low[2]) * downhill  # where its weight meets the pad
            columns += [*margins(face, beneath), *margins(wide, beneath), centre[2] - low[2]]
            if felt is not None:
                columns += list(felt - beneath)
        if felt is not None:
            columns += [*felt, *margins(face, felt), *margins(wide, felt)]
        rows.append(columns)
    return np.array(rows, float)
