"""Figures of predictions, training and simulation. Each function writes one file."""

from sts_jax.evaluation.figures.curves import Trained, scaling, training_curves
from sts_jax.evaluation.figures.grids import comparison
from sts_jax.evaluation.figures.held_out import SAMPLES, calibration, ends, predictions
from sts_jax.evaluation.figures.motion import SLOWER, animation, strip
from sts_jax.evaluation.figures.sides import side_by_side

__all__ = [
    "SAMPLES",
    "SLOWER",
    "Trained",
    "animation",
    "calibration",
    "comparison",
    "ends",
    "predictions",
    "scaling",
    "side_by_side",
    "strip",
    "training_curves",
]
