"""Checks of the arguments of `simulate` and `starts`, and of the values that the methods of a scenario return."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sts_jax.physics.bodies import check_bodies
from sts_jax.physics.scenario import Hidden, Scenario, Start
from sts_jax.sensor import Sensor


def listed(body: Any) -> list[Any]:
    """Convert one body, or a sequence of bodies, to a list. The items are not checked."""
    return list(body) if isinstance(body, Sequence) and not isinstance(body, str) else [body]


def check_arguments(bodies: Sequence[Any], sensor: Any, scenario: Any, **counts: Any) -> None:
    """Raise an error if an argument of `simulate` or `starts` cannot be used.

    Args:
        bodies: Bodies to simulate.
        sensor: Sensor whose pad the bodies fall on.
        scenario: Scenario to simulate.
        counts: Further arguments, such as `num=num`, that must be whole numbers >= 1. The message of an error contains
            the keyword, such as `num`.

    Raises:
        BodyError: A body has bad values. BodyError is a ValueError.
        ValueError: A count or a field of the scenario is out of range, or there is no body.
        TypeError: The sensor, the scenario or a body has the wrong type.
    """
    for name, count in counts.items():
        whole = isinstance(count, int | np.integer) and not isinstance(count, bool)
        if not whole or count < 1:
            raise ValueError(f"{name} is {count!r}, but it must be a whole number >= 1")
    if not bodies:
        raise ValueError("no body was given: pass one Body or a sequence of bodies")
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
    """Raise a ValueError unless `start.condition` has as many numbers as `scenario.quantities` declares.

    The condition of a trajectory consists of known quantities, such as the acceleration of the pad.
    """
    width, declared = start.condition.shape[-1], len(scenario.condition_scale)
    if width != declared:
        raise ValueError(
            f"scenario.start returns a condition of length {width}, but scenario.quantities declares a condition of "
            f"length {declared}: declare a physics.Quantity for each number or vector of the condition"
        )


def check_outcomes(scenario: Scenario, outcome: np.ndarray) -> None:
    """Raise a ValueError unless `scenario.outcomes` contains all values in `outcome`."""
    known = [int(one) for one in scenario.outcomes]
    other = sorted(set(outcome.tolist()) - set(known))
    if other:
        raise ValueError(
            f"scenario.outcome returns {other[0]}, but the members of scenario.outcomes have the values {known}: "
            f"add a member with the value {other[0]}"
        )


def check_start(start: Start, scenario: Scenario, count: int) -> Start:
    """Check the starts that a caller passes to `simulate`, and return them as JAX arrays of n starts.

    Args:
        start: Starts of n trajectories. `Start` explains the fields. `pose` has the shape (n, 7), and `condition` has
            the shape (n, c). `held` and `carried` have the shape (n,) or are one number for all trajectories.
        scenario: Scenario, whose `quantities` define c.
        count: Number n of trajectories.

    Raises:
        ValueError: A field has the wrong shape or a value out of range. The message names the field and the allowed
            values.
    """
    pose, condition = np.asarray(start.pose, np.float32), np.asarray(start.condition, np.float32)
    for name, values, width in (("pose", pose, 7), ("condition", condition, len(scenario.condition_scale))):
        if values.shape != (count, width):
            raise ValueError(
                f"start.{name} has shape {values.shape}, but it must be {(count, width)}, with one row for each "
                "trajectory. The number of trajectories is the number of bodies times `num`"
            )
        if not np.isfinite(values).all():
            raise ValueError(f"start.{name} has values that are not finite, but all must be finite")
    if not np.allclose(np.linalg.norm(pose[:, 3:], axis=1), 1, atol=1e-3):
        raise ValueError("start.pose has quaternions whose length is not 1: divide each quaternion by its length")
    held, carried = np.asarray(start.held), np.asarray(start.carried, np.float32)
    for name, values in (("held", held), ("carried", carried)):
        if values.shape not in ((), (count,)):
            raise ValueError(
                f"start.{name} has shape {values.shape}, but it must be one number or have the shape {(count,)}"
            )
    if held.dtype.kind not in "iu" or held.min() < 0:
        raise ValueError(f"start.held is {start.held}, but each value must be an integer >= 0 (time steps)")
    if not (carried.min() >= 0 and carried.max() <= 1):
        raise ValueError(
            f"start.carried has the smallest value {carried.min()} and the largest value {carried.max()}, but each "
            "value must be from 0 to 1"
        )
    return Start(
        jnp.asarray(pose),
        jnp.broadcast_to(jnp.asarray(held, jnp.int32), (count,)),
        jnp.asarray(condition),
        jnp.broadcast_to(jnp.asarray(carried), (count,)),
    )


def check_hidden(hidden: Hidden, count: int) -> Hidden:
    """Check the hidden properties that a caller passes to `simulate`, and return them as JAX arrays.

    Args:
        hidden: Hidden properties of n trajectories. The fields `fill`, `shell_scale` and `friction` have the shape
            (n,). The field `up` has the shape (n, 3) and contains unit vectors in the mesh frame.
        count: Number n of trajectories.

    Raises:
        ValueError: A field has the wrong shape or a value out of range. The message names the field and the allowed
            values.
    """
    arrays = {name: np.asarray(values, np.float32) for name, values in hidden._asdict().items()}
    for name, values in arrays.items():
        expected = (count, 3) if name == "up" else (count,)
        if values.shape != expected:
            raise ValueError(
                f"hidden.{name} has shape {values.shape}, but it must be {expected}, with one entry for each "
                "trajectory. The number of trajectories is the number of bodies times `num`"
            )
        if not np.isfinite(values).all():
            raise ValueError(f"hidden.{name} has values that are not finite, but all must be finite")
    fill = arrays["fill"]
    if fill.min() < 0 or fill.max() > 1:
        raise ValueError(
            f"hidden.fill has the smallest value {fill.min()} and the largest value {fill.max()}, but each value must "
            "be from 0 to 1"
        )
    for name in ("shell_scale", "friction"):
        if arrays[name].min() <= 0:
            raise ValueError(f"hidden.{name} has the value {arrays[name].min()}, but it must be > 0")
    if not np.allclose(np.linalg.norm(arrays["up"], axis=1), 1, atol=1e-3):
        raise ValueError("hidden.up has rows that are not unit vectors: divide each row by its length")
    return Hidden(**jax.tree.map(jnp.asarray, arrays))
