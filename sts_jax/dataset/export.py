"""Export of datasets to the formats of other programs: LeRobot, Open-X-Tactile, Parquet, and PNG files with a table.

One trajectory is one episode. The episodes have the order of the parts of the split: training, validation, test. Only
a few images and the trajectories of one shard are in memory at a time. [Datasets](../datasets.md) describes the fields.
"""

import concurrent.futures
import csv
import dataclasses
import importlib.util
import json
import math
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import cv2
import numpy as np

from sts_jax import physics
from sts_jax._devices import cores
from sts_jax.dataset.card import CARD
from sts_jax.dataset.collection import PARTS
from sts_jax.dataset.items import frame_fields, trajectory_fields
from sts_jax.dataset.loading import Dataset, load
from sts_jax.dataset.records import Shard
from sts_jax.dataset.remote import Remote, local_copy, local_or_remote
from sts_jax.physics.scenario import in_words
from sts_jax.storage import DamagedFileError, lock, read_json, remedy, write_json

Frames = Literal["all", "ends"]
RECORD = "export.json"  # file of a finished export that tells where its data comes from
STREAMS = ("visual", "tactile")
# names of the numbers of a vector. Those of others are x, y and z
_NUMBERS = {
    "pose": ("x", "y", "z", "qw", "qx", "qy", "qz"),
    "velocity": ("x", "y", "z", "angular_x", "angular_y", "angular_z"),
    "wrench": ("force_x", "force_y", "force_z", "moment_x", "moment_y", "moment_z"),
}
_BATCH = 2**25  # bytes of images that are read at once
_ROW_GROUP = 2**24  # bytes of encoded images in one row group of a Parquet file
_FILE = 100 * 2**20  # bytes of encoded images in one Parquet file, as in LeRobot
_CHUNK = 2**20  # bytes of one chunk of a Zarr array, before compression
_SAMPLE = 2**14  # most frames from which quantiles are computed
_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
_FILES_PER_CHUNK = 1000  # files in one folder of LeRobot
_EPISODES = 500  # episodes in one row group of LeRobot's table of episodes
_INSTRUCTION, _WORD = 100, 64  # characters of an instruction of Open-X-Tactile, and of a class or outcome


class Progress(NamedTuple):
    """Progress of an export."""

    done: int  # finished frames
    total: int  # all frames


class Exported(NamedTuple):
    """What an export has."""

    trajectories: int  # number of exported trajectories
    frames: int  # number of exported frames
    left_out: int  # number of trajectories with images that are left out: images of some of their frames are not stored


class _Step(NamedTuple):
    """The trajectories of one shard in one part of the split."""

    part: str
    shard: int
    before: int  # number of trajectories of the dataset in the shards before. Objects that cannot be made are absent


class _Job(NamedTuple):
    """What is exported."""

    folder: Path  # folder of the dataset
    frames: Frames
    steps: list[_Step]  # in the order of the export
    exported: Exported
    task: str  # name of the scenario
    rate: float  # frames per second
    identity: str  # of the dataset
    progress: Callable[[Progress], None] | None


class _Batch(NamedTuple):
    """Successive frames of one episode."""

    part: str
    starts: bool  # true for the first batch of an episode
    values: dict[str, np.ndarray]  # all fields but the images by name, (n, *shape) each
    images: dict[str, np.ndarray]  # uint8 (n, height, width, 3), by stream


def to_lerobot(
    folder: str | Path, target: Path, *, frames: Frames = "all", progress: Callable[[Progress], None] | None = None
) -> Exported:
    """Export a dataset to a folder in the format of LeRobotDataset v3.0, with images as PNG files inside Parquet.

    Needs the extra `export`. The poses are `observation.state`. There are no actions.

    Args:
        folder: Folder or URL of a finished dataset, as for `dataset.load`.
        target: Folder of the export. If it exists, it must have the same export already.
        frames: "all" exports the trajectories with images of all frames, and "ends" the first and the last frames of
            all trajectories with images.
        progress: Called when some frames are finished.
    """
    _need("pyarrow")
    return _exported("lerobot", _lerobot, folder, target, frames, progress)


