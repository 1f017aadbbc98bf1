"""The records of an evaluation: `Scores`, the errors of a predictor, and `Metric`, a column of a table."""

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np

from sts_jax.dataset import Pairs
from sts_jax.evaluation.metrics import ImageError
from sts_jax.evaluation.predictions import Predicted

Statistic = Callable[[np.ndarray], float]  # a number as a function of the weights of the items (n,)
Errors = Callable[[Predicted, Pairs], np.ndarray | None]  # one number per item (n,)


class Scores(NamedTuple):
    """Errors of one predictor, per item. The errors of quantities that it does not predict are None.

    The fields from `coverage` to `fell_off` are for predicted distributions. The energy score of a deterministic
    position is its error.
    """

    visual: ImageError | None
    visual_object: ImageError | None
    tactile: ImageError | None
    tactile_object: ImageError | None
    position: np.ndarray | None  # m (n,)
    angle: np.ndarray | None  # rad (n,)
    axis: np.ndarray | None  # rad (n,), of the up axes
    outcome: np.ndarray | None  # int (n,)
    energy: np.ndarray | None = None  # m (n,), energy score of the position
    coverage: np.ndarray | None = None  # (n,), see `metrics.coverage`
    best: ImageError | None = None  # visual error of each item's sample with the smallest excess
    gradient: np.ndarray | None = None  # (n,) gradient energy of the image, or mean over the visual samples
    gradient_target: np.ndarray | None = None  # (n,) gradient energy of the true images
    log_loss: np.ndarray | None = None  # nats (n,), of the outcome
    confidence: np.ndarray | None = None  # (n,) probability of the likeliest outcome
    right: np.ndarray | None = None  # bool (n,), whether that outcome came true
    fell_off: np.ndarray | None = None  # (n,) probability of FELL_OFF
    further: dict[str, np.ndarray] | None = None  # (n,) each, the `errors` of metrics by their name

    def first(self, count: int) -> "Scores":
        """The errors of the first `count` items."""
        cut: Scores = jax.tree.map(lambda leaf: leaf[:count], self)  # None stays None
        return cut


class Judged(NamedTuple):
    """The errors of one predictor, and the reference and the truth of the same items."""

    scores: Scores
    constant: Scores  # of the constant prediction, the reference of the skill
    test: Pairs


@dataclasses.dataclass(frozen=True)
class Metric:
    """A number that summaries and tables have for each predictor.

    Predicted images are too large to keep, so a metric is computed in two steps. `score` calls `errors`, which makes
    one number per item of a prediction. `summarise` calls `statistic`, which makes a function of the weights of the
    items of these numbers. The bootstrap over objects evaluates that function. Without `statistic`, the metric is the
    weighted mean of `errors`. A metric of the errors that `Scores` has anyway needs no `errors`.

    Raises:
        ValueError: The metric has neither `errors` nor a `statistic`, its name is empty, or a field is out of range.
    """

    name: str  # under which summaries list it
    errors: Errors | None = None  # of a prediction of n items, `(n,)`, or None if it does not predict the quantity
    unit: str = ""  # of the column, shown in brackets
    digits: int = 3  # decimals in the column
    factor: float = 1.0  # from the number in the summary (SI units) to the column's unit, such as 1e3 for mm
    heading: str = ""  # of the column (default: the name, with spaces)
    statistic: Callable[[Judged], Statistic | None] | None = None  # None if a predictor does not have the metric
    interval: bool = True  # whether the column shows the interval
    column: bool = True  # whether the complete table has the metric. Summaries always have it.
    # "higher" or "lower", the better values. A metric with a direction is a column of the differences from baselines.
    compared: str | None = None
    note: str = ""  # a sentence above the table that explains the metric

    def __post_init__(self) -> None:
        if not self.name:
            raise ValueError(
                "name of a metric is empty: give the name under which summaries list it, such as 'height_error'"
            )
        if self.errors is None and self.statistic is None:
            raise ValueError(f"metric {self.name!r} has neither errors nor statistic: give a function as one of them")
        if type(self.digits) is not int or self.digits < 0:
            raise ValueError(f"metric {self.name!r}: digits must be a whole number >= 0, got {self.digits!r}")
        if self.compared not in ("higher", "lower", None):
            raise ValueError(f"metric {self.name!r}: compared must be 'higher', 'lower' or None, got {self.compared!r}")

    @property
    def title(self) -> str:
        """The heading of its column, with the unit."""
        heading = self.heading or self.name.replace("_", " ")
        return f"{heading} ({self.unit})" if self.unit else heading

    def of(self, judged: Judged) -> Statistic | None:
        """The metric of one predictor as a function of the weights of its items, or None if it does not have it."""
        if self.statistic is not None:
            return self.statistic(judged)
        values = (judged.scores.further or {}).get(self.name)
        return None if values is None else functools.partial(mean, values)


class Column(NamedTuple):
    """A column of the short table: one metric, or several of one quantity with a slash between them."""

    heading: str
    metrics: tuple[Metric, ...]


def mean(values: np.ndarray, weight: np.ndarray) -> float:
    """The weighted mean, or nan if there is no weight."""
    return float((weight * values).sum() / weight.sum()) if weight.sum() > 0 else float("nan")
