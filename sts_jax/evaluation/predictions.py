"""Predictions of frames of held-out trajectories, from any subset of a model's inputs."""

import enum
import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from sts_jax import physics, statespace, training
from sts_jax._checked import in_32_bits
from sts_jax.dataset import Dataset, Pairs
from sts_jax.dataset.measurement import NAMES
from sts_jax.evaluation.metrics import best_threshold
from sts_jax.physics.engines import outcome_of

TRUE_STATE = "visual and the true state"  # the true state: pose, shape and mass of the object, from the simulation
_FELL_OFF = int(physics.Outcome.FELL_OFF)
_CHUNK = 64  # number of trajectories that one call predicts
_FRAMES = 4096  # largest number of frames that one call predicts, to limit the memory


class Predicted(NamedTuple):
    """The predicted frames of n trajectories, such as the last ones. Quantities that are not predicted are None.

    If a prediction is a distribution, `samples` has k samples, and `visual`, `tactile` and `pose` describe its centre.
    """

    visual: np.ndarray | None = None  # visual images, (n, height, width, 3), float in [0, 1] or uint8
    tactile: np.ndarray | None = None  # tactile images, (n, height, width, 3), float in [0, 1] or uint8
    pose: np.ndarray | None = None  # float (n, 7): position (m) and quaternion
    outcome: np.ndarray | None = None  # int (n,): number of the outcome, one of `Scenario.outcomes`
    samples: "Predicted | None" = None  # k samples with a further first axis, (k, n, ...), or None for a single frame
    outcome_probability: np.ndarray | None = None  # float (n, c), in the order of `Scenario.outcomes`
    measurements: dict[str, np.ndarray] | None = None  # further modalities by name, (n, *shape), float or uint8
    outcomes: np.ndarray | None = None  # int (c,): outcomes of the columns of `outcome_probability`, set by `score`


def take(predicted: Predicted, rows: np.ndarray | slice) -> Predicted:
    """Select trajectories of a prediction by indices, a bool mask `(n,)`, or a slice such as `slice(10)`."""
    return _mapped(lambda axis, leaf: leaf[rows] if axis == 0 else leaf[:, rows], predicted)


def joined(parts: Sequence[Predicted]) -> Predicted:
    """Concatenate predictions of the same quantities for different trajectories."""
    return _mapped(lambda axis, *leaves: np.concatenate(leaves, axis), *parts)


def _mapped(function: Callable[..., np.ndarray], *parts: Predicted) -> Predicted:
    """Apply a function to each quantity. Its first argument is the axis of the trajectories: 0, or 1 in samples."""
    samples = [part.samples for part in parts]
    out: Predicted = jax.tree.map(functools.partial(function, 0), *(part._replace(samples=None) for part in parts))
    return out if samples[0] is None else out._replace(samples=jax.tree.map(functools.partial(function, 1), *samples))


def in_unit(image: np.ndarray) -> np.ndarray:
    """Convert an image of `uint8` to float32 in [0, 1]. An image of floats in [0, 1] stays the same."""
    return image.astype(np.float32) / 255 if image.dtype == np.uint8 else image


def outcome_of_pose(scenario: physics.Scenario, first: np.ndarray, last: np.ndarray) -> np.ndarray:
    """Determine the outcomes, int `(n,)`, from first poses and true or predicted last poses, `(n, 7)`."""
    return np.asarray(outcome_of(first, last, scenario=scenario))


def shares(outcome: np.ndarray, outcomes: Sequence[enum.IntEnum]) -> np.ndarray:
    """Probabilities `(n, c)` of c outcomes from k samples `(k, n)`: `(count + 1 / c) / (k + 1)`, which is never 0."""
    counts = (outcome[..., None] == np.array([int(one) for one in outcomes])).sum(0)
    return (counts + 1 / len(outcomes)) / (len(outcome) + 1)


def frequency(outcome: np.ndarray, outcomes: Sequence[enum.IntEnum]) -> np.ndarray:
    """Estimate the frequencies `(c,)` of outcomes from those of n training trajectories, int `(n,)`, like `shares`."""
    return shares(outcome[:, None], outcomes)[0]


def train_share(shares: Sequence[float], split: str) -> float:
    """Share of `Collection.shares` that trains a model. A split by trajectory includes the share of the validation."""
    return shares[0] if split == "object" else 1 - shares[2]


def rows_of(data: Dataset, split: str = "object") -> dict[str, np.ndarray]:
    """Indices of the trajectories with images in each part, `train`, `validation` and `test`.

    Args:
        split: With `object`, whole objects are held out, see `Dataset.split`. With `trajectory`, random trajectories
            are held out, as in the paper (Rezaei-Shoshtari et al. 2021). The training and the test part then have
            objects in common, and the validation part equals the training part.
    """
    if split == "object":
        return {name: data.members(name) for name in ("train", "validation", "test")}
    if split != "trajectory":
        raise ValueError(f"split must be 'object' or 'trajectory', got {split!r}")
    rendered = data.rendered()
    order = rendered[np.random.default_rng(data.collection["seed"]).permutation(len(rendered))]
    cut = round(train_share(data.collection["shares"], split) * len(order))
    return {"train": np.sort(order[:cut]), "validation": np.sort(order[:cut]), "test": np.sort(order[cut:])}


