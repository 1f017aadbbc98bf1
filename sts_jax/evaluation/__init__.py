"""Evaluation of predictions: errors, metrics, baselines, the best possible prediction, tables and figures."""

from sts_jax.evaluation import figures, gap, metrics
from sts_jax.evaluation.catalogue import (
    CALIBRATION,
    COLUMNS,
    LOG_LOSS,
    METRICS,
    Column,
    Metric,
    Scores,
    measurement_error,
)
from sts_jax.evaluation.figures.motion import outside
from sts_jax.evaluation.images import STREAMS, image_summary
from sts_jax.evaluation.predictions import (
    TRUE_STATE,
    Predicted,
    emptiness,
    first,
    frequency,
    joined,
    outcome_of_pose,
    predict,
    rows_of,
    shares,
    subsets,
    train_share,
)
from sts_jax.evaluation.references import BASELINES, CEILING, CEILINGS, ONE_REROLL, baselines, ceiling, image_baselines
from sts_jax.evaluation.results import full_table, gain, score, scorer, summarise, table

__all__ = [
    "BASELINES",
    "CALIBRATION",
    "CEILING",
    "CEILINGS",
    "COLUMNS",
    "LOG_LOSS",
    "METRICS",
    "ONE_REROLL",
    "STREAMS",
    "TRUE_STATE",
    "Column",
    "Metric",
    "Predicted",
    "Scores",
    "baselines",
    "ceiling",
    "emptiness",
    "figures",
    "first",
    "frequency",
    "full_table",
    "gain",
    "gap",
    "image_baselines",
    "image_summary",
    "joined",
    "measurement_error",
    "metrics",
    "outcome_of_pose",
    "outside",
    "predict",
    "rows_of",
    "score",
    "scorer",
    "shares",
    "subsets",
    "summarise",
    "table",
    "train_share",
]
