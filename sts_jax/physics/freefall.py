"""Free fall: an object is released above the level pad."""

import dataclasses
import math
from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from sts_jax import geometry
from sts_jax.physics.roll import SLOW_TIME
from sts_jax.physics.scenario import G, Outcome, Scenario, Shape, Start, check_length, fell_off, random_place
from sts_jax.physics.scene import Contact


@dataclasses.dataclass(frozen=True)
class Freefall(Scenario):
    """An object is released in any orientation above the level pad. In frame 0 it is at rest in the air.

    A trajectory must last for the fall and the 0.2 s in which an object settles:
    `(frames - 1) / rate >= sqrt(2 height / g) + 0.2 s`. All values are drawn uniformly from the ranges of the fields.
    Source: the See-Through-your-Skin paper, section "Data Collection".
    """

    outcomes = (Outcome.RESTS, Outcome.FELL_OFF)

    height: float = 0.05  # height of the object's lowest point above the pad in frame 0 (m)
    spread: float = 0.05  # radius of the disc about the pad's centre from which the object's origin is drawn (m)
    rate: float = 31.25  # frame rate (frames/s, the default has 32 time steps of 1 ms per frame)
    frames: int = 60  # number of frames (60 frames last 1.9 s at the default rate)
    fill: tuple[float, float] = (0.0, 1.0)  # range of the share of the interior's volume that is filled
    shell_scale: tuple[float, float] = (0.9, 1.1)  # range of the shell's mass over its nominal mass
    friction: tuple[float, float] = (0.4, 0.8)  # range of the coefficient of friction against the pad
    # largest angle between the object's +z and the upward direction in which its contents settled (rad)
    tilt: float = 0.0
    # contact and solver constants (the gel brakes rolling objects, so that round objects come to rest, and time steps
    # below the default do not change falls)
    contact: Contact = dataclasses.field(default_factory=lambda: Contact(0.001, width=0.00005, rolling=0.002))
    symmetric: ClassVar[bool] = True

    def check(self) -> None:
        """See `Scenario.check`."""
        super().check()
        check_length("height", self.height)
        check_length("spread", self.spread)
        lasts, needed = (self.frames - 1) / self.rate, math.sqrt(2 * self.height / G) + SLOW_TIME
        if lasts < needed:
            raise ValueError(
                f"scenario.frames is {self.frames} ({lasts:.3g} s), but a fall from {self.height:g} m to rest lasts "
                f"{needed:.3g} s: give at least {math.ceil(needed * self.rate) + 1} frames or a smaller height"
            )

    def start(self, key: PRNGKeyArray, shape: Shape, pad: tuple[float, float]) -> Start:
        """Draw a random place and orientation in the air."""
        del pad
        turn, radius, angle = jax.random.split(key, 3)
        quat = geometry.random_quat(turn)
        pose = shape.above(random_place(radius, angle, self.spread), quat, self.height)
        return Start(pose, jnp.asarray(self.steps), jnp.zeros(0))

    def gravity(self, time: Float[Array, ""], condition: Float[Array, "0"]) -> Float[Array, "3"]:
        """Gravity on the level pad."""
        del time, condition
        return jnp.array([0.0, 0.0, -G])

    def outcome(self, first: Float[Array, "7"], last: Float[Array, "7"]) -> Int[Array, ""]:
        """`FELL_OFF` if the object has left the pad in the last frame, else `RESTS`."""
        del first
        return jnp.where(fell_off(last), Outcome.FELL_OFF, Outcome.RESTS).astype(jnp.int32)
