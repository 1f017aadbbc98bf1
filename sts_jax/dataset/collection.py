"""`Collection`, the description of a dataset, and functions that return the dataset's objects, classes and split."""

import dataclasses
import math
from dataclasses import field

import jax
import numpy as np

from sts_jax import objects, physics
from sts_jax._checked import in_32_bits
from sts_jax._ranges import COUNT, MOST_PIXELS, NUMBER
from sts_jax._ranges import check as check_ranges
from sts_jax.dataset import records
from sts_jax.dataset.meshes import Meshes, open_library

_MANY = COUNT | {"at_most": 10**6}
PARTS = ("train", "validation", "test")  # the parts into which the objects are split
LEAST = 3  # number of objects in the smallest part of a split of nine or more objects


@dataclasses.dataclass(frozen=True)
class Collection:
    """Description of a dataset. Together with a `Sensor`, it determines every byte of the dataset.

    The description has the names of your own scenario and object classes, but not their code.
    """

    scenario: physics.Scenario = field(default_factory=physics.Freefall)
    # procedural classes, one object of each in turn (`objects.find_family` describes the allowed names)
    categories: tuple[str, ...] = objects.CATEGORIES
    # objects from mesh files, listed by `survey_meshes`, instead of procedural ones (num_objects must be their number)
    meshes: Meshes | None = None
    # split an object into convex parts if its hull fits badly (needs the package coacd, about ten seconds per object)
    parts: bool = False
    num_objects: int = field(default=160, metadata=_MANY)  # number of objects
    # trajectories per object, each with newly drawn hidden values such as mass and friction
    num_per_object: int = field(default=4, metadata=_MANY)
    # number of trajectories with images of all frames (the others: of the first and last frame)
    num_full: int = field(default=20, metadata=NUMBER)
    # number of trajectories with images, for each object: the first ones (None: all)
    num_rendered: int | None = field(default=None, metadata=COUNT)
    # additional visual images per object, in initial poses that are not simulated
    num_views: int = field(default=0, metadata=NUMBER | {"at_most": 10**6})
    resolution: tuple[int, int] = (64, 64)  # height and width of the images (pixels)
    crop: bool = False  # images show the square around the object, as in the paper, instead of the whole pad
    shares: tuple[float, float, float] = (0.7, 0.1, 0.2)  # shares of objects for training, validation and test (sum 1)
    # number of objects in one shard, which is written as a whole or not at all
    objects_per_shard: int = field(default=40, metadata=COUNT)
    seed: int = field(default=0, metadata=NUMBER)  # seed of the objects, the trajectories and the split
    engine: physics.Engine = "mujoco"  # physics engine, see `physics.simulate` (trajectories differ between engines)

    @property
    def num_trajectories(self) -> int:
        """Number of trajectories in the whole dataset."""
        return self.num_objects * self.num_per_object

    @property
    def rendered_per_object(self) -> int:
        """Number of trajectories with images, for each object."""
        return self.num_per_object if self.num_rendered is None else self.num_rendered

    @property
    def num_shards(self) -> int:
        """Number of shards."""
        return math.ceil(self.num_objects / self.objects_per_shard)

    def check(self) -> None:
        """Raise a ValueError if a field or the scenario is invalid."""
        check_ranges(self)
        self.scenario.check()
        if min(self.shares) < 0 or not math.isclose(sum(self.shares), 1):
            raise ValueError(f"shares={self.shares}, but shares must be >= 0 and have sum 1")
        if self.meshes is not None and self.num_objects != len(self.meshes.names):
            count = len(self.meshes.names)
            raise ValueError(
                f"num_objects={self.num_objects}, but `meshes` has {count} objects: set num_objects={count}"
            )
        if self.meshes is None and not self.categories:
            raise ValueError("categories is empty, but it must name at least one class, such as 'bottle'")
        for category in self.categories if self.meshes is None else ():
            objects.find_family(category)
        whole = isinstance(self.resolution, tuple) and all(type(n) is int for n in self.resolution)
        if not whole or len(self.resolution) != 2 or not all(1 <= n <= MOST_PIXELS for n in self.resolution):
            raise ValueError(
                "resolution must be a tuple of two whole numbers (height, width) from 1 to "
                f"{MOST_PIXELS:,} pixels, got {self.resolution!r}"
            )
        if self.rendered_per_object > self.num_per_object:
            raise ValueError(f"num_rendered must be <= num_per_object={self.num_per_object}, got {self.num_rendered}")


