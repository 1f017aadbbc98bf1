"""A finished dataset in the native format with random content that is known, made without a simulation."""

import numpy as np

from sts_jax import dataset, physics, sensor, storage
from sts_jax.dataset import records
from sts_jax.dataset.collection import as_json

FRAMES, RESOLUTION, SHARDS, PER_SHARD, EACH = 6, (10, 14), 3, 4, 2
COLLECTION = dataset.Collection(
    scenario=physics.Perturbed(frames=FRAMES),
    categories=("bottle", "mouse", "fork"),
    num_objects=SHARDS * PER_SHARD,
    num_per_object=EACH,
    objects_per_shard=PER_SHARD,
    resolution=RESOLUTION,
    shares=(0.5, 0.25, 0.25),
)


def write(folder, *, full=5, collection=COLLECTION, condition=3):
    """Write a dataset. Of `full` trajectories of each shard all frames have images, of the next one the ends, of the
    last one no frame, and the others have the ends. Return the images by shard, and the arrays by shard."""
    rng, images, tables = np.random.default_rng(0), [], []
    storage.write_json(folder / "collection.json", as_json(collection))
    storage.write_json(folder / "sensor.json", sensor.Sensor().constants())
    split = {name: part.tolist() for name, part in dataset.split_objects(collection).items()}
    storage.write_json(folder / "split.json", split)
    for shard in range(SHARDS):
        num = PER_SHARD * EACH
        rows = [(i, t) for i in range(num - 1) for t in range(FRAMES) if i < full or t in (0, FRAMES - 1)]
        count = len(rows)
        shown = records.Images(
            rng.integers(0, 256, (count, *RESOLUTION, 3), dtype=np.uint8),
            rng.integers(0, 256, (count, *RESOLUTION, 3), dtype=np.uint8),
            rng.random((count, *RESOLUTION)) < 0.5,
        )
        table = _table(rng, num, shard, condition) | {
            "frames": np.array(rows, np.int32),
            "left_out": np.array([], "U1"),
        }
        names = records.shard_files(shard, SHARDS)
        records.write_images(folder / names[0], [shown])
        storage.write_arrays(folder / names[1], table)
        images.append(shown)
        tables.append(table)
    files = [name for shard in range(SHARDS) for name in records.shard_files(shard, SHARDS)]
    listed = storage.checksums(folder, [*records.DESCRIPTIONS, *files])
    storage.write_manifest(folder, listed, {"shards": SHARDS})
    return images, tables


def _table(rng, num, shard, condition):
    def normal(*shape):
        return rng.normal(size=shape).astype(np.float32)

    pose = normal(num, FRAMES, 7)
    pose[..., 3:] /= np.linalg.norm(pose[..., 3:], axis=-1, keepdims=True)
    trajectory = {
        "time": np.tile(np.arange(FRAMES, dtype=np.float32) / np.float32(31.25), (num, 1)),
        "pose": pose,
        "velocity": normal(num, FRAMES, 6),
        "wrench": normal(num, FRAMES, 6),
        "contact": rng.random((num, FRAMES)) < 0.5,
        "wall": rng.random((num, FRAMES)) < 0.5,
        "gravity": normal(num, FRAMES, 3),
        "settled": rng.random(num) < 0.5,
        "outcome": rng.choice([1, 2, 3, 4], num).astype(np.int32),
        "touches": rng.integers(0, 5, num).astype(np.int32),
        "sunk": normal(num),
        "condition": normal(num, condition),
        "body": (shard * PER_SHARD + np.repeat(np.arange(PER_SHARD), EACH)).astype(np.int32),
        "resampled": np.zeros(num, np.int32),
    }
    hidden = {name: normal(num) for name in ("fill", "shell_scale", "friction")} | {"up": normal(num, 3)}
    solid = {"support": normal(num, 128), "mass": normal(num), "com": normal(num, 3)}
    empty = {"pose": (0, 7), "support": (0, 128), "mass": (0,), "com": (0, 3)}
    view = {name: np.zeros(shape, np.float32) for name, shape in empty.items()} | {"body": np.zeros(0, np.int32)}
    groups = {"trajectory": trajectory, "hidden": hidden, "solid": solid, "view": view}
    return {f"{group}/{name}": x for group, fields in groups.items() for name, x in fields.items()}
