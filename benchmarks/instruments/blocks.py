"""Blocks of simulated trajectories that `benchmarks.soak --keep FOLDER` stores, and their simulation settings."""

import json
from pathlib import Path

import numpy as np

from benchmarks.instruments.starts import Starts
from sts_jax import physics, storage
from sts_jax.physics.simulation import SUNK_LIMIT

SCENARIOS: dict[str, physics.Scenario] = {
    "freefall": physics.Freefall(),
    "inclined": physics.Inclined(),
    "perturbed": physics.Perturbed(),
    "released": physics.Released(),
}
NUM = 8  # trajectories of each object


def claim(folder: Path, name: str, size: int) -> None:
    """Write a JSON file with the simulation settings of a scenario, such as the number of trajectories per object."""
    settings = {"scenario": repr(SCENARIOS[name]), "num": NUM, "block": size, "sunk_limit": SUNK_LIMIT}
    storage.claim(folder / f"{name}.json", settings)


def soaked(folder: Path, name: str) -> Starts:
    """Load the initial states and outcomes of a scenario's trajectories, which a run with `--keep` stored."""
    claimed, paths = folder / f"{name}.json", sorted(folder.glob(f"{name}-????.npz"))
    if not (claimed.exists() and paths):
        raise FileNotFoundError(
            f"{folder} has no stored trajectories ({name}.json and {name}-*.npz): make them with "
            f"python -m benchmarks.soak --keep {folder}"
        )
    claim(folder, name, json.loads(claimed.read_text())["block"])
    parts = []
    for path in paths:
        with np.load(path) as kept:
            known = {field: kept[field] for field in Starts._fields if field != "rerolled"}
            parts.append(Starts(**known, rerolled=np.full(len(kept["body"]), -1)))
    return Starts(*map(np.concatenate, zip(*parts, strict=True)))
