"""`collect` simulates and renders the shards of a dataset and writes them into a folder."""

import concurrent.futures
import dataclasses
import functools
import importlib.metadata
import os
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sts_jax._checked import in_32_bits
from sts_jax.dataset import cluster, records
from sts_jax.dataset.card import CARD, card
from sts_jax.dataset.collection import PLACES, Collection, as_json, split_objects
from sts_jax.dataset.remote import Remote, local_or_remote
from sts_jax.dataset.shards import Simulated, planned, simulate_shard, write_shard
from sts_jax.sensor import Sensor
from sts_jax.storage import (
    MANIFEST,
    DamagedFileError,
    Manifest,
    checksums,
    claim,
    delete_partial,
    digest,
    lock,
    read_arrays,
    read_json,
    read_manifest,
    sha256,
    verify,
    write_bytes,
    write_json,
    write_manifest,
)


class Collected(NamedTuple):
    """The result of `collect`: how many failed trajectories were sampled again, and which objects the dataset lacks."""

    resampled: int  # number of trajectories that were discarded and sampled again
    left_out: tuple[str, ...]  # one line for each object that the dataset lacks, with the reason
    repaired: tuple[str, ...] = ()  # one line for each damaged file that was made again


class Progress(NamedTuple):
    """Progress of `collect` in the shards of this process, including those that were finished before."""

    trajectories: int  # simulated trajectories
    frames: int  # rendered frames and views
    all_trajectories: int
    all_frames: int


@dataclasses.dataclass(frozen=True)
class _Work:
    """What one call of `collect` does. The fields are its arguments."""

    collection: Collection
    sensor: Sensor
    target: Path | Remote
    own: range  # indices of the shards of this process
    cluster: str | None
    repair: bool
    progress: Callable[[Progress], None] | None

    def names(self, index: int) -> tuple[str, str, str]:
        """Names of the files of a shard, its manifest last."""
        return records.all_files(index, self.collection.num_shards)


