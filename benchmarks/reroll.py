"""What hidden values decide of a fall: the same starts again, with other fills, shells and frictions.

    python -m benchmarks.reroll  # about 2 minutes

Prints how far the ends of one start lie from each other, beside how far they lie from the start.
"""

import argparse

import jax
import numpy as np

from benchmarks.starts import bodies
from sts_jax import objects, physics
from sts_jax.sensor import Sensor


def main(times: int, *, num_objects: int = 48, num: int = 4) -> None:
    """Drops the same starts several times with fresh fill, shell and friction and prints how the ends differ."""
    sensor, scenario, items = Sensor(), physics.Freefall(), bodies(objects.CATEGORIES, num_objects)
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
    parser.add_argument("--times", type=int, default=6, help="how often each start is rolled, at least 2")
    arguments = parser.parse_args()
    if arguments.times < 2:
        parser.error(f"--times {arguments.times}: ends are compared, roll at least twice")
    main(arguments.times)
