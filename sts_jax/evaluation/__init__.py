"""Evaluation of predictions: metrics per item, tables with intervals, ceilings and figures."""

from sts_jax.evaluation import figures, metrics
from sts_jax.evaluation.report import (
    BASELINES,
    CEILING,
    CEILINGS,
    ONE_REROLL,
    Predicted,
    Scores,
    baselines,
    emptiness,
    first,
    frequency,
    joined,
    outcome_of_image,
    outcome_of_pose,
    score,
    shares,
)
from sts_jax.evaluation.rerolls import ceiling
from sts_jax.evaluation.tables import full_table, gain, summarise, table
from sts_jax.evaluation.views import outside

__all__ = [
    "BASELINES",
    "CEILING",
    "CEILINGS",
    "ONE_REROLL",
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
    "joined",
    "metrics",
    "outcome_of_image",
    "outcome_of_pose",
    "outside",
    "score",
    "shares",
    "summarise",
    "table",
]