def class_names(collection: Collection) -> tuple[str, ...]:
    """Return the class name (such as `bottle`) of each object in a collection, in the order of the objects."""
    if collection.meshes is not None:
        return collection.meshes.labels
    return tuple(collection.categories[i % len(collection.categories)] for i in range(collection.num_objects))


@in_32_bits
def make_bodies(collection: Collection, indices: np.ndarray) -> list[objects.Body]:
    """Make the objects of a collection with the given indices, int `(n,)`. Each depends on its own index only."""
    if collection.meshes is not None:
        library, where = open_library(collection.meshes, collection.parts)
        chosen = [collection.meshes.names[i] for i in indices]
        gone = [name for name in chosen if name not in where]
        if gone:
            raise FileNotFoundError(
                f"{library.folder} no longer has {', '.join(gone)}: restore every missing mesh file"
            )
        return [objects.read(library, where[name]).body for name in chosen]
    key, names = jax.random.key(collection.seed), class_names(collection)
    bodies = [objects.make(jax.random.fold_in(key, int(i)), names[i]) for i in indices]
    if not collection.parts:
        return bodies
    return [objects.decompose(body) if objects.gaps(body)[1] > objects.HOLLOW else body for body in bodies]


def split_objects(collection: Collection) -> dict[str, np.ndarray]:
    """Split the objects of a collection at random into parts with nearly equal proportions of the classes.

    Of nine or more objects, each part has at least three, because the spread of one or two says little. Two exceptions
    keep datasets that exist already: procedural objects may have parts of two, and none where the share rounds to 0.

    Returns:
        Sorted indices of the objects, int `(n,)`, for each of `train`, `validation` and `test`.
    """
    rng = np.random.default_rng([collection.seed, 1])
    names = np.array(class_names(collection))
    members = [rng.permutation(np.flatnonzero(names == name)) for name in dict.fromkeys(names.tolist())]
    # Each part consists of successive blocks. The objects of each class are spread evenly over the blocks, so the parts
    # have equal proportions of the classes.
    blocks: list[list[int]] = [[] for _ in range(max(map(len, members)))]
    for alike in members:
        for i, index in enumerate(alike.tolist()):
            # A class that lacks one object fills the first blocks, as in datasets that exist already.
            blocks[i if len(alike) >= len(blocks) - 1 else (2 * i + 1) * len(blocks) // (2 * len(alike))].append(index)
    order = np.concatenate([rng.permutation(block) for block in blocks])
    cuts = np.round(np.cumsum(collection.shares)[:-1] * collection.num_objects).astype(int)
    sizes = np.diff(cuts, prepend=0, append=collection.num_objects)
    wanted = np.array(collection.shares) > 0
    if collection.num_objects >= 3 * LEAST and (collection.meshes is not None or sizes[wanted].min() == 1):
        while sizes[wanted].min() < LEAST:
            sizes[np.where(wanted, sizes, np.inf).argmin()] += 1
            sizes[sizes.argmax()] -= 1
        cuts = np.cumsum(sizes)[:-1]
    return {name: np.sort(part).astype(np.int64) for name, part in zip(PARTS, np.split(order, cuts), strict=True)}


# Fields of a collection in JSON that may differ between computers. The files themselves have a checksum.
PLACES = ("meshes.folder", "meshes.cache")


def as_json(collection: Collection) -> dict:
    """The content of a dataset's `collection.json`."""
    content = dataclasses.asdict(collection)
    content["scenario"] = {"name": type(collection.scenario).__name__, **content["scenario"]}
    return {"format": records.FORMAT, **content}