def subsets(modalities: Sequence[str], *, state: bool = False) -> dict[str, tuple[str, ...]]:
    """The non-empty subsets of a model's inputs (or the empty one), by a description such as "from visual and pose".

    Args:
        state: True to add the subset ("visual", "state"), if the visual image is an input. "state" is the true pose,
            shape and mass, which state-space models accept as an input.
    """
    usable = tuple(modalities)
    if not usable:
        return {"no input: the first touch is always blank": ()}
    described = {}
    for count in range(1, len(usable) + 1):
        for subset in itertools.combinations(usable, count):
            every = count == len(usable) > 1
            described["from all inputs" if every else f"from {' and '.join(subset)}"] = subset
    if state and "visual" in usable:
        described[f"from {TRUE_STATE}"] = ("visual", "state")
    return described


@in_32_bits
def predict(
    predictor: Any,
    inputs: Sequence[str],
    test: Pairs,
    scenario: physics.Scenario,
    *,
    validation: Pairs | None = None,
    blank: np.ndarray | None = None,
    num_samples: int = 0,
) -> Predicted:
    """Predict the second frames of held-out pairs with a model, from some of the inputs of the first frames.

    A one-step model (`Predictor.stride`) is rolled out from `test.frame[:, 0]` to `test.frame[:, 1]`. A state-space
    model is only rolled out from frame 0, because its roll-out begins with an object at rest. The predicted
    outcome follows from the predicted pose. Outcome probabilities are those of the model, or the shares of the outcomes
    among its samples. A model of the visual image without a pose gets an outcome if the scenario has two outcomes and
    `validation` and `blank` are given: `FELL_OFF` if the image shows no object.

    Args:
        predictor: A `sts_jax.Predictor`, or any object with its `__call__`, `prior`, `rollout` and `preprocessing`.
        test: The held-out trajectories, with images of the resolution that the model expects. For a one-step model, all
            pairs have the same number of frames from the first to the second.
        inputs: Names of the inputs, some of `predictor.modalities`, or also `state` for models that accept the true
            pose, shape and mass. Without inputs, the prediction is the model's prior, which has no samples.
        validation: Trajectories for choosing the threshold that separates images with and without an object.
        blank: Empty visual image in [0, 1], `(height, width, 3)`.
        num_samples: Number of samples of each prediction, or 0 for none.
    """
    names = tuple(inputs)
    _check(names, test, validation)

    def run(pairs: Pairs, num_samples: int) -> Predicted:
        return _predicted(predictor, names, pairs, num_samples, _steps(predictor, pairs), last=True)[0]

    out = _judged(run(test, num_samples), test, scenario)
    unknown = out.pose is None and out.visual is not None and len(scenario.stays) == 1
    if unknown and validation is not None and blank is not None:
        score, judged = (np.abs(x - blank).mean((1, 2, 3)) for x in (np.asarray(run(validation, 0).visual), out.visual))
        empty = judged <= best_threshold(score, validation.outcome != _FELL_OFF)
        out = out._replace(outcome=np.where(empty, _FELL_OFF, int(scenario.stays[0])))
    return out


@in_32_bits
def rollout(
    predictor: Any, inputs: Sequence[str], test: Pairs, scenario: physics.Scenario, *, steps: int, num_samples: int = 0
) -> list[Predicted]:
    """Roll out a one-step model from the first frames of held-out pairs, and return the prediction of each step.

    Element i describes the frames `test.frame[:, 0] + (i + 1) * predictor.stride`. All predicted images are held in
    memory, 12 bytes for each pixel of each stream. The arguments are those of `predict`.

    Args:
        steps: Number of steps.
    """
    names = tuple(inputs)
    _check(names, test)
    if predictor.preprocessing.stride is None:
        raise ValueError("the predictor predicts the last frame, and has no steps: use evaluation.predict")
    _check_begin(predictor, test)
    predicted = _predicted(predictor, names, test, num_samples, steps, last=False)
    return [_judged(out, test, scenario) for out in predicted]


def _check(names: tuple[str, ...], test: Pairs, validation: Pairs | None = None) -> None:
    """Raise a ValueError if there is no trajectory to test, or if pairs lack the measurements among the inputs."""
    if len(test.object) == 0:
        raise ValueError("`test` has 0 trajectories: choose a split with held-out trajectories")
    for name, pairs in (("test", test), ("validation", validation)):
        lacking = set(names) - set(NAMES) - set(test.measurements if pairs is None else pairs.measurements)
        if lacking:
            raise ValueError(
                f"`inputs` contains {', '.join(map(repr, sorted(lacking)))}, but `{name}.measurements` does not: make "
                f"`{name}` with Dataset.pairs(..., measurements=...)"
            )


