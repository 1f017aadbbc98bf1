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

    `inputs` and `targets` are dictionaries of arrays by name, such as `visual`, `tactile` or `pose`. `present` and
    `target_present` are dictionaries of Boolean arrays. `present[name]` is True for each sample that has the input
    `name`, and `target_present[name]` is True for each sample that has the target `name`. `condition` has the known
    quantities of each sample, such as an acceleration of the pad, or is None. The first axis of all these arrays is the
    sample. Images are uint8, or float32 in [0, 1].

    Raises:
        ValueError: The arrays have different numbers of samples, or no samples.
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
        sizes = {len(x) for x in jax.tree.leaves(self._tree())}
        if len(sizes) != 1 or 0 in sizes:
            leaves = jax.tree_util.tree_leaves_with_path(self._tree())
            found = {jax.tree_util.keystr(path, simple=True, separator="/"): len(x) for path, x in leaves}
            raise ValueError(
                "all arrays must have the same length, which is the number of samples and must be at least 1, but "
                f"{f'the lengths are {found}' if found else 'there are no arrays'}: give arrays of equal length that "
                "are not empty"
            )

    def __len__(self) -> int:
        return len(next(iter(self.targets.values())))

    def take(self, index: np.ndarray, **further: np.ndarray) -> Batch:
        """Select the samples of one batch.

        Args:
            index: Indices of the samples.
            further: Two optional keyword arguments, `views` and `falls`. Each has indices along the first axis of the
                arrays in the field of the same name. If one of them is missing, the batch lacks this field.

        Returns:
            A dictionary from the name of each field to its selected arrays. The field `empty` is included as a whole.
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
    """Iterate over the batches of a training, each as an array of sample indices.

    Each epoch is a random permutation of all samples. A batch may contain the end of one epoch and the start of the
    next, so that no sample is dropped. The batches of a training are numbered from 0. The samples in batch k do not
    depend on `start` and `stop`, so that a resumed training uses the same batches.

    Args:
        seed: Seed of the permutations.
        samples: Number of samples.
        batch_size: Number of samples in a batch.
        start: Number k of the first batch.
        stop: Number k of the last batch, plus 1, as in `range(start, stop)`.

    Yields:
        Indices of the samples of one batch, `(batch_size,)`.
    """
    permutations: dict[int, np.ndarray] = {}
    for number in range(start, stop):
        epoch, place = np.divmod(np.arange(number * batch_size, (number + 1) * batch_size), samples)
        permutations = {
            e: permutations.get(e, np.random.default_rng([seed, e]).permutation(samples)) for e in np.unique(epoch)
        }
        yield np.array([permutations[e][p] for e, p in zip(epoch, place, strict=True)])
