"""Load a dataset as arrays: trajectories, rendered frames, and pairs of first and last moments."""

import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from sts_jax._files import TornFileError, digest, read_json, sha256
from sts_jax.dataset import records
from sts_jax.dataset.collection import PARTS
from sts_jax.dataset.symmetry import turn, turn_condition


class Pairs(NamedTuple):
    """First and last moments of some trajectories, in memory. `n` is trajectories times symmetries."""

    visual: np.ndarray  # uint8 (n, 2, height, width, 3): first, last
    tactile: np.ndarray  # uint8 (n, 2, height, width, 3)
    segmentation: np.ndarray  # bool (n, 2, height, width)
    pose: np.ndarray  # float32 (n, 2, 7)
    contact: np.ndarray  # bool (n, 2): the pad pushes the object
    condition: np.ndarray  # float32 (n, c): the scenario's input, SI units, turned like the pose
    outcome: np.ndarray  # int32 (n,), physics.Outcome
    object: np.ndarray  # int64 (n,), index of the object in the collection
    trajectory: np.ndarray  # int64 (n,), index of the trajectory in the dataset
    support: np.ndarray  # float32 (n, 128), m: `objects.support` of the body, or of the mirrored body
    mass: np.ndarray  # float32 (n,), kg, with the trajectory's hidden values
    com: np.ndarray  # float32 (n, 3), m, centre of mass in the mesh frame, mirrored like the body


class Ends(NamedTuple):
    """First and last poses of some trajectories, with the true shape and mass, and without images."""

    pose: np.ndarray  # float32 (n, 2, 7): first, last
    condition: np.ndarray  # float32 (n, c): the scenario's input, SI units
    outcome: np.ndarray  # int32 (n,), physics.Outcome
    support: np.ndarray  # float32 (n, 128), m: `objects.support` of the body
    mass: np.ndarray  # float32 (n,), kg, with the trajectory's hidden values
    com: np.ndarray  # float32 (n, 3), m, centre of mass in the mesh frame
    object: np.ndarray  # int64 (n,), index of the object in the collection
    trajectory: np.ndarray  # int64 (n,), index of the trajectory in the dataset


class Views(NamedTuple):
    """Pictures of some objects at starts that are not simulated, in memory."""

    visual: np.ndarray  # uint8 (m, height, width, 3)
    pose: np.ndarray  # float32 (m, 7)
    support: np.ndarray  # float32 (m, 128), m: `objects.support` of the body
    mass: np.ndarray  # float32 (m,), kg, with hidden values drawn for the view
    com: np.ndarray  # float32 (m, 3), m, centre of mass in the mesh frame
    object: np.ndarray  # int64 (m,), index of the object in the collection


def reduced(pairs: Pairs, size: int) -> Pairs:
    """The same moments with images of a lower resolution, which are means over blocks of pixels.

    Args:
        pairs: moments with square images.
        size: pixels, new side of the images, which divides their present side.

    Raises:
        ValueError: the images are not square, or their side is not a multiple of `size`.
    """
    height, width = pairs.visual.shape[2:4]
    if height != width or size < 1 or height % size:
        raise ValueError(f"size is {size}, but it must divide the side of square images, got {height} x {width} pixels")
    return pairs._replace(
        visual=_means(pairs.visual, size),
        tactile=_means(pairs.tactile, size),
        segmentation=_means(pairs.segmentation[..., None], size)[..., 0],
    )


def reduced_images(images: dict[str, np.ndarray], size: int) -> dict[str, np.ndarray]:
    """Reduce single square images `(side, side, channels)` as `reduced` does."""
    return {name: _means(image, size) for name, image in images.items()}


