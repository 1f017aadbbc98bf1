"""The jerked pad: an object stands on the pad, which is accelerated sideways for a short time."""

import dataclasses
import math
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from sts_jax import geometry
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
    check_length,
    check_range,
    fell_off,
    random_place,
    random_yaw,
)
from sts_jax.physics.scene import Contact


class Jerk(NamedTuple):
    """Constant acceleration of the pad that begins at frame 0."""

    acceleration: Float[Array | np.ndarray, "*n 2"]  # acceleration of the pad along x and y (m/s^2)
    duration: Float[Array | np.ndarray, "*n"]  # duration of the acceleration (s)


def jerk(condition: Float[Array | np.ndarray, "*n 3"]) -> Jerk:
    """The jerk of a condition of `Perturbed`."""
    return Jerk(condition[..., :2], condition[..., 2])


@dataclasses.dataclass(frozen=True)
class Perturbed(Scenario):
    """An object stands upright on the pad, which accelerates sideways for a short time and then keeps its velocity.

    The acceleration begins at frame 0 and is called a jerk, although it is not a derivative. The simulation runs in the
    frame of the pad, so the acceleration is subtracted from gravity.

    The defaults are chosen for bottles, which can contain water: they have a narrow base, so `fill` often decides
    whether they topple. All values are drawn uniformly from the ranges of the fields. Source: the See-Through-your-Skin
    paper, section "Data Collection".
    """

    quantities = (Quantity("acceleration", "m/s²", 10.0, vector=True), Quantity("duration", "s", 0.1))
    outcomes = (Outcome.TOPPLES, Outcome.SLIDES, Outcome.STANDS, Outcome.FELL_OFF)

    acceleration: tuple[float, float] = (4.0, 12.0)  # range of the acceleration, in a random direction (m/s^2)
    duration: tuple[float, float] = (0.06, 0.12)  # range of the duration of the acceleration (s)
    spread: float = 0.02  # radius of the disc about the pad's centre from which the object's origin is drawn (m)
    rate: float = 31.25  # frame rate (frames/s)
    frames: int = 60  # number of frames
    fill: tuple[float, float] = (0.0, 1.0)  # range of the share of the interior's volume that is filled
    shell_scale: tuple[float, float] = (0.9, 1.1)  # range of the shell's mass over its nominal mass
    friction: tuple[float, float] = (0.5, 0.6)  # range of the coefficient of friction against the pad
    # largest angle between the object's +z and the upward direction in which its contents settled (rad)
    tilt: float = 0.0
    contact: Contact = dataclasses.field(default_factory=Contact)  # contact and solver constants
    symmetric: ClassVar[bool] = True
    must_stand: ClassVar[bool] = True

    def check(self) -> None:
        """See `Scenario.check`."""
        super().check()
        check_length("spread", self.spread)
        check_range("acceleration", self.acceleration, positive=False)
        check_range("duration", self.duration, positive=False)

    def start(self, key: PRNGKeyArray, shape: Shape, pad: tuple[float, float]) -> Start:
        """Draw a place and a jerk. The object stands with its +z up."""
        del pad
        turn, radius, angle, push, heading, time = jax.random.split(key, 6)
        pose = shape.above(random_place(radius, angle, self.spread), random_yaw(turn), -STANDING)
        size = jax.random.uniform(push, minval=self.acceleration[0], maxval=self.acceleration[1])
        along = jax.random.uniform(heading, maxval=2 * jnp.pi)
        lasts = jax.random.uniform(time, minval=self.duration[0], maxval=self.duration[1])
        condition = jnp.stack([size * jnp.cos(along), size * jnp.sin(along), lasts])
        return Start(pose, jnp.asarray(0), condition)

    def gravity(self, time: Float[Array, ""], condition: Float[Array, "3"]) -> Float[Array, "3"]:
        """Gravity minus the mean acceleration of the pad over the time step."""
        acceleration, duration = jerk(condition)
        step = self.contact.timestep
        share = jnp.clip((duration - time) / step, 0, 1) * (time > -step / 2)
        return jnp.append(-acceleration * share, -G)

    def drift(self, condition: Float[Array, "3"]) -> Float[Array, "2"]:
        """Velocity relative to the pad after the jerk: minus the acceleration times the duration."""
        acceleration, duration = jerk(condition)
        return jnp.asarray(-acceleration * duration)

    def outcome(self, first: Float[Array, "7"], last: Float[Array, "7"]) -> Int[Array, ""]:
        """`FELL_OFF`, else `TOPPLES` (+z leans by more than 45 degrees), else `SLIDES` (10 mm or more), or `STANDS`."""
        leans = geometry.quat_to_matrix(geometry.normalize(last[3:]))[2, 2] < math.cos(TURNED)
        moved = geometry.norm(last[:2] - first[:2]) >= MOVED
        stays = jnp.where(moved, Outcome.SLIDES, Outcome.STANDS)
        ends = jnp.where(fell_off(last), Outcome.FELL_OFF, jnp.where(leans, Outcome.TOPPLES, stays))
        return ends.astype(jnp.int32)
