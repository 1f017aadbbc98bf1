"""How good a prediction is: metrics per item, tables with intervals, ceilings, figures."""

from sts_jax.evaluation import figures, metrics
from sts_jax.evaluation.report import (
    BASELINES,
    Predicted,
    Scores,
    baselines,
    emptiness,
    first,
    joined,
    outcome_of_image,
    outcome_of_pose,
    score,
    shares,
)
from sts_jax.evaluation.rerolls import CEILING, ONE_REROLL, ceiling
from sts_jax.evaluation.tables import full_table, gain, summarise, table
from sts_jax.evaluation.views import outside

__all__ = [
    "BASELINES",
    "CEILING",
    "ONE_REROLL",
    "Predicted",
    "Scores",
    "baselines",
    "ceiling",
    "emptiness",
    "figures",
    "first",
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
