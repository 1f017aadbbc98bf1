"""The slope: an object is laid on the tilted pad, or released just above it."""

import dataclasses
import math
from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from sts_jax import geometry
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
    check_length,
    check_range,
    fell_off,
    random_yaw,
    upright,
)
from sts_jax.physics.scene import Contact

DIRECTIONS = 120  # horizontal directions in which the extent of an object's support is measured
LET_GO = 0.008  # s from release to frame 0. Frame 0 then has a wrench, and a tipping object leans by only 0.1 degree
CLEARANCE = 0.001  # m, smallest distance of a start on the slope from the stop wall


@dataclasses.dataclass(frozen=True)
class Inclined(Scenario):
    """An object starts at rest on the tilted pad, or is released just above it. Downhill is +y, with a stop wall.

    The contents have settled earlier in another, random orientation (`tilt`), and do not move on the slope. In most
    poses they hardly matter: a flat object stays and a high object tips, wherever its contents lie. A start at rest
    therefore has that one of several random poses in which the contents matter most for tipping.

    All values are drawn uniformly from the ranges of the fields. Source: the See-Through-your-Skin paper, section "Data
    Collection".
    """

    outcomes = (Outcome.ROLLS, Outcome.SLIDES, Outcome.STICKS, Outcome.FELL_OFF)

    slope: float = math.radians(30)  # angle of the pad to the horizontal (rad)
    wall: float = 0.02  # height of the stop wall at the lower edge (m, 0 for no wall)
    resting: float = 0.9  # share of starts at rest on a stable face (the others: above the pad in any orientation)
    # range of the distance from the pad to the object's lowest point, for starts that are not at rest (m)
    gap: tuple[float, float] = (0.001, 0.01)
    # number of candidate poses of a start at rest, each with a random stable face and a random turn about the
    # vertical (the start has the pose in which the contents matter most for whether the object tips)
    tries: int = 16
    across: float = 0.04  # largest |x| of the object's origin at the start (m)
    # range of y of the object's origin at the start (m, objects that would touch the stop wall start farther uphill)
    along: tuple[float, float] = (-0.05, 0.03)
    rate: float = 31.25  # frame rate (frames/s)
    frames: int = 60  # number of frames
    fill: tuple[float, float] = (0.2, 0.6)  # range of the share of the interior's volume that is filled
    shell_scale: tuple[float, float] = (0.9, 1.1)  # range of the shell's mass over its nominal mass
    friction: tuple[float, float] = (0.56, 0.76)  # range of the coefficient of friction against the pad
    # largest angle between the object's +z and the upward direction in which its contents settled (rad)
    tilt: float = math.pi
    contact: Contact = dataclasses.field(default_factory=Contact)  # contact and solver constants
    symmetric: ClassVar[bool] = True
    by_contents: ClassVar[bool] = True

    def check(self) -> None:
        """See `Scenario.check`."""
        super().check()
        if not 0 <= self.slope < math.pi / 2:
            raise ValueError(f"scenario.slope is {self.slope} rad, but it must be >= 0 and < pi / 2: use math.radians")
        check_length("wall", self.wall)
        check_length("across", self.across)
        check_range("gap", self.gap, positive=False)
        if not (math.isfinite(sum(self.along)) and self.along[0] <= self.along[1]):
            raise ValueError(f"scenario.along is {self.along}, but it must be finite (low, high) with low <= high")
        if not 1 <= self.tries <= 10_000:
            raise ValueError(f"scenario.tries is {self.tries}, but it must be from 1 to 10,000")
        if not 0 <= self.resting <= 1:
            raise ValueError(f"scenario.resting is {self.resting}, but it must be from 0 to 1")

    def start(self, key: PRNGKeyArray, shape: Shape, pad: tuple[float, float]) -> Start:
        """Draw a pose uphill of the stop wall, at rest on the pad or in the air.

        At rest, the pose is that one of `tries` with the largest `min(mean(max(m, 0)), mean(max(-m, 0)))`. The means
        are over random contents, and m is the distance by which the centre of mass, projected vertically onto the pad,
        lies inside the area that supports the object (negative if the object tips).
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
        let_go = max(self.steps - round(LET_GO / self.contact.timestep), 0)
        held = jnp.where(rests, let_go, self.steps)
        return Start(shape.above(place, geometry.quat_canonical(quat), height), held, jnp.zeros(0))

    def gravity(self, time: Float[Array, ""], condition: Float[Array, "0"]) -> Float[Array, "3"]:
        """Gravity in the frame of the tilted pad."""
        del time, condition
        return G * jnp.array([0.0, math.sin(self.slope), -math.cos(self.slope)])

    def outcome(self, first: Float[Array, "7"], last: Float[Array, "7"]) -> Int[Array, ""]:
        """`FELL_OFF`, else `ROLLS` (turned by more than 45 degrees), else `SLIDES` (by 10 mm or more), or `STICKS`."""
        same = jnp.abs(geometry.normalize(first[3:]) @ geometry.normalize(last[3:]))
        moved = geometry.norm(last[:2] - first[:2]) >= MOVED
        stays = jnp.where(moved, Outcome.SLIDES, Outcome.STICKS)
        ends = jnp.where(fell_off(last), Outcome.FELL_OFF, jnp.where(same < math.cos(TURNED / 2), Outcome.ROLLS, stays))
        return ends.astype(jnp.int32)


def _margins(quat: Float[Array, "4"], shape: Shape, slope: float) -> Float[Array, "m"]:
    """The margins m of `Inclined.start` (m) for each centre of mass of the object, on a slope towards +y."""
    rotation = geometry.quat_to_matrix(quat)
    points, coms = shape.points @ rotation.T, shape.coms @ rotation.T
    low = jnp.min(points[:, 2])
    meets = coms[:, :2] + (coms[:, 2:] - low) * math.tan(slope) * jnp.array([0.0, 1.0])
    angle = jnp.arange(DIRECTIONS) * (2 * jnp.pi / DIRECTIONS)
    outward = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    reach = jnp.max(jnp.where((points[:, 2] < low + LEVEL)[:, None], points[:, :2] @ outward, -jnp.inf), axis=0)
    return jnp.min(reach - meets @ outward, axis=1)
