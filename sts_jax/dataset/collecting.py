"""`collect` simulates and renders the shards of a dataset and writes them into a folder."""

import concurrent.futures
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from sts_jax._checked import in_32_bits
from sts_jax.dataset import records
from sts_jax.dataset.collection import Collection, as_json, split_objects
from sts_jax.dataset.shards import simulate_shard, write_shard
from sts_jax.sensor import Sensor
from sts_jax.storage import (
    Manifest,
    checksums,
    claim,
    delete_partial,
    digest,
    lock,
    read_arrays,
    verify,
    write_json,
    write_manifest,
)


class Collected(NamedTuple):
    """The result of `collect`: how many failed trajectories were sampled again, and which objects the dataset lacks."""

    resampled: int  # number of trajectories that were discarded and sampled again
    left_out: tuple[str, ...]  # one line for each object that the dataset lacks, with the reason


class Progress(NamedTuple):
    """Progress of `collect`, which simulates the objects of a shard while it renders those of the one before."""

    done: int  # finished trajectories of the dataset, or finished frames and views of the current shard
    total: int  # all trajectories of the dataset, or all frames and views of the current shard
    stage: str  # "trajectories" for the simulation, "frames" for the rendering


@in_32_bits
def collect(
    collection: Collection,
    sensor: Sensor,
    folder: Path,
    *,
    process_index: int = 0,
    process_count: int = 1,
    progress: Callable[[Progress], None] | None = None,
) -> Collected:
    """Simulate and render a dataset into a folder. A repeated call makes only the shards that the folder lacks.

    A trajectory that becomes non-finite, or whose object sinks too deep into the pad, is discarded and sampled again.
    An object that cannot be made or simulated is left out.

    Several processes, also on several computers with a common folder, can share the work: process i of n makes the
    shards i, i + n, i + 2 n, ... The one that finds all shards finished completes the dataset. The files are the same
    bytes whoever makes them.

    Args:
        collection: The description of the dataset.
        sensor: The sensor for the simulation and the images.
        folder: The folder of the dataset. It receives the shards, `collection.json`, `sensor.json` (for
            `Sensor.load`), `split.json` and `manifest.json`.
        process_index: Index of this process, from 0.
        process_count: Number of the processes that share the work.
        progress: Called when some trajectories or images are finished.

    Returns:
        Summary of all shards of this process, including those that earlier calls made.

    Raises:
        LockedError: Another process makes the same shards.
    """
    sensor.check()
    collection.check()
    if not 0 <= process_index < process_count:
        raise ValueError(
            f"process_index must be from 0 to process_count - 1 = {process_count - 1}, got {process_index}"
        )
    count = collection.num_shards
    own = range(process_index, count, process_count)
    with lock(folder, finished=True, part=(process_index, process_count)):
        manifest = records.manifest_of(folder)
        claim(folder / "collection.json", as_json(collection))
        claim(folder / "sensor.json", sensor.constants())
        if not (folder / "split.json").exists():
            split = {name: [int(i) for i in part] for name, part in split_objects(collection).items()}
            write_json(folder / "split.json", split)
        if manifest is not None:
            verify(folder, manifest, records.remedy(folder), records.DESCRIPTIONS)
        dataset = digest(checksums(folder, records.DESCRIPTIONS))
        missing = [index for index in own if not _is_finished(folder, dataset, manifest, index, count)]
        _make(collection, sensor, folder, dataset, missing, progress)
        _complete(folder, dataset, manifest, count)
        tables = [read_arrays(folder / records.shard_files(i, count)[1], records.remedy(folder)) for i in own]
    resampled = sum(int(table["trajectory/resampled"].sum()) for table in tables)
    return Collected(resampled, tuple(line for table in tables for line in table["left_out"].tolist()))


def _is_finished(folder: Path, dataset: str, manifest: Manifest | None, index: int, count: int) -> bool:
    """Whether a shard is finished. Its files are verified."""
    files = records.listed(folder, dataset, manifest, index, count)
    if files is None or not any((folder / name).exists() for name in files):
        delete_partial(folder, f"shard-{index:05d}-of-")  # of a killed process
        return False
    verify(folder, Manifest(files, {}), records.remedy(folder))
    return True


def _make(
    collection: Collection,
    sensor: Sensor,
    folder: Path,
    dataset: str,
    missing: list[int],
    progress: Callable[[Progress], None] | None,
) -> None:
    """Make shards. The objects of the next one are simulated while one is rendered and written."""

    def reporting(stage: str, before: int, total: int) -> Callable[[int], None]:
        return lambda done: None if progress is None else progress(Progress(before + done, total, stage))

    def simulated(index: int) -> concurrent.futures.Future:
        before = index * collection.objects_per_shard * collection.num_per_object
        report = reporting("trajectories", before, collection.num_trajectories)
        return pool.submit(simulate_shard, collection, sensor, index, report)

    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        ahead = simulated(missing[0]) if missing else None
        for place, index in enumerate(missing):
            assert ahead is not None
            try:
                shard = ahead.result()
            except ValueError as error:
                raise ValueError(f"{folder}: {error}") from error
            ahead = simulated(missing[place + 1]) if place + 1 < len(missing) else None
            report = reporting("frames", 0, len(shard.frames) + len(shard.views["body"]))
            write_shard(collection, sensor, folder, dataset, index, shard, report)


def _complete(folder: Path, dataset: str, manifest: Manifest | None, count: int) -> None:
    """Write what describes the whole dataset, the manifest last, if all shards are finished."""
    shards = [records.listed(folder, dataset, manifest, index, count) for index in range(count)]
    files = checksums(folder, records.DESCRIPTIONS)
    for shard in shards:
        if shard is None:
            return
        files |= shard
    if manifest is not None and manifest.files == files:
        delete_partial(folder)  # of killed processes
        return
    delete_partial(folder, "shard-")
    # The data card belongs here.
    write_manifest(folder, files, {"shards": count})
