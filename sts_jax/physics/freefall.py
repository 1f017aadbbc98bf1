"""Free fall: an object is released above the level pad."""

import dataclasses
import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from sts_jax import geometry
from sts_jax.physics.limits import check_length
from sts_jax.physics.roll import SLOW_TIME
from sts_jax.physics.scenario import G, Outcome, Scenario, Shape, Start, fell_off, random_place
from sts_jax.physics.scene import Contact


@dataclasses.dataclass(frozen=True)
class Freefall(Scenario):
    """An object is released in any orientation above the flat pad. In frame 0 it is at rest in the air.

    The frames must last at least as long as the fall to the pad plus 0.2 s, the time at rest after which an object
    counts as settled: `(frames - 1) / rate >= sqrt(2 height / g) + 0.2 s`. Shorter trajectories are refused. They have
    no outcome, since no object can have come to rest by their end. After 1.9 s, the default, few objects still move
    (`Trajectory.settled`).

    Ranges are uniform. Source: paper, "Data Collection".
    """

    symmetries = tuple(range(8))
    outcomes = (Outcome.RESTS, Outcome.FELL_OFF)

    height: float = 0.05  # m, lowest point of the object above the pad in frame 0
    spread: float = 0.05  # m, radius of the disc from which the object's origin is drawn
    rate: float = 31.25  # frames/s, 32 steps of 1 ms each. 60 frames last 1.9 s, after which few objects still move
    frames: int = 60
    fill: tuple[float, float] = (0.0, 1.0)  # share of the interior's volume
    shell_scale: tuple[float, float] = (0.9, 1.1)  # shell's mass over nominal
    friction: tuple[float, float] = (0.4, 0.8)
    tilt: float = 0.0  # rad, largest lean of the contents' up from the object's +z, in any direction
    # A gel brakes rolling objects, so lathed ones come to rest. Finer time steps do not change falls.
    contact: Contact = dataclasses.field(default_factory=lambda: Contact(0.001, width=0.00005, rolling=0.002))

    def check(self) -> None:
        """See `Scenario.check`."""
        super().check()
        check_length("height", self.height)
        check_length("spread", self.spread)
        lasts, needed = (self.frames - 1) / self.rate, math.sqrt(2 * self.height / G) + SLOW_TIME
        if lasts < needed:
            raise ValueError(
                f"scenario.frames is {self.frames}, which last {lasts:.3g} s, but an object released {self.height:g} m "
                f"above the pad needs at least {needed:.3g} s to fall and come to rest: give at least "
                f"{math.ceil(needed * self.rate) + 1} frames or a smaller height"
            )

    def start(self, key: PRNGKeyArray, shape: Shape, pad: tuple[float, float]) -> Start:
        """Draw one start, see `Scenario.start`."""
        del pad
        turn, radius, angle = jax.random.split(key, 3)
        quat = geometry.random_quat(turn)
        pose = shape.above(random_place(radius, angle, self.spread), quat, self.height)
        return Start(pose, jnp.asarray(self.steps), jnp.zeros(0))

    def gravity(self, time: Float[Array, ""], condition: Float[Array, "0"]) -> Float[Array, "3"]:
        """See `Scenario.gravity`."""
        del time, condition
        return jnp.array([0.0, 0.0, -G])

    def outcome(self, first: Float[Array, "7"], last: Float[Array, "7"]) -> Int[Array, ""]:
        """`RESTS` or `FELL_OFF`, from the true or predicted poses of the first and the last frame."""
        del first
        return jnp.where(fell_off(last), Outcome.FELL_OFF, Outcome.RESTS).astype(jnp.int32)
