"""The devices of a training: each batch is split over them, and the state of the training is copied to all.

With several processes (`jax.distributed`), each process reads only the part of a batch that its devices get.
"""

import contextlib
import json
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from sts_jax import storage
from sts_jax.training.arrays import Arrays, Batch


class Devices(NamedTuple):
    """One device, or a mesh of several."""

    mesh: Mesh | None  # None for the default device alone

    @classmethod
    def of(cls, devices: Sequence[jax.Device] | None, **sizes: int) -> "Devices":
        """Check that the devices divide the sizes of a batch, and that each process has as many of them.

        Args:
            devices: None for as many devices of each process as divide the sizes: all, or fewer.
            sizes: Numbers of items of a batch by the name of their field in `TrainConfig`.
        """
        chosen = sorted(jax.devices() if devices is None else devices, key=lambda one: (one.process_index, one.id))
        if devices is None:
            most = min(sum(one.process_index == process for one in chosen) for process in range(jax.process_count()))
            each = next(
                (n for n in range(most, 1, -1) if not any(s % (n * jax.process_count()) for s in sizes.values())), 1
            )
            places = [[one for one in chosen if one.process_index == i][:each] for i in range(jax.process_count())]
            chosen = [one for place in places for one in place]
        counts = [sum(one.process_index == process for one in chosen) for process in range(jax.process_count())]
        if not chosen or len(set(counts)) > 1:
            raise ValueError(f"devices must be as many in each process, and at least 1, got {counts} in the processes")
        for name, size in sizes.items():
            if size % len(chosen):
                raise ValueError(
                    f"{name} is {size}, but it must be a multiple of {len(chosen)}, the number of devices: choose "
                    "another one, or fewer devices (`devices=jax.devices()[:1]` trains on one)"
                )
        if devices is None and len(chosen) == 1:
            return cls(None)
        return cls(Mesh(np.array(chosen), ("batch",), axis_types=(AxisType.Auto,)))

    @property
    def leads(self) -> bool:
        """Whether this process writes the folder of the model."""
        return jax.process_index() == 0

    @property
    def several(self) -> bool:
        """Whether several processes train together."""
        return jax.process_count() > 1

    @property
    def everywhere(self) -> NamedSharding | None:
        """Place of arrays of which each device has a copy, None for one device."""
        return None if self.mesh is None else NamedSharding(self.mesh, PartitionSpec())

    def lock(self, folder: Path) -> contextlib.AbstractContextManager[None]:
        """Lock a folder for the process that writes it."""
        return storage.lock(folder) if self.leads else contextlib.nullcontext()

    def agree(self, **facts: Any) -> None:
        """Raise a ValueError if the processes differ in a fact, a JSON value."""
        if not self.several:
            return
        for name, fact in facts.items():
            sums = multihost_utils.process_allgather(np.uint32(zlib.crc32(json.dumps(fact).encode())))
            if len(np.unique(sums)) > 1:
                raise ValueError(
                    f"the processes of this training differ in {name} (here {fact}): start all with the same "
                    "arguments, and with a `workdir` on a file system that all share"
                )

    def wait(self, name: str) -> None:
        """Wait until all processes have come here."""
        if self.several:
            multihost_utils.sync_global_devices(name)

    def copies(self, state: Any) -> Any:
        """Copy arrays to all devices."""
        return state if self.mesh is None else jax.device_put(state, self.everywhere)

    def one(self, state: Any) -> Any:
        """The copy of arrays on the first device of this process."""
        return state if self.mesh is None else jax.tree.map(lambda leaf: leaf.addressable_data(0), state)

    def whole(self, state: Any) -> Any:
        """Arrays of a state for `folder.save`."""
        return state if self.several else self.one(state)

    def take(self, arrays: Arrays, index: np.ndarray, further: dict[str, np.ndarray]) -> Batch:
        """Read a batch, see `Arrays.take`. If the devices do not divide it, each gets all of it."""
        if self.mesh is None:
            return arrays.take(index, **further)
        divided = len(index) % self.mesh.size == 0

        def part(rows: np.ndarray) -> np.ndarray:
            return rows.reshape(jax.process_count(), -1)[jax.process_index()] if divided else rows

        batch = arrays.take(part(index), **{name: part(rows) for name, rows in further.items()})
        whole = self.everywhere
        split = NamedSharding(self.mesh, PartitionSpec("batch")) if divided else whole
        return {
            name: jax.tree.map(
                lambda x, to=whole if name == "empty" else split: jax.make_array_from_process_local_data(
                    to, np.asarray(x)
                ),
                value,
            )
            for name, value in batch.items()
        }
