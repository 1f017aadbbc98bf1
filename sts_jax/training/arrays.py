"""A training set in memory, its batches, and the order of the samples."""

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np

Batch = dict[str, Any]  # the fields of `Arrays` by name, with the samples of one batch


@dataclass(frozen=True)
class Arrays:
    """A training set in memory.

    The first axis of all arrays is the sample. Images are uint8, or float32 in [0, 1].
    """

    inputs: dict[str, np.ndarray]  # inputs of the model, from first frames
    # Targets of the model, from last frames. A state-space model also needs the state codes `state` of the first
    # frames, pose codes `pose`, and indices `outcome` into the outcomes of the scenario.
    targets: dict[str, np.ndarray]
    # bool (samples,): True if a sample has the input. An input without a mask is present in all samples.
    present: dict[str, np.ndarray] = field(default_factory=dict)
    target_present: dict[str, np.ndarray] = field(default_factory=dict)  # the same for targets, for `mvae` models only
    condition: np.ndarray | None = None  # (samples, condition), encoded condition of the scenario
    # For state-space models: `visual` and `tactile` image of the empty sensor, (size, size, 3)
    empty: dict[str, np.ndarray] = field(default_factory=dict)
    # For state-space models: first frames without a trajectory, as `visual` and `state`, (views, *shape)
    views: dict[str, np.ndarray] = field(default_factory=dict)
    # For state-space models: trajectories without images, as `state`, `pose`, `outcome` and, if the model has a
    # condition, `condition`, (falls, *shape)
    falls: dict[str, np.ndarray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        leaves = jax.tree_util.tree_leaves_with_path(self._tree())
        lengths = {jax.tree_util.keystr(path, simple=True, separator="/"): len(x) for path, x in leaves}
        if len(set(lengths.values())) != 1 or 0 in lengths.values():
            raise ValueError(f"all arrays must have the same number of samples, at least 1, got the lengths {lengths}")

    def __len__(self) -> int:
        return len(next(iter(self.targets.values())))

    def take(self, index: np.ndarray, **further: np.ndarray) -> Batch:
        """The arrays of one batch by field. `empty` is included as a whole.

        Args:
            index: Indices of the samples.
            further: Indices into the fields `views` and `falls`, which the batch lacks otherwise.
        """
        batch = jax.tree.map(lambda x: x[index], self._tree()) | {"empty": self.empty}
        return batch | {name: {k: x[rows] for k, x in getattr(self, name).items()} for name, rows in further.items()}

    def checksum(self) -> int:
        """CRC-32 of the names, shapes, types and values of all arrays."""
        value = 0
        further = {"empty": self.empty, "views": self.views, "falls": self.falls}
        for path, x in jax.tree_util.tree_leaves_with_path(self._tree() | further):
            value = zlib.crc32(f"{path}{x.shape}{x.dtype}".encode(), value)
            value = zlib.crc32(np.ascontiguousarray(x).data, value)
        return value

    def _tree(self) -> Batch:
        return {name: getattr(self, name) for name in ("inputs", "targets", "present", "target_present", "condition")}


def order(seed: int, samples: int, batch_size: int, start: int, stop: int) -> Iterator[np.ndarray]:
    """Iterate over the batches of a training, each as an array of sample indices `(batch_size,)`.

    Each epoch is a random permutation of all samples. A batch may contain the end of one epoch and the start of the
    next. The samples in batch k do not depend on `start` and `stop`, so that a resumed training uses the same batches.

    Args:
        seed: Seed of the permutations.
        samples: Number of samples.
        batch_size: Number of samples in a batch.
        start: Number of the first batch, counted from 0.
        stop: Number of the last batch, plus 1.
    """
    permutations: dict[int, np.ndarray] = {}
    for number in range(start, stop):
        epoch, place = np.divmod(np.arange(number * batch_size, (number + 1) * batch_size), samples)
        permutations = {
            e: permutations.get(e, np.random.default_rng([seed, e]).permutation(samples)) for e in np.unique(epoch)
        }
        yield np.array([permutations[e][p] for e, p in zip(epoch, place, strict=True)])
