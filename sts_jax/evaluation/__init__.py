"""Evaluation of predictions: errors, metrics, baselines, the best possible prediction, tables and figures."""

from sts_jax.evaluation import figures, gap, metrics
from sts_jax.evaluation.catalogue import COLUMNS, METRICS
from sts_jax.evaluation.images import STREAMS, image_baselines, image_summary
from sts_jax.evaluation.measurements import measurement_error
from sts_jax.evaluation.outcomes import emptiness, frequency, outcome_of_image, outcome_of_pose, shares
from sts_jax.evaluation.predictions import TRUE_STATE, Forecaster, Predicted, first, joined, predict, subsets
from sts_jax.evaluation.records import Column, Judged, Metric, Scores
from sts_jax.evaluation.reference import BASELINES, CEILING, CEILINGS, ONE_REROLL, baselines
from sts_jax.evaluation.rerolls import ceiling
from sts_jax.evaluation.scores import score, scorer
from sts_jax.evaluation.split import rows_of, train_share
from sts_jax.evaluation.summary import gain, summarise
from sts_jax.evaluation.tables import full_table, table
from sts_jax.evaluation.views import outside

__all__ = [
    "BASELINES",
    "CEILING",
    "CEILINGS",
    "COLUMNS",
    "METRICS",
    "ONE_REROLL",
    "STREAMS",
    "TRUE_STATE",
    "Column",
    "Forecaster",
    "Judged",
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
    "outcome_of_image",
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
