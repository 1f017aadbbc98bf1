"""The slope: an object is laid on the tilted pad."""

import dataclasses
import math
from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from sts_jax import geometry
from sts_jax.physics.limits import check_length, check_range
from sts_jax.physics.scenario import (
    LEVEL,
    MOVED,
    STANDING,
    TURNED,
    G,
    Outcome,
    Scenario,
    Shape,
    Start,
    fell_off,
    random_yaw,
    upright,
)
from sts_jax.physics.scene import Contact

DIRECTIONS = 120  # directions in which an object's support is measured
LET_GO = 0.008  # s from release to frame 0, when a tipping object leans by 0.1 degree and touch has felt it
CLEARANCE = 0.001  # m, smallest distance of a start on the slope from the stop wall


@dataclasses.dataclass(frozen=True)
class Inclined(Scenario):
    """An object is laid on the tilted pad or released just above it. Downhill is +y, with a stop wall at the edge.

    On the slope, weight reveals little, but the centre of pressure reveals where the contents lie. They are therefore
    frozen in any direction. Whatever its contents, an object that lies flat holds and one that stands high tips, so
    objects are laid in poses in which the contents decide.

    Ranges are uniform. Source: paper, "Data Collection".
    """

    symmetries = (0, 6)  # x -> -x
    outcomes = (Outcome.ROLLS, Outcome.SLIDES, Outcome.STICKS, Outcome.FELL_OFF)

    slope: float = math.radians(30)  # rad
    wall: float = 0.02  # m, height of the stop wall at the lower edge, 0 for none
    resting: float = 0.9  # share of the starts at rest on a stable face. The others are in any orientation ...
    gap: tuple[float, float] = (0.001, 0.01)  # m, ... and this far above the pad
    # candidate faces and turns of a start at rest, which has the one where the contents decide most whether it tips
    tries: int = 16
    across: float = 0.04  # m, largest |x| of the object's origin at the start
    along: tuple[float, float] = (-0.05, 0.03)  # m, y of the origin at the start
    rate: float = 31.25  # frames/s
    frames: int = 60
    fill: tuple[float, float] = (0.2, 0.6)  # share of the interior's volume
    shell_scale: tuple[float, float] = (0.9, 1.1)  # shell's mass over nominal
    friction: tuple[float, float] = (0.56, 0.76)
    tilt: float = math.pi  # rad, as in `Freefall`
    contact: Contact = dataclasses.field(default_factory=Contact)
    by_contents: ClassVar[bool] = True

    def check(self) -> None:
        """See `Scenario.check`."""
        super().check()
        if not 0 <= self.slope < math.pi / 2:
            raise ValueError(
                f"scenario.slope is {self.slope} rad, but it must be >= 0 and < pi / 2 "
                "(give degrees as math.radians(30))"
            )
        check_length("wall", self.wall)
        check_length("across", self.across)
        check_range("gap", self.gap, positive=False)
        if not (math.isfinite(sum(self.along)) and self.along[0] <= self.along[1]):
            raise ValueError(f"scenario.along is {self.along}, but it must be (low, high), finite and low <= high")
        if self.tries < 1:
            raise ValueError(f"scenario.tries is {self.tries}, but it must be >= 1")
        if not 0 <= self.resting <= 1:
            raise ValueError(f"scenario.resting is {self.resting}, but a share must be from 0 to 1")

    def start(self, key: PRNGKeyArray, shape: Shape, pad: tuple[float, float]) -> Start:
        """Draw one start outside the wall, as `Scenario.start` describes.

        A start at rest has the best of `tries` faces and turns: the one in which some contents hold by the widest
        margin and others tip by it.
        """
        kind, face, turn, free, gap, x, y = jax.random.split(key, 7)
        rests = jax.random.uniform(kind) < self.resting
        faces = shape.rests[jax.random.categorical(face, jnp.log(shape.shares), shape=(self.tries,))]
        turns = jax.vmap(random_yaw)(jax.random.split(turn, self.tries))
        laid = jax.vmap(geometry.quat_multiply)(turns, jax.vmap(upright)(faces))
        margin = jax.lax.map(lambda quat: _margins(quat, shape, self.slope), laid)  # one by one, to save memory
        undecided = jnp.minimum(jnp.maximum(margin, 0).mean(axis=1), jnp.maximum(-margin, 0).mean(axis=1))
        quat = jnp.where(rests, laid[jnp.argmax(undecided)], geometry.random_quat(free))
        lower_end = jnp.max(shape.points @ geometry.quat_to_matrix(quat)[1])
        place = jnp.stack(
            [
                jax.random.uniform(x, minval=-self.across, maxval=self.across),
                jnp.minimum(
                    jax.random.uniform(y, minval=self.along[0], maxval=self.along[1]),
                    pad[1] / 2 - CLEARANCE - lower_end,
                ),
            ]
        )
        height = jnp.where(rests, -STANDING, jax.random.uniform(gap, minval=self.gap[0], maxval=self.gap[1]))
        held = jnp.where(rests, self.steps - round(LET_GO / self.contact.timestep), self.steps)
        return Start(shape.above(place, geometry.quat_canonical(quat), height), held, jnp.zeros(0))

    def gravity(self, time: Float[Array, ""], condition: Float[Array, "0"]) -> Float[Array, "3"]:
        """See `Scenario.gravity`."""
        del time, condition
        return G * jnp.array([0.0, math.sin(self.slope), -math.cos(self.slope)])

    def outcome(self, first: Float[Array, "7"], last: Float[Array, "7"]) -> Int[Array, ""]:
        """`FELL_OFF`, `ROLLS` (turned by 45 degrees or more, about any axis), `SLIDES` (moved by 10 mm) or `STICKS`."""
        same = jnp.abs(geometry.normalize(first[3:]) @ geometry.normalize(last[3:]))
        moved = geometry.norm(last[:2] - first[:2]) >= MOVED
        stays = jnp.where(moved, Outcome.SLIDES, Outcome.STICKS)
        ends = jnp.where(fell_off(last), Outcome.FELL_OFF, jnp.where(same < math.cos(TURNED / 2), Outcome.ROLLS, stays))
        return ends.astype(jnp.int32)


def _margins(quat: Float[Array, "4"], shape: Shape, slope: float) -> Float[Array, "m"]:
    """How far (m) inside its support an object's weight meets a slope towards +y, for each centre of mass.

    Where this is negative, the object tips.
    """
    rotation = geometry.quat_to_matrix(quat)
    points, coms = shape.points @ rotation.T, shape.coms @ rotation.T
    low = jnp.min(points[:, 2])
    meets = coms[:, :2] + (coms[:, 2:] - low) * math.tan(slope) * jnp.array([0.0, 1.0])
    angle = jnp.arange(DIRECTIONS) * (2 * jnp.pi / DIRECTIONS)
    outward = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    reach = jnp.max(jnp.where((points[:, 2] < low + LEVEL)[:, None], points[:, :2] @ outward, -jnp.inf), axis=0)
    return jnp.min(reach - meets @ outward, axis=1)
