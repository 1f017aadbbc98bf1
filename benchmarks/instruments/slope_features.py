"""Features from which a classifier predicts the outcomes of objects on the slope (`physics.Inclined`).

The features come from vision, and optionally from the measured centre of pressure. They describe whether the object
stands stably: its support polygon, and the point at which its weight acts. Downhill is +y.
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
SEEN = (0.0001, 0.0017)  # m and rad, standard deviations of position and orientation from vision
DRAWS = 128  # random draws of the hidden contents for the features of a start
FRICTIONS = 8  # coefficients of friction that are combined with each draw
# m, heights above the lowest point. Points up to the first height support the object, up to the second after it rocks
LEVELS = (0.0001, 0.001)
SNAP = 0.9986  # cosine of 3 degrees. An object that leans less than this from a stable face lies on the face


def support(points: np.ndarray, level: float) -> np.ndarray:
    """Compute the support polygon of an object."""
    low = np.unique(points[points[:, 2] < points[:, 2].min() + level, :2].round(7), axis=0)
    try:
        return low[ConvexHull(low).vertices]
    except (QhullError, ValueError):  # the object stands on an edge or a corner
        far = low @ np.array([0.3, 1.0])
        return low[[far.argmin(), far.argmax()]]


def margins(corners: np.ndarray, place: np.ndarray) -> list[float]:
    """Distances of a point from the edges of a support polygon."""
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
    """Predict by statics how a body on the slope moves, and where the body presses on the pad."""
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
    """Centres of mass of a body for random fill levels and places of the contents, mesh frame (m), `(DRAWS, 3)`."""
    if not body.contents_density:
        return np.tile(np.asarray(body.shell_com), (DRAWS, 1))
    hidden = jax.vmap(scenario.hidden)(jax.random.split(jax.random.key(0), DRAWS))
    return np.asarray(rigid(body, hidden.fill, hidden.shell_scale, hidden.up)[1])


def levelled(rotation: np.ndarray, ups: np.ndarray) -> np.ndarray:
    """Rotate an object that lies almost on a stable face until it lies on the face exactly."""
    up = rotation @ ups[(ups @ rotation[2]).argmax()]
    if up[2] < SNAP:
        return rotation
    return Rotation.align_vectors([[0.0, 0, 1]], [up])[0].as_matrix() @ rotation


def pressed(starts: Starts) -> np.ndarray:
    """Exact value of the quantity that the sense of touch measures: the centre of pressure."""
    force = np.where(starts.wrench[:, 2] > 0, starts.wrench[:, 2], np.nan)
    return np.stack([-starts.wrench[:, 4], starts.wrench[:, 3]], 1) / force[:, None]


def laid(scenario: physics.Inclined, items: list[objects.Body], starts: Starts, touch: np.ndarray | None) -> np.ndarray:
    """Compute features from which a classifier predicts the outcomes of trajectories on the slope."""
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
        columns += list((turn @ rotation.T)[:2, 2])  # lean of the object from the stable face
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
            beneath = centre[:2] + (centre[2] - low[2]) * downhill  # where gravity points to on the pad
            columns += [*margins(face, beneath), *margins(wide, beneath), centre[2] - low[2]]
            if felt is not None:
                columns += list(felt - beneath)
        if felt is not None:
            columns += [*felt, *margins(face, felt), *margins(wide, felt)]
        rows.append(columns)
    return np.array(rows, float)
