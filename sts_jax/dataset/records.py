"""The files of a dataset: shards, and the manifest that lists them.

A file is written as a whole or not at all, and the same inputs give the same bytes. `NAME.array_record` has one record
per rendered frame: the visual image, the tactile image (`uint8`, `(height, width, 3)`) and the segmentation (bits), in
that order, and then one record per view. `NAME.npz` has all other data of the shard as named arrays. `NAME.json`, which
is written last, is a manifest of these two files: a shard without it counts as missing.

`manifest.json` is written when all shards are finished. It lists both files of every shard, and the descriptions. In
older datasets it grew with every shard, and the shards had no manifests of their own.
"""

import dataclasses
import threading
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import pydantic
from array_record.python.array_record_module import ArrayRecordReader, ArrayRecordWriter

from sts_jax.storage import (
    MANIFEST,
    DamagedFileError,
    Manifest,
    checksums,
    read_json,
    read_manifest,
    write_manifest,
    write_whole,
)

FORMAT = 6  # format of a dataset's files, incremented when older files can no longer be read
DESCRIPTIONS = ("collection.json", "sensor.json", "split.json")
# One record per group, because a read decompresses the whole group.
WRITER_OPTIONS = "group_size:1,zstd:3"
# For random access: twice as fast as the defaults, which read ahead.
READER_OPTIONS, READER_BUFFER = "readahead_buffer_size:0,max_parallelism:0", 2**15


@dataclasses.dataclass(frozen=True)
class _Facts:
    """The facts in the manifest of a dataset."""

    shards: Annotated[int, pydantic.Field(ge=1)]


class Images(NamedTuple):
    """The images of n rendered frames, as a dataset stores them."""

    visual: np.ndarray  # uint8 (n, height, width, 3)
    tactile: np.ndarray  # uint8 (n, height, width, 3)
    segmentation: np.ndarray  # bool (n, height, width)


@dataclasses.dataclass(frozen=True)
class _ShardFacts:
    """The facts in the manifest of a shard."""

    dataset: str  # digest of the checksums of the descriptions
    resampled: Annotated[int, pydantic.Field(ge=0)]  # number of trajectories that were discarded and sampled again
    left_out: tuple[str, ...]  # one line for each object that the shard lacks


def shard_files(index: int, count: int) -> tuple[str, str]:
    """Names of the image file and the array file of a shard."""
    name = f"shard-{index:05d}-of-{count:05d}"
    return f"{name}.array_record", f"{name}.npz"


def all_files(index: int, count: int) -> tuple[str, str, str]:
    """Names of all files of a shard, in the order in which they are written."""
    return *shard_files(index, count), sidecar(index, count)


def sidecar(index: int, count: int) -> str:
    """Name of the manifest of a shard."""
    return f"shard-{index:05d}-of-{count:05d}.json"


def remedy(folder: Path) -> str:
    """The remedy for a damaged file of a dataset."""
    return (
        f"restore it, or delete it (of a shard all files) and collect into {folder} again, which makes only what is "
        "missing"
    )


def finish_shard(folder: Path, dataset: str, index: int, count: int, arrays: dict[str, np.ndarray]) -> None:
    """Write the manifest of a shard, whose two files are written already.

    Args:
        dataset: Digest of the checksums of the descriptions.
        arrays: The arrays of the shard.
    """
    facts = {
        "dataset": dataset,
        "resampled": int(arrays["trajectory/resampled"].sum()),
        "left_out": arrays["left_out"].tolist(),
    }
    write_manifest(folder, checksums(folder, shard_files(index, count)), facts, name=sidecar(index, count))


def shard_manifest(folder: Path, dataset: str, manifest: Manifest | None, index: int, count: int) -> Manifest | None:
    """The manifest of a finished shard, or None if the shard is not finished.

    Args:
        dataset: As in `finish_shard`.
        manifest: The manifest of the dataset. It lists shards that have no manifest of their own, without facts.
    """
    files, name = shard_files(index, count), sidecar(index, count)
    shard = read_manifest(folder, remedy(folder), _ShardFacts, name=name)
    if shard is not None:
        if tuple(shard.files) != files or shard.facts["dataset"] != dataset:
            raise DamagedFileError(f"{folder / name} is that of another shard or dataset: {remedy(folder)}.")
        return shard
    if manifest is not None and all(file in manifest.files for file in files):
        return Manifest({file: manifest.files[file] for file in files}, {})
    return None


