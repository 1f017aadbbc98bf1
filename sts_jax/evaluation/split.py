"""The trajectories of a dataset that train, validate and test a model."""

from collections.abc import Sequence

import numpy as np

from sts_jax.dataset import Dataset


def train_share(shares: Sequence[float], split: str) -> float:
    """The share of the objects, or of the trajectories, that is used for training.

    Args:
        shares: The shares of training, validation and test objects that the collection states.
        split: `object` if whole objects are held out, `trajectory` if trajectories are. The latter split has no
            validation part, as in the paper.
    """
    return shares[0] if split == "object" else 1 - shares[2]


def rows_of(data: Dataset, split: str = "object") -> dict[str, np.ndarray]:
    """Indices of the trajectories with images that are for training, validation and test.

    Args:
        data: The dataset.
        split: `object` holds out whole objects. `trajectory` holds out shuffled trajectories, so that the parts have
            objects in common, as in the paper. Its validation part is the training part.

    Raises:
        ValueError: The split is neither of these.
    """
    if split == "object":
        return {name: data.members(name) for name in ("train", "validation", "test")}
    if split != "trajectory":
        raise ValueError(f"split must be 'object' or 'trajectory', got {split!r}")
    rendered = data.rendered()
    order = rendered[np.random.default_rng(data.collection["seed"]).permutation(len(rendered))]
    cut = round(train_share(data.collection["shares"], split) * len(order))
    return {"train": np.sort(order[:cut]), "validation": np.sort(order[:cut]), "test": np.sort(order[cut:])}