def to_oxt(
    folder: str | Path, target: Path, *, frames: Frames = "all", progress: Callable[[Progress], None] | None = None
) -> Exported:
    """Export a dataset in the Zarr format (version 2) of Open-X-Tactile and FTP-1. Arguments as for `to_lerobot`.

    The part `train` of a dataset of free falls becomes `train/freefall.zarr`, and so on.
    """
    _need("zarr")
    return _exported("oxt", _oxt, folder, target, frames, progress)


def to_parquet(
    folder: str | Path, target: Path, *, frames: Frames = "all", progress: Callable[[Progress], None] | None = None
) -> Exported:
    """Export a dataset to Parquet files for `datasets.load_dataset`. Arguments as for `to_lerobot`."""
    _need("pyarrow")
    return _exported("parquet", _parquet, folder, target, frames, progress)


def to_png(
    folder: str | Path, target: Path, *, frames: Frames = "all", progress: Callable[[Progress], None] | None = None
) -> Exported:
    """Export a dataset to PNG files and the table `frames.csv`. Arguments as for `to_lerobot`."""
    return _exported("png", _png, folder, target, frames, progress)


FORMATS = {"lerobot": to_lerobot, "oxt": to_oxt, "parquet": to_parquet, "png": to_png}


def _need(package: str) -> None:
    """Raise an ImportError if a package is not installed."""
    if importlib.util.find_spec(package) is None:
        raise ImportError(f"this export needs the package {package}: pip install {package}")


def _exported(
    name: str,
    write: Callable[[Path, _Job], None],
    folder: str | Path,
    target: Path,
    frames: Frames,
    progress: Callable[[Progress], None] | None,
) -> Exported:
    """Write an export into a folder with another name, and rename it when it is complete."""
    place, target = local_or_remote(folder), Path(target).absolute()
    taken = target.exists() and (not target.is_dir() or any(target.iterdir()))
    if taken and not (target / RECORD).exists():
        raise FileExistsError(f"{target} exists, and is no finished export: choose another folder, or delete it.")
    job = _planned(local_copy(place) if isinstance(place, Remote) else place, frames, progress)
    record = {"format": name, "frames": frames, "dataset": job.identity}
    if taken:
        if read_json(target / RECORD, "choose another folder") != record:
            raise FileExistsError(f"{target} has another export: choose another folder, or delete it.")
        return job.exported
    partial = target.with_name(f".{target.name}.partial")
    with lock(partial):  # a second process is refused, and what a killed one has left is deleted
        try:
            for path in partial.iterdir():
                if path.is_dir():
                    shutil.rmtree(path)
            write(partial, job)
            if (job.folder / CARD).exists():
                shutil.copyfile(job.folder / CARD, partial / CARD)
            write_json(partial / RECORD, record)
            os.sync()
            if target.exists():
                target.rmdir()
            partial.rename(target)
        except DamagedFileError:
            raise
        except OSError as error:
            raise OSError(
                error.errno, f"cannot write {target}: {error.strerror or error}. {remedy(error)}, then start again."
            ) from error
        finally:
            for left in (target / ".lock", target / ".lock-owner"):
                left.unlink(missing_ok=True)
            shutil.rmtree(partial, ignore_errors=True)
    return job.exported


