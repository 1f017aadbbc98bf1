"""Checks of the arguments of `simulate` and `starts`, whatever their types."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sts_jax.physics.bodies import check_bodies
from sts_jax.physics.scenario import Hidden, Scenario, Start
from sts_jax.sensor import Sensor


def listed(body: Any) -> list[Any]:
    """One body or several as a list, unchecked."""
    return list(body) if isinstance(body, Sequence) and not isinstance(body, str) else [body]


def check_arguments(bodies: Sequence[Any], sensor: Any, scenario: Any, **counts: Any) -> None:
    """Raise an error for any argument that cannot be used.

    Args:
        bodies: the bodies.
        sensor: the sensor.
        scenario: the scenario.
        counts: numbers of trajectories by the name of their argument.

    Raises:
        BodyError: (a ValueError) a body has bad values.
        ValueError: another argument, which the message names, is out of range.
        TypeError: an argument is of another type.
    """
    for name, count in counts.items():
        whole = isinstance(count, int | np.integer) and not isinstance(count, bool)
        if not whole or count < 1:
            raise ValueError(f"{name} is {count!r}, but it must be a whole number of trajectories >= 1")
    if not bodies:
        raise ValueError("no body was given: pass one Body or a sequence of them")
    if not isinstance(sensor, Sensor):
        raise TypeError(f"sensor is {sensor!r}, but it must be a Sensor, for instance sts.Sensor()")
    if not isinstance(scenario, Scenario) or not _is_frozen(scenario):
        raise TypeError(
            f"scenario is {scenario!r}, but it must be Freefall(), Inclined(), Perturbed(), Released() or a frozen "
            "dataclass of your own that derives from physics.Scenario"
        )
    scenario.check()
    check_bodies(bodies)


def _is_frozen(scenario: Any) -> bool:
    parameters = getattr(type(scenario), "__dataclass_params__", None)
    return parameters is not None and parameters.frozen


def check_condition(scenario: Scenario, start: Start) -> None:
    """Raise an error unless the condition of some starts has the numbers that the scenario declares."""
    width, declared = start.condition.shape[-1], len(scenario.condition_scale)
    if width != declared:
        raise ValueError(
            f"scenario.start returns a condition of {width} numbers, but scenario.quantities declares {declared}: "
            "declare a physics.Quantity for each number or vector of the condition"
        )


def check_outcomes(scenario: Scenario, outcome: np.ndarray) -> None:
    """Raise an error unless the outcomes of some trajectories (n,) are the scenario's."""
    known = [int(one) for one in scenario.outcomes]
    other = sorted(set(outcome.tolist()) - set(known))
    if other:
        raise ValueError(
            f"scenario.outcome returns {other[0]}, but the numbers of scenario.outcomes are {known}: declare it there"
        )


def check_hidden(hidden: Hidden, count: int) -> Hidden:
    """Given hidden values of `count` draws as arrays of JAX.

    Raises:
        ValueError: a value, which the message names, has another shape or is out of range.
    """
    arrays = {name: np.asarray(values, np.float32) for name, values in hidden._asdict().items()}
    for name, values in arrays.items():
        expected = (count, 3) if name == "up" else (count,)
        if values.shape != expected:
            raise ValueError(
                f"hidden.{name} has shape {values.shape}, but it must be {expected}, because bodies * num is {count}"
            )
        if not np.isfinite(values).all():
            raise ValueError(f"hidden.{name} has a value that is not finite, but all must be finite")
    fill = arrays["fill"]
    if fill.min() < 0 or fill.max() > 1:
        raise ValueError(f"hidden.fill reaches from {fill.min()} to {fill.max()}, but a share must be from 0 to 1")
    for name in ("shell_scale", "friction"):
        if arrays[name].min() <= 0:
            raise ValueError(f"hidden.{name} has the value {arrays[name].min()}, but it must be > 0")
    if not np.allclose(np.linalg.norm(arrays["up"], axis=1), 1, atol=1e-3):
        raise ValueError("hidden.up has rows that are not unit vectors: divide each row by its length")
    return Hidden(**jax.tree.map(jnp.asarray, arrays))
