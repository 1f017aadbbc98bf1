"""Markdown tables of a summary: `table` with the main metrics, and `full_table` with further metrics."""

from collections.abc import Sequence

from sts_jax.evaluation.catalogue import COLUMNS, METRICS
from sts_jax.evaluation.records import Column, Metric


def table(
    summary: dict,
    *,
    title: str,
    rows: Sequence[str] | None = None,
    notes: Sequence[str] = (),
    columns: Sequence[Column] = COLUMNS,
) -> str:
    """Format the main metrics as a Markdown table.

    Args:
        summary: The result of `summarise`.
        title: Heading above the table.
        rows: Names of the predictors, in the order of the rows (default: all).
        notes: Lines below the table.
        columns: The columns of metrics, from left to right.

    Returns:
        The text. It consists of the title, an explanation of the metrics, the table and the notes.

    Raises:
        ValueError: The summary lacks the metric of a column.
    """
    shown = [metric for column in columns for metric in column.metrics]
    _check(summary, shown)
    lines = _head(["predictor", *(column.heading for column in columns)])
    for name in summary["predictors"] if rows is None else rows:
        own = summary["predictors"][name]
        cells = [[_shown(own, metric, interval=metric.interval) for metric in column.metrics] for column in columns]
        lines.append(_row([name, *("-" if set(cell) == {"-"} else " / ".join(cell) for cell in cells)]))
    return "\n".join([f"# {title}", "", _above(summary, shown), "", *lines, "", *notes, ""])


def full_table(summary: dict, *, title: str, notes: Sequence[str] = (), metrics: Sequence[Metric] = METRICS) -> str:
    """Format all metrics as a Markdown table, followed by a table of the differences from the baselines.

    Metrics whose field `column` is False are left out.

    Args:
        summary: The result of `summarise`.
        title: Heading above the tables.
        notes: Lines below the tables.
        metrics: The metrics, in the order of the columns.

    Returns:
        The text. It consists of the title, an explanation of the metrics, the tables and the notes.

    Raises:
        ValueError: The summary lacks a metric.
    """
    shown = [metric for metric in metrics if metric.column]
    _check(summary, shown)
    lines = _head(["predictor", *(metric.title for metric in shown)])
    for name, own in summary["predictors"].items():
        lines.append(_row([name, *(_shown(own, metric, interval=metric.interval) for metric in shown)]))
    compared = [metric for metric in shown if metric.compared is not None]
    lines += ["", _directions(compared), "", *_head(["predictor", "baseline", *(metric.title for metric in compared)])]
    for name, against in summary["differences"].items():
        for base, own in against.items():
            cells = [_shown(own, metric, interval=True) for metric in compared]
            if set(cells) != {"-"}:
                lines.append(_row([name, base, *cells]))
    return "\n".join([f"# {title}", "", _above(summary, shown), "", *lines, "", *notes, ""])


def _check(summary: dict, metrics: Sequence[Metric]) -> None:
    """Raise an error if the summary lacks a metric."""
    known: dict = next(iter(summary["predictors"].values()), {})
    missing = [metric.name for metric in metrics if metric.name not in known]
    if missing:
        raise ValueError(
            f"summary lacks {' and '.join(map(repr, missing))}: pass all metrics of the table to score() and "
            "summarise()"
        )


def _head(cells: Sequence[str]) -> list[str]:
    return [_row(cells), "|---" * len(cells) + "|"]


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _shown(own: dict, metric: Metric, *, interval: bool) -> str:
    """The text of a cell: the value of a metric, or "-" if the predictor does not have the metric."""
    found = own[metric.name]
    if found is None:
        return "-"
    value, low, high = (f"{found[key] * metric.factor:.{metric.digits}f}" for key in ("value", "low", "high"))
    return f"{value} [{low}, {high}]" if interval else value


def _directions(compared: Sequence[Metric]) -> str:
    """Sentences above the differences: for which metrics a positive or a negative difference is better."""
    text = "Differences from the baselines (predictor minus baseline)."
    for sign, direction in (("positive", "higher"), ("negative", "lower")):
        titles = [
            metric.heading or metric.name.replace("_", " ") for metric in compared if metric.compared == direction
        ]
        if titles:
            text += f" A {sign} difference is better for {', '.join(titles)}."
    return text


def _above(summary: dict, metrics: Sequence[Metric]) -> str:
    """The text above the tables: the number of held-out trajectories, and explanations of the metrics."""
    outcomes = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in summary["outcomes"].items())
    text = (
        f"{summary['items']} held-out trajectories of {summary['objects']} objects ({outcomes}). Brackets contain "
        "95 % bootstrap intervals over objects."
    )
    fewer = [
        f'The metrics of "{name}" are over the first {count} trajectories.'
        for name, count in summary["scored"].items()
        if count < summary["items"]
    ]
    explained = dict.fromkeys(metric.note for metric in metrics if metric.note)
    return " ".join([text, *fewer, *explained])
