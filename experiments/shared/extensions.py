"""`Extensions`: a user's own loss, optimiser, logger, metrics and modalities for a whole experiment."""

import dataclasses
from collections.abc import Callable
from typing import Any

import optax

from sts_jax import dataset, evaluation, mvae, statespace, training

Log = Callable[[int, dict[str, float]], None]  # arguments: step of a record, its other numbers by name


@dataclasses.dataclass(frozen=True)
class Extensions:
    """Your own parts of an experiment. A field with its default value stands for the part of the library.

    Functions cannot be compared. A finished model or table is therefore not made again if the code of a function
    changes. After such a change, use other `notes`, another name of the metric, or a new work directory.

    Raises:
        ValueError: Two metrics have the same name, or a column has a metric that `metrics` lacks.
    """

    # Function of the configuration of a model that returns the loss of this model
    loss: Callable[[mvae.Config | statespace.Config], training.Loss] | None = None
    # Optimiser of all models, in place of Adam with the options of the configuration
    optimiser: optax.GradientTransformation | None = None
    # JSON values that describe the loss and the optimiser. They are stored with each model, and a resumed training must
    # have the same notes
    notes: dict[str, Any] | None = None
    # Function of the name of a model that returns a function of the step and the values of a record, as the argument
    # `log` of `training.train`
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
                        f"the column {column.heading!r} has the metric {metric.name!r}, but metrics has only "
                        f"{', '.join(map(repr, names))}: add the metric to metrics, or leave out the column"
                    )

    @property
    def scored(self) -> tuple[evaluation.Metric, ...]:
        """All metrics: `metrics`, and the error of each further modality."""
        return (*self.metrics, *(evaluation.measurement_error(own) for own in self.measurements))

    def described(self) -> list[Any]:
        """The metrics without their functions, the columns and the modalities, as JSON values for a checksum."""
        fields = [{name: str(x) for name, x in vars(metric).items() if not callable(x)} for metric in self.scored]
        columns = [[column.heading, [metric.name for metric in column.metrics]] for column in self.columns]
        return [fields, columns, [own.name for own in self.measurements]]


NONE = Extensions()  # only parts of the library
