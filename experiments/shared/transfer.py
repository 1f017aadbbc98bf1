"""Predicts recorded trajectories with the library's model `released`, which was trained on simulated images only."""

import dataclasses
from pathlib import Path

import numpy as np

import sts_jax as sts
from experiments.shared import recorded
from experiments.shared.recorded import Config, Recorded
from sts_jax import hardware
from sts_jax.evaluation import Predicted
from sts_jax.hardware import SensorView
from sts_jax.predict import MODELS

NAME = "released"
FOLDER = MODELS / NAME
TITLE = "state-space model, simulated training"


def predictions(config: Config, data: Recorded, workdir: Path) -> Predicted | None:
    """Predict the last frames of the validation trajectories from their initial visual and tactile images.

    The brightness and the colours of the images are first adapted to the model's training images (`hardware.relit`).
    The brightness and the colours of the predictions are then adapted back to the recorded images.

    Args:
        config: Configuration of the experiment.
        data: Recorded trajectories with images of `config.image_size`.
        workdir: Work directory from which the trajectories were read.

    Returns:
        The predictions at `config.image_size`. None if the model predicts images of another size, or if the height of
        its input images is not a multiple of `config.image_size`.
    """
    predictor = sts.Predictor.load(NAME)
    side, (height, _) = config.image_size, predictor.preprocessing.resolution
    if height % side:
        return None
    seen = recorded.read(dataclasses.replace(config, image_size=height), workdir)
    own, model = SensorView(**_unit(seen.empty)), SensorView(**predictor.empty)
    streams = _unit({"visual": seen.validation.visual[:, 0], "tactile": seen.validation.tactile[:, 0]})
    views = [hardware.relit(SensorView(*pair), own, model) for pair in zip(*streams.values(), strict=True)]
    given = SensorView(np.stack([view.visual for view in views]), np.stack([view.tactile for view in views]))
    out = predictor(visual=given.visual, tactile=given.tactile)
    visual, tactile = np.asarray(out.visual), np.asarray(out.tactile)
    if visual.shape[1:3] != (side, side):
        return None
    own, model = SensorView(**_unit(data.empty)), SensorView(*(_reduced(image, side) for image in model))
    back = [hardware.relit(SensorView(*pair), model, own) for pair in zip(visual, tactile, strict=True)]
    return Predicted(np.stack([view.visual for view in back]), np.stack([view.tactile for view in back]))


def _unit(images: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Convert uint8 images to float32 in [0, 1]."""
    return {stream: own.astype(np.float32) / 255 for stream, own in images.items()}


def _reduced(image: np.ndarray, side: int) -> np.ndarray:
    """Reduce a square image to `side` pixels by averaging blocks of pixels."""
    step = image.shape[0] // side
    return image.reshape(side, step, side, step, 3).mean((1, 3))
