"""Evaluation of predicted last images without poses, as of recordings of a real sensor."""

from collections.abc import Mapping

import numpy as np

from sts_jax.evaluation.metrics import ImageError, bootstrap, image_error, interval, ratio, skill
from sts_jax.evaluation.predictions import Predicted, in_unit
from sts_jax.evaluation.references import CONSTANT, COPY, Streams

STREAMS = ("visual", "tactile")


def image_summary(
    predictions: Mapping[str, Predicted], test: Streams, *, num: int = 2000, seed: int = 0
) -> dict[str, dict]:
    """Compute cross-entropy and skill of predicted images, with 95 % bootstrap intervals over trajectories.

    Args:
        predictions: Predictions by name, with those of `image_baselines`.

    Returns:
        A dictionary for each of the streams `visual` and `tactile`, with the following entries.

        - `floor`: The entropy of the true images, which is the smallest possible cross-entropy (nats per pixel and
            channel).
        - `predictors`: The metrics of each predictor by its name. `bce` is the cross-entropy (nats per pixel and
            channel). `skill` is the skill relative to the mean training image. `skill_copy` is the skill relative to
            the first image. Each metric is a dictionary of `value` and of the limits `low` and `high` of its interval.
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
                f"prediction {name!r}: {stream} has shape {images.shape}, but the true images have shape {truth.shape}"
            )
        errors[name] = image_error(in_unit(images), truth)
    constant, copy = errors[CONSTANT], errors[COPY]

    def numbers(weight: np.ndarray) -> np.ndarray:
        return np.array(
            [
                [
                    ratio(error.bce, error.pixels, weight),
                    skill(error.excess, constant.excess, weight),
                    skill(error.excess, copy.excess, weight),
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
    return {"floor": ratio(constant.bce - constant.excess, constant.pixels), "predictors": cells}


def _last(streams: Streams, stream: str) -> np.ndarray:
    """The true last images of a stream, in [0, 1]."""
    return getattr(streams, stream)[:, 1].astype(np.float32) / 255
