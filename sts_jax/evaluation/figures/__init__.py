"""Figures of predictions, training and simulation. Each function writes one file."""

from sts_jax.evaluation.figures.curves import Trained, calibration, ends, scaling, training_curves
from sts_jax.evaluation.figures.motion import SLOWER, animation, strip
from sts_jax.evaluation.figures.pictures import SAMPLES, comparison, predictions, side_by_side

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
