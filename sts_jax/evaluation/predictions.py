"""Predictions of the images and poses at the end of held-out trajectories, from any subset of a model's inputs."""

import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import numpy as np

from sts_jax import physics, training
from sts_jax.dataset import Pairs
from sts_jax.evaluation.metrics import best_threshold
from sts_jax.evaluation.outcomes import emptiness, outcome_of_image, outcome_of_pose, shares

TRUE_STATE = "visual and the true state"  # inputs that a simulation provides: pose, shape and mass of the object
_CHUNK = 64  # items predicted by one call


class Predicted(NamedTuple):
    """The predicted last moment of `n` trajectories. Quantities that are not predicted are None.

    With samples, `visual` and `tactile` are their means and `pose` is a point prediction.
    """

    visual: np.ndarray | None = None  # (n, height, width, 3), float in [0, 1] or uint8
    tactile: np.ndarray | None = None  # (n, height, width, 3), float in [0, 1] or uint8
    pose: np.ndarray | None = None  # float (n, 7)
    outcome: np.ndarray | None = None  # int (n,), physics.Outcome
    samples: "Predicted | None" = None  # k draws of the whole prediction, (k, n, ...), or None if it is deterministic
    outcome_probability: np.ndarray | None = None  # float (n, c), in the order of `scenario.outcomes`


def first(predicted: Predicted, count: int) -> Predicted:
    """The prediction for the first `count` items."""
    return _mapped(lambda leaves, axis: leaves[0][:count] if axis == 0 else leaves[0][:, :count], [predicted])


def joined(parts: Sequence[Predicted]) -> Predicted:
    """One prediction for the items of several predictions of the same quantities, in order."""
    return _mapped(np.concatenate, parts)


def _mapped(
    function: Callable[[Sequence[np.ndarray], int], np.ndarray], parts: Sequence[Predicted], axis: int = 0
) -> Predicted:
    """Apply a function of several arrays and their axis of items to every quantity of several predictions."""

    def apply(leaves: Sequence[np.ndarray | None]) -> np.ndarray | None:
        there = [leaf for leaf in leaves if leaf is not None]
        return function(there, axis) if there else None

    samples = [part.samples for part in parts if part.samples is not None]
    return Predicted(
        visual=apply([part.visual for part in parts]),
        tactile=apply([part.tactile for part in parts]),
        pose=apply([part.pose for part in parts]),
        outcome=apply([part.outcome for part in parts]),
        samples=_mapped(function, samples, 1) if samples else None,
        outcome_probability=apply([part.outcome_probability for part in parts]),
    )


def in_unit(image: np.ndarray) -> np.ndarray:
    """Grey values in [0, 1] of an image of `uint8` or of floats in [0, 1]."""
    return image.astype(np.float32) / 255 if image.dtype == np.uint8 else image


@runtime_checkable
class Forecaster(Protocol):
    """A model of the last moment, such as `sts_jax.Predictor`."""

    @property
    def modalities(self) -> tuple[str, ...]:
        """The inputs that it accepts, some of `visual`, `tactile` and `pose`."""

    @property
    def preprocessing(self) -> training.Preprocessing:
        """How it encodes poses, for the input `state`."""

    def __call__(
        self,
        *,
        visual: Any = None,
        tactile: Any = None,
        pose: Any = None,
        condition: Any = None,
        state: Any = None,
        key: Any = None,
        num_samples: int = 0,
    ) -> Any:
        """Predict from the modalities that are given.

        Returns:
            An object with `visual`, `tactile`, `pose`, `outcome_probability` and `samples` as in
            `sts_jax.predict.Prediction`.
        """

    def prior(self, shape: tuple[int, ...] = (), *, condition: Any = None) -> Any:
        """Predict without any input."""


def subsets(modalities: Sequence[str], *, state: bool = False) -> dict[str, tuple[str, ...]]:
    """All subsets of the inputs of a model, by a description such as "from visual and pose".

    Args:
        modalities: The inputs of the model. If it has none, the only subset is the empty one.
        state: Whether the model also accepts the true state beside a visual image, as state-space models do.
    """
    usable = tuple(modalities)
    if not usable:
        return {"no input: the first touch is always blank": ()}
    found = {}
    for count in range(1, len(usable) + 1):
        for subset in itertools.combinations(usable, count):
            every = count == len(usable) > 1
            found["from all inputs" if every else f"from {' and '.join(subset)}"] = subset
    if state and "visual" in usable:
        found[f"from {TRUE_STATE}"] = ("visual", "state")
    return found


