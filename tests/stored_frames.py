"""A dataset of random images and poses that is written without a simulation, so that every stored frame is known."""

from typing import NamedTuple

import numpy as np

from sts_jax import dataset, training
from sts_jax.dataset import records

SIZE, FRAMES, RATE = 32, 5, 25.0
BLANK = np.full((SIZE, SIZE, 3), 100, np.uint8)


class Stored(NamedTuple):
    """A dataset, and what it stores."""

    data: dataset.Dataset
    visual: np.ndarray  # uint8 (trajectories, frames, height, width, 3)
    tactile: (
        np.ndarray
    )  # the same. The frames of `touched` differ from `BLANK` in one pixel, the others are equal to it
    touched: np.ndarray  # bool (trajectories, frames)


def stored(folder, *, objects=10, each=2, ends_only=(), condition=2, identity="a") -> Stored:
    """Two shards of frames. Of the trajectories `ends_only`, only the first and the last frame are stored."""
    rng, num = np.random.default_rng(0), objects * each
    visual = rng.integers(0, 256, (num, FRAMES, SIZE, SIZE, 3), dtype=np.uint8)
    touched = rng.random((num, FRAMES)) < 0.5
    tactile = np.tile(BLANK, (num, FRAMES, 1, 1, 1))
    for one in np.argwhere(touched):
        tactile[(*one, *rng.integers(0, SIZE, 2))] += 10
    rows = [(i, t) for i in range(num) for t in range(FRAMES) if i not in ends_only or t in (0, FRAMES - 1)]
    frames, cut = np.array(rows), sum(i < num // 3 for i, _ in rows)
    paths = []
    for number, part in enumerate((frames[:cut], frames[cut:])):
        paths.append(folder / f"{number}.array_record")
        images = (visual[tuple(part.T)], tactile[tuple(part.T)], visual[tuple(part.T)][..., 0] > 127)
        records.write_images(paths[-1], [images])
    body = np.repeat(np.arange(objects), each)
    order = rng.permutation(objects)
    data = dataset.Dataset(
        collection={"resolution": [SIZE, SIZE], "shares": [0.6, 0.2, 0.2], "seed": 0},
        identity=identity,
        split={"train": np.sort(order[:6]), "validation": np.sort(order[6:8]), "test": np.sort(order[8:])},
        trajectory={
            "time": np.tile(np.arange(FRAMES, dtype=np.float32) / RATE, (num, 1)),
            "pose": unit_quaternions(rng.normal(size=(num, FRAMES, 7)).astype(np.float32)),
            "contact": rng.random((num, FRAMES)) < 0.5,
            "condition": rng.normal(size=(num, condition)).astype(np.float32),
            "outcome": rng.integers(0, 2, num).astype(np.int32),
            "body": body.astype(np.int32),
        },
        hidden={},
        solid={"support": rng.random((num, 128)), "mass": rng.random(num), "com": rng.random((num, 3))},
        view={},
        frames=frames,
        shards=tuple(paths),
        shard_of=(np.arange(len(frames)) >= cut).astype(np.int64),
        record_of=np.concatenate([np.arange(cut), np.arange(len(frames) - cut)]),
        view_shard_of=np.zeros(0, np.int64),
        view_record_of=np.zeros(0, np.int64),
    )
    return Stored(data, visual, tactile, touched)


def unit_quaternions(pose):
    """Scale positions to the pad and quaternions to length 1."""
    return np.concatenate([0.01 * pose[..., :3], pose[..., 3:] / np.linalg.norm(pose[..., 3:], axis=-1)[..., None]], -1)


def preprocessing(condition=2, **changes):
    """A preprocessing for the images of `stored`."""
    scale = tuple(np.arange(2.0, 2 + condition).tolist())
    return training.Preprocessing(**{"resolution": (SIZE, SIZE), "condition_scale": scale} | changes)
