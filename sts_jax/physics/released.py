"""The release by hand: a hand holds an object on the pad in an unstable pose, and lets go."""

import dataclasses
import math
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from sts_jax import geometry
from sts_jax.physics.scenario import (
    LEVEL,
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
    random_place,
    random_yaw,
    upright,
)
from sts_jax.physics.scene import Contact

SMALLEST = math.radians(6)  # rad, smallest lean of a held object, so that it never seems to lie on its face
FLAT = math.radians(15)  # rad, if an object balances at a smaller lean, its face is one facet of a rounded side
CLEARANCE = 0.002  # m, smallest distance between the points that touch the pad and the edge of the pad


@dataclasses.dataclass(frozen=True)
class Released(Scenario):
    """A hand tilts an object about an edge of its bottom face, holds it tilted on the pad, and lets go at frame 0.

    The hand holds the object near the angle at which it would balance on the edge. This angle depends on the place of
    the contents, which can lie anywhere in the object. The contents therefore decide whether the object returns to its
    face or topples.

    In frame 0 the object is at rest. The pad carries a random share of the weight (`carried`), and the hand carries the
    rest and balances all moments. The wrench in frame 0 is computed from the held pose and this share
    (`rest.held_wrench`), and does not depend on the motion after the release.

    All values are drawn uniformly from the ranges of the fields. Source: the See-Through-your-Skin paper, section
    "Real-World Dataset", where the object is a small camera.
    """

    outcomes = (Outcome.TOPPLES, Outcome.RETURNS, Outcome.FELL_OFF)

    # range of the held angle minus the angle at which an object with average contents balances (rad, at a negative
    # value such an object returns to its face)
    beyond: tuple[float, float] = (math.radians(-9), math.radians(9))
    skew: float = math.radians(4)  # largest angle in the pad's plane between the axis of the lean and the edge (rad)
    carried: tuple[float, float] = (0.3, 0.9)  # range of the share of the weight on the pad until the release
    # radius of the disc about the pad's centre from which the object's place is drawn (m, the place is the midpoint
    # between the centres of mass before and after a fall over the edge)
    spread: float = 0.015
    # number of candidate edges of random stable faces (the start has the suitable edge with the lowest centre of mass
    # in balance, so that few objects tumble off the pad)
    tries: int = 16
    rate: float = 31.25  # frame rate (frames/s)
    frames: int = 60  # number of frames
    fill: tuple[float, float] = (0.2, 0.6)  # range of the share of the interior's volume that is filled
    shell_scale: tuple[float, float] = (0.9, 1.1)  # range of the shell's mass over its nominal mass
    friction: tuple[float, float] = (0.5, 0.6)  # range of the coefficient of friction against the pad
    # largest angle between the object's +z and the upward direction in which its contents settled (rad)
    tilt: float = math.pi
    # contact and solver constants (a gel brakes rolling objects, but more rolling friction would let an object stand on
    # its edge)
    contact: Contact = dataclasses.field(default_factory=lambda: Contact(rolling=0.0005))
    symmetric: ClassVar[bool] = True
    by_contents: ClassVar[bool] = True

    def check(self) -> None:
        """See `Scenario.check`."""
        super().check()
        check_length("spread", self.spread)
        if not 0 <= self.skew <= TURNED:
            raise ValueError(f"scenario.skew is {self.skew} rad, but it must be from 0 to pi / 4: use math.radians")
        low, high = self.beyond
        if not -TURNED <= low <= high <= TURNED:
            raise ValueError(
                f"scenario.beyond is {self.beyond} rad, but it must be (low, high) with -pi / 4 <= low <= high <= "
                "pi / 4: use math.radians"
            )
        check_range("carried", self.carried)
        if self.carried[1] > 1:
            raise ValueError(f"scenario.carried is {self.carried}, but it must have 0 < low <= high <= 1")
        if not 1 <= self.tries <= 10_000:
            raise ValueError(f"scenario.tries is {self.tries}, but it must be from 1 to 10,000")

    def start(self, key: PRNGKeyArray, shape: Shape, pad: tuple[float, float]) -> Start:
        """Draw the pose in which the object is held, and the share of the weight that the pad carries.

        Of `tries` random edges of stable faces, those are suitable on which the object balances at a lean of 15 to 45
        degrees. The object is held on the suitable edge with the lowest centre of mass in balance. If none is suitable,
        as for a cylinder on its side, it is the lowest of all.
        """
        candidates, beyond, skew, radius, angle, share = jax.random.split(key, 6)
        keys = jax.random.split(candidates, self.tries)
        edges = jax.lax.map(lambda key: _random_edge(key, shape), keys)  # one by one, to save memory
        suitable = (edges.balance > FLAT) & (edges.balance < TURNED)
        chosen = jnp.argmin(jnp.where(suitable, edges.height, edges.height + 1.0))  # 1 m ranks other edges last
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
        # The midpoint of the centre of mass on the one face and on the other, so that the object stays over the pad.
        middle = random_place(radius, angle, self.spread) - edge.middle
        place = jnp.clip(middle - (low + high) / 2, -room - low, room - high)
        carried = jax.random.uniform(share, minval=self.carried[0], maxval=self.carried[1])
        return Start(shape.above(place, quat, -STANDING), jnp.asarray(self.steps), jnp.zeros(0), carried)

    def gravity(self, time: Float[Array, ""], condition: Float[Array, "0"]) -> Float[Array, "3"]:
        """Gravity on the level pad."""
        del time, condition
        return jnp.array([0.0, 0.0, -G])

    def outcome(self, first: Float[Array, "7"], last: Float[Array, "7"]) -> Int[Array, ""]:
        """`FELL_OFF`, else `TOPPLES` (turned by more than 45 degrees, but not about the vertical), or `RETURNS`.

        At an edge between two perpendicular faces, an object that leans by a < 45 degrees turns by a if it returns, and
        by 90 degrees - a if it topples.
        """
        before, after = (geometry.quat_to_matrix(geometry.normalize(pose[3:]))[2] for pose in (first, last))
        stays = jnp.where(before @ after < math.cos(TURNED), Outcome.TOPPLES, Outcome.RETURNS)
        return jnp.where(fell_off(last), Outcome.FELL_OFF, stays).astype(jnp.int32)


class _Edge(NamedTuple):
    """An edge of a face on which an object lies."""

    quat: Float[Array, "4"]  # orientation of the object on the face
    outward: Float[Array, ""]  # rad, direction in the pad's plane perpendicular to the edge, away from the face
    balance: Float[Array, ""]  # rad, lean over the edge at which an object with average contents balances
    height: Float[Array, ""]  # m, height of the centre of mass at this lean
    middle: Float[Array, "2"]  # m, from the edge to the midpoint of the centre of mass before and after a quarter turn


def _random_edge(key: PRNGKeyArray, shape: Shape) -> _Edge:
    """Draw a stable face with its share as the probability, and the edge of the face in a random direction."""
    which, turn, direction = jax.random.split(key, 3)
    face = jax.random.categorical(which, jnp.log(shape.shares))
    quat = geometry.quat_multiply(random_yaw(turn), upright(shape.rests[face]))
    rotation = geometry.quat_to_matrix(quat)
    points, com = shape.points @ rotation.T, jnp.mean(shape.coms, axis=0) @ rotation.T
    low = jnp.min(points[:, 2])
    support = points[:, 2] < low + LEVEL

    # The edge runs from the corner that reaches farthest in the direction to the next corner around the face's outline.
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