def predict(
    predictor: Forecaster,
    inputs: Sequence[str],
    test: Pairs,
    scenario: physics.Scenario,
    *,
    validation: Pairs | None = None,
    blank: np.ndarray | None = None,
    num_samples: int = 0,
) -> Predicted:
    """The prediction of a model for held-out trajectories, from some of its inputs.

    The outcome is that of the pose. With samples, its probabilities are the shares of the samples' outcomes, unless the
    model predicts them itself. In a scenario with two outcomes, the outcome of a model without a pose depends on
    whether its image is empty, if `validation` and `blank` are given. Otherwise it has no outcome.

    Args:
        predictor: The model.
        inputs: Some of its modalities, and possibly `state`. Empty for the prediction without any input.
        test: The held-out trajectories, with images of the resolution that the model takes.
        scenario: The scenario of the trajectories.
        validation: Trajectories on which the threshold of an empty image is chosen.
        blank: The visual image of the untouched sensor, `(height, width, 3)` in [0, 1].
        num_samples: Number of samples of each prediction, or 0 for none.
    """
    names = tuple(inputs)

    def run(pairs: Pairs, num_samples: int) -> Predicted:
        """Predict in calls of equal size, which bounds the memory. The last call repeats an item to be as long."""
        count = len(pairs.object)
        size, parts = min(count, _CHUNK), []
        for number, start in enumerate(range(0, count, size)):
            rows = np.minimum(np.arange(start, start + size), count - 1)
            parts.append(_asked(predictor, names, pairs, rows, num_samples, number))
        return first(joined(parts), count)

    out = run(test, num_samples)
    if out.pose is not None:
        out = out._replace(outcome=outcome_of_pose(scenario, test.pose[:, 0], out.pose))
    elif out.visual is not None and len(scenario.stays) == 1 and validation is not None and blank is not None:
        score = emptiness(np.asarray(run(validation, 0).visual), blank)
        threshold = best_threshold(score, validation.outcome != int(physics.Outcome.FELL_OFF))
        out = out._replace(outcome=outcome_of_image(out.visual, blank, threshold, stays=int(scenario.stays[0])))
    if out.samples is not None and out.samples.pose is not None and out.outcome_probability is None:
        ends = np.stack([outcome_of_pose(scenario, test.pose[:, 0], pose) for pose in out.samples.pose])
        out = out._replace(outcome_probability=shares(ends, scenario.outcomes))
    return out


def _asked(
    predictor: Forecaster, names: tuple[str, ...], pairs: Pairs, rows: np.ndarray, num_samples: int, seed: int
) -> Predicted:
    """The prediction for some items, from the inputs `names`, with images of samples in `uint8`."""
    condition = pairs.condition[rows] if pairs.condition.shape[1] else None
    if names:
        out = predictor(
            visual=pairs.visual[rows, 0] / 255 if "visual" in names else None,
            tactile=pairs.tactile[rows, 0] / 255 if "tactile" in names else None,
            pose=pairs.pose[rows, 0] if "pose" in names else None,
            condition=condition,
            state=_true_states(predictor, pairs, rows) if "state" in names else None,
            key=jax.random.key(seed) if num_samples else None,
            num_samples=num_samples,
        )
    else:
        out = predictor.prior((len(rows),), condition=condition)
    found = (out.visual, out.tactile, out.pose, out.outcome_probability)
    visual, tactile, pose, probability = (None if leaf is None else np.asarray(leaf) for leaf in found)
    samples = None
    if out.samples is not None:
        images = (out.samples.visual, out.samples.tactile)
        drawn, felt = (None if leaf is None else np.round(255 * np.asarray(leaf)).astype(np.uint8) for leaf in images)
        samples = Predicted(drawn, felt, None if out.samples.pose is None else np.asarray(out.samples.pose))
    return Predicted(visual, tactile, pose, samples=samples, outcome_probability=probability)


def _true_states(predictor: Forecaster, pairs: Pairs, rows: np.ndarray) -> np.ndarray:
    return training.state_codes(
        predictor.preprocessing, pairs.pose[rows, 0], pairs.support[rows], pairs.mass[rows], pairs.com[rows]
    )