def manifest_of(folder: Path) -> Manifest | None:
    """The manifest of a dataset that this version of the library can read, or None if nothing was collected."""
    path = folder / "collection.json"
    if path.exists():
        content = read_json(path, remedy(folder))
        written = content.get("format", 1) if isinstance(content, dict) else None  # the first format had no number
        if written != FORMAT:
            raise ValueError(
                f"{path} is of a dataset of format {written!r}, but this version of sts_jax reads format {FORMAT}: "
                "collect into another folder, or read this one with the version that wrote it."
            )
    manifest = read_manifest(folder, f"restore it, or collect into another folder than {folder}", _Facts)
    several = any(folder.glob(".lock-*-of-*"))  # processes, of which each may be between the files of a shard
    finished = manifest is not None or any(folder.glob("shard-*.json"))
    if not finished and not several and len(list(folder.glob("shard-*.npz"))) > 1:
        # A process that is killed leaves at most one finished pair of files without a manifest.
        raise DamagedFileError(
            f"{folder / MANIFEST} is missing, but {folder} has shards: restore it, or collect into another folder."
        )
    return manifest


def write_images(path: Path, frames: Iterable[tuple[np.ndarray, ...]]) -> None:
    """Write batches of images, each a tuple of arrays `(n, ...)` such as `Images`, to an array_record file."""

    def write(temporary: Path) -> None:
        writer = _or_os_error(ArrayRecordWriter, str(temporary), WRITER_OPTIONS)
        for batch in frames:
            for images in zip(*batch, strict=True):
                record = [np.packbits(image) if image.dtype == bool else image for image in images]
                _or_os_error(writer.write, b"".join(image.tobytes() for image in record))
        _or_os_error(writer.close)

    write_whole(path, write)


def _or_os_error(call: Callable[..., Any], *args: Any) -> Any:
    """Call array_record, and turn the RuntimeError or ValueError that it raises on a full disk into an OSError."""
    try:
        return call(*args)
    except (RuntimeError, ValueError) as error:
        raise OSError(str(error)) from error


class Shard:
    """The open image file of a shard, for one or several threads."""

    def __init__(self, path: Path, *, resolution: tuple[int, int], total: int) -> None:
        """Open a file that must contain `total` records. A truncated file may open without an error otherwise."""
        if not path.is_file():
            raise FileNotFoundError(f"{path} is missing: {remedy(path.parent)}.")
        path.open("rb").close()  # its error, such as too many open files, would otherwise look like damage
        self._path, self._resolution, self._lock = path, resolution, threading.Lock()
        try:
            self._reader = ArrayRecordReader(str(path), READER_OPTIONS, file_reader_buffer_size=READER_BUFFER)
            count = self._reader.num_records()
        except (RuntimeError, ValueError, IndexError) as error:
            raise self._damaged(error) from error
        if count != total:
            raise self._damaged(f"it has {count} records, but should have {total}")

    def images(self, indices: np.ndarray) -> Images:
        """Read some frames, in the order of the indices of their records, int `(n,)`."""
        height, width = self._resolution
        size = height * width * 3
        data = self._records(indices, 2 * size + -(-height * width // 8))
        return Images(
            visual=data[:, :size].reshape(-1, height, width, 3),
            tactile=data[:, size : 2 * size].reshape(-1, height, width, 3),
            segmentation=np.unpackbits(data[:, 2 * size :], axis=1, count=height * width)
            .reshape(-1, height, width)
            .view(bool),
        )

    def views(self, indices: np.ndarray) -> np.ndarray:
        """Read some views as uint8 `(n, height, width, 3)`, like `images`."""
        height, width = self._resolution
        return self._records(indices, 3 * height * width).reshape(-1, height, width, 3)

    def _records(self, indices: np.ndarray, length: int) -> np.ndarray:
        """Read some records of equal length, `uint8 (n, length)`."""
        try:
            with self._lock:
                records = self._reader.read(indices.tolist()) if len(indices) else []
        except (RuntimeError, ValueError, IndexError) as error:
            raise self._damaged(error) from error
        if any(len(record) != length for record in records):
            raise self._damaged(f"a record does not have {length} bytes")
        return np.frombuffer(b"".join(records), np.uint8).reshape(len(records), -1)

    def _damaged(self, problem: object) -> DamagedFileError:
        return DamagedFileError(f"{self._path} is damaged ({problem}): {remedy(self._path.parent)}.")
