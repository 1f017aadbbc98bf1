"""Outcomes of predictions, and probabilities of outcomes."""

import enum
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from sts_jax import physics

OUTCOMES: tuple[enum.IntEnum, ...] = tuple(physics.Outcome)


def named(outcome: int, outcomes: Sequence[enum.IntEnum] = OUTCOMES) -> str:
    """The name of an outcome, such as `fell_off`, among the outcomes of a scenario."""
    return next(one.name.lower() for one in outcomes if int(one) == outcome)


def outcome_of_pose(scenario: physics.Scenario, first: np.ndarray, last: np.ndarray) -> np.ndarray:
    """`scenario.outcome` of first and last poses `(n, 7)`, true or predicted."""
    return np.asarray(jax.vmap(scenario.outcome)(jnp.asarray(first), jnp.asarray(last)))


def shares(outcome: np.ndarray, outcomes: Sequence[enum.IntEnum]) -> np.ndarray:
    """Probabilities `(n, c)` of outcomes from samples of the outcome.

    One more sample is spread evenly over the outcomes, so that no probability is 0.

    Args:
        outcome: Outcome of each sample, int `(k, n)`.
        outcomes: `scenario.outcomes`, in the order of the columns.
    """
    counts = (outcome[..., None] == np.array([int(one) for one in outcomes])).sum(0)
    return (counts + 1 / len(outcomes)) / (len(outcome) + 1)


def frequency(outcome: np.ndarray, outcomes: Sequence[enum.IntEnum]) -> np.ndarray:
    """Frequency of each outcome `(c,)`, with one more item that is spread evenly, so that no frequency is 0.

    Args:
        outcome: Outcomes of training trajectories, int `(n,)`.
        outcomes: `scenario.outcomes`.
    """
    return shares(outcome[:, None], outcomes)[0]


def outcome_of_image(
    visual: np.ndarray, blank: np.ndarray, threshold: float, stays: int = int(physics.Outcome.RESTS)
) -> np.ndarray:
    """The outcome from an image: `FELL_OFF` if its distance from the empty image is at most a threshold.

    Other distinctions depend on how an object lies on the pad, which is not read from images.

    Args:
        visual: Images `(n, height, width, 3)` in [0, 1].
        blank: The image of the untouched sensor, `(height, width, 3)`.
        threshold: Largest `emptiness` of an image without an object.
        stays: The outcome of the other images.
    """
    empty = emptiness(visual, blank) <= threshold
    return np.where(empty, int(physics.Outcome.FELL_OFF), stays)


def emptiness(visual: np.ndarray, blank: np.ndarray) -> np.ndarray:
    """Mean absolute difference `(n,)` of images `(n, height, width, 3)` in [0, 1] from the empty sensor's."""
    return np.abs(visual - blank).mean((1, 2, 3))
