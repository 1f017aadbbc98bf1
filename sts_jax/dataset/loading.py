"""Loading of a dataset as arrays: trajectories, rendered images, and pairs of frames, by default the first and last."""

import concurrent.futures
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import numpy as np
import pydantic
from jaxtyping import Float, Int

from sts_jax import geometry, physics
from sts_jax._checked import check_arrays, in_32_bits
from sts_jax._devices import cores
from sts_jax.dataset import records
from sts_jax.dataset.measurement import Measurement, measured
from sts_jax.dataset.remote import Remote, local_copy, local_or_remote
from sts_jax.storage import (
    MANIFEST,
    DamagedFileError,
    Finite,
    decode,
    digest,
    read_arrays,
    read_fields,
    read_json,
    verify,
)

_OPEN = 128  # shards that are kept open. Many systems allow 256 or 1,024 open files per process


class Pairs(NamedTuple):
    """Two frames of each of n trajectories: by default the first and the last, or those of `frame`.

    In arrays of shape `(n, 2, ...)`, index 0 of the second axis is the earlier frame and index 1 is the later frame.
    """

    visual: np.ndarray  # uint8 (n, 2, height, width, 3): images of the visual stream
    tactile: np.ndarray  # uint8 (n, 2, height, width, 3): images of the tactile stream
    segmentation: np.ndarray  # bool (n, 2, height, width): pixels that show the object
    pose: np.ndarray  # float32 (n, 2, 7): mesh frame in the sensor frame, position (m) and quaternion
    contact: np.ndarray  # bool (n, 2): true if the pad pushes on the object
    condition: np.ndarray  # float32 (n, c): input of the scenario such as a jerk (SI units)
    outcome: np.ndarray  # int32 (n,): number of the outcome of the whole trajectory, one of `Scenario.outcomes`
    object: np.ndarray  # int32 (n,): index of the object in the collection
    trajectory: np.ndarray  # int64 (n,): index of the trajectory in the dataset
    support: np.ndarray  # float32 (n, 128): support function of the body (m), see `objects.support`
    mass: np.ndarray  # float32 (n,): mass of the object with its contents (kg)
    com: np.ndarray  # float32 (n, 3): centre of mass in the mesh frame (m)
    # (n, 2, *shape) each: the values of further modalities by name, uint8 or float32, NaN where not measured
    measurements: dict[str, np.ndarray] = {}  # noqa: RUF012 (never changed)
    frame: np.ndarray | None = None  # int64 (n, 2): indices of both frames in the trajectory (None: unknown)

    def take(self, rows: np.ndarray | slice) -> "Pairs":
        """Select trajectories by indices, a bool mask `(n,)`, or a slice such as `slice(10)`."""
        taken: Pairs = jax.tree.map(lambda leaf: leaf[rows], self)
        return taken


class Ends(NamedTuple):
    """First and last poses of n trajectories, without images."""

    pose: np.ndarray  # float32 (n, 2, 7): first and last pose, mesh frame in the sensor frame
    condition: np.ndarray  # float32 (n, c): input of the scenario such as a jerk (SI units)
    outcome: np.ndarray  # int32 (n,): number of the outcome, one of `Scenario.outcomes`
    support: np.ndarray  # float32 (n, 128): support function of the body (m), see `objects.support`
    mass: np.ndarray  # float32 (n,): mass of the object with its contents (kg)
    com: np.ndarray  # float32 (n, 3): centre of mass in the mesh frame (m)
    object: np.ndarray  # int64 (n,): index of the object in the collection
    trajectory: np.ndarray  # int64 (n,): index of the trajectory in the dataset


class Views(NamedTuple):
    """Views of a dataset, in memory."""

    visual: np.ndarray  # uint8 (m, height, width, 3): images of the visual stream
    pose: np.ndarray  # float32 (m, 7): mesh frame in the sensor frame, position (m) and quaternion
    support: np.ndarray  # float32 (m, 128): support function of the body (m), see `objects.support`
    mass: np.ndarray  # float32 (m,): mass of the object with its contents, which are drawn for each view (kg)
    com: np.ndarray  # float32 (m, 3): centre of mass in the mesh frame (m)
    object: np.ndarray  # int64 (m,): index of the object in the collection


