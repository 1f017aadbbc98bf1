"""Endurance test: failures, outcomes and accuracy of many thousand trajectories of each scenario.

    python -m benchmarks.soak                            # 10,000 trajectories per scenario, about 2 hours on two cores
    python -m benchmarks.soak --num 300 --only inclined  # about a minute
    python -m benchmarks.soak --keep FOLDER              # keep finished blocks in a folder, and resume from it

A new object is made for every eight trajectories. A trajectory is unsettled if the object is neither at rest nor off
the pad at the end. Trajectories that `simulate` discarded, because they were not finite or sank deeper than
`physics.simulation.SUNK_LIMIT`, are counted. The wrench at rest is compared with the weight, and the energy without
contact with that at the start, except in `perturbed`, where gravity changes. `benchmarks.hidden --soaked FOLDER`
analyses kept blocks.
"""

import dataclasses
import tempfile
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from tqdm import tqdm

from benchmarks.instruments.starts import NUM, SCENARIOS, bodies, claim, rigid_of
from sts_jax import geometry, objects, physics, storage
from sts_jax.physics.scenario import G
from sts_jax.physics.simulation import SUNK_LIMIT
from sts_jax.sensor import Sensor

BLOCK = 504  # trajectories simulated by one call, unless fewer are requested


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the command line."""

    num: int = 10_000  # number of trajectories of each scenario
    only: Literal["freefall", "inclined", "perturbed", "released"] | None = None  # scenario (default: all)
    keep: Path | None = None  # folder that keeps finished blocks (default: a temporary folder)


def excess_energy(
    rigid: tuple[np.ndarray, np.ndarray, np.ndarray], pose: np.ndarray, velocity: np.ndarray, gravity: np.ndarray
) -> np.ndarray:
    """Compute the mechanical energy in each frame, minus the mechanical energy in the first frame."""
    mass, com, inertia = (np.asarray(x, np.float64) for x in rigid)
    rotation = np.asarray(geometry.quat_to_matrix(jnp.asarray(pose[..., 3:])), np.float64)
    arm = np.einsum("nfij,nj->nfi", rotation, com)
    turn = np.einsum("nfji,nfj->nfi", rotation, velocity[..., 3:])
    speed = velocity[..., :3] + np.cross(velocity[..., 3:], arm)
    kinetic = 0.5 * mass[:, None] * (speed**2).sum(-1) + 0.5 * np.einsum("nfi,nij,nfj->nf", turn, inertia, turn)
    energy = kinetic - mass[:, None] * ((pose[..., :3] + arm) @ gravity)
    return (energy - energy[:, :1]) / (mass[:, None] * np.linalg.norm(gravity) * 0.05)


def block(name: str, index: int, size: int) -> dict[str, np.ndarray]:
    """Simulate a block of trajectories of a scenario."""
    scenario = SCENARIOS[name]
    first = index * size // NUM
    items = bodies(("bottle",) if scenario.must_stand else objects.CATEGORIES, size // NUM, first)
    key = jax.random.fold_in(jax.random.key(1), index)
    traj = jax.tree.map(np.asarray, physics.simulate(key, items, Sensor(), scenario, NUM))
    rigid = rigid_of(items, traj)
    mass = rigid[0]
    fell = traj.outcome == physics.Outcome.FELL_OFF
    gravity = traj.gravity[0, -1].astype(np.float64)
    carried = -(mass[:, None] * gravity)
    error = np.linalg.norm(traj.wrench[:, -1, :3] - carried, axis=1) / (mass * G)
    at_rest = traj.settled & ~fell & ~traj.wall[:, -1]
    free = excess_energy(rigid, traj.pose, traj.velocity, gravity)
    constant = not np.ptp(traj.gravity, axis=(0, 1)).any()
    out_of_contact = ~traj.contact & ~traj.wall & ~fell[:, None]
    return {
        "body": first + traj.body,
        "pose": traj.pose[:, 0],
        "wrench": traj.wrench[:, 0],
        "condition": traj.condition,
        "fill": traj.hidden.fill,
        "mass": mass,
        "category": np.array([int(items[b].category) for b in traj.body]),
        "outcome": traj.outcome,
        "settled": traj.settled,
        "resampled": traj.resampled,
        "sunk": traj.sunk,
        "touches": traj.touches,
        "wrench_error": np.where(at_rest, error, np.nan),
        "excess": np.where(out_of_contact, free, -np.inf).max(1) if constant else np.full(len(fell), np.nan),
    }


def report(name: str, found: dict[str, np.ndarray]) -> str:
    """Format the results of one scenario as lines of text."""
    outcome = found["outcome"]
    shares = {o.name.lower(): np.mean(outcome == o) for o in SCENARIOS[name].outcomes}
    lines = [
        f"{name}: {len(outcome)} trajectories",
        f"    drawn again (non-finite or deeper than {1e3 * SUNK_LIMIT:.0f} mm)  {found['resampled'].sum()}",
        f"    deepest: median {1e3 * np.median(found['sunk']):.2f} mm, largest {1e3 * found['sunk'].max():.2f} mm",
        "    " + ", ".join(f"{key} {100 * share:.1f} %" for key, share in shares.items()),
        f"    unsettled {100 * np.mean(~found['settled']):.2f} %",
        f"    touch, part and touch again {100 * np.mean(found['touches'] >= 2):.1f} %",
        f"    wrench at rest against the weight: error median {100 * np.nanmedian(found['wrench_error']):.3f} %, "
        f"99 % below {100 * np.nanquantile(found['wrench_error'], 0.99):.2f} %",
    ]
    if np.isfinite(found["excess"]).any():
        lines.append(
            f"    energy out of contact above the start's: largest {100 * found['excess'].max():.3f} % of the weight "
            "times 50 mm"
        )
    for index in np.unique(found["category"]):
        own = found["category"] == index
        lines.append(f"        {objects.CATEGORIES[index]:9s} unsettled {100 * np.mean(~found['settled'][own]):5.2f} %")
    return "\n".join(lines)


def main(args: Args, folder: Path) -> None:
    """Simulate the trajectories of each requested scenario in blocks, and print the results."""
    size = min(BLOCK, -(-args.num // NUM) * NUM)
    for name in [args.only] if args.only else list(SCENARIOS):
        claim(folder, name, size)
        parts = []
        for index in tqdm(range(-(-args.num // size)), unit="block", desc=name):
            path = folder / f"{name}-{index:04d}.npz"
            if not path.exists():
                storage.write_arrays(path, block(name, index, size))
            with np.load(path) as kept:
                parts.append(dict(kept))
        found = {field: np.concatenate([part[field] for part in parts])[: args.num] for field in parts[0]}
        print(report(name, found), flush=True)


if __name__ == "__main__":
    args = tyro.cli(Args, description=__doc__)
    with tempfile.TemporaryDirectory() as temporary:
        main(args, args.keep or Path(temporary))
