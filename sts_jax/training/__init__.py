"""Training of `sts_jax.statespace` and `sts_jax.mvae` models: training arrays, the training loop and checkpoints."""

from sts_jax.training.arrays import Arrays, order
from sts_jax.training.blank import load_blank, save_blank
from sts_jax.training.calibrating import calibrate
from sts_jax.training.calibration_file import write as save_calibration
from sts_jax.training.checkpoint import TrainState, Weights, restore, save, seal
from sts_jax.training.config import TrainConfig
from sts_jax.training.learners import Learner, Loss, learner
from sts_jax.training.loop import initial, step, train
from sts_jax.training.model import Model, load
from sts_jax.training.optimisers import optimiser
from sts_jax.training.preprocess import (
    Preprocessing,
    preprocessing_from_json,
    touch_of_noisy_images,
)
from sts_jax.training.shifts import shifted
from sts_jax.training.trajectories import (
    frame_arrays,
    image_arrays,
    paper_model,
    state_arrays,
    state_codes,
    state_model,
)

__all__ = [
    "Arrays",
    "Learner",
    "Loss",
    "Model",
    "Preprocessing",
    "TrainConfig",
    "TrainState",
    "Weights",
    "calibrate",
    "frame_arrays",
    "image_arrays",
    "initial",
    "learner",
    "load",
    "load_blank",
    "optimiser",
    "order",
    "paper_model",
    "preprocessing_from_json",
    "restore",
    "save",
    "save_blank",
    "save_calibration",
    "seal",
    "shifted",
    "state_arrays",
    "state_codes",
    "state_model",
    "step",
    "touch_of_noisy_images",
    "train",
]