def reduced(pairs: Pairs, size: int) -> Pairs:
    """Reduce the images of pairs as `reduced_images` does."""
    images = {"visual": pairs.visual, "tactile": pairs.tactile, "segmentation": pairs.segmentation[..., None]}
    small = reduced_images(images, size)
    return pairs._replace(visual=small["visual"], tactile=small["tactile"], segmentation=small["segmentation"][..., 0])


@in_32_bits
def reduced_images(images: dict[str, np.ndarray], size: int) -> dict[str, np.ndarray]:
    """Reduce square images `(*n, side, side, channels)` to `size` pixels, each the mean of a square block of pixels.

    A bool pixel is true if at least half of its block is true.
    """
    for image in images.values():
        height, width = image.shape[-3:-1]
        if height != width or size < 1 or height % size:
            raise ValueError(
                f"size is {size}, but the images are {height} x {width} pixels: the images must be square, with a side "
                "length that is a multiple of `size`"
            )
    return {name: _means(image, size) for name, image in images.items()}


def _means(images: np.ndarray, size: int) -> np.ndarray:
    """Means over blocks of pixels, rounded to the type of the images."""
    factor = images.shape[-2] // size
    # The smallest type that can hold the sum of a block. A sum of slices is many times as fast as `sum` over two axes.
    kind = np.min_scalar_type(256 * factor**2)
    total = np.full((*images.shape[:-3], size, size, images.shape[-1]), factor**2 // 2, kind)
    for row, column in np.ndindex(factor, factor):
        total += images[..., row::factor, column::factor, :]
    total //= kind.type(factor**2)
    return total.astype(images.dtype)


@dataclasses.dataclass(frozen=True)
class Dataset:
    """A dataset that `load` has opened: num trajectories in memory. Images are read on request."""

    collection: dict  # content of collection.json
    identity: str  # SHA-256 of the manifest, and thus of all collected data and of the split
    split: dict[str, np.ndarray]  # indices of the objects in each part: `train`, `validation` and `test`
    trajectory: dict[str, np.ndarray]  # fields of `physics.Trajectory` by name, each (num, ...)
    hidden: dict[str, np.ndarray]  # fields of `physics.Hidden` by name, each (num, ...)
    solid: dict[str, np.ndarray]  # `support`, `mass` and `com` of each trajectory as in `Pairs`, each (num, ...)
    view: dict[str, np.ndarray]  # `pose`, `body`, `support`, `mass` and `com` of each of the k views, each (k, ...)
    frames: np.ndarray  # int (m, 2): trajectory and frame of each stored frame, in the order of the shards
    shards: tuple[Path, ...]  # file of the images of each shard
    shard_of: np.ndarray  # int (m,): index of the shard of each stored frame
    record_of: np.ndarray  # int (m,): index of the record of each stored frame in its shard
    view_shard_of: np.ndarray  # int (k,): index of the shard of each view
    view_record_of: np.ndarray  # int (k,): index of the record of each view in its shard

    def __repr__(self) -> str:
        height, width = self.collection["resolution"]
        parts = ", ".join(f"{len(objects)} {part}" for part, objects in self.split.items())
        return (
            f"Dataset({self.collection['scenario']['name']}, {len(self.trajectory['outcome'])} trajectories of "
            f"{self.collection['num_objects']} objects ({parts}), {len(self.frames)} frames and "
            f"{len(self.view_shard_of)} views of {height} x {width} pixels)"
        )

    def images(self, rows: np.ndarray, *, opened: dict[int, records.Shard] | None = None) -> records.Images:
        """Read the images of stored frames.

        Args:
            rows: Int `(n,)`. Index i is the frame of `self.frames[i]`.
            opened: The shards that earlier calls with the same dictionary have opened, which makes small reads twice as
                fast. New ones are added, and of more than 128 the oldest ones are closed.
        """
        height, width = self.collection["resolution"]
        out = records.Images(
            np.empty((len(rows), height, width, 3), np.uint8),
            np.empty((len(rows), height, width, 3), np.uint8),
            np.empty((len(rows), height, width), bool),
        )

        def read(shard: int) -> None:
            here = np.flatnonzero(self.shard_of[rows] == shard)
            file = (opened or {}).get(shard) or self._opened(shard)
            if opened is not None:
                opened[shard] = file
                for oldest in list(opened)[:-_OPEN]:
                    opened.pop(oldest, None)
            for whole, piece in zip(out, file.images(self.record_of[rows[here]]), strict=True):
                whole[here] = piece

        needed = np.unique(self.shard_of[rows]).tolist()
        if len(needed) == 1:  # threads would take longer than the reading
            read(needed[0])
        else:
            with concurrent.futures.ThreadPoolExecutor(cores()) as pool:
                list(pool.map(read, needed))
        return out

    def _opened(self, shard: int) -> records.Shard:
        total = int((self.shard_of == shard).sum() + (self.view_shard_of == shard).sum())
        return records.Shard(self.shards[shard], resolution=tuple(self.collection["resolution"]), total=total)

    def rendered(self) -> np.ndarray:
        """Indices of the trajectories that have images."""
        return np.unique(self.frames[:, 0]).astype(np.int64)

    def full_trajectories(self) -> np.ndarray:
        """Indices of the trajectories that have images of every frame."""
        counts = np.bincount(self.frames[:, 0], minlength=len(self.trajectory["outcome"]))
        return np.flatnonzero(counts == self.trajectory["pose"].shape[1])

    def strip(self, trajectory: int) -> records.Images:
        """Read all stored images of one trajectory, in the order of time. See `full_trajectories`."""
        rows = np.flatnonzero(self.frames[:, 0] == trajectory)
        return self.images(rows[np.argsort(self.frames[rows, 1])])

    def members(self, part: str, *, rendered: bool = True) -> np.ndarray:
        """Indices of the trajectories of one part of the split.

        Args:
            part: `train`, `validation` or `test`.
            rendered: True to leave out trajectories without images, which `pairs` refuses and `ends` accepts.
        """
        members = np.flatnonzero(np.isin(self.trajectory["body"], self._part(part)))
        return members[np.isin(members, self.rendered())] if rendered else members

    def _part(self, part: str) -> np.ndarray:
        if part not in self.split:
            raise ValueError(f"unknown part {part!r} of the dataset: give one of {', '.join(self.split)}.")
        return self.split[part]

    def ends(self, trajectories: np.ndarray) -> Ends:
        """Return the first and last poses of trajectories, which need no images. `trajectories` is int `(n,)`."""
        index = self.checked(trajectories)
        return Ends(
            pose=self.trajectory["pose"][index][:, [0, -1]],
            condition=self.trajectory["condition"][index],
            outcome=self.trajectory["outcome"][index],
            support=self.solid["support"][index],
            mass=self.solid["mass"][index],
            com=self.solid["com"][index],
            object=self.trajectory["body"][index].astype(np.int64),
            trajectory=index,
        )

    def views(self, part: str) -> Views:
        """Read the views of one part of the split: `train`, `validation` or `test`. There may be none."""
        rows = np.flatnonzero(np.isin(self.view["body"], self._part(part)))
        height, width = self.collection["resolution"]
        visual = np.empty((len(rows), height, width, 3), np.uint8)
        for shard in np.unique(self.view_shard_of[rows]).tolist():
            here = np.flatnonzero(self.view_shard_of[rows] == shard)
            visual[here] = self._opened(shard).views(self.view_record_of[rows[here]])
        pose, support, mass, com = (self.view[name][rows] for name in ("pose", "support", "mass", "com"))
        return Views(visual, pose, support, mass, com, self.view["body"][rows].astype(np.int64))

    def checked(self, trajectories: Any) -> np.ndarray:
        """Return indices of trajectories as int64 `(n,)`, or raise a ValueError if one is invalid."""
        trajectories, count = np.asarray(trajectories), len(self.trajectory["outcome"])
        if trajectories.ndim != 1 or (trajectories.size and trajectories.dtype.kind not in "iu"):
            raise ValueError(
                f"`trajectories` has the type {trajectories.dtype} and the shape {trajectories.shape}, but it must be "
                "a list of indices: give np.flatnonzero(mask) for a mask."
            )
        outside = trajectories[(trajectories < 0) | (trajectories >= count)]
        if outside.size:
            raise ValueError(
                f"`trajectories` contains {outside[0]}, but the dataset has trajectories 0 to {count - 1}."
            )
        return trajectories.astype(np.int64)

    def stored(self, trajectories: np.ndarray, frames: np.ndarray) -> np.ndarray:
        """Indices into `self.frames` of frames of trajectories, for `images`. The arguments are int, of one shape."""
        place = np.full(self.trajectory["time"].shape, -1)
        place[self.frames[:, 0], self.frames[:, 1]] = np.arange(len(self.frames))
        rows = place[trajectories, frames]
        if (lacking := np.argwhere(rows < 0)).size:
            one = tuple(lacking[0])
            raise ValueError(
                f"trajectory {trajectories[one]} has no image of frame {frames[one]}: take trajectories from "
                "`full_trajectories`, or collect with a larger `num_full`."
            )
        return rows

    def steps(self, trajectories: np.ndarray, stride: int = 1) -> np.ndarray:
        """Rows (trajectory, t, t + stride) for every frame t of trajectories with images of all frames, int `(m, 3)`.

        Args:
            trajectories: Indices of the trajectories, int `(n,)`.
            stride: Number of frames from the first to the second frame of each row.
        """
        index, length = self.checked(trajectories), self.trajectory["time"].shape[1]
        if not isinstance(stride, int | np.integer) or not 1 <= stride < length:
            raise ValueError(
                f"stride is {stride!r}, but it must be a whole number from 1 to {length - 1}, because the trajectories "
                f"have {length} frames."
            )
        lacking = index[~np.isin(index, self.full_trajectories())]
        if lacking.size:
            raise ValueError(
                f"`trajectories` contains {lacking[0]}, of which not all frames are stored: take trajectories from "
                "`full_trajectories`, or collect with `num_full` as large as the number of trajectories."
            )
        first = np.arange(length - stride)
        return np.stack([x.ravel() for x in np.broadcast_arrays(index[:, None], first, first + stride)], axis=-1)

    def pairs(
        self,
        trajectories: np.ndarray,
        *,
        frames: Sequence[int | np.ndarray] = (0, -1),
        measurements: Sequence[Measurement] = (),
    ) -> Pairs:
        """Read two frames of each of n trajectories that have images.

        Args:
            trajectories: Indices of the trajectories, int `(n,)`.
            frames: The two frames, by default the first and the last: numbers for all trajectories, or int `(n,)`. A
                negative number counts from the end. Frames between the first and the last are stored for
                `full_trajectories` only.
            measurements: Further modalities to measure, for the first and last frames only.
        """
        index = self.checked(trajectories)
        without = index[~np.isin(index, self.rendered())]
        if without.size:
            raise ValueError(
                f"`trajectories` contains {without[0]}, which has no images: use `ends`, or take indices from "
                "`members` or `rendered`."
            )
        frame = self._frames(frames, len(index))
        if measurements and (frame != self._frames((0, -1), len(index))).any():
            raise ValueError(
                f"frames is {frames!r}, but measurements exist for the first and last frames only: leave out "
                "`measurements` or `frames`."
            )
        both = np.broadcast_to(index[:, None], frame.shape)
        images = [leaf.reshape(-1, 2, *leaf.shape[1:]) for leaf in self.images(self.stored(both, frame).ravel())]
        pose = self.trajectory["pose"][both, frame]
        return Pairs(
            visual=images[0],
            tactile=images[1],
            segmentation=images[2],
            pose=np.concatenate([pose[..., :3], geometry.quat_canonical(pose[..., 3:])], -1),
            contact=self.trajectory["contact"][both, frame],
            condition=self.trajectory["condition"][index],
            outcome=self.trajectory["outcome"][index],
            object=self.trajectory["body"][index],
            trajectory=index,
            support=self.solid["support"][index],
            mass=self.solid["mass"][index],
            com=self.solid["com"][index],
            measurements=measured(measurements, self, index),
            frame=frame,
        )

    def _frames(self, frames: Any, count: int) -> np.ndarray:
        """Return two frames of each trajectory as indices from 0, int64 `(count, 2)`, or raise a ValueError."""
        ends, length = [np.asarray(end) for end in frames], self.trajectory["time"].shape[1]
        if len(ends) != 2 or any(end.dtype.kind not in "iu" or end.shape not in ((), (count,)) for end in ends):
            raise ValueError(
                f"frames is {frames!r}, but it must be two whole numbers, or two lists of {count} whole numbers, one "
                "for each trajectory."
            )
        both = np.stack([np.broadcast_to(end, count) for end in ends], axis=-1).astype(np.int64)
        outside = both[(both < -length) | (both >= length)]
        if outside.size:
            raise ValueError(
                f"frames contains {outside[0]}, but the trajectories have the frames 0 to {length - 1}. A negative "
                "number counts from the end."
            )
        return both % length


def load(folder: str | Path, *, shards: Sequence[int] | None = None) -> Dataset:
    """Open and verify a dataset that `collect` has finished. The verification takes about 1 s per GB.

    Args:
        folder: Folder of the dataset, the work directory of an experiment, which has it in `dataset/`, or a URL such as
            `s3://bucket/falls`, of which a copy is kept in the folder `datasets` of `compilation.cache_folder`.
        shards: Indices of the shards to read and verify, for datasets of which not even the poses fit in memory. The
            trajectories are numbered from 0 in the first of them. None: all.

    Raises:
        FileNotFoundError: The folder has no dataset, or `collect` has not finished it.
        DamagedFileError: A file is damaged, or belongs to another dataset or shard. The message names the file.
    """
    place = local_or_remote(folder)
    folder = local_copy(place) if isinstance(place, Remote) else place
    if folder.is_file():
        raise NotADirectoryError(f"{folder} is a file: give the folder of a collected dataset.")
    if not (folder / "collection.json").exists() and (folder / "dataset" / "collection.json").exists():
        folder /= "dataset"
    manifest = records.manifest_of(folder)
    if manifest is None and (folder / "collection.json").exists():
        raise FileNotFoundError(
            f"{folder / MANIFEST} is missing: the collection is not finished. Call `collect` to continue it."
        )
    if manifest is None:
        raise FileNotFoundError(f"{folder} is not a collected dataset: give another folder, or call `collect`.")
    count = manifest.facts["shards"]
    if shards is not None and not len(shards):
        raise ValueError(f"shards is empty, but {folder} has the shards 0 to {count - 1}: name one or more")
    if any(not 0 <= index < count for index in shards or ()):
        raise ValueError(f"shards is {shards!r}, but {folder} has the shards 0 to {count - 1}")
    files = [records.shard_files(index, count) for index in (range(count) if shards is None else shards)]
    for name in (name for both in files for name in both if name not in manifest.files):
        raise FileNotFoundError(
            f"{folder / name} is missing: the collection is not finished. Call `collect` to continue it."
        )
    names = None if shards is None else [*records.DESCRIPTIONS, *(name for both in files for name in both)]
    verify(folder, manifest, records.remedy(folder), names)
    collection, split = _descriptions(folder)
    parts = [_table(folder / table, collection["num_objects"]) for _, table in files]
    starts = np.cumsum([0] + [len(part["trajectory/outcome"]) for part in parts])
    leaves = {key: np.concatenate([part[key] for part in parts]) for key in parts[0] if key != "frames"}
    sizes = [len(part["frames"]) for part in parts]
    views = [len(part["view/body"]) for part in parts]
    return Dataset(
        collection=collection,
        identity=digest(manifest._asdict()),
        split=split,
        **{
            group: {k.split("/")[1]: v for k, v in leaves.items() if k.startswith(f"{group}/")}
            for group in ("trajectory", "hidden", "solid", "view")
        },
        frames=np.concatenate([p["frames"] + np.array([s, 0]) for p, s in zip(parts, starts[:-1], strict=True)]),
        shards=tuple(folder / images for images, _ in files),
        shard_of=np.repeat(np.arange(len(files)), sizes),
        record_of=np.concatenate([np.arange(size) for size in sizes]),
        view_shard_of=np.repeat(np.arange(len(files)), views),
        view_record_of=np.concatenate([size + np.arange(k) for size, k in zip(sizes, views, strict=True)]),
    )


class _Solid(NamedTuple):
    support: Float[np.ndarray, "n 128"]
    mass: Float[np.ndarray, "n"]
    com: Float[np.ndarray, "n 3"]


class _Table(NamedTuple):
    """The arrays of the trajectories of a shard."""

    trajectory: physics.Trajectory
    solid: _Solid


class _ViewTable(NamedTuple):
    """The arrays of the views of a shard."""

    pose: Float[np.ndarray, "n 7"]
    body: Int[np.ndarray, "n"]
    support: Float[np.ndarray, "n 128"]
    mass: Float[np.ndarray, "n"]
    com: Float[np.ndarray, "n 3"]


def _table(path: Path, num_objects: int) -> dict[str, np.ndarray]:
    """Read and check the arrays of a shard."""
    arrays = read_arrays(path, records.remedy(path.parent))
    groups: dict[str, dict[str, np.ndarray]] = {"trajectory": {}, "view": {}}
    for name, values in arrays.items():
        group = "view" if name.startswith("view/") else "trajectory"
        if "/" in name:
            groups[group][name.removeprefix("view/").replace("hidden/", "trajectory/hidden/")] = values
    try:
        check_arrays(_Table, groups["trajectory"])
        check_arrays(_ViewTable, groups["view"])
        shape = arrays["trajectory/time"].shape
        for name, limits in (
            ("trajectory/body", num_objects),
            ("view/body", num_objects),
            ("frames", np.array(shape)),
        ):
            values = arrays[name]
            if values.dtype.kind not in "iu" or ((values < 0) | (values >= limits)).any():
                raise ValueError(f"array {name} has values that are no indices below {limits}")
    except (KeyError, ValueError) as error:
        raise DamagedFileError(
            f"{path} is not the table of a shard ({error}): {records.remedy(path.parent)}."
        ) from None
    return arrays


_Count = Annotated[int, pydantic.Field(ge=1)]
_Indices = tuple[Annotated[int, pydantic.Field(ge=0)], ...]


@dataclasses.dataclass(frozen=True)
class _Collection:
    """The fields of `collection.json` that are read."""

    num_objects: _Count
    resolution: tuple[_Count, _Count]
    shares: tuple[Finite, Finite, Finite]
    seed: int
    crop: bool


@dataclasses.dataclass(frozen=True)
class _Split:
    """The content of `split.json`."""

    train: _Indices
    validation: _Indices
    test: _Indices


def _descriptions(folder: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read and check `collection.json` and `split.json`."""
    remedy, path = records.remedy(folder), folder / "collection.json"
    collection = read_json(path, remedy)
    names = [field.name for field in dataclasses.fields(_Collection)]
    try:
        read = decode(_Collection, {name: collection[name] for name in names if name in collection}, "collection")
    except ValueError as error:
        raise DamagedFileError(f"{path} does not describe a dataset ({error}): {remedy}.") from None
    split = dataclasses.asdict(read_fields(_Split, folder / "split.json", remedy))
    members = [index for part in split.values() for index in part]
    if len(set(members)) != len(members) or max(members, default=0) >= read.num_objects:
        raise DamagedFileError(
            f"{folder / 'split.json'} has an object in two parts, or one >= {read.num_objects}: {remedy}."
        )
    return collection, {name: np.array(part, np.int64) for name, part in split.items()}
