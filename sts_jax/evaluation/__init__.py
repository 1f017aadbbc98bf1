"""How good a prediction is: metrics per item, tables with intervals, figures."""

from sts_jax.evaluation import figures, metrics
from sts_jax.evaluation.report import (
    Predicted,
    Scores,
    baselines,
    emptiness,
    outcome_of_image,
    outcome_of_pose,
    score,
    summarise,
    table,
)
from sts_jax.evaluation.views import outside

__all__ = [
    "Predicted",
    "Scores",
    "baselines",
    "emptiness",
    "figures",
    "metrics",
    "outcome_of_image",
    "outcome_of_pose",
    "outside",
    "score",
    "summarise",
    "table",
]
