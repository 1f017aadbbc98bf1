"""A state-space model that predicts the last frame of a trajectory from any subset of its inputs in the first frame.

A one-step model (`Config.stride`) predicts frame after frame.
"""

from sts_jax.statespace.calibration import fit as fit_calibration
from sts_jax.statespace.config import IMAGES, INPUTS, Config, LossWeights
from sts_jax.statespace.networks import CONTRAST, Model, init
from sts_jax.statespace.objective import loss
from sts_jax.statespace.poses import CODE as POSE_CODE
from sts_jax.statespace.predict import Calibration, Samples, sample
from sts_jax.statespace.rollout import Rollout, render, rollout
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
    "Rollout",
    "Samples",
    "encode",
    "fit_calibration",
    "init",
    "loss",
    "render",
    "rollout",
    "sample",
]