def _planned(folder: Path, frames: Frames, progress: Callable[[Progress], None] | None) -> _Job:
    """Verify the dataset, and list what is exported."""
    if frames not in get_args(Frames):
        raise ValueError(f"frames must be 'all' or 'ends', got {frames!r}")
    data = load(folder, shards=[0])
    folder = data.shards[0].parent  # a work directory has its dataset and the card in a folder below
    count = math.ceil(data.collection["num_objects"] / data.collection["objects_per_shard"])
    time, ends = data.trajectory["time"][0], _frames(data, frames)
    seconds = float(time[ends[-1]]) / max(len(ends) - 1, 1)
    steps, trajectories, left_out, before = [], 0, 0, 0
    for shard in range(count):
        data = load(folder, shards=[shard]) if shard else data
        members = {part: chosen for part, chosen in _members(data, frames).items() if len(chosen)}
        steps += [_Step(part, shard, before) for part in members]
        trajectories += sum(map(len, members.values()))
        left_out += len(data.rendered()) - sum(map(len, members.values()))
        before += len(data.trajectory["outcome"])
    if not steps:
        raise ValueError(
            f"{folder} has no trajectory with images of all frames: use frames='ends' (--frames ends), or collect with "
            "a larger num_full"
        )
    return _Job(
        folder=folder,
        frames=frames,
        steps=sorted(steps, key=lambda step: PARTS.index(step.part)),
        exported=Exported(trajectories, trajectories * len(ends), left_out),
        task=data.collection["scenario"]["name"].lower(),
        rate=float(f"{1 / seconds:.6g}") if seconds else 1.0,
        identity=data.identity,
        progress=progress,
    )


def _frames(data: Dataset, frames: Frames) -> np.ndarray:
    """Indices of the frames that are exported of each trajectory."""
    count = data.trajectory["time"].shape[1]
    return np.arange(count) if frames == "all" else np.unique([0, count - 1])


def _members(data: Dataset, frames: Frames) -> dict[str, np.ndarray]:
    """Indices of the trajectories of each part that have the images."""
    chosen = data.full_trajectories() if frames == "all" else data.rendered()
    return {part: chosen[np.isin(chosen, data.members(part))] for part in PARTS}


