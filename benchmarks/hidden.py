"""What cannot be seen: whether it decides the outcome, whether touch tells it, whether pictures give it away.

    python -m benchmarks.hidden                 # the jerked pad, about 25 minutes on two CPU cores
    python -m benchmarks.hidden outcomes truth  # some of: outcomes truth pictures fill
    python -m benchmarks.hidden --keep FOLDER   # keep what was simulated and drawn there, and go on from it
    python -m benchmarks.hidden outcomes truth --scenario inclined --soaked FOLDER  # of what `benchmarks.soak` kept

`outcomes`: shares of the outcomes, and how many starts end otherwise when the fill alone is drawn again. `truth`: a
classifier of the outcome that knows shape, start and shake exactly loses so much; one that is also told what touch
would tell, roughly, so much less (gain: the share of the loss that is gone). `pictures`: the same, told what a small
network reads from the first uint8 tactile frame; the network learned on other objects. `fill`: a small network that
is to tell full from empty objects sees frames in the air, the same frames with fuller ones painted, and touch.

Folds and 95 % intervals are by object. Everything is simulated once with the scenario's shipped defaults.
"""

import argparse
import concurrent.futures
import dataclasses
import functools
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from benchmarks import classify, reader
from sts_jax import _math, dataset, objects, physics
from sts_jax.physics.scenarios import G
from sts_jax.sensor import Sensor

PARTS = ("outcomes", "truth", "pictures", "fill")
FILLS = np.linspace(0, 1, 17)
TINT = 0.1  # share of white in the painted ones' own colours (linear light)
OTHERS = 1_000_000  # keys of objects that networks learn on begin here
EXAMPLES = 8  # starts of each of those
SEEN = (0.0001, 0.0017)  # m, rad: how well sight tells a pose on the slope, standard deviations
DRAWS = 128  # of contents, by which sight judges a start on the slope, ...
FRICTIONS = 8  # ... each with as many frictions
LEVELS = (0.0001, 0.001)  # m; what is so much higher than the lowest point supports at once, or after rocking
SNAP = 0.9986  # cosine; what leans less than 3 degrees from a face that it may rest on is seen to lie on it


class Starts(NamedTuple):
    """What trajectories begin with and how they end, a row each."""

    body: np.ndarray  # (n,) index of the object
    pose: np.ndarray  # (n, 7) frame 0
    wrench: np.ndarray  # (n, 6) frame 0
    condition: np.ndarray  # (n, c)
    fill: np.ndarray  # (n,)
    mass: np.ndarray  # (n,) kg
    settled: np.ndarray  # (n,)
    outcome: np.ndarray  # (n,) Outcome
    rerolled: np.ndarray  # (n,) Outcome with another fill, -1 where it was not rolled again


class Sight(NamedTuple):
    """What an exact eye knows of the shape of each object, rows of `bodies`."""

    profile: np.ndarray  # (b, 10) m: radius of the base, height, greatest radius, radius at seven heights
    low: np.ndarray  # (b,) m, the lowest point in the mesh frame
    rigid: np.ndarray  # (b, FILLS, 3) mass, height of the centre of mass over the base, inertia across, if filled so


@dataclasses.dataclass(frozen=True)
class Study:
    """One scenario: what is asked of it."""

    scenario: physics.Scenario
    categories: tuple[str, ...]  # of the objects, in turn
    reroll: tuple[str, ...]  # hidden values that are drawn again
    touch: Callable[[Starts], np.ndarray]  # (n, k) what touch tells, exactly; nan where nothing touches
    noise: float  # standard deviation of each column of it
    noise_name: str
    features: Callable[[list[objects.Body], Starts, np.ndarray | None], np.ndarray]  # without or with touch


def bodies(categories: tuple[str, ...], count: int, first: int = 0) -> list[objects.Body]:
    """Objects of some families in turn, each from a key of its own."""
    return [objects.make(jax.random.key(first + i), categories[i % len(categories)]) for i in range(count)]


