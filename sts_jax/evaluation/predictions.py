"""Predictions of the last frames of held-out trajectories, from any subset of a model's inputs."""

import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import numpy as np

from sts_jax import physics, training
from sts_jax.dataset import Pairs
from sts_jax.dataset.measurement import NAMES
from sts_jax.evaluation.metrics import best_threshold
from sts_jax.evaluation.outcomes import emptiness, outcome_of_image, outcome_of_pose, shares

TRUE_STATE = "visual and the true state"  # the true state: pose, shape and mass of the object, from the simulation
_CHUNK = 64  # number of trajectories that one call predicts


class Predicted(NamedTuple):
    """The predicted last frames of n trajectories. Quantities that are not predicted are None.

    A prediction is a single frame, or a distribution that is given by k samples. In the second case, `visual`,
    `tactile` and `pose` describe its centre. For state-space models and for re-rolls (simulations from the same start),
    the images are means of the distribution, the position in `pose` is a geometric median, and the orientation is that
    of a sample near the centre.
    """

    visual: np.ndarray | None = None  # visual images, (n, height, width, 3), float in [0, 1] or uint8
    tactile: np.ndarray | None = None  # tactile images, (n, height, width, 3), float in [0, 1] or uint8
    pose: np.ndarray | None = None  # float (n, 7): position (m) and quaternion
    outcome: np.ndarray | None = None  # int (n,): number of the outcome, one of `Scenario.outcomes`
    samples: "Predicted | None" = None  # k samples with a further first axis, (k, n, ...), or None for a single frame
    outcome_probability: np.ndarray | None = None  # float (n, c), in the order of `Scenario.outcomes`
    measurements: dict[str, np.ndarray] | None = None  # further modalities by name, (n, *shape), float or uint8


def first(predicted: Predicted, count: int) -> Predicted:
    """Return the prediction for the first `count` trajectories."""
    return _mapped(lambda leaves, axis: leaves[0][:count] if axis == 0 else leaves[0][:, :count], [predicted])


def joined(parts: Sequence[Predicted]) -> Predicted:
    """Concatenate predictions for different trajectories. All predictions must contain the same quantities."""
    return _mapped(np.concatenate, parts)


def _mapped(
    function: Callable[[Sequence[np.ndarray], int], np.ndarray], parts: Sequence[Predicted], axis: int = 0
) -> Predicted:
    """Combine several predictions into one, quantity by quantity.

    Args:
        function: Function of the arrays of one quantity, one from each prediction, and of their axis of trajectories.
        parts: The predictions.
        axis: The axis of trajectories: 0 for predictions, 1 for samples.
    """

    def apply(leaves: Sequence[np.ndarray | None]) -> np.ndarray | None:
        there = [leaf for leaf in leaves if leaf is not None]
        return function(there, axis) if there else None

    samples = [part.samples for part in parts if part.samples is not None]
    further = [part.measurements for part in parts if part.measurements is not None]
    return Predicted(
        visual=apply([part.visual for part in parts]),
        tactile=apply([part.tactile for part in parts]),
        pose=apply([part.pose for part in parts]),
        outcome=apply([part.outcome for part in parts]),
        samples=_mapped(function, samples, 1) if samples else None,
        outcome_probability=apply([part.outcome_probability for part in parts]),
        measurements={name: function([own[name] for own in further], axis) for name in further[0]} if further else None,
    )


def in_unit(image: np.ndarray) -> np.ndarray:
    """Convert an image of `uint8` to float32 in [0, 1]. An image of floats in [0, 1] stays the same."""
    return image.astype(np.float32) / 255 if image.dtype == np.uint8 else image


@runtime_checkable
class Forecaster(Protocol):
    """A model that predicts the last frame from the first one, such as `sts_jax.Predictor`."""

    @property
    def modalities(self) -> tuple[str, ...]:
        """The inputs that the model accepts: any of `visual`, `tactile`, `pose` and names of measurements.

        A measurement (`dataset.Measurement`) is an additional quantity, such as the contact force.
        """

    @property
    def preprocessing(self) -> training.Preprocessing:
        """Settings with which `predict` encodes the true pose, shape and mass as the model's input `state`."""

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
        """Predict from the inputs that are not None. See `sts_jax.Predictor` for the arguments.

        If `modalities` contains further modalities (`dataset.Measurement`), the model must also accept the arguments
        `measurements` and `present` of `sts_jax.Predictor`.

        Returns:
            An object with the fields `visual`, `tactile`, `pose`, `outcome_probability` and `samples` of
            `sts_jax.predict.Prediction`. The field `measurements` is optional.
        """

    def prior(self, shape: tuple[int, ...] = (), *, condition: Any = None) -> Any:
        """Predict the last frame without a measurement, from the prior distribution of the model.

        Args:
            shape: Sizes of the leading axes of the predictions. The default is a single prediction.
            condition: Known quantities of the scenario in SI units, such as an acceleration of the pad, as an array
                `(*shape, c)` for c quantities. None for scenarios without such quantities.

        Returns:
            An object with the same fields as the result of `__call__`.
        """


