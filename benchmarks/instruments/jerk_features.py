"""Features from which a classifier predicts whether a bottle on a jerked pad (`physics.Perturbed`) topples or slides.

The features come from vision, and optionally from the measured mass. They are suitable for all solids of revolution.
"""

from typing import NamedTuple

import numpy as np

from benchmarks.instruments.starts import Starts, filled
from sts_jax import objects, physics
from sts_jax.physics.perturbed import jerk
from sts_jax.physics.scenario import G
from sts_jax.sensor import Sensor

FILLS = np.linspace(0, 1, 17)  # fill levels at which mass properties are computed
NOISE = 0.05  # standard deviation of the measured log mass, about 5 % of the mass


class Sight(NamedTuple):
    """Properties computed from the shapes of b objects."""

    profile: np.ndarray  # (b, 10) m: radius of the base, height, greatest radius, radii at seven heights
    low: np.ndarray  # (b,) m, height of the lowest point in the mesh frame
    # (b, 17, 3) for each of FILLS: mass (kg), height of the centre of mass above the base (m), inertia about a
    # horizontal axis through the centre of mass (kg m^2)
    rigid: np.ndarray


def look(body: objects.Body) -> tuple[np.ndarray, float, np.ndarray]:
    """Compute the properties of one object. `Sight` contains the same properties of several objects."""
    points = np.asarray(body.vertices)[np.unique(np.asarray(body.faces))]
    low = float(points[:, 2].min())
    radius, level = np.hypot(points[:, 0], points[:, 1]), (points[:, 2] - low).round(5)
    levels = np.unique(level)
    widest = np.array([radius[level == z].max() for z in levels])
    heights = np.linspace(0, levels[-1], 9)[1:-1]
    profile = np.concatenate([[widest[0], levels[-1], widest.max()], np.interp(heights, levels, widest)])
    mass, com, inertia = filled(body, FILLS)
    return profile, low, np.stack([mass, com[:, 2] - low, (inertia[:, 0, 0] + inertia[:, 1, 1]) / 2], 1)


def sight(items: list[objects.Body]) -> Sight:
    """Compute a `Sight`, which contains properties of several objects."""
    return Sight(*map(np.stack, zip(*map(look, items), strict=True)))


def weighed(starts: Starts) -> np.ndarray:
    """Logarithm of the mass (kg) of the object in each start, `(n, 1)`."""
    return np.log(starts.mass)[:, None]


def canonical(pose: np.ndarray, condition: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotate or mirror starts by a symmetry of the pad, so that the push is 0 to 45 degrees from +x."""
    push = -np.asarray(jerk(condition).acceleration)
    sign = np.where(push < 0, -1, 1)
    push, place = push * sign, pose[:, :2] * sign
    swap = (push[:, 1] > push[:, 0])[:, None]
    return np.where(swap, place[:, ::-1], place), np.where(swap, push[:, ::-1], push)


def tipping(rigid: np.ndarray, base: np.ndarray, push: np.ndarray, time: np.ndarray, friction: float) -> np.ndarray:
    """Ratios that exceed 1 for an object that topples: acceleration over g b / h, and energy over that of tipping."""
    mass, height, inertia = rigid.T
    force, lasts = np.minimum(push, friction * G), time * np.maximum(1, push / (friction * G))
    begin = np.maximum(mass * (force * height - G * base), 0) / (inertia + mass * (base**2 + height**2))
    arm, lean = np.hypot(base, height), np.arctan2(base, height)
    turn = np.minimum(begin * lasts**2 / 2, lean)
    energy = (inertia / mass + arm**2) * (begin * lasts) ** 2 / 2 + G * arm * (np.cos(lean - turn) - np.cos(lean))
    over = energy / (G * arm * (1 - np.cos(lean)))
    return np.stack([push * height / (G * base), np.log(np.clip(over, 1e-3, 50))], 1)


def shaken(
    scenario: physics.Perturbed, items: list[objects.Body], starts: Starts, touch: np.ndarray | None
) -> np.ndarray:
    """Compute features from which a classifier predicts the outcomes of trajectories on the jerked pad."""
    seen = sight(items)
    friction = float(np.mean(scenario.friction))
    place, push = canonical(starts.pose, starts.condition)
    time, size = np.asarray(jerk(starts.condition).duration), np.linalg.norm(push, axis=1)
    ahead = push / size[:, None]
    room = (float(Sensor().gel.size[0]) / 2 - place[:, 0]) / ahead[:, 0]
    slip = np.maximum(size - friction * G, 0) * time**2 / 2 * size / (friction * G)
    base, rigid = seen.profile[starts.body, 0], seen.rigid[starts.body]
    columns = [seen.profile[starts.body], place, ahead]
    columns += [np.stack([size, time, size * time, room, slip, room - slip], 1), rigid[:, [0, -1], 0]]
    columns += [tipping(rigid[:, k], base, size, time, friction) for k in range(0, len(FILLS), 4)]
    if touch is not None:
        mass = np.exp(touch[:, 0])
        fill = np.array([np.interp(m, own[:, 0], FILLS) for m, own in zip(mass, rigid, strict=True)])
        felt = [[np.interp(f, FILLS, own[:, k]) for k in range(3)] for f, own in zip(fill, rigid, strict=True)]
        columns += [np.stack([mass, mass / rigid[:, 0, 0], fill, np.array(felt)[:, 1]], 1)]
        columns += [tipping(np.array(felt), base, size, time, friction)]
    return np.concatenate(columns, 1)