@jax.jit
def _rigid(body: objects.Body, hidden: dict[str, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
    return jax.vmap(lambda own: objects.rigid(body, **own))(hidden)


def masses(items: list[objects.Body], traj: physics.Trajectory) -> np.ndarray:
    """Mass (kg) of each trajectory."""
    hidden = {name: values for name, values in traj.hidden._asdict().items() if name != "friction"}
    own = np.asarray(traj.body)
    parts = [_rigid(b, {name: x[own == i] for name, x in hidden.items()})[0] for i, b in enumerate(items)]
    return np.concatenate([np.asarray(part) for part in parts])


def roll(study: Study, items: list[objects.Body], num: int, again: int, seed: int) -> Starts:
    """Simulates `num` starts of each object, and the first `again` of each once more with other fills."""
    key, fresh = jax.random.split(jax.random.key(seed))
    simulate = functools.partial(physics.simulate, key, items, Sensor(), study.scenario)
    with tqdm(total=len(items) * num, unit="starts") as bar:
        traj = simulate(num, progress=lambda n: bar.update(n - bar.n))
    outcome = np.asarray(traj.outcome)
    rerolled = np.full(len(outcome), -1)
    if again:
        rows = (np.arange(len(items))[:, None] * num + np.arange(again)).ravel()
        other = jax.vmap(study.scenario.hidden)(jax.random.split(fresh, len(rows)))
        hidden = jax.tree.map(lambda x: x[rows], traj.hidden)
        hidden = hidden._replace(**{name: getattr(other, name) for name in study.reroll})
        with tqdm(total=len(rows), unit="rolled again") as bar:
            second = simulate(again, hidden=hidden, progress=lambda n: bar.update(n - bar.n))
        same = (np.asarray(traj.resampled)[rows] == 0) & (np.asarray(second.resampled) == 0)
        rerolled[rows[same]] = np.asarray(second.outcome)[same]
    return Starts(
        body=np.asarray(traj.body),
        pose=np.asarray(traj.pose[:, 0]),
        wrench=np.asarray(traj.wrench[:, 0]),
        condition=np.asarray(traj.condition),
        fill=np.asarray(traj.hidden.fill),
        mass=masses(items, traj),
        settled=np.asarray(traj.settled),
        outcome=outcome,
        rerolled=rerolled,
    )


def draw(
    items: list[objects.Body], body: np.ndarray, pose: np.ndarray, wrench: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Visual and tactile frames, uint8 (n, 64, 64, 3), of rows sorted by object."""

    def one(index: int) -> tuple[np.ndarray, ...]:
        own = body == index
        images = dataset.render_uint8(Sensor(), items[index], pose[own], wrench[own], resolution=(64, 64), crop=False)
        return tuple(np.asarray(image) for image in images[:2])

    with concurrent.futures.ThreadPoolExecutor(os.cpu_count()) as pool:
        visual, tactile = zip(*pool.map(one, np.unique(body).tolist()), strict=True)
    return np.concatenate(visual), np.concatenate(tactile)


# What is seen of a lathed thing that stands, and what follows from it.


def look(body: objects.Body) -> tuple[np.ndarray, float, np.ndarray]:
    """The row of `Sight` of one object."""
    points = np.asarray(body.vertices)[np.unique(np.asarray(body.faces))]
    low = float(points[:, 2].min())
    radius, level = np.hypot(points[:, 0], points[:, 1]), (points[:, 2] - low).round(5)
    levels = np.unique(level)
    widest = np.array([radius[level == z].max() for z in levels])
    heights = np.linspace(0, levels[-1], 9)[1:-1]
    profile = np.concatenate([[widest[0], levels[-1], widest.max()], np.interp(heights, levels, widest)])
    fills = jnp.asarray(FILLS, jnp.float32)
    mass, com, inertia = map(np.asarray, _rigid(body, {"fill": fills, "shell_scale": jnp.ones_like(fills)}))
    return profile, low, np.stack([mass, com[:, 2] - low, (inertia[:, 0, 0] + inertia[:, 1, 1]) / 2], 1)


def sight(items: list[objects.Body]) -> Sight:
    """What is seen of each object's shape."""
    return Sight(*map(np.stack, zip(*map(look, items), strict=True)))


def canonical(pose: np.ndarray, condition: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places and pushes, (n, 2) each, in that of the pad's eight symmetries in which pushes point 0 to 45 degrees.

    A push is what the object feels: the opposite of the pad's acceleration.
    """
    push = -condition[:, :2]
    sign = np.where(push < 0, -1, 1)
    push, place = push * sign, pose[:, :2] * sign
    swap = (push[:, 1] > push[:, 0])[:, None]
    return np.where(swap, place[:, ::-1], place), np.where(swap, push[:, ::-1], push)


def tipping(rigid: np.ndarray, base: np.ndarray, push: np.ndarray, time: np.ndarray, friction: float) -> np.ndarray:
    """How near a standing thing comes to toppling if it turns about its base's edge, two columns (n, 2).

    Its acceleration over that at which it begins to tip, g b / h; and the logarithm of its energy at the end of the
    push over what carries its centre of mass over the edge. Friction limits the force and lets it last for longer.

    Args:
        rigid: (n, 3) mass, height of the centre of mass, inertia across it.
        base: (n,) radius.
        push: (n,) acceleration.
        time: (n,) how long it lasts.
        friction: a usual one; its own is hidden.
    """
    mass, height, inertia = rigid.T
    force, lasts = np.minimum(push, friction * G), time * np.maximum(1, push / (friction * G))
    begin = np.maximum(mass * (force * height - G * base), 0) / (inertia + mass * (base**2 + height**2))
    arm, lean = np.hypot(base, height), np.arctan2(base, height)
    turn = np.minimum(begin * lasts**2 / 2, lean)
    energy = (inertia / mass + arm**2) * (begin * lasts) ** 2 / 2 + G * arm * (np.cos(lean - turn) - np.cos(lean))
    over = energy / (G * arm * (1 - np.cos(lean)))
    return np.stack([push * height / (G * base), np.log(np.clip(over, 1e-3, 50))], 1)


def shaken(items: list[objects.Body], starts: Starts, touch: np.ndarray | None) -> np.ndarray:
    """Features of a jerked start of lathed things; `touch` (n, 1) is the logarithm of the weight's mass."""
    seen = sight(items)
    friction = float(np.mean(physics.Perturbed().friction))
    place, push = canonical(starts.pose, starts.condition)
    time, size = starts.condition[:, 2], np.linalg.norm(push, axis=1)
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


def support(points: np.ndarray, level: float) -> np.ndarray:
    """The corners (k, 2), in turn, of what an object's points (n, 3) span that are within a level of the lowest."""
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
    """Centres of mass (DRAWS, 3) of a body with what may be hidden in it."""
    if not body.contents_density:
        return np.tile(np.asarray(body.shell_com), (DRAWS, 1))
    hidden = jax.vmap(scenario.hidden)(jax.random.split(jax.random.key(0), DRAWS))
    return np.asarray(_rigid(body, {"fill": hidden.fill, "shell_scale": hidden.shell_scale, "up": hidden.up})[1])


def levelled(rotation: np.ndarray, ups: np.ndarray) -> np.ndarray:
    """A rotation (3, 3) seen, or the nearest with one of the directions (k, 3) of an object up, if that is near."""
    up = rotation @ ups[(ups @ rotation[2]).argmax()]
    if up[2] < SNAP:
        return rotation
    return Rotation.align_vectors([[0.0, 0, 1]], [up])[0].as_matrix() @ rotation


def laid(items: list[objects.Body], starts: Starts, touch: np.ndarray | None) -> np.ndarray:
    """Features of a start on the slope, of things of any shape; `touch` (n, 2) is the centre of pressure.

    Among them what `balance` says of DRAWS of what is hidden, all alike to sight; touch tells which are likely. Sight
    tells the pose as well as SEEN: a pose to the last bit tells, by micrometres, what has begun to slip.
    """
    scenario, noise = STUDIES["inclined"].scenario, STUDIES["inclined"].noise
    assert isinstance(scenario, physics.Inclined)
    centres = [np.tile(drawn_centres(body, scenario), (FRICTIONS, 1)) for body in items]
    friction = np.repeat(np.linspace(*scenario.friction, 2 * FRICTIONS + 1)[1::2], DRAWS)
    rng = np.random.default_rng(1)
    seen = starts.pose + np.array([*[SEEN[0]] * 3, *[SEEN[1] / 2] * 4]) * rng.normal(size=starts.pose.shape)
    turns = np.asarray(jax.vmap(_math.quat_matrix)(_math.normalize(jnp.asarray(seen[:, 3:], jnp.float32))))
    full = [np.asarray(_rigid(b, {"fill": jnp.ones(1), "shell_scale": jnp.ones(1)})[1][0]) for b in items]
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
            likely = np.exp(-((felt - pressure) ** 2).sum(1) / 2 / noise**2) + 1e-9
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


def pressed(starts: Starts) -> np.ndarray:
    """Centre of pressure (n, 2) in m, nan without contact: of the normal force, where `-My / Fz, Mx / Fz` lie."""
    force = np.where(starts.wrench[:, 2] > 0, starts.wrench[:, 2], np.nan)
    return np.stack([-starts.wrench[:, 4], starts.wrench[:, 3]], 1) / force[:, None]


STUDIES = {
    "perturbed": Study(
        scenario=physics.Perturbed(),
        categories=("bottle",),
        reroll=("fill",),
        touch=lambda starts: np.log(starts.mass)[:, None],
        noise=0.05,
        noise_name="weight to 5 %",
        features=shaken,
    ),
    "inclined": Study(
        scenario=physics.Inclined(),
        categories=objects.CATEGORIES,
        reroll=("fill", "up"),
        touch=pressed,
        noise=0.001,
        noise_name="pressure to 1 mm",
        features=laid,
    ),
}


# The four parts.


def outcomes(study: Study, starts: Starts) -> None:
    """Prints the shares of the outcomes, unsettled ones, and starts that end otherwise with another fill."""
    share = functools.partial(classify.interval, np.mean, groups=starts.body)
    for outcome in study.scenario.outcomes:
        print(f"{outcome.name.lower():30s} {share(starts.outcome == outcome)}")
    print(f"{'unsettled':30s} {share(~starts.settled)}")
    rolled = starts.rerolled >= 0
    if not rolled.any():
        return
    changed = (starts.rerolled != starts.outcome)[rolled]
    figure = classify.interval(np.mean, changed, groups=starts.body[rolled])
    print(f"{'another fill, another outcome':30s} {figure} ({len(changed)} starts)", flush=True)


def losses(study: Study, items: list[objects.Body], starts: Starts, touch: np.ndarray | None) -> np.ndarray:
    """Log loss of each start's outcome, of a classifier without or with touch."""
    label = np.searchsorted(np.sort(study.scenario.outcomes), starts.outcome)
    return classify.log_loss(classify.chances(study.features(items, starts, touch), label, starts.body), label)


def gains(study: Study, items: list[objects.Body], starts: Starts, read: np.ndarray | None) -> None:
    """Prints what the classifiers lose on true states and, where a network `read` touch in pictures, with that."""
    exact = study.touch(starts)
    rough = exact + study.noise * np.random.default_rng(0).normal(size=exact.shape)
    interval = functools.partial(classify.interval, groups=starts.body)
    share = np.array([np.mean(starts.outcome == outcome) for outcome in study.scenario.outcomes])
    before, after = losses(study, items, starts, None), losses(study, items, starts, rough)
    print(f"{'log loss: constant':30s} {-(share * np.log(share)).sum():.3f}")
    print(f"{'log loss: vision':30s} {interval(np.mean, before)}")
    print(f"{'log loss: ' + study.noise_name:30s} {interval(np.mean, after)}")
    print(f"{'gain: ' + study.noise_name:30s} {interval(classify.gain, before, after)}", flush=True)
    if read is None:
        return
    seen_too = losses(study, items, starts, read)
    error = np.sqrt(np.nanmean((read - exact) ** 2, 0))
    print(f"{'read in the tactile frame':30s} rms error {' '.join(f'{e:.4g}' for e in error)}")
    print(f"{'gain: pictures':30s} {interval(classify.gain, before, seen_too)}")
    print(f"{'share of the gain kept':30s} {interval(classify.kept, before, after, seen_too)}", flush=True)


def detect(name: str, images: np.ndarray, starts: Starts, new: np.ndarray, held_out: Starts, steps: int) -> None:
    """Prints how well a network tells, in frames of objects it has not seen, which are fuller than half."""
    read = reader.fit(jax.random.key(1), images, starts.fill[:, None] > 0.5, steps=steps)
    label, score = held_out.fill > 0.5, read(new)[:, 0]
    figure = classify.interval(classify.auc, label, score, groups=held_out.body)
    print(f"{'AUC of the fill: ' + name:30s} {figure} ({len(label)} held-out items)", flush=True)


def painted(body: objects.Body) -> objects.Body:
    """The body with TINT of white in its colours."""
    return dataclasses.replace(body, colors=(1 - TINT) * body.colors + TINT)


def aloft(study: Study, items: list[objects.Body], num: int, seed: int) -> tuple[Starts, np.ndarray, np.ndarray]:
    """Objects in the air, as freefall begins: starts, visual frames, and those with the fuller objects painted."""
    starts = roll(dataclasses.replace(study, scenario=physics.Freefall(frames=1)), items, num, 0, seed)
    plain, _ = draw(items, starts.body, starts.pose, starts.wrench)
    both, _ = draw([painted(body) for body in items], starts.body, starts.pose, starts.wrench)
    return starts, plain, np.where((starts.fill > 0.5)[:, None, None, None], both, plain)


# What is made once.


def kept(folder: Path | None, name: str, make: Callable[[], Starts]) -> Starts:
    """What a folder keeps under a name, or what is made now (and kept)."""
    path = None if folder is None else folder / f"{name}.npz"
    if path is not None and path.exists():
        with np.load(path) as file:
            return Starts(**{field: file[field] for field in Starts._fields})
    starts = make()
    if path is not None:
        dataset.write_arrays(path, starts._asdict())
    return starts


def soaked(folder: Path, name: str) -> Starts:
    """What the kept blocks of `benchmarks.soak` began with and how they ended; nothing was rolled again."""
    paths = sorted(folder.glob(f"{name}-*.npz"))
    if not paths:
        raise FileNotFoundError(f"{folder} holds no block {name}-*.npz: run python -m benchmarks.soak --keep {folder}")
    parts = []
    for path in paths:
        with np.load(path) as block:
            known = {field: block[field] for field in Starts._fields if field != "rerolled"}
            parts.append(Starts(**known, rerolled=np.full(len(block["body"]), -1)))
    return Starts(*map(np.concatenate, zip(*parts, strict=True)))


def main(
    parts: set[str],
    name: str,
    counts: tuple[int, int, int, int],
    steps: int,
    folder: Path | None,
    soak: Path | None = None,
) -> None:
    """Simulates what is needed and prints the parts."""
    study = STUDIES[name]
    num_objects, num, again, others = counts
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        dataset.claim(folder / f"{name}.json", {"scenario": repr(study.scenario), "counts": counts})
    if soak is None:
        items = bodies(study.categories, num_objects)
        starts = kept(folder, name, lambda: roll(study, items, num, again, 0))
    else:
        starts = soaked(soak, name)
        num_objects = int(starts.body.max()) + 1
        items = bodies(study.categories, num_objects)
    print(
        f"{study.scenario}\n{len(starts.body)} starts of {num_objects} objects ({', '.join(study.categories)})",
        flush=True,
    )
    if "outcomes" in parts:
        outcomes(study, starts)
    read, tactile = None, np.zeros(0)
    still = dataclasses.replace(study, scenario=dataclasses.replace(study.scenario, frames=1))
    if parts & {"pictures", "fill"}:
        rest = bodies(study.categories, others, OTHERS)
        learned = roll(still, rest, EXAMPLES, 0, 1)
        _, examples = draw(rest, learned.body, learned.pose, learned.wrench)
        _, tactile = draw(items, starts.body, starts.pose, starts.wrench)
    if "pictures" in parts:
        told = study.touch(learned)
        known = np.isfinite(told).all(1)
        read = reader.fit(jax.random.key(0), examples[known], told[known], steps=steps)(tactile)
        read = np.where(np.isfinite(study.touch(starts)), read, np.nan)  # an untouched skin is known as such
    if parts & {"truth", "pictures"}:
        gains(study, items, starts, read)
    if "fill" in parts:
        detect("touch, standing", examples, learned, tactile, starts, steps)
        flying, plain, tinted = aloft(study, rest, EXAMPLES, 2)
        new, new_plain, new_tinted = aloft(study, items, num, 3)
        detect("seen in the air", plain, flying, new_plain, new, steps)
        detect(f"{TINT:.0%} tint", tinted, flying, new_tinted, new, steps)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"some of {', '.join(PARTS)}; all by default")
    parser.add_argument("--scenario", choices=STUDIES, default="perturbed")
    parser.add_argument("--objects", type=int, default=200, help="whose starts are shaken")
    parser.add_argument("--num", type=int, default=16, help="starts of each object")
    parser.add_argument("--again", type=int, default=8, help="of these, how many with another fill as well")
    parser.add_argument("--others", type=int, default=400, help="objects that networks learn on")
    parser.add_argument("--steps", type=int, default=1000, help="of the networks")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="keep trajectories there, go on from them")
    parser.add_argument("--soaked", type=Path, metavar="FOLDER", help="blocks of benchmarks.soak instead of --objects")
    args = parser.parse_args()
    # Full and empty are told apart where containers stand.
    parts = PARTS if args.scenario == "perturbed" else PARTS[:-1]
    if not set(args.parts) <= set(parts):
        parser.error(f"{' '.join(args.parts)}: parts of {args.scenario} are {', '.join(parts)}")
    main(
        set(args.parts or parts),
        args.scenario,
        (args.objects, args.num, args.again, args.others),
        args.steps,
        args.keep,
        args.soaked,
    )
