"""Loss of a classifier on unseen objects, with confidence intervals over objects.

Rows of the arrays are items, such as trajectories or images. `groups` has the index of each item's object.
Cross-validation folds and bootstrap samples contain all items of an object or none.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from sklearn.ensemble import HistGradientBoostingClassifier
from sklearn.model_selection import GroupKFold
from threadpoolctl import threadpool_limits

from sts_jax.evaluation import metrics

FOLDS = 5
SEEDS = 3  # classifiers for each fold, whose probabilities are averaged
FLOOR = 1e-3  # smallest probability of a class, which bounds the log loss


class Interval(NamedTuple):
    """A value with its 95 % interval."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return metrics.written(*self, digits=3)


def probabilities(x: np.ndarray, y: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """Predict the class of each row by boosted trees that were fitted to rows of other groups."""
    result = np.zeros((len(y), y.max() + 1))
    # The trees are small, so more threads would only wait for each other on a busy machine.
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
    """Return the weighted mean, `sum(weight * values) / sum(weight)`."""
    return float(np.average(values, weights=weight))


def gain(before: np.ndarray, after: np.ndarray, weight: np.ndarray) -> float:
    """Relative decrease of the weighted mean loss, `1 - mean(after, weight) / mean(before, weight)`."""
    return 1 - mean(after, weight) / mean(before, weight)


def interval(statistic: Callable[..., float], *columns: np.ndarray, groups: np.ndarray) -> Interval:
    """Compute a statistic and its 95 % interval, from a bootstrap that resamples groups of rows."""
    draws = metrics.bootstrap(groups, lambda weight: np.asarray(statistic(*columns, weight)))
    return Interval(statistic(*columns, np.ones(len(groups))), *metrics.interval(draws))
