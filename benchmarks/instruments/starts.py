"""Functions that make objects, simulate their trajectories, and render the first frames of the trajectories."""

import concurrent.futures
import json
import os
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray
from tqdm import tqdm

from sts_jax import dataset, objects, physics, storage
from sts_jax.physics.simulation import SUNK_LIMIT
from sts_jax.sensor import Sensor

SCENARIOS: dict[str, physics.Scenario] = {
    "freefall": physics.Freefall(),
    "inclined": physics.Inclined(),
    "perturbed": physics.Perturbed(),
    "released": physics.Released(),
}
NUM = 8  # trajectories of each object

# Mass, centre of mass and inertia of one body for several fills, shell scales and directions of the contents.
rigid = jax.jit(jax.vmap(objects.rigid, in_axes=(None, 0, 0, 0)))
_settled = jax.jit(jax.vmap(objects.rigid, in_axes=(None, 0, 0)))  # the same for contents that settled along +z


class Starts(NamedTuple):
    """Starts and outcomes of trajectories, with one row for each trajectory."""

    body: np.ndarray  # (n,) index of the object
    pose: np.ndarray  # (n, 7) pose in the first frame
    wrench: np.ndarray  # (n, 6) wrench in the first frame
    condition: np.ndarray  # (n, c) condition of the scenario
    fill: np.ndarray  # (n,) filled share of the interior's volume
    mass: np.ndarray  # (n,) kg, mass of shell and contents
    settled: np.ndarray  # (n,) bool, True if the object is at rest at the end
    outcome: np.ndarray  # (n,) `physics.Outcome`
    rerolled: np.ndarray  # (n,) outcome of the same start with other contents, -1 if it was not simulated again


def bodies(categories: tuple[str, ...], count: int, first: int = 0) -> list[objects.Body]:
    """Make objects of the given classes, such as "bottle". The classes alternate from object to object."""
    numbers = range(first, first + count)
    return [objects.make(jax.random.key(i), categories[i % len(categories)]) for i in numbers]


def filled(body: objects.Body, fill: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mass properties of a body at several fill levels."""
    mass, com, inertia = _settled(body, jnp.asarray(fill, jnp.float32), jnp.ones(len(fill)))
    return np.asarray(mass), np.asarray(com), np.asarray(inertia)


def rigid_of(items: list[objects.Body], traj: physics.Trajectory) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mass properties of the object of each trajectory. The trajectories must be sorted by object."""
    owner, parts = np.asarray(traj.body), []
    for index, body in enumerate(items):
        own = jax.tree.map(lambda x, mine=owner == index: x[mine], traj.hidden)
        parts.append(rigid(body, own.fill, own.shell_scale, own.up))
    mass, com, inertia = (np.concatenate(part) for part in zip(*parts, strict=True))
    return mass, com, inertia


def roll(
    key: PRNGKeyArray,
    items: list[objects.Body],
    scenario: physics.Scenario,
    num: int,
    *,
    again: int = 0,
    reroll: tuple[str, ...] = (),
) -> Starts:
    """Simulate trajectories of each object, and repeat some of them with other hidden properties (such as friction)."""
    key, fresh = jax.random.split(key)
    with tqdm(total=len(items) * num, unit="starts") as bar:
        traj = physics.simulate(key, items, Sensor(), scenario, num, progress=lambda n: bar.update(n - bar.n))
    outcome = np.asarray(traj.outcome)
    rerolled = np.full(len(outcome), -1)
    if again:
        rows = (np.arange(len(items))[:, None] * num + np.arange(again)).ravel()
        other = jax.vmap(scenario.hidden)(jax.random.split(fresh, len(rows)))
        hidden = jax.tree.map(lambda x: x[rows], traj.hidden)
        hidden = hidden._replace(**{name: getattr(other, name) for name in reroll})
        with tqdm(total=len(rows), unit="repeated starts") as bar:
            second = physics.simulate(
                key, items, Sensor(), scenario, again, hidden=hidden, progress=lambda n: bar.update(n - bar.n)
            )
        same = (np.asarray(traj.resampled)[rows] == 0) & (np.asarray(second.resampled) == 0)
        rerolled[rows[same]] = np.asarray(second.outcome)[same]
    return Starts(
        body=np.asarray(traj.body),
        pose=np.asarray(traj.pose[:, 0]),
        wrench=np.asarray(traj.wrench[:, 0]),
        condition=np.asarray(traj.condition),
        fill=np.asarray(traj.hidden.fill),
        mass=rigid_of(items, traj)[0],
        settled=np.asarray(traj.settled),
        outcome=outcome,
        rerolled=rerolled,
    )


def draw(items: list[objects.Body], starts: Starts) -> np.ndarray:
    """Render the first tactile image of each trajectory."""

    def one(index: int) -> np.ndarray:
        own = starts.body == index
        images = dataset.render_uint8(
            Sensor(), items[index], starts.pose[own], starts.wrench[own], resolution=(64, 64), crop=False
        )
        return np.asarray(images[1])

    with concurrent.futures.ThreadPoolExecutor(os.cpu_count()) as pool:
        return np.concatenate([*pool.map(one, np.unique(starts.body).tolist())])


def claim(folder: Path, name: str, size: int) -> None:
    """Write a JSON file with the simulation settings of a scenario, such as the number of trajectories per object."""
    settings = {"scenario": repr(SCENARIOS[name]), "num": NUM, "block": size, "sunk_limit": SUNK_LIMIT}
    storage.claim(folder / f"{name}.json", settings)


def soaked(folder: Path, name: str) -> Starts:
    """Load the initial states and outcomes of a scenario's trajectories, which a run with `--keep` stored."""
    claimed, paths = folder / f"{name}.json", sorted(folder.glob(f"{name}-????.npz"))
    if not (claimed.exists() and paths):
        raise FileNotFoundError(f"{folder} has no trajectories of {name}: run benchmarks.soak --keep {folder}")
    claim(folder, name, json.loads(claimed.read_text())["block"])
    parts = []
    for path in paths:
        with np.load(path) as kept:
            known = {field: kept[field] for field in Starts._fields if field != "rerolled"}
            parts.append(Starts(**known, rerolled=np.full(len(kept["body"]), -1)))
    return Starts(*map(np.concatenate, zip(*parts, strict=True)))
