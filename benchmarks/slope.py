"""What statics says of a thing laid on the slope, from sight and from its centre of pressure: features of a classifier.

Downhill is +y.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from benchmarks.starts import Starts, filled, rigid
from sts_jax import geometry, objects, physics
from sts_jax.sensor import Sensor

NOISE = 0.001  # m, standard deviation of the centre of pressure that is asked about
SEEN = (0.0001, 0.0017)  # m, rad: how well sight tells a pose, standard deviations
DRAWS = 128  # of contents, by which sight judges a start, ...
FRICTIONS = 8  # ... each with as many frictions
LEVELS = (0.0001, 0.001)  # m; what is so much higher than the lowest point supports at once, or after rocking
SNAP = 0.9986  # cosine; what leans less than 3 degrees from a face that it may rest on is seen to lie on it


def support(points: np.ndarray, level: float) -> np.ndarray:
    """The corners (k, 2), in turn, of what an object's points (n, 3) span that are within a level of the lowest, m."""
    low = np.unique(points[points[:, 2] < points[:, 2].min() + level, :2].round(7), axis=0)
    try:
        return low[ConvexHull(low).vertices]
    except (QhullError, ValueError):  # an edge or a corner
        far = low @ np.array([0.3, 1.0])
        return low[[far.argmin(), far.argmax()]]


def margins(corners: np.ndarray, place: np.ndarray) -> list[float]:
    """How far (m) a place (2,) is inside what supports an object: of the nearest edge and of the nearest edge below it
    on the slope; of the latter also its length (m) and how squarely it lies across the slope.
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
    """What statics says of bodies that differ in what is hidden: tips (0), slides (1) or sticks (2), and the centre of
    pressure.

    Args:
        corners: (k, 2) m, of what supports them.
        centre: (m, 3) m, of mass, over the pad.
        friction: (m,).
        slope: rad, towards +y.

    Returns:
        (m,) and (m, 2) m; what tips presses on the edge that it tips over.
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
    """Centres of mass (DRAWS, 3) in m, mesh frame, of a body with what may be hidden in it."""
    if not body.contents_density:
        return np.tile(np.asarray(body.shell_com), (DRAWS, 1))
    hidden = jax.vmap(scenario.hidden)(jax.random.split(jax.random.key(0), DRAWS))
    return np.asarray(rigid(body, hidden.fill, hidden.shell_scale, hidden.up)[1])


def levelled(rotation: np.ndarray, ups: np.ndarray) -> np.ndarray:
    """A rotation (3, 3) seen, or the nearest with one of the directions (k, 3) of an object up, if that is near."""
    up = rotation @ ups[(ups @ rotation[2]).argmax()]
    if up[2] < SNAP:
        return rotation
    return Rotation.align_vectors([[0.0, 0, 1]], [up])[0].as_matrix() @ rotation


def pressed(starts: Starts) -> np.ndarray:
    """What touch tells, (n, 2) in m: the normal force's centre of pressure, `(-My, Mx) / Fz`; nan without contact."""
    force = np.where(starts.wrench[:, 2] > 0, starts.wrench[:, 2], np.nan)
    return np.stack([-starts.wrench[:, 4], starts.wrench[:, 3]], 1) / force[:, None]


def laid(scenario: physics.Inclined, items: list[objects.Body], starts: Starts, touch: np.ndarray | None) -> np.ndarray:
    """Features (n, k) of starts on the slope, of things of any shape; `touch` (n, 2) in m is the centre of pressure.

    Among them what `balance` says of DRAWS of what is hidden, all alike to sight; touch tells which are likely. Sight
    tells the pose as well as SEEN: a pose to the last bit tells, by micrometres, what has begun to slip.
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
        columns += list((turn @ rotation.T)[:2, 2])  # how it leans over its face already
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
