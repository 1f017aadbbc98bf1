"""The release by hand: an object is held in an unstable pose in contact with the pad, and let go."""

import dataclasses
import math
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from sts_jax import geometry
from sts_jax.physics.limits import check_length, check_range
from sts_jax.physics.scenario import (
    LEVEL,
    STANDING,
    TURNED,
    G,
    Outcome,
    Scenario,
    Shape,
    Start,
    fell_off,
    random_place,
    random_yaw,
    upright,
)
from sts_jax.physics.scene import Contact

SMALLEST = math.radians(6)  # rad, smallest lean from the face, so that a held object never seems to lie on it
FLAT = math.radians(15)  # rad, an object that balances at a smaller lean lies on one of several facets
CLEARANCE = 0.002  # m, smallest distance of the points that touch from the edge of the pad


@dataclasses.dataclass(frozen=True)
class Released(Scenario):
    """A hand leans an object over an edge of one of its faces, holds it there on the pad and lets go at frame 0.

    Over the edge, the object balances at one angle. It is held a little short of this angle, from where it returns to
    the face, or beyond it, from where it topples. Contents that lie anywhere in the object move the angle, so the
    contents decide near it.

    In frame 0 the object is at rest. The pad carries a random share of its weight, and the hand carries the rest and
    all moments. The wrench is that of the gel under the held pose (`held.held_wrench`). It depends on nothing that
    happens after the release.

    Ranges are uniform. Source: paper, "Real-World Dataset", where a small camera is released by hand.
    """

    symmetries = tuple(range(8))
    outcomes = (Outcome.TOPPLES, Outcome.RETURNS, Outcome.FELL_OFF)

    # rad, lean beyond the angle at which an object with average contents balances, negative short of it
    beyond: tuple[float, float] = (math.radians(-9), math.radians(9))
    skew: float = math.radians(4)  # rad, largest angle in the pad's plane between the axis of the lean and the edge
    carried: tuple[float, float] = (0.3, 0.9)  # share of the weight that the pad carries until the release
    spread: float = 0.015  # m, radius of the disc about the pad's centre, where the object lies on average
    # Candidate faces and edges. The suitable one with the lowest centre of mass in balance is taken, so that few
    # objects tumble off the pad.
    tries: int = 16
    rate: float = 31.25  # frames/s
    frames: int = 60
    fill: tuple[float, float] = (0.2, 0.6)  # share of the interior's volume
    shell_scale: tuple[float, float] = (0.9, 1.1)  # shell's mass over nominal
    friction: tuple[float, float] = (0.5, 0.6)
    tilt: float = math.pi  # rad, as in `Freefall`
    # A gel brakes rolling objects. More rolling friction would let an object stand on its edge.
    contact: Contact = dataclasses.field(default_factory=lambda: Contact(rolling=0.0005))
    by_contents: ClassVar[bool] = True

    def check(self) -> None:
        """See `Scenario.check`."""
        super().check()
        check_length("spread", self.spread)
        if not 0 <= self.skew <= TURNED:
            raise ValueError(
                f"scenario.skew is {self.skew} rad, but it must be from 0 to pi / 4 (give degrees as math.radians(4))"
            )
        low, high = self.beyond
        if not -TURNED <= low <= high <= TURNED:
            raise ValueError(
                f"scenario.beyond is {self.beyond} rad, but it must be (low, high) with -pi / 4 <= low <= high <= "
                "pi / 4 (give degrees as math.radians(10))"
            )
        check_range("carried", self.carried)
        if self.carried[1] > 1:
            raise ValueError(f"scenario.carried is {self.carried}, but a share of the weight must be > 0 and <= 1")
        if self.tries < 1:
            raise ValueError(f"scenario.tries is {self.tries}, but it must be >= 1")

    def start(self, key: PRNGKeyArray, shape: Shape, pad: tuple[float, float]) -> Start:
        """Draw one held pose over the pad and the share of the weight on the pad, as `Scenario.start` describes.

        Toppling and returning differ by the angle that the object turns, see `outcome`. Starts therefore lean from the
        narrower one of the two faces at an edge, on which the object balances at 15 to 45 degrees. An object without
        such a face, such as a cylinder on its side, leans from another one.
        """
        candidates, beyond, skew, radius, angle, share = jax.random.split(key, 6)
        keys = jax.random.split(candidates, self.tries)
        edges = jax.lax.map(lambda own: _random_edge(own, shape), keys)  # one by one, to save memory
        suitable = (edges.balance > FLAT) & (edges.balance < TURNED)
        chosen = jnp.argmin(jnp.where(suitable, edges.height, edges.height + 1.0))  # no object is 1 m high
        edge = jax.tree.map(lambda x: x[chosen], edges)

        past = jax.random.uniform(beyond, minval=self.beyond[0], maxval=self.beyond[1])
        lean = jnp.maximum(edge.balance + past, SMALLEST)
        heading = edge.outward + jax.random.uniform(skew, minval=-self.skew, maxval=self.skew)
        axis = jnp.stack([-jnp.sin(heading), jnp.cos(heading), 0.0])
        quat = geometry.quat_canonical(geometry.quat_multiply(geometry.quat_from_rotvec(lean * axis), edge.quat))

        points = shape.points @ geometry.quat_to_matrix(quat).T
        across = points[:, :2]
        touching = (points[:, 2] < jnp.min(points[:, 2]) + LEVEL)[:, None]
        low = jnp.min(jnp.where(touching, across, jnp.inf), axis=0)
        high = jnp.max(jnp.where(touching, across, -jnp.inf), axis=0)
        room = jnp.asarray(pad) / 2 - CLEARANCE
        # Halfway between the places of the centre of mass on the two faces, so that it is over the pad on either.
        middle = random_place(radius, angle, self.spread) - edge.middle
        place = jnp.clip(middle - (low + high) / 2, -room - low, room - high)
        carried = jax.random.uniform(share, minval=self.carried[0], maxval=self.carried[1])
        return Start(shape.above(place, quat, -STANDING), jnp.asarray(self.steps), jnp.zeros(0), carried)

    def gravity(self, time: Float[Array, ""], condition: Float[Array, "0"]) -> Float[Array, "3"]:
        """See `Scenario.gravity`."""
        del time, condition
        return jnp.array([0.0, 0.0, -G])

    def outcome(self, first: Float[Array, "7"], last: Float[Array, "7"]) -> Int[Array, ""]:
        """`FELL_OFF`, `TOPPLES` (its upward direction turned by more than 45 degrees) or `RETURNS`.

        The lean from the narrower face at an edge is less than 45 degrees and that from the wider one more, so an
        object that turned less has returned to the face from which it leaned. Turns about the vertical do not count.
        """
        before, after = (geometry.quat_to_matrix(geometry.normalize(pose[3:]))[2] for pose in (first, last))
        stays = jnp.where(before @ after < math.cos(TURNED), Outcome.TOPPLES, Outcome.RETURNS)
        return jnp.where(fell_off(last), Outcome.FELL_OFF, stays).astype(jnp.int32)


