"""The images of both streams at rest, judged without poses: for recordings of a real sensor."""

from collections.abc import Mapping
from typing import Protocol, runtime_checkable

import numpy as np

from sts_jax.evaluation.metrics import ImageError, bootstrap, image_error, interval, mean_per_pixel, skill
from sts_jax.evaluation.predictions import Predicted, in_unit
from sts_jax.evaluation.reference import CONSTANT, COPY, NEIGHBOUR

STREAMS = ("visual", "tactile")


@runtime_checkable
class Streams(Protocol):
    """First and last images of some trajectories, such as `hardware.Moments` or `dataset.Pairs`."""

    @property
    def visual(self) -> np.ndarray:
        """Images of the visual stream, uint8 (n, 2, height, width, 3)."""

    @property
    def tactile(self) -> np.ndarray:
        """Images of the tactile stream, uint8 (n, 2, height, width, 3)."""


def image_baselines(train: Streams, test: Streams) -> dict[str, Predicted]:
    """Predictions without learning: the mean last image, the input itself, and the end of the nearest input.

    The nearest input is the training trajectory whose first visual image has the smallest squared distance.
    """
    inputs, queries = (own.visual[:, 0].reshape(len(own.visual), -1).astype(np.float32) for own in (train, test))
    nearest = ((inputs**2).sum(1) - 2 * queries @ inputs.T).argmin(1)

    def constant(stream: str) -> np.ndarray:
        return np.broadcast_to(_last(train, stream).mean(0), _last(test, stream).shape)

    return {
        CONSTANT: Predicted(constant("visual"), constant("tactile")),
        COPY: Predicted(test.visual[:, 0], test.tactile[:, 0]),
        NEIGHBOUR: Predicted(train.visual[nearest, 1], train.tactile[nearest, 1]),
    }


def image_summary(
    predictions: Mapping[str, Predicted], test: Streams, *, num: int = 2000, seed: int = 0
) -> dict[str, dict]:
    """Cross-entropy and skill of predicted images, with 95 % bootstrap intervals over trajectories.

    Args:
        predictions: Predictions by name, with those of `image_baselines`. A stream that is not predicted is None.
        test: The held-out trajectories.
        num: Number of bootstrap draws.
        seed: Seed of the draws.

    Returns:
        By stream: `floor`, the smallest possible cross-entropy (the entropy of the true images), and `predictors`. They
        have by name `bce` (nats per pixel and channel), and the skills `skill` against the mean training image and
        `skill_copy` against the copy of the input. Each is a dictionary of `value`, `low` and `high`.

    Raises:
        ValueError: A baseline is missing, or a prediction has another shape than the true images.
    """
    missing = [name for name in (CONSTANT, COPY) if name not in predictions]
    if missing:
        raise ValueError(f"predictions lacks {', '.join(missing)}: add those of evaluation.image_baselines")
    return {stream: _of_stream(predictions, test, stream, num, seed) for stream in STREAMS}


def _of_stream(predictions: Mapping[str, Predicted], test: Streams, stream: str, num: int, seed: int) -> dict:
    truth = _last(test, stream)
    errors: dict[str, ImageError] = {}
    for name, predicted in predictions.items():
        images = getattr(predicted, stream)
        if images is None:
            continue
        if images.shape != truth.shape:
            raise ValueError(f"{name}: {stream} has shape {images.shape}, but the true images have {truth.shape}")
        errors[name] = image_error(in_unit(images), truth)
    reference = errors[CONSTANT]
    floor = mean_per_pixel(reference.bce - reference.excess, reference.pixels)

    def numbers(weight: np.ndarray) -> np.ndarray:
        return np.array(
            [
                [
                    mean_per_pixel(error.bce, error.pixels, weight),
                    skill(error, reference, weight),
                    skill(error, errors[COPY], weight),
                ]
                for error in errors.values()
            ]
        )

    value, draws = numbers(np.ones(len(truth))), bootstrap(np.arange(len(truth)), numbers, num=num, seed=seed)
    cells = {
        name: {
            key: dict(zip(("value", "low", "high"), (float(value[i, k]), *interval(draws[:, i, k])), strict=True))
            for k, key in enumerate(("bce", "skill", "skill_copy"))
        }
        for i, name in enumerate(errors)
    }
    return {"floor": floor, "predictors": cells}


def _last(streams: Streams, stream: str) -> np.ndarray:
    """The true last images of a stream, in [0, 1]."""
    return getattr(streams, stream)[:, 1].astype(np.float32) / 255
