"""The slope: an object is laid on the tilted pad, or released just above it."""

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

DIRECTIONS = 120  # horizontal directions in which the extent of an object's support is measured
LET_GO = 0.008  # s from release to frame 0. Frame 0 then has a wrench, and a tipping object leans by only 0.1 degree
CLEARANCE = 0.001  # m, smallest distance of a start on the slope from the stop wall


@dataclasses.dataclass(frozen=True)
class Inclined(Scenario):
    """An object starts at rest on the tilted pad, or is released just above it. Downhill is +y.

    A stop wall stands at the lower edge of the pad. The contents of each object have settled earlier, in another,
    random orientation of the object. The field `tilt` limits how far that orientation is from upright. On the slope,
    the contents do not move inside the object, so the contents have the same place in the object in all frames. For a
    start at rest, the centre of pressure in frame 0 reveals this place. The weight alone reveals little about this
    place.

    In most poses, the contents hardly matter: a flat object stays and a high object tips, wherever its contents lie.
    For a start at rest, several random poses are therefore compared (the field `tries` is their number). The object
    starts in the pose in which its contents have the largest influence on tipping.

    The random values of each trajectory, such as the friction, are drawn uniformly from the ranges that the fields of
    this class define. Source: the See-Through-your-Skin paper, section "Data Collection".
    """

    symmetries = (0, 6)  # x -> -x
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
    by_contents: ClassVar[bool] = True

    def check(self) -> None:
        """Raise a ValueError if a field has a value of the wrong type or out of range. The message names the field."""
        super().check()
        if not 0 <= self.slope < math.pi / 2:
            raise ValueError(
                f"scenario.slope is {self.slope} rad, but it must be >= 0 and < pi / 2. "
                "For an angle in degrees, use math.radians"
            )
        check_length("wall", self.wall)
        check_length("across", self.across)
        check_range("gap", self.gap, positive=False)
        if not (math.isfinite(sum(self.along)) and self.along[0] <= self.along[1]):
            raise ValueError(
                f"scenario.along is {self.along}, but it must be (low, high) with finite numbers and low <= high"
            )
        if self.tries < 1:
            raise ValueError(f"scenario.tries is {self.tries}, but it must be >= 1")
        if not 0 <= self.resting <= 1:
            raise ValueError(
                f"scenario.resting is {self.resting}, but it must be from 0 to 1 (share of the trajectories that start "
                "at rest)"
            )

    def start(self, key: PRNGKeyArray, shape: Shape, pad: tuple[float, float]) -> Start:
        """Draw one start: a pose uphill of the stop wall, at rest on the pad or in the air.

        See `Scenario.start` for the arguments.

        For a start at rest, several random poses are drawn (the field `tries` is their number), and the best pose is
        used. In a good pose, the amount and the place of the object's contents decide whether the object tips or stays.
        Each pose is therefore tested with several random contents. The margin m of one test is the distance by which
        the centre of mass, projected vertically onto the pad, lies inside the area that supports the object. The margin
        is negative if the object tips. The best pose has the largest value of `min(mean(max(m, 0)), mean(max(-m, 0)))`,
        with means over the tests of the pose.
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
        """Return the gravity in the frame of the tilted pad (m/s^2). It does not depend on the arguments."""
        del time, condition
        return G * jnp.array([0.0, math.sin(self.slope), -math.cos(self.slope)])

    def outcome(self, first: Float[Array, "7"], last: Float[Array, "7"]) -> Int[Array, ""]:
        """Return the number of the outcome, given the poses (7,) of the first and the last frame.

        The outcome is the first of these that applies:

        - `FELL_OFF`, if the object has left the pad,
        - `ROLLS`, if it has turned by more than 45 degrees about any axis,
        - `SLIDES`, if it has moved by 10 mm or more along the pad,
        - `STICKS`, in all other cases.
        """
        same = jnp.abs(geometry.normalize(first[3:]) @ geometry.normalize(last[3:]))
        moved = geometry.norm(last[:2] - first[:2]) >= MOVED
        stays = jnp.where(moved, Outcome.SLIDES, Outcome.STICKS)
        ends = jnp.where(fell_off(last), Outcome.FELL_OFF, jnp.where(same < math.cos(TURNED / 2), Outcome.ROLLS, stays))
        return ends.astype(jnp.int32)


def _margins(quat: Float[Array, "4"], shape: Shape, slope: float) -> Float[Array, "m"]:
    """Compute the margin (m) by which an object with each centre of mass holds on a slope towards +y.

    The vertical line through the centre of mass meets the pad at a point. The margin is the distance of this point from
    the outline of the points that support the object. It is negative outside the outline, where the object tips.
    """
    rotation = geometry.quat_to_matrix(quat)
    points, coms = shape.points @ rotation.T, shape.coms @ rotation.T
    low = jnp.min(points[:, 2])
    meets = coms[:, :2] + (coms[:, 2:] - low) * math.tan(slope) * jnp.array([0.0, 1.0])
    angle = jnp.arange(DIRECTIONS) * (2 * jnp.pi / DIRECTIONS)
    outward = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    reach = jnp.max(jnp.where((points[:, 2] < low + LEVEL)[:, None], points[:, :2] @ outward, -jnp.inf), axis=0)
    return jnp.min(reach - meets @ outward, axis=1)
