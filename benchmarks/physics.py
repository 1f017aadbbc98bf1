"""Physics: steps per second beside C MuJoCo, and what becomes of many drops.

    python -m benchmarks.physics             # about 2 minutes
    python -m benchmarks.physics --soak 3000 # about 10 minutes on two cores
    python -m benchmarks.physics --reroll 6  # about 2 minutes

The first steps the same objects from the same starts for a whole trajectory, in both engines. The second drops
objects of all categories (a new one every eight drops) and counts. The third rolls the same starts again with other
hidden values: how far the end is decided by what cannot be seen.
"""

import argparse
import functools
import statistics
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from tqdm import tqdm

from sts_jax import _math, objects, physics
from sts_jax.physics import scene
from sts_jax.physics.scenarios import G
from sts_jax.physics.simulate import SUNK_LIMIT
from sts_jax.sensor import Sensor


def bodies(count: int) -> list[objects.Body]:
    """Objects of all categories in turn."""
    names = objects.CATEGORIES
    return [objects.make(jax.random.key(i), names[i % len(names)]) for i in range(count)]


def median_seconds(run: Callable[[], object], repeats: int = 3) -> float:
    """Median wall time of a call, after one that is not counted."""
    run()
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        run()
        times.append(time.perf_counter() - begin)
    return statistics.median(times)


def mass_properties(body: objects.Body, hidden: physics.Hidden) -> list[tuple[float, np.ndarray, np.ndarray]]:
    """Mass, centre of mass and inertia of each draw."""
    rigid = jax.vmap(functools.partial(objects.rigid, body))(hidden.fill, hidden.shell_scale, hidden.up)
    return list(zip(*(np.asarray(x, np.float64) for x in rigid), strict=True))


def speed(num: int) -> None:
    """Steps per second of both engines, on the drops of eight objects."""
    sensor, scenario, items = Sensor(), physics.Freefall(), bodies(8)
    pad = (float(sensor.gel.size[0]), float(sensor.gel.size[1]))
    steps = round(scenario.frames / scenario.rate / scenario.contact.timestep)
    traj = physics.simulate(jax.random.key(0), items, sensor, scenario, num)

    def in_mjx() -> None:
        physics.simulate(jax.random.key(0), items, sensor, scenario, num)

    worlds = []
    for index, body in enumerate(items):
        own = np.flatnonzero(np.asarray(traj.body) == index)
        hidden = jax.tree.map(lambda x, own=own: x[own], traj.hidden)
        for row, rigid, friction in zip(own, mass_properties(body, hidden), hidden.friction, strict=True):
            model = scene.compile_scene(np.asarray(body.hulls), pad, scenario.contact)
            data = mujoco.MjData(model)
            scene.set_rigid(model, data, *rigid, float(friction))
            worlds.append((model, data, np.asarray(traj.pose[row, 0])))

    def in_c() -> None:
        for model, data, pose in worlds:
            mujoco.mj_resetData(model, data)
            data.qpos[:] = pose
            mujoco.mj_step(model, data, nstep=steps)

    count = len(worlds) * steps
    ours, theirs = count / median_seconds(in_mjx), count / median_seconds(in_c)
    print(f"simulate (MJX)   {ours:10,.0f} steps/s, two threads, all costs but compilation")
    print(f"C MuJoCo         {theirs:10,.0f} steps/s, one thread")
    print(f"ratio            {ours / theirs:10.4f} (1/{theirs / ours:.0f})")


