"""A dataset with made-up trajectories and images, written in the native format without a simulation.

A grey disc stands for the object, in both streams: in the visual image in each frame, and in the tactile image in each
frame with contact. Every image with a disc is unique.
"""

import dataclasses

import numpy as np

import sts_jax as sts
from sts_jax import dataset, storage
from sts_jax.dataset import records
from sts_jax.dataset.collection import as_json

SIZE, FRAMES = 24, 6
SKIN = 100  # value of all pixels of the untouched skin
COLLECTION = dataset.Collection(
    sts.physics.Perturbed(frames=FRAMES),
    ("bottle", "fork"),
    num_objects=10,
    num_per_object=2,
    num_full=4,
    num_views=1,
    resolution=(SIZE, SIZE),
    objects_per_shard=6,
    seed=3,
)


@dataclasses.dataclass(frozen=True)
class Faults:
    """What `write` changes in the images of some frames, each named by (trajectory, frame)."""

    visual: dict = dataclasses.field(default_factory=dict)  # value of all pixels of the visual image
    tactile: dict = dataclasses.field(default_factory=dict)  # value of all pixels of the tactile image
    copies: dict = dataclasses.field(default_factory=dict)  # frame whose visual image is copied
    hidden: tuple = ()  # frames whose segmentation is empty


NO_FAULTS = Faults()


def write(folder, faults=NO_FAULTS):
    """Write a dataset with some faults, and return its arrays, concatenated over the shards."""
    folder.mkdir(parents=True, exist_ok=True)
    storage.write_json(folder / "collection.json", as_json(COLLECTION))
    storage.write_json(folder / "sensor.json", sts.Sensor().constants())
    split = dataset.split_objects(COLLECTION)
    storage.write_json(folder / "split.json", {name: part.tolist() for name, part in split.items()})
    rng, files, tables, before = np.random.default_rng(0), list(records.DESCRIPTIONS), [], 0
    for index, members in enumerate((np.arange(6), np.arange(6, 10))):
        names = records.shard_files(index, 2)
        table = made_up(members, rng, before)
        records.write_images(folder / names[0], list(images_of(table, before, faults)))
        storage.write_arrays(folder / names[1], table)
        files += names
        tables.append(table)
        before += len(table["trajectory/body"])
    storage.write_manifest(folder, storage.checksums(folder, files), {"shards": 2})
    return {name: np.concatenate([table[name] for table in tables]) for name in tables[0] if name != "frames"}


def made_up(members, rng, before):
    num = 2 * len(members)
    quat = rng.normal(size=(num, FRAMES, 4))
    wrench = np.zeros((num, FRAMES, 6), np.float32)
    contact = np.ones((num, FRAMES), bool)
    contact[:, 0] = False
    wrench[..., 2] = rng.uniform(0.5, 3.0, (num, FRAMES)) * contact
    place = rng.uniform(-0.06, 0.06, (num, FRAMES, 3))
    outcomes = [int(outcome) for outcome in COLLECTION.scenario.outcomes]
    full = [i for i in range(num) if before + i < 4]
    frames = [(i, t) for i in range(num) for t in (range(FRAMES) if i in full else (0, FRAMES - 1))]
    single = dict(zip(("fill", "shell_scale", "friction"), rng.random((3, num), np.float32), strict=True))
    return {
        "trajectory/time": np.tile(np.arange(FRAMES, dtype=np.float32) / 31.25, (num, 1)),
        "trajectory/pose": np.concatenate([place, quat / np.linalg.norm(quat, axis=-1, keepdims=True)], -1).astype(
            "f4"
        ),
        "trajectory/velocity": rng.normal(size=(num, FRAMES, 6)).astype(np.float32),
        "trajectory/wrench": wrench,
        "trajectory/contact": contact,
        "trajectory/wall": np.zeros((num, FRAMES), bool),
        "trajectory/gravity": np.tile(np.array([0, 0, -9.81], np.float32), (num, FRAMES, 1)),
        "trajectory/settled": rng.random(num) < 0.8,
        "trajectory/outcome": rng.choice(outcomes, num).astype(np.int32),
        "trajectory/touches": rng.integers(1, 9, num).astype(np.int32),
        "trajectory/sunk": np.zeros(num, np.float32),
        "trajectory/condition": rng.normal(size=(num, 3)).astype(np.float32),
        "trajectory/body": np.repeat(members, 2).astype(np.int32),
        "trajectory/resampled": rng.integers(0, 2, num).astype(np.int32),
        **{f"hidden/{name}": values for name, values in single.items()},
        "hidden/up": np.tile(np.array([0, 0, 1], np.float32), (num, 1)),
        "solid/support": rng.random((num, 128), np.float32),
        "solid/mass": rng.uniform(0.01, 0.3, num).astype(np.float32),
        "solid/com": np.zeros((num, 3), np.float32),
        "view/body": members.astype(np.int32),
        "view/pose": np.tile(np.array([0, 0, 0.1, 1, 0, 0, 0], np.float32), (len(members), 1)),
        "view/support": rng.random((len(members), 128), np.float32),
        "view/mass": rng.random(len(members), np.float32),
        "view/com": np.zeros((len(members), 3), np.float32),
        "frames": np.array(frames, np.int32),
        "left_out": np.array([], str),
    }


def images_of(table, before, faults):
    """The images of each frame, and then of the views."""
    for i, t in table["frames"].tolist():
        key, contact = (before + i, t), table["trajectory/contact"][i, t]
        seen = disc(*faults.copies.get(key, key))
        visual, tactile = drawn(seen, 160, *key), drawn(seen & contact, SKIN, *key)
        if key in faults.copies:
            visual = drawn(seen, 160, *faults.copies[key])
        visual = np.full_like(visual, faults.visual[key]) if key in faults.visual else visual
        tactile = np.full_like(tactile, faults.tactile[key]) if key in faults.tactile else tactile
        yield visual[None], tactile[None], (seen & (key not in faults.hidden))[None]
    for number in range(len(table["view/body"])):
        yield (np.full((1, SIZE, SIZE, 3), number, np.uint8),)


def disc(trajectory, frame):
    y, x = np.mgrid[:SIZE, :SIZE]
    return np.hypot(x - 6 - trajectory % 12, y - 8 - frame) < 4


def drawn(seen, background, trajectory, frame):
    value = np.array([40 + 2 * trajectory, 60 + 2 * frame, 50])
    return np.where(seen[..., None], value, background).astype(np.uint8)