def subsets(modalities: Sequence[str], *, state: bool = False) -> dict[str, tuple[str, ...]]:
    """List the subsets of a model's inputs from which the model can predict.

    The result has all subsets except the empty one. For a model without inputs, the result has only the empty
    subset.

    Args:
        modalities: The inputs of the model, `predictor.modalities`.
        state: True to add the subset ("visual", "state"), if the visual image is an input. Here, "state" is the true
            pose, shape and mass, which state-space models accept as an input.

    Returns:
        A dictionary from the description of each subset to the subset. For a model with three inputs, for example, the
        subset ("visual", "pose") has the description "from visual and pose", and the subset of all inputs has the
        description "from all inputs". The subset ("visual", "state") has the description "from visual and the true
        state".
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
    """Predict the last frames of held-out trajectories with a model, from some of its inputs.

    The predicted outcome follows from the predicted pose. If the model predicts outcome probabilities, the result
    contains these probabilities. If the model predicts samples but no outcome probabilities, the outcome probabilities
    are the shares of the outcomes among the samples.

    If the model predicts a visual image but no pose, and if the scenario has two outcomes, the outcome follows from the
    image: `FELL_OFF` if the image shows no object, and the other outcome if it shows an object. This needs the
    arguments `validation` and `blank`. If they are None, the predicted outcome is None too.

    Args:
        predictor: The model.
        inputs: Names of the inputs, some of `predictor.modalities`. Models that accept the true pose, shape and mass
            also have the input `state`. If the list is empty, the model predicts without inputs.
        test: The held-out trajectories, with images of the resolution that the model expects.
        scenario: The scenario of the trajectories.
        validation: Trajectories for choosing the threshold that separates images with and without an object.
        blank: Visual image of the sensor without an object, in [0, 1], `(height, width, 3)`.
        num_samples: Number of samples of each prediction, or 0 for none. Predictions without inputs have no samples.

    Returns:
        The predictions for all trajectories of `test`.

    Raises:
        ValueError: `test` has no trajectories, or `inputs` has the name of a measurement (`dataset.Measurement`) that
            `test` or `validation` lacks.
    """
    names = tuple(inputs)
    if len(test.object) == 0:
        raise ValueError(
            "`test` has 0 trajectories, but at least one is needed: choose a split with held-out trajectories"
        )
    for name, pairs in (("test", test), ("validation", validation)):
        lacking = set(names) - set(NAMES) - set(test.measurements if pairs is None else pairs.measurements)
        if lacking:
            raise ValueError(
                f"`inputs` contains {', '.join(map(repr, sorted(lacking)))}, but `{name}.measurements` does not: make "
                f"`{name}` with Dataset.pairs(..., measurements=...)"
            )

    def run(pairs: Pairs, num_samples: int) -> Predicted:
        """Predict the trajectories in groups of equal size, to limit the memory.

        If the last group is too small, copies of the last trajectory are added to it, and the predictions of the copies
        are removed.
        """
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
    """Predict the trajectories `rows` of `pairs` from the inputs `names`. The images of samples become `uint8`."""
    condition = pairs.condition[rows] if pairs.condition.shape[1] else None
    further = {name: in_unit(pairs.measurements[name][rows, 0]) for name in names if name in pairs.measurements}
    if names:
        masks = {name: ~np.isnan(x).reshape(len(rows), -1).any(-1) for name, x in further.items()}
        out = predictor(
            visual=pairs.visual[rows, 0] / 255 if "visual" in names else None,
            tactile=pairs.tactile[rows, 0] / 255 if "tactile" in names else None,
            pose=pairs.pose[rows, 0] if "pose" in names else None,
            condition=condition,
            state=_true_states(predictor, pairs, rows) if "state" in names else None,
            key=jax.random.key(seed) if num_samples else None,
            num_samples=num_samples,
            **({"measurements": further, "present": masks} if further else {}),
        )
    else:
        out = predictor.prior((len(rows),), condition=condition)
    found = (out.visual, out.tactile, out.pose, out.outcome_probability)
    visual, tactile, pose, probability = (None if leaf is None else np.asarray(leaf) for leaf in found)
    measurements = jax.tree.map(np.asarray, getattr(out, "measurements", None))
    samples = None
    if out.samples is not None:
        images = (out.samples.visual, out.samples.tactile)
        drawn, felt = (None if leaf is None else np.round(255 * np.asarray(leaf)).astype(np.uint8) for leaf in images)
        samples = Predicted(drawn, felt, None if out.samples.pose is None else np.asarray(out.samples.pose))
    return Predicted(visual, tactile, pose, samples=samples, outcome_probability=probability, measurements=measurements)


def _true_states(predictor: Forecaster, pairs: Pairs, rows: np.ndarray) -> np.ndarray:
    """The true states of the trajectories `rows`, in the encoding of the model."""
    return training.state_codes(
        predictor.preprocessing, pairs.pose[rows, 0], pairs.support[rows], pairs.mass[rows], pairs.com[rows]
    )
