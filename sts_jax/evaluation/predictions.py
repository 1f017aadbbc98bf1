"""Predictions of the last frames of held-out trajectories, from any subset of a model's inputs."""

import enum
import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sts_jax import physics, training
from sts_jax._checked import in_32_bits
from sts_jax.dataset import Dataset, Pairs
from sts_jax.dataset.measurement import NAMES
from sts_jax.evaluation.metrics import best_threshold

TRUE_STATE = "visual and the true state"  # the true state: pose, shape and mass of the object, from the simulation
_FELL_OFF = int(physics.Outcome.FELL_OFF)
_CHUNK = 64  # number of trajectories that one call predicts


class Predicted(NamedTuple):
    """The predicted last frames of n trajectories. Quantities that are not predicted are None.

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


def first(predicted: Predicted, count: int) -> Predicted:
    """Return the prediction for the first `count` trajectories."""
    return _mapped(lambda axis, leaf: leaf[:count] if axis == 0 else leaf[:, :count], predicted)


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
    return np.asarray(jax.vmap(scenario.outcome)(jnp.asarray(first), jnp.asarray(last)))


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
    """Predict the last frames of held-out trajectories with a model, from some of its inputs.

    The predicted outcome follows from the predicted pose. Outcome probabilities are those of the model, or the shares
    of the outcomes among its samples. A model of the visual image without a pose gets an outcome if the scenario has
    two outcomes and `validation` and `blank` are given: `FELL_OFF` if the image shows no object.

    Args:
        predictor: A `sts_jax.Predictor`, or any object with its `__call__`, `prior` and `preprocessing`.
        test: The held-out trajectories, with images of the resolution that the model expects.
        inputs: Names of the inputs, some of `predictor.modalities`, or also `state` for models that accept the true
            pose, shape and mass. Without inputs, the prediction is the model's prior, which has no samples.
        validation: Trajectories for choosing the threshold that separates images with and without an object.
        blank: Empty visual image in [0, 1], `(height, width, 3)`.
        num_samples: Number of samples of each prediction, or 0 for none.
    """
    names = tuple(inputs)
    if len(test.object) == 0:
        raise ValueError("`test` has 0 trajectories: choose a split with held-out trajectories")
    for name, pairs in (("test", test), ("validation", validation)):
        lacking = set(names) - set(NAMES) - set(test.measurements if pairs is None else pairs.measurements)
        if lacking:
            raise ValueError(
                f"`inputs` contains {', '.join(map(repr, sorted(lacking)))}, but `{name}.measurements` does not: make "
                f"`{name}` with Dataset.pairs(..., measurements=...)"
            )

    def run(pairs: Pairs, num_samples: int) -> Predicted:
        """Predict in groups of equal size, to limit the memory. Copies of the last trajectory fill the last group."""
        count = len(pairs.object)
        size, parts = min(count, _CHUNK), []
        keys = jax.random.split(jax.random.key(0), count) if num_samples else None
        for start in range(0, count, size):
            rows = np.minimum(np.arange(start, start + size), count - 1)
            some = None if keys is None else keys[rows]
            parts.append(_predict_rows(predictor, names, pairs, rows, some, num_samples))
        return first(joined(parts), count)

    out = run(test, num_samples)
    if out.pose is not None:
        out = out._replace(outcome=outcome_of_pose(scenario, test.pose[:, 0], out.pose))
    elif out.visual is not None and len(scenario.stays) == 1 and validation is not None and blank is not None:
        score, judged = (np.abs(x - blank).mean((1, 2, 3)) for x in (np.asarray(run(validation, 0).visual), out.visual))
        empty = judged <= best_threshold(score, validation.outcome != _FELL_OFF)
        out = out._replace(outcome=np.where(empty, _FELL_OFF, int(scenario.stays[0])))
    if out.samples is not None and out.samples.pose is not None and out.outcome_probability is None:
        ends = np.stack([outcome_of_pose(scenario, test.pose[:, 0], pose) for pose in out.samples.pose])
        out = out._replace(outcome_probability=shares(ends, scenario.outcomes))
    return out


def _predict_rows(
    predictor: Any, names: tuple[str, ...], pairs: Pairs, rows: np.ndarray, key: Any, num_samples: int
) -> Predicted:
    """Predict the trajectories `rows` of `pairs` from the inputs `names`. The images of samples become `uint8`."""
    condition = pairs.condition[rows] if pairs.condition.shape[1] else None
    further = {name: in_unit(pairs.measurements[name][rows, 0]) for name in names if name in pairs.measurements}
    if names:
        masks = {name: ~np.isnan(x).reshape(len(rows), -1).any(-1) for name, x in further.items()}
        state = None
        if "state" in names:
            truth = (pairs.pose[rows, 0], pairs.support[rows], pairs.mass[rows], pairs.com[rows])
            state = training.state_codes(predictor.preprocessing, *truth)
        out = predictor(
            visual=pairs.visual[rows, 0] / 255 if "visual" in names else None,
            tactile=pairs.tactile[rows, 0] / 255 if "tactile" in names else None,
            pose=pairs.pose[rows, 0] if "pose" in names else None,
            condition=condition,
            state=state,
            key=key,
            num_samples=num_samples,
            **({"measurements": further, "present": masks} if further else {}),
        )
    else:
        out = predictor.prior((len(rows),), condition=condition)
    samples = None
    if out.samples is not None:
        images = (out.samples.visual, out.samples.tactile)
        drawn, felt = (None if leaf is None else np.round(255 * np.asarray(leaf)).astype(np.uint8) for leaf in images)
        samples = Predicted(drawn, felt, None if out.samples.pose is None else np.asarray(out.samples.pose))
    centre = Predicted(
        out.visual,
        out.tactile,
        out.pose,
        outcome_probability=out.outcome_probability,
        measurements=getattr(out, "measurements", None),
    )
    return jax.tree.map(np.asarray, centre)._replace(samples=samples)
