"""A state-space model that predicts the last frame of a trajectory from the first frame.

The inputs of a model (`Config.inputs`) can be the visual image, the tactile image and the object's pose in the first
frame. A trained model also predicts from any subset of its inputs. It predicts the object's final pose, and the visual
and tactile images of the last frame.
"""

from sts_jax.statespace.calibration import Calibration
from sts_jax.statespace.config import IMAGES, INPUTS, Config, LossWeights
from sts_jax.statespace.fitting import fit as fit_calibration
from sts_jax.statespace.layers import CONTRAST
from sts_jax.statespace.networks import Model, init
from sts_jax.statespace.objective import loss
from sts_jax.statespace.poses import CODE as POSE_CODE
from sts_jax.statespace.predict import Samples, sample
from sts_jax.statespace.state import CODE as STATE_CODE
from sts_jax.statespace.state import encode

__all__ = [
    "CONTRAST",
    "IMAGES",
    "INPUTS",
    "POSE_CODE",
    "STATE_CODE",
    "Calibration",
    "Config",
    "LossWeights",
    "Model",
    "Samples",
    "encode",
    "fit_calibration",
    "init",
    "loss",
    "sample",
]
