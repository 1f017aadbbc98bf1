"""Training of `sts_jax.statespace` and `sts_jax.mvae` models: training arrays, the training loop and model folders."""

from sts_jax.training.arrays import (
    Arrays,
    frame_arrays,
    image_arrays,
    order,
    paper_model,
    shifted,
    state_arrays,
    state_codes,
    state_model,
)
from sts_jax.training.config import TrainConfig, optimiser
from sts_jax.training.folder import TrainState, load_blank, records, restore, save, save_blank, save_calibration
from sts_jax.training.loop import Learner, Loss, initial, learner, step, train
from sts_jax.training.model import Model, calibrate, load
from sts_jax.training.preprocess import Preprocessing, touch_of_noisy_images

__all__ = [
    "Arrays",
    "Learner",
    "Loss",
    "Model",
    "Preprocessing",
    "TrainConfig",
    "TrainState",
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
    "records",
    "restore",
    "save",
    "save_blank",
    "save_calibration",
    "shifted",
    "state_arrays",
    "state_codes",
    "state_model",
    "step",
    "touch_of_noisy_images",
    "train",
]
