"""Evaluation of predictions of the last visual and the last tactile image of each trajectory.

The evaluation needs no poses, so recordings of a real sensor can be used.
"""

from collections.abc import Mapping
from typing import Protocol, runtime_checkable

import numpy as np

from sts_jax.evaluation.intervals import bootstrap, interval
from sts_jax.evaluation.metrics import ImageError, image_error, mean_per_pixel, skill
from sts_jax.evaluation.predictions import Predicted, in_unit
from sts_jax.evaluation.reference import CONSTANT, COPY, NEIGHBOUR

STREAMS = ("visual", "tactile")


@runtime_checkable
class Streams(Protocol):
    """Interface of classes that hold the first and last images of n trajectories.

    Two such classes are `hardware.RecordedImages` and `dataset.Pairs`.
    """

    @property
    def visual(self) -> np.ndarray:
        """First and last images of the visual stream, uint8 `(n, 2, height, width, 3)`."""

    @property
    def tactile(self) -> np.ndarray:
        """First and last images of the tactile stream, uint8 `(n, 2, height, width, 3)`."""


def image_baselines(train: Streams, test: Streams) -> dict[str, Predicted]:
    """Predict the last images without a trained model, in three ways.

    - The constant is the mean last image of the training trajectories.
    - The copy predicts that the last image equals the first one.
    - The nearest neighbour is the last image of the most similar training trajectory. Two trajectories are compared by
      the squared distance between their first visual images.

    Args:
        train: The training trajectories.
        test: The held-out trajectories.

    Returns:
        The predictions for `test` by name. The names are "constant (mean training target)", "copy of the input" and
        "nearest neighbour".
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
    """Compute cross-entropy and skill of predicted images, with 95 % bootstrap intervals over trajectories.

    The excess of a prediction is its cross-entropy minus the entropy of the true image, so a perfect prediction has
    excess 0. The skill is `1 - excess / reference_excess`, where `reference_excess` is the excess of a reference
    prediction.

    Args:
        predictions: Dictionary from the name of each predictor to its predictions of the last image of each trajectory.
            The dictionary must contain the entries "constant (mean training target)" and "copy of the input" from
            `image_baselines`. The field `visual` or `tactile` of a prediction is None if the predictor does not predict
            this stream.
        test: The held-out trajectories.
        num: Number of bootstrap samples.
        seed: Seed of the bootstrap.

    Returns:
        A dictionary for each of the streams `visual` and `tactile`, with the following entries.

        - `floor`: The entropy of the true images, which is the smallest possible cross-entropy (nats per pixel and
            channel).
        - `predictors`: The metrics of each predictor by its name. `bce` is the cross-entropy (nats per pixel and
            channel). `skill` is the skill relative to the mean training image. `skill_copy` is the skill relative to
            the first image. Each metric is a dictionary of `value` and of the limits `low` and `high` of its interval.

    Raises:
        ValueError: A required entry is missing, or the shape of a prediction differs from that of the true images.
    """
    missing = [name for name in (CONSTANT, COPY) if name not in predictions]
    if missing:
        raise ValueError(
            f"`predictions` lacks {' and '.join(map(repr, missing))}: add the results of evaluation.image_baselines"
        )
    return {stream: _of_stream(predictions, test, stream, num, seed) for stream in STREAMS}


def _of_stream(predictions: Mapping[str, Predicted], test: Streams, stream: str, num: int, seed: int) -> dict:
    """The part of `image_summary` for one stream."""
    truth = _last(test, stream)
    errors: dict[str, ImageError] = {}
    for name, predicted in predictions.items():
        images = getattr(predicted, stream)
        if images is None:
            continue
        if images.shape != truth.shape:
            raise ValueError(
                f"prediction {name!r}: {stream} has shape {images.shape}, but the true images have shape "
                f"{truth.shape}: give predicted images of this shape"
            )
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