def _steps(predictor: Any, pairs: Pairs) -> int | None:
    """Number of steps of a one-step model from the first to the second frames, or None for another model."""
    stride = predictor.preprocessing.stride
    if stride is None:
        return None
    if pairs.frame is None:
        raise ValueError("the pairs have no `frame`, which a one-step model needs: make them with Dataset.pairs")
    _check_begin(predictor, pairs)
    apart = np.unique(pairs.frame[:, 1] - pairs.frame[:, 0])
    if len(apart) > 1 or apart[0] < stride or apart[0] % stride:
        raise ValueError(
            f"the two frames of the pairs are {', '.join(map(str, apart[:5]))} frames apart, but a step of the model "
            f"takes {stride}: make the pairs with Dataset.pairs(..., frames=(t, t + k * {stride})) for one k >= 1"
        )
    return int(apart[0]) // stride


def _check_begin(predictor: Any, pairs: Pairs) -> None:
    """Raise a ValueError if pairs begin at a frame from which a state-space model cannot be rolled out."""
    config = getattr(getattr(predictor, "model", None), "config", None)
    if isinstance(config, statespace.Config) and pairs.frame is not None and pairs.frame[:, 0].any():
        raise ValueError(
            f"the pairs begin at frame {pairs.frame[:, 0].max()}, but a roll-out of a state-space model begins with an "
            "object at rest, as in frame 0: make the pairs with Dataset.pairs(..., frames=(0, t))"
        )


def _judged(out: Predicted, test: Pairs, scenario: physics.Scenario) -> Predicted:
    """Add the outcome of the predicted pose, and the outcome probabilities of sampled poses."""
    if out.pose is not None:
        out = out._replace(outcome=outcome_of_pose(scenario, test.pose[:, 0], out.pose))
    if out.samples is not None and out.samples.pose is not None and out.outcome_probability is None:
        ends = np.stack([outcome_of_pose(scenario, test.pose[:, 0], pose) for pose in out.samples.pose])
        out = out._replace(outcome_probability=shares(ends, scenario.outcomes))
    return out


def _predicted(
    predictor: Any, names: tuple[str, ...], pairs: Pairs, num_samples: int, steps: int | None, *, last: bool
) -> list[Predicted]:
    """Predict each step, or only the last one, in groups of equal size, to limit the memory.

    Copies of the last trajectory fill the last group. A model that is no one-step model has no `steps`.
    """
    count = len(pairs.object)
    most = _CHUNK if steps is None or last else _FRAMES // (max(steps, 1) * (num_samples + 1))
    size, parts = min(count, _CHUNK, max(most, 1)), []
    keys = jax.random.split(jax.random.key(0), count) if num_samples else None
    for start in range(0, count, size):
        rows = np.minimum(np.arange(start, start + size), count - 1)
        some = None if keys is None else keys[rows]
        out = _predict_rows(predictor, names, pairs, rows, some, num_samples, steps, last=last)
        number = 0 if steps is None else 1 if last else steps
        frames = [_mapped(lambda axis, leaf, i=i: leaf.take(i, axis + 1), out) for i in range(number)]
        parts.append(frames or [out])
    return [take(joined(groups), slice(count)) for groups in zip(*parts, strict=True)]


def _predict_rows(
    predictor: Any,
    names: tuple[str, ...],
    pairs: Pairs,
    rows: np.ndarray,
    key: Any,
    num_samples: int,
    steps: int | None,
    *,
    last: bool,
) -> Predicted:
    """Predict the trajectories `rows` of `pairs` from the inputs `names`. The images of samples become `uint8`."""
    condition = pairs.condition[rows] if pairs.condition.shape[1] else None
    further = {name: in_unit(pairs.measurements[name][rows, 0]) for name in names if name in pairs.measurements}
    given: dict[str, Any] = {
        name: getattr(pairs, name)[rows, 0] / 255 for name in ("visual", "tactile") if name in names
    }
    if "pose" in names:
        given["pose"] = pairs.pose[rows, 0]
    if "state" in names:
        truth = (pairs.pose[rows, 0], pairs.support[rows], pairs.mass[rows], pairs.com[rows])
        given["state"] = training.state_codes(predictor.preprocessing, *truth)
    drawn = {"condition": condition, "key": key, "num_samples": num_samples}
    if steps is not None:
        view = predictor.preprocessing
        time = 0.0 if pairs.frame is None else pairs.frame[rows, 0] * view.period / view.stride
        out = predictor.rollout(given | further, steps, time=time, last=last, **drawn)
    elif names:
        masks = {name: ~np.isnan(x).reshape(len(rows), -1).any(-1) for name, x in further.items()}
        out = predictor(**given, **drawn, **({"measurements": further, "present": masks} if further else {}))
    else:
        out = predictor.prior((len(rows),), condition=condition)
    samples = None
    if out.samples is not None:
        images = (out.samples.visual, out.samples.tactile)
        seen, felt = (None if leaf is None else np.round(255 * np.asarray(leaf)).astype(np.uint8) for leaf in images)
        samples = Predicted(seen, felt, None if out.samples.pose is None else np.asarray(out.samples.pose))
    centre = Predicted(
        out.visual,
        out.tactile,
        out.pose,
        outcome_probability=out.outcome_probability,
        measurements=getattr(out, "measurements", None),
    )
    return jax.tree.map(np.asarray, centre)._replace(samples=samples)
