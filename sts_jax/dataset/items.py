"""`Items`: random access to the trajectories or frames of a dataset, for data loaders such as grain and PyTorch."""

import dataclasses
from typing import Any, Literal

import numpy as np

from sts_jax.dataset.loading import Dataset
from sts_jax.dataset.records import Shard

_FRAME = ("time", "pose", "velocity", "wrench", "gravity", "contact", "wall")
_TRAJECTORY = ("outcome", "settled", "condition")


def frame_fields(data: Dataset, trajectory: int, frames: np.ndarray) -> dict[str, np.ndarray]:
    """Fields of some frames of a trajectory by name, (n, *shape) each: those of `physics.Trajectory`, and `frame`."""
    return {"frame": frames} | {name: data.trajectory[name][trajectory, frames] for name in _FRAME}


def trajectory_fields(data: Dataset, trajectory: int) -> dict[str, np.ndarray]:
    """Fields of a trajectory by name: outcome, condition, hidden properties, mass (kg), centre of mass (m), object."""
    return {
        "trajectory": np.array(trajectory),
        # copies, because a loader may change an item in place
        **{name: data.trajectory[name][trajectory].copy() for name in _TRAJECTORY},
        **{f"hidden.{name}": values[trajectory].copy() for name, values in data.hidden.items()},
        **{name: data.solid[name][trajectory].copy() for name in ("mass", "com")},
        "object": data.trajectory["body"][trajectory].astype(np.int64),
    }


@dataclasses.dataclass(frozen=True, eq=False)
class Items:
    """Trajectories or frames of a dataset as a sequence, which reads the images of one item when it is asked for it.

    `grain.MapDataset.source`, `grain.DataLoader` and `torch.utils.data.DataLoader` accept it. It can be pickled, and
    several threads and processes can read it.
    """

    data: Dataset  # the dataset
    trajectories: np.ndarray  # indices of trajectories with images, int (n,)
    # "trajectory": an item has all stored frames of one trajectory, on the first axis. "frame": an item is one frame
    by: Literal["trajectory", "frame"] = "trajectory"
    # rows of `Dataset.frames` in the order of trajectory and time, and the part of them that each item has
    _order: np.ndarray = dataclasses.field(init=False, repr=False)
    _bounds: np.ndarray = dataclasses.field(init=False, repr=False)
    _opened: dict[int, Shard] = dataclasses.field(init=False, repr=False)

    def __post_init__(self) -> None:
        if self.by not in ("trajectory", "frame"):
            raise ValueError(f"by is {self.by!r}, but it must be 'trajectory' or 'frame'")
        chosen = self.data.checked(self.trajectories)
        order = np.lexsort(self.data.frames.T[::-1])
        bounds = np.searchsorted(self.data.frames[order, 0], np.stack([chosen, chosen + 1], axis=1))
        if (lacking := chosen[bounds[:, 0] == bounds[:, 1]]).size:
            raise ValueError(
                f"`trajectories` contains {lacking[0]}, which has no images: take indices from `Dataset.members` or "
                "`Dataset.rendered`"
            )
        if self.by == "frame":
            first = np.concatenate([np.arange(0), *(np.arange(*both) for both in bounds)])
            bounds = np.stack([first, first + 1], axis=1)
        for name, value in (("_order", order), ("_bounds", bounds), ("_opened", {})):
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return len(self._bounds)

    def __getitem__(self, index: int) -> dict[str, np.ndarray]:
        """The fields of `trajectory_fields` and `frame_fields` by name, and the fields of `Images`."""
        rows = self._order[slice(*self._bounds[index])]
        trajectory, frames = int(self.data.frames[rows[0], 0]), self.data.frames[rows, 1].astype(np.int64)
        images = self.data.images(rows, opened=self._opened)
        of_frames = frame_fields(self.data, trajectory, frames) | images._asdict()
        if self.by == "frame":
            of_frames = {name: x[0] for name, x in of_frames.items()}
        return trajectory_fields(self.data, trajectory) | of_frames

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"_opened": {}}  # an open file cannot be pickled
