"""Bootstrap over groups of items, such as all trajectories of one object, and intervals of the bootstrap values."""

from collections.abc import Callable

import numpy as np


def bootstrap(
    groups: np.ndarray, statistic: Callable[[np.ndarray], np.ndarray], *, num: int = 2000, seed: int = 0
) -> np.ndarray:
    """Compute a statistic for bootstrap samples, in which whole groups of items are drawn with replacement.

    Args:
        groups: Group of each item, such as its object, `(n,)`.
        statistic: Function that takes the weights of the items, `(n,)`, and returns a value or an array of values. The
            weight of an item is how often its group was drawn.
        num: Number of bootstrap samples.
        seed: Seed of the random numbers.

    Returns:
        Values of the statistic, `(num, ...)`.
    """
    rng = np.random.default_rng(seed)
    _, member = np.unique(groups, return_inverse=True)
    size = member.max() + 1
    draws = rng.multinomial(size, np.full(size, 1 / size), size=num)
    return np.stack([statistic(draw[member].astype(np.float64)) for draw in draws])


def interval(draws: np.ndarray) -> tuple[float, float]:
    """Compute a 95 % interval from bootstrap values: their 2.5 % and 97.5 % quantiles. NaN is ignored."""
    low, high = np.nanpercentile(draws, [2.5, 97.5])
    return float(low), float(high)
