"""Training of `sts_jax.statespace` and `sts_jax.mvae` models: arrays, loop, schedules and checkpoints."""

from sts_jax.training.checkpoint import TrainState, Weights, restore, save, seal
from sts_jax.training.moments import moments, paper_model, state_codes, state_model, state_moments
from sts_jax.training.preprocess import Preprocessing, load_blank, preprocessing_from_json, save_blank
from sts_jax.training.train import (
    Arrays,
    Learner,
    Model,
    TrainConfig,
    initial,
    learner,
    load,
    optimiser,
    order,
    step,
    train,
)

__all__ = [
    "Arrays",
    "Learner",
    "Model",
    "Preprocessing",
    "TrainConfig",
    "TrainState",
    "Weights",
    "initial",
    "learner",
    "load",
    "load_blank",
    "moments",
    "optimiser",
    "order",
    "paper_model",
    "preprocessing_from_json",
    "restore",
    "save",
    "save_blank",
    "seal",
    "state_codes",
    "state_model",
    "state_moments",
    "step",
    "train",
]