def _means(images: np.ndarray, size: int) -> np.ndarray:
    factor = images.shape[-2] // size
    blocks = images.reshape(*images.shape[:-3], size, factor, size, factor, images.shape[-1])
    return ((blocks.sum((-4, -2), dtype=np.uint32) + factor**2 // 2) // factor**2).astype(images.dtype)


@dataclasses.dataclass(frozen=True)
class Dataset:
    """A dataset. Images are read on request, and everything else is in memory."""

    collection: dict  # content of collection.json
    identity: str  # SHA-256 of all collected data and of the split
    split: dict[str, np.ndarray]  # name -> object indices
    trajectory: dict[str, np.ndarray]  # leaves of physics.Trajectory, all shards: (num, ...)
    hidden: dict[str, np.ndarray]  # leaves of physics.Hidden, (num,)
    solid: dict[str, np.ndarray]  # support, mirrored (support of the mirrored body), mass, com: (num, ...)
    view: dict[str, np.ndarray]  # pose, body, support, mass, com of each view: (k, ...)
    frames: np.ndarray  # int (m, 3): trajectory, frame, symmetry of every stored image, in order of the shards
    shards: tuple[Path, ...]
    shard_of: np.ndarray  # int (m,): index of the shard of each stored image
    record_of: np.ndarray  # int (m,): index of its record in the shard
    view_shard_of: np.ndarray  # int (k,): index of the shard of each view
    view_record_of: np.ndarray  # int (k,): index of its record in the shard

    def images(self, rows: np.ndarray) -> records.Images:
        """Read the images of some rows of `frames`, in the given order."""
        height, width = self.collection["resolution"]
        out = records.Images(
            np.empty((len(rows), height, width, 3), np.uint8),
            np.empty((len(rows), height, width, 3), np.uint8),
            np.empty((len(rows), height, width), bool),
        )
        for shard in np.unique(self.shard_of[rows]).tolist():
            here = np.flatnonzero(self.shard_of[rows] == shard)
            part = records.read_images(
                self.shards[shard],
                self.record_of[rows[here]],
                resolution=(height, width),
                total=self._records_in(shard),
            )
            for whole, piece in zip(out, part, strict=True):
                whole[here] = piece
        return out

    def _records_in(self, shard: int) -> int:
        return int((self.shard_of == shard).sum() + (self.view_shard_of == shard).sum())

    def rendered(self) -> np.ndarray:
        """Indices of the trajectories that have images."""
        return np.unique(self.frames[:, 0]).astype(np.int64)

    def full_trajectories(self) -> np.ndarray:
        """Indices of the trajectories that have every frame rendered."""
        plain = self.frames[self.frames[:, 2] == 0]
        counts = np.bincount(plain[:, 0], minlength=len(self.trajectory["outcome"]))
        return np.flatnonzero(counts == self.trajectory["pose"].shape[1])

    def strip(self, trajectory: int) -> records.Images:
        """Read every frame of one fully rendered trajectory, in time order."""
        rows = np.flatnonzero((self.frames[:, 0] == trajectory) & (self.frames[:, 2] == 0))
        return self.images(rows[np.argsort(self.frames[rows, 1])])

    def members(self, part: str, *, rendered: bool = True) -> np.ndarray:
        """Indices of the trajectories of `train`, `validation` or `test`.

        Args:
            part: One of these names.
            rendered: Whether to return only trajectories with images, which `pairs` loads. `ends` loads all.

        Raises:
            ValueError: The name is unknown.
        """
        found = np.flatnonzero(np.isin(self.trajectory["body"], self._part(part)))
        return found[np.isin(found, self.rendered())] if rendered else found

    def _part(self, part: str) -> np.ndarray:
        if part not in self.split:
            raise ValueError(f"unknown part {part!r} of the dataset: give one of {', '.join(self.split)}.")
        return self.split[part]

    def ends(self, trajectories: np.ndarray) -> Ends:
        """First and last poses of some trajectories, with images or without. No image is read.

        Args:
            trajectories: Their indices.

        Raises:
            ValueError: An index is not a whole number or is out of range.
        """
        index = self._checked(trajectories)
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
        """Pictures, possibly none, of the objects of `train`, `validation` or `test` at further starts.

        Args:
            part: One of these names.

        Raises:
            ValueError: The name is unknown.
        """
        rows = np.flatnonzero(np.isin(self.view["body"], self._part(part)))
        height, width = self.collection["resolution"]
        visual = np.empty((len(rows), height, width, 3), np.uint8)
        for shard in np.unique(self.view_shard_of[rows]).tolist():
            here = np.flatnonzero(self.view_shard_of[rows] == shard)
            visual[here] = records.read_views(
                self.shards[shard],
                self.view_record_of[rows[here]],
                resolution=(height, width),
                total=self._records_in(shard),
            )
        pose, support, mass, com = (self.view[name][rows] for name in ("pose", "support", "mass", "com"))
        return Views(visual, pose, support, mass, com, self.view["body"][rows].astype(np.int64))

    def _checked(self, trajectories: Any) -> np.ndarray:
        """Indices of trajectories as int64. Raise a ValueError if they are invalid."""
        trajectories, count = np.asarray(trajectories), len(self.trajectory["outcome"])
        if trajectories.ndim != 1 or (trajectories.size and trajectories.dtype.kind not in "iu"):
            raise ValueError(
                f"trajectories has the type {trajectories.dtype} and the shape {trajectories.shape}, but it must be "
                "a list of indices (np.flatnonzero turns a mask into one)."
            )
        outside = trajectories[(trajectories < 0) | (trajectories >= count)]
        if outside.size:
            raise ValueError(f"trajectories holds {outside[0]}, but the dataset has trajectories 0 to {count - 1}.")
        return trajectories.astype(np.int64)

    def pairs(self, trajectories: np.ndarray, *, symmetries: bool = False) -> Pairs:
        """First and last moments of some trajectories.

        Args:
            trajectories: Their indices.
            symmetries: Whether to add the turned and mirrored copies that the collection rendered.

        Raises:
            ValueError: An index is not a whole number or is out of range, or its trajectory has no images.
        """
        trajectories = self._checked(trajectories)
        without = trajectories[~np.isin(trajectories, self.rendered())]
        if without.size:
            raise ValueError(
                f"trajectories holds {without[0]}, which has no images (num_rendered="
                f"{self.collection['num_rendered']}): use `ends`, or take indices from `members` or `rendered`."
            )
        last = self.trajectory["pose"].shape[1] - 1
        kinds = np.unique(self.frames[:, 2]).tolist() if symmetries else [0]
        row_of = {tuple(row): i for i, row in enumerate(self.frames.tolist())}
        wanted = [(int(t), kind) for t in trajectories for kind in kinds]
        rows = np.array([[row_of[t, 0, q], row_of[t, last, q]] for t, q in wanted], np.int64).reshape(-1, 2)
        images = [leaf.reshape(-1, 2, *leaf.shape[1:]) for leaf in self.images(rows.ravel())]
        index = np.array([t for t, _ in wanted], np.int64)
        ends, input = jnp.asarray(self.trajectory["pose"][:, [0, last]]), jnp.asarray(self.trajectory["condition"])
        turned = np.stack([np.asarray(turn(ends, kind)) for kind in kinds])
        vectors = self.collection["scenario"].get("vectors", 1)
        conditions = np.stack([np.asarray(turn_condition(input, kind, vectors)) for kind in kinds])
        place = np.tile(np.arange(len(kinds)), len(trajectories))
        mirrored = np.array(kinds)[place, None] >= 4
        com = self.solid["com"][index]
        return Pairs(
            visual=images[0],
            tactile=images[1],
            segmentation=images[2],
            pose=turned[place, index].astype(np.float32),
            contact=self.trajectory["contact"][:, [0, last]][index],
            condition=conditions[place, index].astype(np.float32),
            outcome=self.trajectory["outcome"][index],
            object=self.trajectory["body"][index],
            trajectory=index,
            support=np.where(mirrored, self.solid["mirrored"][index], self.solid["support"][index]),
            mass=self.solid["mass"][index],
            com=np.where(mirrored, com * np.array([1, -1, 1], np.float32), com),
        )


def load(folder: str | Path) -> Dataset:
    """Open a folder that `collect` has finished, and verify it. Every image is read once, in about 1 s per GB.

    Raises:
        FileNotFoundError: The folder or one of its files is missing. The message names it.
        TornFileError: A file is damaged, or belongs to another dataset or shard. The message names it.
        ValueError: The dataset has an older format.
    """
    folder = Path(folder)
    path = folder / "collection.json"
    collection = _read(path)
    records.check_format(collection, folder)
    objects, each = (_whole_number(collection, name, path) for name in ("num_objects", "objects_per_shard"))
    split = _read_split(folder / "split.json", objects)
    made_of, seen_by = digest(collection), digest(_read(folder / "sensor.json"))
    count = -(-objects // each)
    shards, parts = [], []
    for index in range(count):
        path = records.shard_path(folder, count, index)
        if not path.with_suffix(".npz").exists():
            raise FileNotFoundError(
                f"{path.with_suffix('.npz')} is missing: the collection is not finished. Run it again to resume it."
            )
        parts.append(records.read_shard(path, records.Identity(made_of, seen_by, index)))
        shards.append(path)
    starts = np.cumsum([0] + [len(part["trajectory/outcome"]) for part in parts])
    leaves = {key: np.concatenate([part[key] for part in parts]) for key in parts[0] if key != "frames"}
    sizes = [len(part["frames"]) for part in parts]
    views = [len(part["view/body"]) for part in parts]
    contents = [sha256(shard.with_suffix(".npz")) for shard in shards]  # each holds the hash of its images
    return Dataset(
        collection=collection,
        identity=digest([made_of, seen_by, {name: part.tolist() for name, part in split.items()}, contents]),
        split=split,
        **{
            group: {k.split("/")[1]: v for k, v in leaves.items() if k.startswith(f"{group}/")}
            for group in ("trajectory", "hidden", "solid", "view")
        },
        frames=np.concatenate([p["frames"] + np.array([s, 0, 0]) for p, s in zip(parts, starts[:-1], strict=True)]),
        shards=tuple(shards),
        shard_of=np.repeat(np.arange(count), sizes),
        record_of=np.concatenate([np.arange(size) for size in sizes]),
        view_shard_of=np.repeat(np.arange(count), views),
        view_record_of=np.concatenate([size + np.arange(k) for size, k in zip(sizes, views, strict=True)]),
    )


def _read(path: Path, remedy: str | None = None) -> Any:
    if path.parent.exists() and not path.parent.is_dir():
        raise NotADirectoryError(f"{path.parent} is a file: give the folder of a collected dataset.")
    try:
        return read_json(path, remedy or f"delete {path.parent} and collect again")
    except FileNotFoundError:
        raise FileNotFoundError(
            f"{path} is missing: {path.parent} is not a collected dataset. Give the folder of one, or collect into it."
        ) from None


def _whole_number(collection: dict, name: str, path: Path) -> int:
    value = collection.get(name)
    if type(value) is not int or value < 1:
        raise TornFileError(
            f"{path}: {name} must be a whole number of at least 1, got {value!r}: "
            f"delete {path.parent} and collect again."
        )
    return value


def _read_split(path: Path, num_objects: int) -> dict[str, np.ndarray]:
    """Read the split of the objects. Each object must be in exactly one part."""
    remedy = f"delete {path} and start the collection again, which writes it anew"
    content = _read(path, remedy)
    if not isinstance(content, dict) or set(content) != set(PARTS):
        parts = ", ".join(map(repr, content)) if isinstance(content, dict) else f"a {type(content).__name__}"
        raise TornFileError(f"{path} must have the parts {', '.join(PARTS)}, got {parts}: {remedy}.")
    for name, part in content.items():
        if not isinstance(part, list) or not all(type(i) is int for i in part):
            raise TornFileError(f"{path}: {name} must be a list of whole numbers, got {part!r:.60}: {remedy}.")
        outside = [i for i in part if not 0 <= i < num_objects]
        if outside:
            raise TornFileError(
                f"{path}: {name} holds object {outside[0]}, but the objects are 0 to {num_objects - 1}: {remedy}."
            )
    named = np.array([i for part in content.values() for i in part], np.int64)
    times = np.bincount(named, minlength=num_objects)
    if (times != 1).any():
        number = int(np.flatnonzero(times != 1)[0])
        raise TornFileError(
            f"{path}: object {number} must be in one part, but it occurs {times[number]} times: {remedy}."
        )
    return {name: np.array(part, np.int64) for name, part in content.items()}
