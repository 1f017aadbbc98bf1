"""Features of lathed objects that stand on the jerked pad, for a classifier: from vision and from weight."""

from typing import NamedTuple

import numpy as np

from benchmarks.instruments.starts import Starts, filled
from sts_jax import objects, physics
from sts_jax.physics.perturbed import jerk
from sts_jax.physics.scenario import G
from sts_jax.sensor import Sensor

FILLS = np.linspace(0, 1, 17)  # fills at which mass properties are computed for a shape
NOISE = 0.05  # log kg, standard deviation of the measured mass


class Sight(NamedTuple):
    """Exact properties that follow from the shape of each object, one row each."""

    profile: np.ndarray  # (b, 10) m: radius of the base, height, greatest radius, radius at seven heights
    low: np.ndarray  # (b,) m, the lowest point in the mesh frame
    # (b, FILLS, 3) at each fill: mass (kg), height of the centre of mass over the base (m), inertia across (kg m^2)
    rigid: np.ndarray


def look(body: objects.Body) -> tuple[np.ndarray, float, np.ndarray]:
    """The row of `Sight` of one object."""
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
    """The properties of all objects."""
    return Sight(*map(np.stack, zip(*map(look, items), strict=True)))


def weighed(starts: Starts) -> np.ndarray:
    """The quantity that touch measures, (n, 1): the logarithm of the mass in kg."""
    return np.log(starts.mass)[:, None]


def canonical(pose: np.ndarray, condition: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Turn or mirror first states by a symmetry of the square pad, so that the push points 0 to 45 degrees from +x.

    Args:
        pose: First poses, (n, 7).
        condition: (n, 3). The first two columns are the acceleration of the pad (m/s^2), the opposite of the push.
            The third is not used.

    Returns:
        Positions on the pad (m) and pushes (m/s^2), (n, 2) each.
    """
    push = -np.asarray(jerk(condition).acceleration)
    sign = np.where(push < 0, -1, 1)
    push, place = push * sign, pose[:, :2] * sign
    swap = (push[:, 1] > push[:, 0])[:, None]
    return np.where(swap, place[:, ::-1], place), np.where(swap, push[:, ::-1], push)


def tipping(rigid: np.ndarray, base: np.ndarray, push: np.ndarray, time: np.ndarray, friction: float) -> np.ndarray:
    """Two ratios (n, 2) above which a standing object topples about the edge of its base.

    The first ratio is its acceleration over that at which it begins to tip, g b / h. The second one, as a logarithm, is
    its energy at the end of the push over the energy that lifts its centre of mass over the edge. Friction limits the
    force, which then lasts longer.

    Args:
        rigid: (n, 3) mass (kg), height of the centre of mass (m), inertia across it (kg m^2).
        base: (n,) m, radius of the base.
        push: (n,) m/s^2, acceleration.
        time: (n,) s, duration of the push.
        friction: A typical coefficient, because the true one is hidden.
    """
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
    """Features (n, k) of jerked starts of lathed objects.

    Args:
        scenario: The scenario.
        items: The objects.
        starts: Their starts.
        touch: (n, 1) logarithm of the mass in kg, or None for features from vision alone.
    """
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
