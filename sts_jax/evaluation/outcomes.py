"""Outcomes of trajectories, such as `FELL_OFF`, from poses or images, and probabilities of outcomes from samples."""

import enum
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from sts_jax import physics

OUTCOMES: tuple[enum.IntEnum, ...] = tuple(physics.Outcome)


def named(outcome: int, outcomes: Sequence[enum.IntEnum] = OUTCOMES) -> str:
    """Return the name of an outcome, such as `fell_off`.

    Args:
        outcome: Value of a member of `outcomes`.
        outcomes: The outcomes of the scenario, `scenario.outcomes` (default: all members of `physics.Outcome`).

    Raises:
        KeyError: No member of `outcomes` has this value.
    """
    return {int(one): one.name.lower() for one in outcomes}[outcome]


def outcome_of_pose(scenario: physics.Scenario, first: np.ndarray, last: np.ndarray) -> np.ndarray:
    """Determine the outcomes of trajectories from their first and last poses.

    Args:
        scenario: The scenario of the trajectories.
        first: First poses, position (m) and quaternion, `(n, 7)`.
        last: Last poses, true or predicted, `(n, 7)`.

    Returns:
        Outcome of each trajectory, int `(n,)`. Each outcome is the value of a member of `scenario.outcomes`.
    """
    return np.asarray(jax.vmap(scenario.outcome)(jnp.asarray(first), jnp.asarray(last)))


def shares(outcome: np.ndarray, outcomes: Sequence[enum.IntEnum]) -> np.ndarray:
    """Estimate the probabilities of outcomes from samples.

    Each item has k samples, and there are c possible outcomes. The probability of an outcome is
    `(count + 1 / c) / (k + 1)`, where `count` is the number of the item's samples with this outcome. All
    probabilities are therefore above 0.

    Args:
        outcome: Outcomes of k samples for each of n items, int `(k, n)`. Each is the value of a member of `outcomes`.
        outcomes: The c outcomes of the scenario, `scenario.outcomes`.

    Returns:
        Probabilities, `(n, c)`, with the columns in the order of `outcomes`.
    """
    counts = (outcome[..., None] == np.array([int(one) for one in outcomes])).sum(0)
    return (counts + 1 / len(outcomes)) / (len(outcome) + 1)


def frequency(outcome: np.ndarray, outcomes: Sequence[enum.IntEnum]) -> np.ndarray:
    """Compute the frequencies of the outcomes among training trajectories.

    There are n trajectories and c possible outcomes. The frequency of an outcome is `(count + 1 / c) / (n + 1)`, where
    `count` is the number of trajectories with this outcome. All frequencies are therefore above 0.

    Args:
        outcome: Outcome of each trajectory as the value of a member of `outcomes`, int `(n,)`.
        outcomes: The c outcomes of the scenario, `scenario.outcomes`.

    Returns:
        Frequencies, `(c,)`, in the order of `outcomes`.
    """
    return shares(outcome[:, None], outcomes)[0]


def outcome_of_image(
    visual: np.ndarray, blank: np.ndarray, threshold: float, stays: int = int(physics.Outcome.RESTS)
) -> np.ndarray:
    """Determine from the last visual image of each trajectory whether the object fell off.

    The outcome is `FELL_OFF` if the image shows no object. Otherwise, it is the value of the argument `stays`, because
    the function does not distinguish between the outcomes of objects that stay on the pad.

    Args:
        visual: Images in [0, 1], `(n, height, width, 3)`.
        blank: Image of the sensor without an object, in [0, 1], `(height, width, 3)`.
        threshold: Largest mean absolute difference from `blank` (see `emptiness`) at which an image shows no object.
        stays: Outcome of objects that stay on the pad, as an integer (default: `physics.Outcome.RESTS`).

    Returns:
        Outcome of each image, int `(n,)`. Each outcome is either the value of `physics.Outcome.FELL_OFF` or `stays`.
    """
    empty = emptiness(visual, blank) <= threshold
    return np.where(empty, int(physics.Outcome.FELL_OFF), stays)


def emptiness(visual: np.ndarray, blank: np.ndarray) -> np.ndarray:
    """Compute the mean absolute difference between each image and the image of the sensor without an object.

    Args:
        visual: Images in [0, 1], `(n, height, width, 3)`.
        blank: Image of the sensor without an object, in [0, 1], `(height, width, 3)`.

    Returns:
        Differences in [0, 1], `(n,)`. The difference is 0 for an image that equals `blank`.
    """
    return np.abs(visual - blank).mean((1, 2, 3))
