"""Figures of predictions, training and simulation. Each function writes one file."""

from sts_jax.evaluation.figures.curves import calibration as calibration
from sts_jax.evaluation.figures.curves import ends as ends
from sts_jax.evaluation.figures.curves import error_curves as error_curves
from sts_jax.evaluation.figures.curves import training_curves as training_curves
from sts_jax.evaluation.figures.motion import SLOWER as SLOWER
from sts_jax.evaluation.figures.motion import animation as animation
from sts_jax.evaluation.figures.motion import strip as strip
from sts_jax.evaluation.figures.outlines import draw_outlines as draw_outlines
from sts_jax.evaluation.figures.outlines import silhouettes as silhouettes
from sts_jax.evaluation.figures.pictures import comparison as comparison
from sts_jax.evaluation.figures.pictures import side_by_side as side_by_side
from sts_jax.evaluation.figures.sheets import SAMPLES as SAMPLES
from sts_jax.evaluation.figures.sheets import crossed_sheet as crossed_sheet
from sts_jax.evaluation.figures.sheets import models_sheet as models_sheet
from sts_jax.evaluation.figures.sheets import one_of_each as one_of_each
from sts_jax.evaluation.figures.sheets import pose_sheet as pose_sheet
from sts_jax.evaluation.figures.sheets import rollout_strip as rollout_strip