def _batches(job: _Job) -> Iterator[_Batch]:
    """Read the frames of all episodes in order."""
    done, episode = 0, 0
    for step in job.steps:
        data = load(job.folder, shards=[step.shard])
        height, width = data.collection["resolution"]
        size = max(1, _BATCH // (6 * height * width))
        frames, opened = _frames(data, job.frames), dict[int, Shard]()
        for trajectory in _members(data, job.frames)[step.part].tolist():
            constants = trajectory_fields(data, trajectory)
            constants |= _words(data, constants) | {"trajectory": np.array(step.before + trajectory)}
            constants |= {"episode_index": np.array(episode), "split": np.array(step.part), "task": np.array(job.task)}
            for start in range(0, len(frames), size):
                some = frames[start : start + size]
                values = frame_fields(data, trajectory, some) | {"frame_index": start + np.arange(len(some))}
                values |= {name: np.broadcast_to(x, (len(some), *x.shape)) for name, x in constants.items()}
                values = {"timestamp": values.pop("time"), **values}
                images = data.images(data.stored(np.full_like(some, trajectory), some), opened=opened)
                yield _Batch(step.part, start == 0, values, {name: getattr(images, name) for name in STREAMS})
                done += len(some)
                if job.progress is not None:
                    job.progress(Progress(done, job.exported.frames))
            episode += 1


def _words(data: Dataset, fields: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The class of the object and the outcome in words, and the quantities of the condition, instead of `condition`."""
    meshes, categories = data.collection["meshes"], data.collection["categories"]
    index, number = int(fields["object"]), int(fields["outcome"])
    label = meshes["labels"][index] if meshes else categories[index % len(categories)]
    known = {int(outcome): in_words(outcome) for outcome in physics.Outcome}
    words = {"class": np.array(label), "outcome_name": np.array(known.get(number, str(number)))}
    condition, start = fields.pop("condition"), 0
    # The description of a dataset has the name of a scenario, but not the code of one that a user has written, whose
    # name may be that of another class.
    stored = data.collection["scenario"]
    library = (physics.Freefall, physics.Inclined, physics.Perturbed, physics.Released)
    scenario = next((kind for kind in library if kind.__name__ == stored["name"]), None)
    if scenario is None or not {*stored} <= {"name", *(field.name for field in dataclasses.fields(scenario))}:
        return words | ({"condition": condition} if len(condition) else {})
    for quantity in scenario.quantities:
        stop = start + 1 + quantity.vector
        words[f"condition.{quantity.name.replace(' ', '_')}"] = (
            condition[start:stop] if quantity.vector else condition[start]
        )
        start = stop
    return words | ({"condition": condition[start:]} if start < len(condition) else {})


def _numbers(name: str, x: np.ndarray) -> list[str]:
    """Names of the numbers in each row of a field."""
    if x.ndim == 1:
        return [name]
    known = _NUMBERS.get(name, ("x", "y", "z"))
    return [*known[: x.shape[1]]] if x.shape[1] <= len(known) else [str(i) for i in range(x.shape[1])]


def _encoded(images: np.ndarray) -> list[bytes]:
    """Encode images (n, height, width, 3) as PNG files."""
    with concurrent.futures.ThreadPoolExecutor(cores()) as pool:
        return list(pool.map(lambda image: cv2.imencode(".png", image[..., ::-1])[1].tobytes(), images))


def _png(folder: Path, job: _Job) -> None:
    with (folder / "frames.csv").open("w", newline="") as file:
        writer = None
        for batch in _batches(job):
            paths: dict[str, list[str]] = {stream: [] for stream in STREAMS}
            for stream in STREAMS:
                for i, data in enumerate(_encoded(batch.images[stream])):
                    episode, frame = (int(batch.values[name][i]) for name in ("episode_index", "frame"))
                    path = Path(batch.part, f"{episode:06d}", f"{frame:03d}-{stream}.png")
                    (folder / path).parent.mkdir(parents=True, exist_ok=True)
                    (folder / path).write_bytes(data)
                    paths[stream].append(path.as_posix())
            columns: dict[str, Any] = dict(paths)
            for name, x in batch.values.items():
                names = [name] if x.ndim == 1 else [f"{name}.{number}" for number in _numbers(name, x)]
                columns |= dict(zip(names, x.reshape(len(x), -1).T, strict=True))
            if writer is None:
                writer = csv.writer(file)
                writer.writerow(columns)
            writer.writerows(zip(*columns.values(), strict=True))


class _ParquetFiles:
    """Parquet files of limited size. An episode is in one file."""

    def __init__(self, folder: Path, name: str) -> None:
        """Write to a folder, to files whose names have their index or the numbers of `_numbered`."""
        self._folder, self._name, self.index = folder, name, -1
        self._writer: Any = None
        self._tables: list[Any] = []
        self._size = self._pending = 0

    def index_of(self, size: int) -> int:
        """Index of the file that the first rows of the next episode go to, with `size` bytes of images."""
        return self.index + (self._writer is None or self._size + size > _FILE)

    def add(self, table: Any, size: int, starts: bool) -> None:
        """Append rows with `size` bytes of images. A new file may begin if the rows start an episode."""
        import pyarrow.parquet as pq

        if self._writer is None or (starts and self.index_of(size) > self.index):
            self.close()
            self.index += 1
            path = self._folder / self._name.format(index=self.index, **_numbered("", self.index))
            path.parent.mkdir(parents=True, exist_ok=True)
            texts = [field.name for field in table.schema if str(field.type) == "string"]
            self._writer = pq.ParquetWriter(path, table.schema, compression="snappy", use_dictionary=texts)
        self._tables.append(table)
        self._size, self._pending = self._size + size, self._pending + size
        if self._pending > _ROW_GROUP:
            self._flush()

    def _flush(self) -> None:
        import pyarrow as pa

        if self._tables:
            self._writer.write_table(pa.concat_tables(self._tables))
        self._tables, self._pending = [], 0

    def close(self) -> None:
        """Complete the current file."""
        if self._writer is not None:
            self._flush()
            self._writer.close()
            self._writer, self._size = None, 0


def _table(png: dict[str, list[bytes]], values: dict[str, np.ndarray]) -> Any:
    """A table of Arrow with the description of its fields that the package `datasets` reads, images included."""
    import pyarrow as pa

    columns: dict[str, Any] = {}
    features: dict[str, Any] = {}
    for name, images in png.items():
        paths = [f"{frame:03d}-{name.rpartition('.')[2]}.png" for frame in values["frame"].tolist()]
        parts = pa.array(images, pa.binary()), pa.array(paths)
        columns[name], features[name] = pa.StructArray.from_arrays(parts, ["bytes", "path"]), {"_type": "Image"}
    for name, x in values.items():
        kind, flat = "string" if x.dtype.kind == "U" else x.dtype.name, np.ascontiguousarray(x).ravel()
        columns[name] = pa.array(flat.tolist() if kind == "string" else flat)
        features[name] = {"dtype": kind, "_type": "Value"}
        if x.ndim == 2:
            columns[name] = pa.FixedSizeListArray.from_arrays(columns[name], x.shape[1])
            features[name] = {"feature": features[name], "length": x.shape[1], "_type": "Sequence"}
    return pa.table(columns, metadata={"huggingface": json.dumps({"info": {"features": features}})})


def _parquet(folder: Path, job: _Job) -> None:
    files: dict[str, _ParquetFiles] = {}
    for batch in _batches(job):
        if batch.part not in files:
            files[batch.part] = _ParquetFiles(folder / "data", f"{batch.part}-{{index:05d}}")
        images = {stream: _encoded(batch.images[stream]) for stream in STREAMS}
        size = sum(len(data) for stream in images.values() for data in stream)
        files[batch.part].add(_table(images, batch.values), size, batch.starts)
    for part, written in files.items():
        written.close()
        for i in range(written.index + 1):  # the number of files is known only now
            path = folder / "data" / f"{part}-{i:05d}"
            path.rename(path.with_name(f"{path.name}-of-{written.index + 1:05d}.parquet"))


def _lerobot(folder: Path, job: _Job) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    meta, chunk = folder / "meta", "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"

    data, episodes = _ParquetFiles(folder / "data", chunk), _ParquetFiles(meta / "episodes", chunk)
    features: dict[str, Any] = {}
    whole, episode, splits, index, rows = (
        _Statistics(),
        _Statistics(),
        dict[str, list[int]](),
        0,
        list[dict[str, Any]](),
    )

    def finish(episode: "_Statistics", row: dict[str, Any]) -> None:
        row |= {"dataset_to_index": index, "length": index - row["dataset_from_index"]}
        row |= {f"stats/{name}/{kind}": x for name, stats in episode.result().items() for kind, x in stats.items()}
        rows.append(row)
        if len(rows) == _EPISODES:
            flush()

    def flush() -> None:
        size = pa.Table.from_pylist(rows).nbytes  # of the numbers of the statistics
        place = _numbered("meta/episodes/", episodes.index_of(size))
        episodes.add(pa.Table.from_pylist([row | place for row in rows]), size, True)
        rows.clear()

    row: dict[str, Any] = {}
    for batch in _batches(job):
        values = {("observation.state" if name == "pose" else name): x for name, x in batch.values.items()}
        count, task = len(values["frame_index"]), str(values.pop("task")[0])
        values |= {"index": index + np.arange(count), "task_index": np.zeros(count, np.int64)}
        images = {f"observation.images.{stream}": batch.images[stream] for stream in STREAMS}
        png = {name: _encoded(x) for name, x in images.items()}
        if batch.starts:
            if row:
                finish(episode, row)
            row = {"episode_index": int(values["episode_index"][0]), "tasks": [task], "dataset_from_index": index}
            episode = _Statistics()
            splits.setdefault(batch.part, [row["episode_index"]] * 2)[1] = row["episode_index"] + 1
        data.add(_table(png, values), sum(len(x) for some in png.values() for x in some), batch.starts)
        row |= _numbered("data/", data.index)
        for statistics in (episode, whole):
            statistics.add(values, images)
        index += count
        features = features or _features(values, images)
    finish(episode, row)
    if rows:
        flush()
    data.close()
    episodes.close()
    tasks = pa.table({"task_index": pa.array([0]), "task": [job.task]})
    kinds = (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    columns = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": stored, "metadata": None}
        for name, kind, stored in kinds
    ]
    # The reader is pandas, and the task must be the index of its table.
    pandas = {"index_columns": ["task"], "column_indexes": [], "columns": columns, "pandas_version": "2.0.0"}
    pq.write_table(tasks.replace_schema_metadata({"pandas": json.dumps(pandas)}), meta / "tasks.parquet")
    write_json(meta / "stats.json", whole.result())
    info = {
        "codebase_version": "v3.0",
        "robot_type": "sts",
        "total_episodes": row["episode_index"] + 1,
        "total_frames": index,
        "total_tasks": 1,
        "chunks_size": _FILES_PER_CHUNK,
        "data_files_size_in_mb": _FILE // 2**20,
        "video_files_size_in_mb": 200,
        "fps": int(job.rate) if job.rate.is_integer() else job.rate,
        "splits": {part: f"{start}:{stop}" for part, (start, stop) in splits.items()},
        "data_path": f"data/{chunk}",
        "video_path": None,
        "features": features,
    }
    write_json(meta / "info.json", info)


def _numbered(prefix: str, index: int) -> dict[str, int]:
    """Numbers of the chunk and of the file in the chunk of a file of LeRobot."""
    chunk, file = divmod(index, _FILES_PER_CHUNK)
    return {f"{prefix}chunk_index": chunk, f"{prefix}file_index": file}


def _features(values: dict[str, np.ndarray], images: dict[str, np.ndarray]) -> dict[str, Any]:
    """The entry `features` of `info.json`."""
    of_images = {
        name: {"dtype": "image", "shape": list(x.shape[1:]), "names": ["height", "width", "channels"]}
        for name, x in images.items()
    }
    return of_images | {
        name: {
            "dtype": "string" if x.dtype.kind == "U" else x.dtype.name,
            "shape": list(x.shape[1:]) or [1],
            "names": None if x.ndim == 1 else _numbers("pose" if name == "observation.state" else name, x),
        }
        for name, x in values.items()
    }


class _Statistics:
    """Statistics as LeRobot defines them: of each number of a vector, and of each colour over all pixels."""

    def __init__(self) -> None:
        self._histograms: dict[str, np.ndarray] = {}
        self._sums: dict[str, np.ndarray] = {}
        self._kept: dict[str, list[np.ndarray]] = {}
        self._count, self._stride = 0, 1

    def add(self, values: dict[str, np.ndarray], images: dict[str, np.ndarray]) -> None:
        """Add some frames."""
        for name, x in images.items():
            counts = np.stack([np.bincount(x[..., i].ravel(), minlength=256) for i in range(3)])
            self._histograms[name] = self._histograms.get(name, 0) + counts
        rows = (self._count + np.arange(len(values["index"]))) % self._stride == 0
        for name, x in values.items():
            if x.dtype.kind == "U":
                continue
            x = x.reshape(len(x), -1).astype(np.float64)
            new = np.stack([x.min(0), -x.max(0), x.sum(0), (x**2).sum(0)])
            old = self._sums.get(name)
            self._sums[name] = new if old is None else np.concatenate([np.minimum(new, old)[:2], (new + old)[2:]])
            self._kept.setdefault(name, []).append(x[rows])
        self._count += len(rows)
        if sum(map(len, self._kept["index"])) > _SAMPLE:  # bounds the memory: every second one of the kept frames
            self._kept = {name: [np.concatenate(kept)[::2]] for name, kept in self._kept.items()}
            self._stride *= 2

    def result(self) -> dict[str, dict[str, Any]]:
        """The statistics by field. Quantiles of many frames are those of evenly spaced ones, except of images."""
        result: dict[str, dict[str, Any]] = {}
        for name, counts in self._histograms.items():
            levels, share = np.arange(256) / 255, counts / counts.sum(1, keepdims=True)
            mean = share @ levels
            statistics = {
                "min": levels[(counts > 0).argmax(1)],
                "max": levels[255 - (counts[:, ::-1] > 0).argmax(1)],
                "mean": mean,
                "std": np.sqrt((share * (levels - mean[:, None]) ** 2).sum(1)),
            }
            statistics |= {key: levels[(share.cumsum(1) < q - 1e-9).sum(1)] for key, q in _QUANTILES.items()}
            result[name] = {key: x.reshape(3, 1, 1).tolist() for key, x in statistics.items()}
        for name, (low, high, total, squares) in self._sums.items():
            mean = total / self._count
            statistics = {"min": low, "max": -high, "mean": mean}
            statistics["std"] = np.sqrt(np.maximum(squares / self._count - mean**2, 0))
            kept = np.concatenate(self._kept[name])
            statistics |= {key: np.quantile(kept, q, axis=0) for key, q in _QUANTILES.items()}
            result[name] = {key: x.tolist() for key, x in statistics.items()}
        return {name: statistics | {"count": [self._count]} for name, statistics in result.items()}


class _Growing:
    """Zarr arrays of one part of the split, to which rows are appended in whole chunks."""

    def __init__(self, path: Path, attributes: dict[str, Any]) -> None:
        import zarr

        self._group = zarr.open_group(path, mode="w", zarr_format=2, attributes=attributes)
        self._arrays: dict[str, Any] = {}
        self._pending: dict[str, list[np.ndarray]] = {}

    def add(self, name: str, x: np.ndarray) -> None:
        """Append rows `(n, *shape)` to an array."""
        from numcodecs import Blosc

        if name not in self._arrays:
            chunk = max(1, _CHUNK // x[0].nbytes)
            self._pending[name] = []
            self._arrays[name] = self._group.create_array(
                name,
                shape=(0, *x.shape[1:]),
                chunks=(chunk, *x.shape[1:]),
                dtype=x.dtype,
                compressors=Blosc("zstd", 3, Blosc.SHUFFLE),
            )
        pending, array = self._pending[name], self._arrays[name]
        pending.append(x)
        if sum(map(len, pending)) >= array.chunks[0]:
            self._append(name, sum(map(len, pending)) // array.chunks[0] * array.chunks[0])

    def _append(self, name: str, count: int) -> None:
        rows = np.concatenate(self._pending[name])
        self._arrays[name].append(rows[:count])
        self._pending[name] = [rows[count:]]

    def close(self) -> None:
        """Append the last rows."""
        for name, pending in self._pending.items():
            self._append(name, sum(map(len, pending)))


def _oxt(folder: Path, job: _Job) -> None:
    stores: dict[str, _Growing] = {}
    ends: dict[str, int] = {}
    for batch in _batches(job):
        if batch.part not in stores:
            path = folder / batch.part / f"{job.task}.zarr"
            stores[batch.part] = _Growing(path, {"fps": job.rate, "dataset": job.identity})
        store, count = stores[batch.part], len(batch.values["frame"])
        if batch.starts and batch.part in ends:
            store.add("meta/episode_ends", np.array([ends[batch.part]]))
        ends[batch.part] = ends.get(batch.part, 0) + count
        values = dict(batch.values)
        arrays = {
            "timestamps": values.pop("frame"),
            "sub_task_instruction": np.full(count, str(values.pop("task")[0]).ljust(_INSTRUCTION)),
            "camera_main_rgb": batch.images["visual"],
            "right_tactile_data_pad": batch.images["tactile"][:, None],
            "right_tactile_area_pad": np.zeros((count, 1), np.int64),
            "right_tactile_sensor_pad": np.full(count, "STS"),
            "right_tactile_type_pad": np.full(count, "image"),
        }
        for name in ("class", "outcome_name"):
            values[name] = values[name].astype(f"<U{_WORD}")
        for name, x in (arrays | values).items():
            store.add(f"data/{name}", np.ascontiguousarray(x))
    for part, store in stores.items():
        store.add("meta/episode_ends", np.array([ends[part]]))
        store.close()
