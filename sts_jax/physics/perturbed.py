"""The jerked pad: an object stands on the pad, which is jerked sideways."""

import dataclasses
import math
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from sts_jax import geometry
from sts_jax.physics.limits import check_length, check_range
from sts_jax.physics.scenario import (
    MOVED,
    STANDING,
    TURNED,
    G,
    Outcome,
    Quantity,
    Scenario,
    Shape,
    Start,
    fell_off,
    random_place,
    random_yaw,
)
from sts_jax.physics.scene import Contact


class Jerk(NamedTuple):
    """The condition of `Perturbed`: the acceleration of the pad for a moment, from frame 0 on."""

    acceleration: Float[Array | np.ndarray, "*n 2"]  # m/s^2, of the pad along x and y
    duration: Float[Array | np.ndarray, "*n"]  # s


def jerk(condition: Float[Array | np.ndarray, "*n 3"]) -> Jerk:
    """The parts of a condition of `Perturbed`."""
    return Jerk(condition[..., :2], condition[..., 2])


@dataclasses.dataclass(frozen=True)
class Perturbed(Scenario):
    """An object stands upright on the pad, which is jerked sideways for a moment and then coasts.

    The simulation runs in the pad's frame. While the pad accelerates, gravity contains the opposite of its
    acceleration. The condition is the jerk: acceleration of the pad along x and y (m/s^2) and duration (s), from frame
    0 on. The fill matters most for a narrow base, so the defaults are for bottles.

    Ranges are uniform. Source: paper, "Data Collection".
    """

    symmetries = tuple(range(8))
    quantities = (Quantity("acceleration", "m/s²", 10.0, vector=True), Quantity("duration", "s", 0.1))
    outcomes = (Outcome.TOPPLES, Outcome.SLIDES, Outcome.STANDS, Outcome.FELL_OFF)

    acceleration: tuple[float, float] = (4.0, 12.0)  # m/s^2, in any direction
    duration: tuple[float, float] = (0.06, 0.12)  # s
    spread: float = 0.02  # m, radius of the disc from which the object's origin is drawn
    rate: float = 31.25  # frames/s
    frames: int = 60
    fill: tuple[float, float] = (0.0, 1.0)  # share of the interior's volume
    shell_scale: tuple[float, float] = (0.9, 1.1)  # shell's mass over nominal
    friction: tuple[float, float] = (0.5, 0.6)
    tilt: float = 0.0  # rad, as in `Freefall`
    contact: Contact = dataclasses.field(default_factory=Contact)
    must_stand: ClassVar[bool] = True

    def check(self) -> None:
        """See `Scenario.check`."""
        super().check()
        check_length("spread", self.spread)
        check_range("acceleration", self.acceleration, positive=False)
        check_range("duration", self.duration, positive=False)

    def start(self, key: PRNGKeyArray, shape: Shape, pad: tuple[float, float]) -> Start:
        """Draw one start with +z up and one jerk, as `Scenario.start` describes."""
        del pad
        turn, radius, angle, push, heading, time = jax.random.split(key, 6)
        pose = shape.above(random_place(radius, angle, self.spread), random_yaw(turn), -STANDING)
        size = jax.random.uniform(push, minval=self.acceleration[0], maxval=self.acceleration[1])
        along = jax.random.uniform(heading, maxval=2 * jnp.pi)
        lasts = jax.random.uniform(time, minval=self.duration[0], maxval=self.duration[1])
        condition = jnp.stack([size * jnp.cos(along), size * jnp.sin(along), lasts])
        return Start(pose, jnp.asarray(0), condition)

    def gravity(self, time: Float[Array, ""], condition: Float[Array, "3"]) -> Float[Array, "3"]:
        """See `Scenario.gravity`. The step in which the jerk ends has the share of the jerk that lies in it."""
        acceleration, duration = jerk(condition)
        step = self.contact.timestep
        share = jnp.clip((duration - time) / step, 0, 1) * (time > -step / 2)
        return jnp.append(-acceleration * share, -G)

    def drift(self, condition: Float[Array, "3"]) -> Float[Array, "2"]:
        """See `Scenario.drift`."""
        acceleration, duration = jerk(condition)
        return jnp.asarray(-acceleration * duration)

    def outcome(self, first: Float[Array, "7"], last: Float[Array, "7"]) -> Int[Array, ""]:
        """`FELL_OFF`, `TOPPLES` (leans by more than 45 degrees), `SLIDES` (moved by 10 mm or more) or `STANDS`."""
        leans = geometry.quat_to_matrix(geometry.normalize(last[3:]))[2, 2] < math.cos(TURNED)
        moved = geometry.norm(last[:2] - first[:2]) >= MOVED
        stays = jnp.where(moved, Outcome.SLIDES, Outcome.STANDS)
        ends = jnp.where(fell_off(last), Outcome.FELL_OFF, jnp.where(leans, Outcome.TOPPLES, stays))
        return ends.astype(jnp.int32)
