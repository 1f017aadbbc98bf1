"""The collection of a dataset with its duration, one progress bar, and a check of a dataset that was made elsewhere."""

import contextlib
import json
import os
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import numpy as np
from tqdm import tqdm

import sts_jax as sts
from experiments.shared.terminal import say
from sts_jax import dataset, storage
from sts_jax._devices import cores

_EVERY_S = 10.0  # time between two lines of progress where standard error is not a terminal (s)
_PROBED = 4  # trajectories that are simulated to measure the speed of this computer


def collect(collection: dataset.Collection, sensor: sts.Sensor, folder: Path) -> dataset.Dataset:
    """Make what is missing of a dataset, and open it."""
    make(collection, sensor, folder)
    return dataset.load(folder)


def make(
    collection: dataset.Collection,
    sensor: sts.Sensor,
    target: str | os.PathLike[str],
    *,
    process_index: int = 0,
    process_count: int = 1,
    cluster: str | None = None,
    repair: bool = False,
) -> dataset.Collected:
    """Make what is missing of a dataset, as `dataset.collect` does, and show the progress."""
    if process_index >= collection.num_shards:
        say(
            f"collect: nothing to do for process {process_index}, because there are {collection.num_shards} shards: "
            "start fewer processes, or make smaller shards (--objects-per-shard)"
        )
    with _Bar(collection, sensor, measure=cluster is None) as bar:
        collected = dataset.collect(
            collection,
            sensor,
            target,
            process_index=process_index,
            process_count=process_count,
            cluster=cluster,
            repair=repair,
            progress=bar,
        )
    for line in collected.left_out:
        say(f"collect: left out {line}")
    for line in collected.repaired:
        say(f"collect: made again, because {line}")
    if collected.resampled:
        say(f"collect: {collected.resampled} trajectories with non-finite values or in the pad were drawn again")
    return collected


def finished(source: str, collection: dataset.Collection, sensor: sts.Sensor | None) -> dataset.Dataset:
    """Open a finished dataset of a collection, or the local copy of one behind a URL. None accepts any sensor.

    Only reads the dataset, so that several processes may use it at the same time.
    """
    data = dataset.load(source)
    place = data.shards[0].parent.resolve()
    new = json.loads(json.dumps(dataset.as_json(collection)))
    changes = storage.differences({name: data.collection.get(name) for name in new}, new, dataset.PLACES)
    if sensor is not None and not changes:
        constants = json.loads(json.dumps(sensor.constants()))
        changes = storage.differences(json.loads((place / "sensor.json").read_text()), constants)
    if changes:
        raise ValueError(
            f"the dataset {source} was collected with {changes}: give the options with which it was collected, or "
            "another dataset"
        )
    return data


def link(data: dataset.Dataset, source: str, folder: Path) -> None:
    """Make a folder a link to a dataset that was opened from `source`."""
    place = data.shards[0].parent.resolve()
    if folder.is_symlink() or folder.exists():
        if folder.resolve() != place:
            raise ValueError(f"{folder} is another dataset than {source}: choose another work directory, or delete it")
    else:
        folder.symlink_to(place, target_is_directory=True)


def seconds(collection: dataset.Collection, sensor: sts.Sensor) -> tuple[float, float]:
    """Measured time of one trajectory with its share of making the objects, and of one frame, on this computer (s)."""
    begin = time.monotonic()
    bodies = dataset.make_bodies(collection, np.arange(1))
    making = (time.monotonic() - begin) / collection.num_per_object
    key, each = jax.random.key(0), []
    for _ in range(2):  # the first call compiles
        begin = time.monotonic()
        motion = sts.physics.simulate(key, bodies, sensor, collection.scenario, _PROBED, engine=collection.engine)
        each.append((time.monotonic() - begin) / _PROBED)
    poses, wrenches = (np.asarray(x).reshape(-1, x.shape[-1]) for x in (motion.pose, motion.wrench))
    chosen = np.linspace(0, len(poses) - 1, dataset.frames_per_call()).astype(int)

    def draw(_: int) -> object:
        return dataset.render_uint8(
            sensor,
            bodies[0],
            poses[chosen],
            wrenches[chosen],
            resolution=collection.resolution,
            crop=collection.crop,
        )[0].block_until_ready()

    draw(0)
    workers = cores()
    begin = time.monotonic()
    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(draw, range(workers)))
    return making + each[1], (time.monotonic() - begin) / (workers * len(chosen))


class _Bar:
    """Says how long a collection will take, and shows its progress with the time left."""

    def __init__(self, collection: dataset.Collection, sensor: sts.Sensor, *, measure: bool) -> None:
        self._given, self._measure = (collection, sensor), measure
        self._weights: tuple[float, float] | None = None
        self._bar: tqdm | None = None
        self._said_s = self._begun_s = self._begun = 0.0
        self._ended = False

    def __enter__(self) -> "_Bar":
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def __call__(self, progress: dataset.Progress) -> None:
        """Show the progress. The first call comes before the first missing shard."""
        if self._weights is None:
            self._begin(progress)
        assert self._weights is not None
        done = np.dot(self._weights, progress[:2])
        note = (
            f"{progress.trajectories:,}/{progress.all_trajectories:,} trajectories, "
            f"{progress.frames:,}/{progress.all_frames:,} images"
        )
        if self._bar is not None:
            self._bar.set_postfix_str(note, refresh=False)
            self._bar.update(done - self._bar.n)
            return
        now = time.monotonic()
        total = np.dot(self._weights, progress[2:])
        if now - self._said_s > _EVERY_S or (done == total and not self._ended):
            self._ended = done == total
            speed = (done - self._begun) / (now - self._begun_s)
            left = f", {duration((total - done) / speed)} left" if speed > 0 and done < total else ""
            say(f"collect: {done / total:.0%}, {note}{left}")
            self._said_s = now

    def _begin(self, progress: dataset.Progress) -> None:
        left = np.subtract(progress[2:], progress[:2])
        time_needed = ""
        self._weights = (1.0, 1.0)  # workers finish both at the same time
        if self._measure:
            with contextlib.suppress(OSError, ValueError):  # an object that cannot be made is left out later
                self._weights = seconds(*self._given)
                time_needed = f", about {duration(float(np.dot(self._weights, left)))} on this computer"
        say(f"collect: {left[0]:,} trajectories and {left[1]:,} images{time_needed}")
        self._begun = float(np.dot(self._weights, progress[:2]))
        self._begun_s = self._said_s = time.monotonic()
        if sys.stderr.isatty():
            self._bar = tqdm(
                total=float(np.dot(self._weights, progress[2:])),
                initial=self._begun,
                dynamic_ncols=True,
                smoothing=0.0,
                bar_format="collect: {percentage:3.0f}%|{bar}| {postfix} [{elapsed}<{remaining}]",
            )


def duration(seconds: float) -> str:
    """A duration in words, such as `12 min`."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
