"""Loss of a classifier on unseen objects, with intervals over objects.

Rows are items (trajectories, frames), and `groups` has the object of each. Folds and intervals never split an object.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from sklearn.ensemble import HistGradientBoostingClassifier
from sklearn.model_selection import GroupKFold
from threadpoolctl import threadpool_limits

FOLDS = 5
SEEDS = 3  # classifiers per fold, whose probabilities are averaged
FLOOR = 1e-3  # least probability of any class


class Interval(NamedTuple):
    """A value with its 95 % interval."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.3f} [{self.low:.3f}, {self.high:.3f}]"


def chances(x: np.ndarray, y: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """Probabilities (n, classes) of the classes 0, 1, ... for each row, by boosted trees fitted without its group."""
    result = np.zeros((len(y), y.max() + 1))
    # One thread, because trees are small, and threads that wait for each other are slow on a busy machine.
    with threadpool_limits(1):
        for fit, held_out in GroupKFold(FOLDS, shuffle=True, random_state=0).split(x, y, groups):
            for seed in range(SEEDS):
                trees = HistGradientBoostingClassifier(
                    max_iter=120,
                    learning_rate=0.05,
                    max_leaf_nodes=8,
                    l2_regularization=1.0,
                    max_features=0.5,
                    early_stopping=False,
                    random_state=seed,
                ).fit(x[fit], y[fit])
                result[np.ix_(held_out, trees.classes_)] += trees.predict_proba(x[held_out]) / SEEDS
    return result * (1 - FLOOR * result.shape[1]) + FLOOR


def log_loss(chances: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Loss (nats) of each row."""
    return -np.log(chances[np.arange(len(y)), y])


def gain(before: np.ndarray, after: np.ndarray) -> float:
    """Share by which the mean loss decreases from `before` to `after`."""
    return float(1 - after.mean() / before.mean())


def kept(before: np.ndarray, after: np.ndarray, other: np.ndarray) -> float:
    """The gain of `other` divided by that of `after`."""
    return gain(before, other) / gain(before, after)


def auc(label: np.ndarray, score: np.ndarray) -> float:
    """Probability that a true item scores above a false one (Mann and Whitney). Ties count half."""
    _, inverse, count = np.unique(score, return_inverse=True, return_counts=True)
    rank = (np.cumsum(count) - (count - 1) / 2)[inverse]
    positive, total = int(label.sum()), len(label)
    return float((rank[label].sum() - positive * (positive + 1) / 2) / (positive * (total - positive)))


def interval(
    statistic: Callable[..., float], *columns: np.ndarray, groups: np.ndarray, times: int = 1000, seed: int = 0
) -> Interval:
    """A statistic of columns with the 2.5 % and 97.5 % quantiles over resampled groups (bootstrap)."""
    rng = np.random.default_rng(seed)
    names, inverse = np.unique(groups, return_inverse=True)
    rows = np.split(np.argsort(inverse, kind="stable"), np.cumsum(np.bincount(inverse))[:-1])
    drawn = []
    for _ in range(times):
        sample = np.concatenate([rows[i] for i in rng.integers(0, len(names), len(names))])
        drawn.append(statistic(*(column[sample] for column in columns)))
    return Interval(statistic(*columns), *(float(q) for q in np.quantile(drawn, [0.025, 0.975])))