def excess_energy(body: objects.Body, hidden: physics.Hidden, pose: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Kinetic and potential energy of each frame over frame 0's, less 1; height is counted from the pad."""
    energies = []
    for (mass, com, inertia), p, v in zip(mass_properties(body, hidden), pose, velocity, strict=True):
        rotation = np.asarray(_math.quat_matrix(jnp.asarray(p[:, 3:])), np.float64)
        arm, turn = rotation @ com, v[:, 3:]
        speed_of_com = v[:, :3] + np.cross(turn, arm)
        own_turn = np.einsum("fji,fj->fi", rotation, turn)
        kinetic = 0.5 * mass * (speed_of_com**2).sum(1) + 0.5 * np.einsum("fi,ij,fj->f", own_turn, inertia, own_turn)
        energies.append(kinetic + mass * G * (p[:, 2] + arm[:, 2]))
    energy = np.array(energies)
    return energy / energy[:, :1] - 1


def soak(count: int) -> None:
    """Drops `count` objects and prints what became of them."""
    sensor, scenario, num = Sensor(), physics.Freefall(), 8
    items = bodies(-(-count // num))
    with tqdm(total=len(items) * num, unit="drops") as bar:
        traj = physics.simulate(
            jax.random.key(1), items, sensor, scenario, num, progress=lambda n: bar.update(n - bar.n)
        )
    traj = jax.tree.map(np.asarray, traj)
    fell = traj.outcome == physics.Outcome.FELL_OFF
    weight, excess = np.zeros(len(fell)), np.zeros(len(fell))
    for index, body in enumerate(items):
        own = np.flatnonzero(traj.body == index)
        hidden = jax.tree.map(lambda x, own=own: x[own], traj.hidden)
        weight[own] = [G * mass for mass, _, _ in mass_properties(body, hidden)]
        free = excess_energy(body, hidden, traj.pose[own], traj.velocity[own])
        excess[own] = np.max(np.where(traj.contact[own] | fell[own][:, None], -1, free), axis=1)
    resting = traj.settled & ~fell
    error = np.abs(traj.wrench[resting, -1, 2] / weight[resting] - 1)
    category = np.array([int(items[b].category) for b in traj.body])
    print(f"{len(fell)} drops of {len(items)} objects")
    print(f"drawn again (non-finite or deeper than {1e3 * SUNK_LIMIT:.0f} mm)  {traj.resampled.sum()}")
    print(f"deepest into the pad: median {1e3 * np.median(traj.sunk):.2f} mm, largest {1e3 * traj.sunk.max():.2f} mm")
    print(f"rests {100 * np.mean(~fell):.1f} %, fell off {100 * np.mean(fell):.1f} %")
    print(
        f"touch, part and touch again  {100 * np.mean(traj.touches >= 2):.1f} % (median {np.median(traj.touches):.0f})"
    )
    print(f"unsettled  {100 * np.mean(~traj.settled):.2f} %")
    for index, name in enumerate(objects.CATEGORIES):
        own = category == index
        unsettled, left = 100 * np.mean(~traj.settled[own]), 100 * np.mean(fell[own])
        print(f"    {name:9s} unsettled {unsettled:5.2f} %, fell {left:5.2f} %")
    print(f"wrench at rest against the weight: error {100 * np.median(error):.3f} %, largest {100 * error.max():.2f} %")
    print(f"energy out of contact above the start's: largest {100 * excess.max():.3f} %")


def reroll(times: int, *, num_objects: int = 48, num: int = 4) -> None:
    """Drops the same starts several times with fresh fill, shell and friction and prints how the ends differ."""
    sensor, scenario, items = Sensor(), physics.Freefall(), bodies(num_objects)
    ends, rests = [], []
    for key in jax.random.split(jax.random.key(2), times):
        hidden = jax.vmap(scenario.hidden)(jax.random.split(key, num_objects * num))
        traj = physics.simulate(jax.random.key(1), items, sensor, scenario, num, hidden=hidden)
        if traj.resampled.sum():
            raise RuntimeError("a drop was drawn again from another start; give another key")
        ends.append(1e3 * np.asarray(traj.pose[:, -1, :2]))
        rests.append(np.asarray(traj.outcome) == physics.Outcome.RESTS)
    place, stay = np.array(ends), np.array(rests)
    start = 1e3 * np.asarray(traj.pose[:, 0, :2])
    own = np.linalg.norm(place - place.mean(0), axis=-1).mean(0) * np.sqrt(times / (times - 1))
    moved = np.linalg.norm(place - start, axis=-1)
    changed = np.mean(stay.any(0) & ~stay.all(0))
    print(f"{place.shape[1]} starts of {num_objects} objects, {times} fills, shells and frictions each")
    print(f"the end lies from the start                  {np.mean(moved[stay]):5.1f} mm (mean, of those that stay)")
    print(f"the ends of one start from their own mean    {np.mean(own):5.1f} mm (mean), {np.median(own):.1f} (median)")
    print(f"starts of which some ends stay and some fall {100 * changed:5.1f} %")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--soak", type=int, default=0, metavar="N", help="drop N objects and count")
    parser.add_argument("--reroll", type=int, default=0, metavar="N", help="roll the same starts N times (N > 1)")
    parser.add_argument("--num", type=int, default=8, help="drops of each of eight objects in the speed test")
    arguments = parser.parse_args()
    if arguments.soak:
        soak(arguments.soak)
    elif arguments.reroll:
        if arguments.reroll < 2:
            parser.error(f"--reroll {arguments.reroll}: ends are compared, roll at least twice")
        reroll(arguments.reroll)
    else:
        speed(arguments.num)
