"""`Extensions`: a user's own loss, optimiser, logger, metrics and modalities for a whole experiment."""

import dataclasses
from collections.abc import Callable
from typing import Any

import optax

from sts_jax import dataset, evaluation, mvae, statespace, training

Log = Callable[[int, dict[str, float]], None]  # arguments: step of a record, other numbers of the record by name


@dataclasses.dataclass(frozen=True)
class Extensions:
    """Your own loss, optimiser, logger, metrics, table columns and modalities for an experiment.

    A field that you do not set selects the library's own part, such as the library's loss.

    Functions cannot be compared. A finished model or table is therefore not made again if the code of a loss, an
    optimiser or a metric changes. After a change of the loss or the optimiser, use a new work directory. After a change
    of a metric's function, rename the metric.

    Raises:
        ValueError: Two metrics have the same name, or a column uses a metric that is neither in `metrics` nor the error
            of a modality in `measurements`.
    """

    # Function that receives the configuration of a model, and returns the loss for it
    loss: Callable[[mvae.Config | statespace.Config], training.Loss] | None = None
    # Optimiser of all models, in place of Adam with the options of the configuration
    optimiser: optax.GradientTransformation | None = None
    # JSON values that describe the loss and the optimiser. They are stored with each model, and a resumed training must
    # have the same notes
    notes: dict[str, Any] | None = None
    # Function that receives the name of a model, and returns the argument `log` of `training.train` for it
    log: Callable[[str], Log] | None = None
    metrics: tuple[evaluation.Metric, ...] = evaluation.METRICS  # metrics of metrics.json and table-full.md
    columns: tuple[evaluation.Column, ...] = evaluation.COLUMNS  # columns of table.md
    # Further modalities of the paper's model with all modalities (`--model paper`). Their errors are further metrics
    measurements: tuple[dataset.Measurement, ...] = ()

    def __post_init__(self) -> None:
        names = [metric.name for metric in self.scored]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"metrics has more than one metric named {twice[0]!r}: give each metric its own name")
        for column in self.columns:
            for metric in column.metrics:
                if metric.name not in names:
                    raise ValueError(
                        f"the column {column.heading!r} has the metric {metric.name!r}, which is not among the metrics "
                        f"of these Extensions ({', '.join(map(repr, names)) or 'none'}): add the metric to the field "
                        "`metrics`, or leave out the column"
                    )

    @property
    def scored(self) -> tuple[evaluation.Metric, ...]:
        """All metrics: those of the field `metrics`, and the error of each modality in `measurements`."""
        return (*self.metrics, *(evaluation.measurement_error(own) for own in self.measurements))

    def described(self) -> list[Any]:
        """Describe all metrics, all table columns and the additional modalities as JSON values that can be compared."""
        fields = [{name: str(x) for name, x in vars(metric).items() if not callable(x)} for metric in self.scored]
        columns = [[column.heading, [metric.name for metric in column.metrics]] for column in self.columns]
        return [fields, columns, [[own.name, own.shape, float(own.scale)] for own in self.measurements]]


NONE = Extensions()
