"""Classes for evaluations. `Scores` holds the errors of a predictor. `Metric` computes one number from them.

An item is one held-out trajectory. n is the number of items.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np

from sts_jax.dataset import Pairs
from sts_jax.evaluation.metrics import ImageError
from sts_jax.evaluation.predictions import Predicted

Statistic = Callable[[np.ndarray], float]  # a function of the weights of the items (n,) that returns a number
Errors = Callable[[Predicted, Pairs], np.ndarray | None]  # returns one number per item (n,)


class Scores(NamedTuple):
    """Errors of one predictor for n held-out trajectories.

    The errors of quantities that the predictor does not predict are None. For a prediction without samples, `coverage`
    and `best` are None, and `energy` is the position error. For a prediction without outcome probabilities, `log_loss`,
    `confidence`, `right` and `fell_off` are None.
    """

    visual: ImageError | None  # error of the visual images
    visual_object: ImageError | None  # error of the visual images over the object's pixels in the true last frame
    tactile: ImageError | None  # error of the tactile images
    tactile_object: ImageError | None  # error of the tactile images over the object's pixels in the true last frame
    position: np.ndarray | None  # (n,): distance of the predicted from the true position (m)
    angle: np.ndarray | None  # (n,): angle between the predicted and the true orientation (rad)
    axis: np.ndarray | None  # (n,): angle between the predicted and the true up axis (rad)
    outcome: np.ndarray | None  # int (n,): number of the predicted outcome
    energy: np.ndarray | None = None  # (n,): energy score of the position (m)
    coverage: np.ndarray | None = None  # (n,): 0 to 1, see `metrics.coverage`
    best: ImageError | None = None  # error of the visual sample with the smallest excess of each item
    gradient: np.ndarray | None = None  # (n,): gradient energy of the visual image, or its mean over the visual samples
    gradient_target: np.ndarray | None = None  # (n,): gradient energy of the true visual image
    log_loss: np.ndarray | None = None  # (n,): minus the logarithm of the true outcome's probability (nats)
    confidence: np.ndarray | None = None  # (n,): probability of the likeliest outcome
    right: np.ndarray | None = None  # bool (n,): true if the likeliest outcome is the true one
    fell_off: np.ndarray | None = None  # (n,): probability that the object falls off
    further: dict[str, np.ndarray] | None = None  # (n,) each: the results of `Metric.errors`, by the metric's name

    def first(self, count: int) -> "Scores":
        """Return the errors of the first `count` items."""
        cut: Scores = jax.tree.map(lambda leaf: leaf[:count], self)  # None stays None
        return cut


class Judged(NamedTuple):
    """The input of `Metric.statistic`: the errors of a predictor and of a constant baseline, and the true trajectories.

    The constant baseline always predicts the mean last frame of the training trajectories.
    """

    scores: Scores  # errors of the predictor
    constant: Scores  # errors of the constant prediction for the same items, to which the skill is relative
    test: Pairs  # the items


@dataclasses.dataclass(frozen=True)
class Metric:
    """A number that describes the quality of a predictor in summaries and tables.

    A metric is computed in two steps, because predicted images are too large to keep. First, `score` calls `errors`,
    which returns one number per item (held-out trajectory). Then `summarise` calls `statistic`, which returns a
    function of the weights of the items. The bootstrap over objects evaluates this function many times, each time with
    different weights.

    A metric needs `errors`, `statistic` or both. Without `statistic`, the metric is the weighted mean of `errors`.
    Without `errors`, `statistic` uses the fields of `Scores`.

    Raises:
        ValueError: `name` is empty, the metric has neither `errors` nor `statistic`, `digits` is not a whole
            number >= 0, or `compared` is not 'higher', 'lower' or None.
    """

    name: str  # name of the metric in summaries
    # Function of the predictions and the true items that returns one number per item, `(n,)`. It returns None if the
    # predictor does not predict the quantity.
    errors: Errors | None = None
    unit: str = ""  # unit in the table, in brackets behind the heading
    digits: int = 3  # number of decimals in the table
    factor: float = 1.0  # value in the table divided by the value in the summary (SI units), such as 1e3 for mm
    heading: str = ""  # heading of the column in the table (default: the name, with spaces)
    # Function that returns a second function or None. The second function computes the metric from the weights of the
    # items, `(n,)`. None means that the predictor does not predict the quantity.
    statistic: Callable[[Judged], Statistic | None] | None = None
    interval: bool = True  # true if the table shows the interval
    column: bool = True  # true if the complete table has the metric (summaries always have it)
    # "higher" or "lower": which values are better. The complete table then also shows the differences from the
    # baselines. None: it does not.
    compared: str | None = None
    note: str = ""  # sentences above the table that explain the metric

    def __post_init__(self) -> None:
        if not self.name:
            raise ValueError("the name of a metric must not be empty: give it a name, such as 'height_error'")
        if self.errors is None and self.statistic is None:
            raise ValueError(
                f"metric {self.name!r} has neither `errors` nor `statistic`: give a function for one of these two "
                "arguments or for both"
            )
        if type(self.digits) is not int or self.digits < 0:
            raise ValueError(f"metric {self.name!r}: `digits` must be a whole number >= 0, got {self.digits!r}")
        if self.compared not in ("higher", "lower", None):
            raise ValueError(
                f"metric {self.name!r}: `compared` must be 'higher', 'lower' or None, got {self.compared!r}"
            )

    @property
    def title(self) -> str:
        """The heading of the metric's column in tables, with the unit, such as "position (mm)"."""
        heading = self.heading or self.name.replace("_", " ")
        return f"{heading} ({self.unit})" if self.unit else heading

    def of(self, judged: Judged) -> Statistic | None:
        """Return a function that computes the metric of one predictor.

        The argument of the function is the weight of each trajectory in the metric, `(n,)`.

        Args:
            judged: The errors of the predictor, the errors of a constant baseline, and the n true trajectories. The
                baseline always predicts the mean last frame of the training trajectories.

        Returns:
            The function, or None if the predictor does not predict the quantity that the metric measures.
        """
        if self.statistic is not None:
            return self.statistic(judged)
        values = (judged.scores.further or {}).get(self.name)
        return None if values is None else functools.partial(mean, values)


class Column(NamedTuple):
    """A column of the Markdown table that `table` makes.

    It contains one metric, or several metrics whose values are separated by slashes.
    """

    heading: str
    metrics: tuple[Metric, ...]


def mean(values: np.ndarray, weight: np.ndarray) -> float:
    """Return `sum(weight * values) / sum(weight)`, or nan if the sum of the weights is 0."""
    return float((weight * values).sum() / weight.sum()) if weight.sum() > 0 else float("nan")
