"""The baselines, which predict the last frame without a trained model.

The module also defines the names of the baselines, and the names of two further predictors, which simulate each
trajectory again. One predicts the mean of many simulations (`evaluation.ceiling`), the other the result of one.
"""

import numpy as np

from sts_jax import physics
from sts_jax.dataset import Pairs
from sts_jax.evaluation.outcomes import outcome_of_pose
from sts_jax.evaluation.predictions import Predicted, in_unit

CONSTANT, COPY, NEIGHBOUR = "constant (mean training target)", "copy of the input", "nearest neighbour"
BELOW = "rests below its start"
BASELINES = (CONSTANT, COPY, NEIGHBOUR, BELOW)
CEILING, ONE_REROLL = "ceiling (mean of re-rolls)", "one re-roll"
CEILINGS = (CEILING, ONE_REROLL)


def baselines(scenario: physics.Scenario, train: Pairs, test: Pairs) -> dict[str, Predicted]:
    """Predict the last frame without a trained model, in four ways.

    - The constant is the mean last frame of the training trajectories. Its outcome is the most frequent outcome of
      these trajectories, and its outcome probabilities are the frequencies of the outcomes.
    - The copy predicts that the last frame equals the first one.
    - The nearest neighbour is the last frame of the most similar training trajectory. Two trajectories are compared by
      the squared distance between their first visual images. In scenarios with a condition (known quantities, such as
      the acceleration of the pad), the squared distance is first divided by the mean squared distance of the images
      from their mean. The mean squared difference of the quantities is then added, where the squared difference of each
      quantity is divided by its variance. The variances are those of the training set.
    - The rule "rests below its start" keeps x, y and the orientation of the first pose. The predicted height is the
      median of the heights of the training objects in their last frames, without the objects that leave the pad. The
      rule predicts no images.

    The constant, the copy and the nearest neighbour also predict the further modalities (`Pairs.measurements`). The
    constant is the mean over the measured values. The copy and the nearest neighbour predict this mean if the value
    that they copy was not measured.

    Args:
        scenario: The scenario of the trajectories.
        train: The training trajectories.
        test: The held-out trajectories.

    Returns:
        The predictions for `test` by name. The names are "constant (mean training target)", "copy of the input",
        "nearest neighbour" and "rests below its start".
    """
    inputs = train.visual[:, 0].reshape(len(train.visual), -1).astype(np.float32)
    queries = test.visual[:, 0].reshape(len(test.visual), -1).astype(np.float32)
    distance = (inputs**2).sum(1) - 2 * queries @ inputs.T
    width = train.condition.shape[1]
    if width:
        variance = float(((inputs - inputs.mean(0)) ** 2).sum(1).mean())
        gap = test.condition[:, None] - train.condition[None]
        spread = train.condition.var(0)
        spread = np.where(spread > 0, spread, 1.0)  # a constant number of the condition does not distinguish items
        distance = distance / variance + (gap**2 / spread).sum(-1) / width
    nearest = distance.argmin(1)
    num = len(test.visual)

    def repeat(mean: np.ndarray) -> np.ndarray:
        return np.broadcast_to(mean, (num, *mean.shape))

    mean_pose = train.pose[:, 1].mean(0)
    mean_pose[3:] /= max(np.linalg.norm(mean_pose[3:]), 1e-6)
    majority = np.bincount(train.outcome).argmax()
    frequency = np.array([np.mean(train.outcome == outcome) for outcome in scenario.outcomes])
    rests = train.outcome != int(physics.Outcome.FELL_OFF)
    below = test.pose[:, 0].copy()
    below[:, 2] = np.median(train.pose[rests if rests.any() else slice(None), 1, 2])
    further = {name: in_unit(x[:, 1]) for name, x in train.measurements.items() if name in test.measurements}
    means = {name: _mean(last) for name, last in further.items()}

    def filled(name: str, values: np.ndarray) -> np.ndarray:
        return np.where(np.isnan(values), means[name], values)

    return {
        CONSTANT: Predicted(
            repeat(train.visual[:, 1].mean(0) / 255),
            repeat(train.tactile[:, 1].mean(0) / 255),
            repeat(mean_pose),
            np.full(num, majority),
            outcome_probability=repeat(frequency),
            measurements={name: repeat(mean) for name, mean in means.items()} or None,
        ),
        COPY: Predicted(
            test.visual[:, 0] / 255,
            test.tactile[:, 0] / 255,
            test.pose[:, 0],
            outcome_of_pose(scenario, test.pose[:, 0], test.pose[:, 0]),
            measurements={name: filled(name, in_unit(test.measurements[name][:, 0])) for name in further} or None,
        ),
        NEIGHBOUR: Predicted(
            train.visual[nearest, 1] / 255,
            train.tactile[nearest, 1] / 255,
            train.pose[nearest, 1],
            train.outcome[nearest],
            measurements={name: filled(name, last[nearest]) for name, last in further.items()} or None,
        ),
        BELOW: Predicted(pose=below, outcome=outcome_of_pose(scenario, test.pose[:, 0], below)),
    }


def _mean(values: np.ndarray) -> np.ndarray:
    """The mean over the items that were measured, or NaN if no item was measured."""
    known = values[~np.isnan(values).reshape(len(values), -1).any(1)]
    return known.mean(0) if len(known) else np.full(values.shape[1:], np.nan)
