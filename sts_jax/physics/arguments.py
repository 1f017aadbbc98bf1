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
    """A list of one body or of a sequence of bodies."""
    return list(body) if isinstance(body, Sequence) and not isinstance(body, str) else [body]


MOST_RECORDS = 10**8  # frames of all trajectories of one call: about 10 GB


def check_arguments(bodies: Sequence[Any], sensor: Any, scenario: Any, **counts: Any) -> None:
    """Raise an error if an argument cannot be used. `counts`, such as `num=num`, must be whole numbers >= 1."""
    for name, count in counts.items():
        whole = isinstance(count, int | np.integer) and not isinstance(count, bool)
        if not whole or not 1 <= count <= MOST_RECORDS:
            raise ValueError(f"{name} is {count!r}, but it must be a whole number from 1 to {MOST_RECORDS:,}")
    if not bodies:
        raise ValueError("no body was given: pass one Body or a sequence of bodies")
    if not isinstance(sensor, Sensor):
        raise TypeError(f"sensor is {sensor!r}, but it must be a Sensor, for instance sts.Sensor()")
    parameters = getattr(type(scenario), "__dataclass_params__", None)
    if not isinstance(scenario, Scenario) or parameters is None or not parameters.frozen:
        raise TypeError(
            f"scenario is {scenario!r}, but it must be Freefall(), Inclined(), Perturbed(), Released() or a frozen "
            "dataclass that derives from physics.Scenario"
        )
    scenario.check()
    records = len(bodies) * counts["num"] * scenario.frames
    if records > MOST_RECORDS:
        raise ValueError(
            f"num is {counts['num']}, which gives {records:,} frames, about {records / 1e7:,.0f} GB: call it several "
            f"times with at most {MOST_RECORDS:,} frames and other keys"
        )
    check_bodies(bodies)


def check_condition(scenario: Scenario, start: Start) -> None:
    """Raise a ValueError unless a start has as many numbers in its condition as the scenario declares."""
    width, declared = start.condition.shape[-1], len(scenario.condition_scale)
    if width != declared:
        raise ValueError(
            f"scenario.start returns a condition of length {width}, but scenario.quantities declares {declared}: "
            "declare a physics.Quantity for each number or vector"
        )
    held = np.asarray(start.held)
    if held.min() < 0 or held.max() > scenario.steps:
        raise ValueError(
            f"scenario.start returns held from {held.min()} to {held.max()} time steps, but it must be from 0 to the "
            f"{scenario.steps} time steps of the interval before frame 0"
        )


def check_outcomes(scenario: Scenario, outcome: np.ndarray) -> None:
    """Raise a ValueError unless `scenario.outcomes` contains all values in `outcome`."""
    declared = [int(one) for one in scenario.outcomes]
    other = sorted(set(outcome.tolist()) - set(declared))
    if other:
        raise ValueError(
            f"scenario.outcome returns {other[0]}, but the members of scenario.outcomes have the values {declared}: "
            f"add a member with the value {other[0]}"
        )


def check_start(start: Start, scenario: Scenario, count: int) -> Start:
    """Check the starts that a caller passes to `simulate`, and return them as JAX arrays of `count` starts."""
    pose, condition = np.asarray(start.pose, np.float32), np.asarray(start.condition, np.float32)
    _check_arrays(
        "start", {"pose": (pose, (count, 7)), "condition": (condition, (count, len(scenario.condition_scale)))}
    )
    if not np.allclose(np.linalg.norm(pose[:, 3:], axis=1), 1, atol=1e-3):
        raise ValueError("start.pose has quaternions whose length is not 1: divide each quaternion by its length")
    held, carried = np.asarray(start.held), np.asarray(start.carried, np.float32)
    for name, values in (("held", held), ("carried", carried)):
        if values.shape not in ((), (count,)):
            raise ValueError(f"start.{name} has shape {values.shape}, but it must be one number or {(count,)}")
    if held.dtype.kind not in "iu" or held.min() < 0:
        raise ValueError(f"start.held is {start.held}, but each value must be an integer >= 0 (time steps)")
    if held.max() > scenario.steps:
        raise ValueError(f"start.held is {start.held}, but it must be at most scenario.steps, {scenario.steps}")
    if not (carried.min() >= 0 and carried.max() <= 1):
        raise ValueError(f"start.carried is from {carried.min()} to {carried.max()}, but it must be from 0 to 1")
    return Start(
        jnp.asarray(pose),
        jnp.broadcast_to(jnp.asarray(held, jnp.int32), (count,)),
        jnp.asarray(condition),
        jnp.broadcast_to(jnp.asarray(carried), (count,)),
    )


def check_hidden(hidden: Hidden, count: int) -> Hidden:
    """Check the hidden properties that a caller passes to `simulate`, and return them as JAX arrays."""
    arrays = {name: np.asarray(values, np.float32) for name, values in hidden._asdict().items()}
    _check_arrays("hidden", {n: (values, (count, 3) if n == "up" else (count,)) for n, values in arrays.items()})
    fill = arrays["fill"]
    if fill.min() < 0 or fill.max() > 1:
        raise ValueError(f"hidden.fill is from {fill.min()} to {fill.max()}, but it must be from 0 to 1")
    for name in ("shell_scale", "friction"):
        if arrays[name].min() <= 0:
            raise ValueError(f"hidden.{name} has the value {arrays[name].min()}, but it must be > 0")
    if not np.allclose(np.linalg.norm(arrays["up"], axis=1), 1, atol=1e-3):
        raise ValueError("hidden.up has rows that are not unit vectors: divide each row by its length")
    return Hidden(**jax.tree.map(jnp.asarray, arrays))


def _check_arrays(owner: str, arrays: dict[str, tuple[np.ndarray, tuple[int, ...]]]) -> None:
    for name, (values, expected) in arrays.items():
        if values.shape != expected:
            raise ValueError(
                f"{owner}.{name} has shape {values.shape}, but it must be {expected}, with one row for each "
                "trajectory: the number of bodies times `num`"
            )
        if not np.isfinite(values).all():
            raise ValueError(f"{owner}.{name} has values that are not finite")