@in_32_bits
def collect(
    collection: Collection,
    sensor: Sensor,
    folder: str | os.PathLike[str],
    *,
    process_index: int = 0,
    process_count: int = 1,
    cluster: str | None = None,
    repair: bool = False,
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
        folder: The folder of the dataset, or a URL such as `s3://bucket/falls`, for which fsspec may need a driver. It
            receives the shards, `collection.json`, `sensor.json` (for `Sensor.load`), `split.json`, a data card
            (`README.md`) and `manifest.json`.
        process_index: Index of this process, from 0.
        process_count: Number of the processes that share the work.
        cluster: Address of a Dask scheduler, such as `tcp://10.0.0.1:8786`, whose workers make the shards (needs the
            extra `cluster`). The workers must have sts_jax and reach the folder by the same path.
        repair: True to make shards with missing or damaged files again. They raise an error otherwise.
        progress: Called before the first missing shard, and when some trajectories or images are finished.

    Returns:
        Summary of all shards of this process, including those that earlier calls made.

    Raises:
        LockedError: Another process makes the same shards. A folder behind a URL is not locked.
        DamagedFileError: A file is damaged, or belongs to another dataset or shard. The message names the file.
    """
    sensor.check()
    collection.check()
    if not 0 <= process_index < process_count:
        raise ValueError(
            f"process_index must be from 0 to process_count - 1 = {process_count - 1}, got {process_index}"
        )
    target, own = local_or_remote(folder), range(process_index, collection.num_shards, process_count)
    work = _Work(collection, sensor, target, own, cluster, repair, progress)
    if isinstance(target, Remote):
        with tempfile.TemporaryDirectory() as temporary:  # for the small files
            return _collect(work, Path(temporary))
    with lock(target, finished=True, part=(process_index, process_count)):
        return _collect(work, target)


def _collect(work: _Work, folder: Path) -> Collected:
    """Collect into a folder, or, through a folder with the small files, into one behind a URL."""
    present = None
    if isinstance(work.target, Remote):
        present = work.target.names()
        work.target.get(folder, sorted(name for name in present if name.endswith(".json")))
    repaired = _repair_descriptions(folder) if work.repair else []
    manifest = _describe(work, folder)
    if isinstance(work.target, Remote):
        work.target.put(folder, [name for name in records.DESCRIPTIONS if repaired or name not in (present or ())])
    dataset, missing = digest(checksums(folder, records.DESCRIPTIONS)), []
    for index in work.own:
        try:
            if not _is_finished(work, folder, dataset, manifest, present, index):
                missing.append(index)
        except DamagedFileError as error:
            if not work.repair:
                raise
            _delete_shard(work, folder, present, index)
            repaired.append(str(error))
            missing.append(index)
    _make(work, folder, dataset, missing)
    shards = _complete(work, folder, dataset, manifest)
    resampled, left_out = 0, []
    for index in work.own:
        facts = shards[index].facts
        if not facts:  # of an older dataset
            table = read_arrays(folder / work.names(index)[1], records.remedy(folder))
            facts = {"resampled": int(table["trajectory/resampled"].sum()), "left_out": table["left_out"].tolist()}
        resampled += facts["resampled"]
        left_out += facts["left_out"]
    return Collected(resampled, tuple(left_out), tuple(repaired))


def _describe(work: _Work, folder: Path) -> Manifest | None:
    """Write the descriptions of the dataset, or check them. Return the manifest of the dataset, if it has one."""
    manifest = records.manifest_of(folder)
    claim(folder / "collection.json", as_json(work.collection), ignored=PLACES)
    claim(folder / "sensor.json", work.sensor.constants())
    if not (folder / "split.json").exists():
        split = {name: [int(i) for i in part] for name, part in split_objects(work.collection).items()}
        write_json(folder / "split.json", split)
    if manifest is not None:
        verify(folder, manifest, records.remedy(folder), records.DESCRIPTIONS)
    return manifest


def _repair_descriptions(folder: Path) -> list[str]:
    """Delete a damaged manifest and damaged descriptions, which are then written again. Return the problems."""
    problems, manifest = [], None
    try:
        manifest = read_manifest(folder, "")
    except DamagedFileError as error:
        if not any(folder.glob("shard-*.json")):  # an older dataset, whose checksums would be lost
            raise
        (folder / MANIFEST).unlink()
        problems.append(str(error))
    for name in records.DESCRIPTIONS:
        path = folder / name
        try:
            if not path.exists() or (
                read_json(path, "") and (manifest is None or manifest.files[name] == sha256(path))
            ):
                continue
            problems.append(f"{path} is not the file that {MANIFEST} lists")
        except DamagedFileError as error:
            problems.append(str(error))
        path.unlink()
    return problems


def _is_finished(
    work: _Work, folder: Path, dataset: str, manifest: Manifest | None, present: set[str] | None, index: int
) -> bool:
    """Whether a shard is finished. Its files are verified, behind a URL only for a repair."""
    shard = records.shard_manifest(folder, dataset, manifest, index, work.collection.num_shards)
    if isinstance(work.target, Remote) and present is not None:
        lacking = [name for name in work.names(index)[:2] if name not in present]
        if shard is None or len(lacking) == 2:
            return False
        if lacking:
            raise DamagedFileError(f"{work.target.url}/{lacking[0]} is missing: {records.remedy(folder)}.")
        if work.repair:
            work.target.get(folder, shard.files)
            try:
                verify(folder, shard, "it is made again", listing=work.names(index)[2])
            finally:
                for name in shard.files:
                    (folder / name).unlink()
        return True
    if shard is None or not any((folder / name).exists() for name in shard.files):
        delete_partial(folder, f"shard-{index:05d}-of-")  # of a killed process
        return False
    verify(folder, shard, records.remedy(folder), listing=work.names(index)[2] if shard.facts else MANIFEST)
    return True


def _delete_shard(work: _Work, folder: Path, present: set[str] | None, index: int) -> None:
    """Delete the files of a shard, its manifest first."""
    for name in reversed(work.names(index)):
        if isinstance(work.target, Remote) and name in (present or ()):
            work.target.delete([name])
        (folder / name).unlink(missing_ok=True)


class _Report:
    """The progress of several threads in the shards of this process, for the function of the caller."""

    def __init__(self, work: _Work, missing: list[int]) -> None:
        self._plan = {index: planned(work.collection, index) for index in work.own}
        self._total = [sum(numbers) for numbers in zip(*self._plan.values(), strict=True)]
        self._sum = self._total.copy()
        self._done = dict(self._plan)
        self._progress, self._lock = work.progress, threading.Lock()
        for index in missing:
            self._note(index, (0, 0))
        if self._progress is not None:
            self._progress(Progress(*self._sum, *self._total))

    def trajectories(self, index: int, done: int) -> None:
        """Report the number of simulated trajectories of a shard."""
        self._tell(index, (done, 0))

    def frames(self, index: int, done: int) -> None:
        """Report the number of rendered frames and views of a shard, whose trajectories are all simulated."""
        self._tell(index, (self._plan[index][0], done))

    def finished(self, index: int) -> None:
        """Report that a shard is finished. It may have less than was planned, because objects may be left out."""
        self._tell(index, self._plan[index])

    def _tell(self, index: int, done: tuple[int, int]) -> None:
        if self._progress is not None:
            with self._lock:
                self._note(index, done)
                self._progress(Progress(*self._sum, *self._total))

    def _note(self, index: int, done: tuple[int, int]) -> None:
        self._sum = [number + new - old for number, new, old in zip(self._sum, done, self._done[index], strict=True)]
        self._done[index] = done


def _make(work: _Work, folder: Path, dataset: str, missing: list[int]) -> None:
    """Make shards, in this process or on a cluster."""
    if not missing:
        return
    report = _Report(work, missing)
    if work.cluster is not None:
        for index in cluster.make_shards(work.cluster, work.collection, work.sensor, work.target, dataset, missing):
            report.finished(index)
        return
    try:
        for index, simulated in _simulated(work, missing, report):
            rendered = functools.partial(report.frames, index)
            write_shard(work.collection, work.sensor, work.target, dataset, index, simulated, rendered)
            report.finished(index)
    except ValueError as error:
        raise ValueError(f"{folder}: {error}") from error


def _simulated(work: _Work, missing: list[int], report: _Report) -> Iterator[tuple[int, Simulated]]:
    """Simulate shards, each while the caller renders and writes the one before."""

    def begin(index: int) -> concurrent.futures.Future[Simulated]:
        return pool.submit(
            simulate_shard, work.collection, work.sensor, index, functools.partial(report.trajectories, index)
        )

    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        ahead = begin(missing[0])
        for place, index in enumerate(missing):
            simulated = ahead.result()
            if place + 1 < len(missing):
                ahead = begin(missing[place + 1])
            yield index, simulated


def _complete(work: _Work, folder: Path, dataset: str, manifest: Manifest | None) -> dict[int, Manifest]:
    """Write what describes the whole dataset, the manifest last, if all shards are finished.

    Returns:
        The manifests of all finished shards, by index.
    """
    count = work.collection.num_shards
    if isinstance(work.target, Remote):
        names = [records.sidecar(index, count) for index in range(count)]
        ready = work.target.names().intersection(names)
        work.target.get(folder, sorted(name for name in ready if not (folder / name).exists()))
    shards = {}
    for index in range(count):
        if (shard := records.shard_manifest(folder, dataset, manifest, index, count)) is not None:
            shards[index] = shard
    if unfinished := [index for index in work.own if index not in shards]:
        raise FileNotFoundError(
            f"{folder / records.sidecar(unfinished[0], count)} is missing, but a worker of {work.cluster} made it: "
            "give a folder that all workers share, or a URL"
        )
    if len(shards) < count:
        return shards
    files = checksums(folder, records.DESCRIPTIONS)
    for shard in shards.values():
        files |= shard.files
    if manifest is not None and manifest.files == files:
        delete_partial(folder)  # of killed processes
        return shards
    delete_partial(folder, "shard-")
    _write_card(work, folder)
    write_manifest(folder, files, {"shards": count})
    if isinstance(work.target, Remote):
        work.target.put(folder, [MANIFEST])
    return shards


def _write_card(work: _Work, folder: Path) -> None:
    """Write the data card of a dataset that has none. The manifest does not list it, so that its owner can edit it."""
    if CARD in (work.target.names() if isinstance(work.target, Remote) else os.listdir(folder)):
        return
    split, tables = split_objects(work.collection), _tables(work, folder)
    text = card(work.collection, work.sensor, split, tables, version=importlib.metadata.version("sts_jax"))
    write_bytes(folder / CARD, text.encode())
    if isinstance(work.target, Remote):
        work.target.put(folder, [CARD])


def _tables(work: _Work, folder: Path) -> Iterator[dict[str, np.ndarray]]:
    """The arrays of each shard, one after another, so that only one is in memory and on the local disk."""
    for index in range(work.collection.num_shards):
        path = folder / work.names(index)[1]
        if isinstance(work.target, Remote):
            work.target.get(folder, [path.name])
        yield read_arrays(path, records.remedy(folder))
        if isinstance(work.target, Remote):
            path.unlink()