class _Edge(NamedTuple):
    """An edge of a face on which an object lies."""

    quat: Float[Array, "4"]  # of the object on the face
    outward: Float[Array, ""]  # rad, direction in the pad's plane perpendicular to the edge, away from the face
    balance: Float[Array, ""]  # rad, lean over the edge at which an object with average contents balances
    height: Float[Array, ""]  # m, of the centre of mass at this angle
    middle: Float[Array, "2"]  # m, from the edge, halfway between the centres of mass before and after a quarter turn


def _random_edge(key: PRNGKeyArray, shape: Shape) -> _Edge:
    """Draw a stable face by its share and an edge of it that lies in a random direction."""
    which, turn, direction = jax.random.split(key, 3)
    face = jax.random.categorical(which, jnp.log(shape.shares))
    quat = geometry.quat_multiply(random_yaw(turn), upright(shape.rests[face]))
    rotation = geometry.quat_to_matrix(quat)
    points, com = shape.points @ rotation.T, jnp.mean(shape.coms, axis=0) @ rotation.T
    low = jnp.min(points[:, 2])
    support = points[:, 2] < low + LEVEL

    # One step around the outline of the face, from the corner that reaches farthest in the direction to the next one.
    angle = jax.random.uniform(direction, maxval=2 * jnp.pi)
    outward = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    corner = points[jnp.argmax(jnp.where(support, points[:, :2] @ outward, -jnp.inf)), :2]
    ahead, aside = (points[:, :2] - corner) @ jnp.stack([-outward[1], outward[0]]), (points[:, :2] - corner) @ -outward
    other = support & (jnp.hypot(ahead, aside) > LEVEL)
    bend = jnp.min(jnp.where(other, jnp.arctan2(jnp.maximum(aside, 0), ahead), jnp.inf))
    heading = angle + jnp.where(jnp.isfinite(bend), bend, 0.0)
    normal = jnp.stack([jnp.cos(heading), jnp.sin(heading)])
    inside, height = (corner - com[:2]) @ normal, com[2] - low
    return _Edge(quat, heading, jnp.arctan2(inside, height), jnp.hypot(inside, height), (height - inside) / 2 * normal)
