"""The split of a dataset into trajectories for training, validation and test."""

from collections.abc import Sequence

import numpy as np

from sts_jax.dataset import Dataset


def train_share(shares: Sequence[float], split: str) -> float:
    """The share of the objects or trajectories that is used for training.

    Args:
        shares: Shares of the objects for training, validation and test, `Collection.shares`.
        split: `object` if whole objects are held out, `trajectory` if single trajectories are held out. A split by
            trajectory has no separate validation part, as in the paper (Rezaei-Shoshtari et al. 2021). The validation
            share is then used for training.
    """
    return shares[0] if split == "object" else 1 - shares[2]


def rows_of(data: Dataset, split: str = "object") -> dict[str, np.ndarray]:
    """Split the trajectories of a dataset into parts for training, validation and test.

    Trajectories without images are left out.

    Args:
        data: The dataset.
        split: With `object`, whole objects are held out, and `Dataset.split` contains the objects of each part. With
            `trajectory`, random trajectories are held out, as in the paper (Rezaei-Shoshtari et al. 2021). The training
            and the test part then have objects in common.

    Returns:
        Indices of the trajectories, int `(n,)`, for each of `train`, `validation` and `test`. With
        `split="trajectory"`, the validation part equals the training part.

    Raises:
        ValueError: `split` is neither `object` nor `trajectory`.
    """
    if split == "object":
        return {name: data.members(name) for name in ("train", "validation", "test")}
    if split != "trajectory":
        raise ValueError(f"split must be 'object' or 'trajectory', got {split!r}")
    rendered = data.rendered()
    order = rendered[np.random.default_rng(data.collection["seed"]).permutation(len(rendered))]
    cut = round(train_share(data.collection["shares"], split) * len(order))
    return {"train": np.sort(order[:cut]), "validation": np.sort(order[:cut]), "test": np.sort(order[cut:])}
