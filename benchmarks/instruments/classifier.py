"""Loss of a classifier on unseen objects, with intervals over objects.

Rows are items (trajectories, frames), and `groups` has the object of each. Folds and intervals never split an object.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from sklearn.ensemble import HistGradientBoostingClassifier
from sklearn.model_selection import GroupKFold
from threadpoolctl import threadpool_limits

from sts_jax.evaluation import metrics

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


def probabilities(x: np.ndarray, y: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """Probabilities of the classes of each row, by boosted trees that are fitted to the other groups.

    Args:
        x: Features, `(n, k)`.
        y: Classes 0, 1, ..., int `(n,)`.
        groups: The group of each row, `(n,)`.

    Returns:
        `(n, classes)`, at least FLOOR.
    """
    result = np.zeros((len(y), y.max() + 1))
    # One thread, because trees are small, and threads that wait for each other are slow on a busy machine.
    with threadpool_limits(1):
        for fitted, held_out in GroupKFold(FOLDS, shuffle=True, random_state=0).split(x, y, groups):
            for seed in range(SEEDS):
                trees = HistGradientBoostingClassifier(
                    max_iter=120,
                    learning_rate=0.05,
                    max_leaf_nodes=8,
                    l2_regularization=1.0,
                    max_features=0.5,
                    early_stopping=False,
                    random_state=seed,
                ).fit(x[fitted], y[fitted])
                result[np.ix_(held_out, trees.classes_)] += trees.predict_proba(x[held_out]) / SEEDS
    return result * (1 - FLOOR * result.shape[1]) + FLOOR


def mean(values: np.ndarray, weight: np.ndarray) -> float:
    """The weighted mean."""
    return float(np.average(values, weights=weight))


def gain(before: np.ndarray, after: np.ndarray, weight: np.ndarray) -> float:
    """Share by which the mean loss decreases from `before` to `after`."""
    return 1 - mean(after, weight) / mean(before, weight)


def kept(before: np.ndarray, after: np.ndarray, other: np.ndarray, weight: np.ndarray) -> float:
    """The gain of `other` divided by that of `after`."""
    return gain(before, other, weight) / gain(before, after, weight)


def interval(statistic: Callable[..., float], *columns: np.ndarray, groups: np.ndarray) -> Interval:
    """A statistic with its 95 % interval over groups (bootstrap).

    Args:
        statistic: A function of the columns and of the weights `(n,)` of the rows, as `mean`.
        columns: Values, `(n,)` each.
        groups: The group of each row, `(n,)`.
    """
    draws = metrics.bootstrap(groups, lambda weight: np.asarray(statistic(*columns, weight)))
    return Interval(statistic(*columns, np.ones(len(groups))), *metrics.interval(draws))
