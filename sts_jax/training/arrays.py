"""The training set in memory, its batches and their order."""

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np

Batch = dict[str, Any]  # dictionaries by name as in `Arrays`, and `condition`, an array or None


@dataclass(frozen=True)
class Arrays:
    """A training set in memory: arrays `(samples, *shape)` by modality. Images are uint8, or float32 in [0, 1].

    Raises:
        ValueError: the numbers of samples differ, or are 0.
    """

    inputs: dict[str, np.ndarray]
    targets: dict[str, np.ndarray]  # for state-space models also the codes `state` and `pose`, and the index `outcome`
    present: dict[str, np.ndarray] = field(default_factory=dict)  # (samples,) bool, True if not given
    target_present: dict[str, np.ndarray] = field(default_factory=dict)
    condition: np.ndarray | None = None  # (samples, condition)
    empty: dict[str, np.ndarray] = field(default_factory=dict)  # images of the untouched sensor, for state-space models
    # For state-space models: first moments without a last one, `visual` and the code `state`, (views, *shape)
    views: dict[str, np.ndarray] = field(default_factory=dict)
    # For state-space models: trajectories without images, with the codes `state` and `pose`, `outcome`, and `condition`
    # if the model has one
    falls: dict[str, np.ndarray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        sizes = {len(x) for x in jax.tree.leaves(self._tree())}
        if len(sizes) != 1 or 0 in sizes:
            raise ValueError(f"arrays have {sorted(sizes)} samples, but all must have the same number, at least one")

    def __len__(self) -> int:
        return len(next(iter(self.targets.values())))

    def take(self, index: np.ndarray, **further: np.ndarray) -> Batch:
        """The batch of samples `index`, and of the given rows of `views` and `falls`."""
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
    """Indices of the samples of batches `start` to `stop - 1`, a function of the seed and the step alone.

    Each epoch has a permutation of the samples, and a batch may straddle two epochs. Every sample is seen once per
    epoch and none is dropped.
    """
    permutations: dict[int, np.ndarray] = {}
    for number in range(start, stop):
        epoch, place = np.divmod(np.arange(number * batch_size, (number + 1) * batch_size), samples)
        permutations = {
            e: permutations.get(e, np.random.default_rng([seed, e]).permutation(samples)) for e in np.unique(epoch)
        }
        yield np.array([permutations[e][p] for e, p in zip(epoch, place, strict=True)])
