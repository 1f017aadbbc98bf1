"""What starts where, under which gravity, and what its end is called."""

import dataclasses
import enum
import math
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from sts_jax import _math
from sts_jax.physics.scene import Contact

G = 9.81  # m/s^2
FELL_OFF_HEIGHT = -0.005  # m; an object's origin lies inside its hull: on the pad it is above, after leaving below
MOVED = 0.01  # m; what moved less stayed where it was
STANDING = 2.3e-5  # m, how deep in the pad a start at rest is: as deep as an object stands with SLIDING's contact
TOPPLED = math.pi / 4  # rad; what leans more lies


# Contact of what slides and topples. Rolling friction widens the base that an object topples over by its length, so it
# must be small beside it; and a contact that is soft at first touch carries what slides, where a stiff one rattles (its
# friction is then off by up to 10 %, in C MuJoCo too).
SLIDING = Contact(rolling=0.0002, soft=0.02, width=0.00005)


class Outcome(enum.IntEnum):
    """How a trajectory ended; each scenario knows some of them."""

    RESTS = 0
    FELL_OFF = 1
    STANDS = 2
    SLIDES = 3
    TOPPLES = 4


class Hidden(NamedTuple):
    """What cannot be seen: one value per trajectory."""

    fill: Float[Array, "*n"]  # share of the interior's volume that is filled
    shell_scale: Float[Array, "*n"]  # shell's mass over its nominal mass
    friction: Float[Array, "*n"]  # sliding friction against the pad


class Start(NamedTuple):
    """State at the beginning of frame 0's interval, and the input the scenario applies."""

    pose: Float[Array, "7"]
    velocity: Float[Array, "6"]
    condition: Float[Array, "c"]


class _Common:
    """What all scenarios have."""

    symmetries: ClassVar[tuple[int, ...]]  # of the square pad, under which the scenario is itself; see `dataset.turn`
    condition_scale: ClassVar[tuple[float, ...]]  # how large (SI) each number of its condition typically is
    outcomes: ClassVar[tuple[Outcome, ...]]  # those it knows, the most telling first

    rate: float
    frames: int
    fill: tuple[float, float]
    shell_scale: tuple[float, float]
    friction: tuple[float, float]
    contact: Contact

    @property
    def steps(self) -> int:
        """Time steps in one frame's interval."""
        return round(1 / (self.rate * self.contact.timestep))

    def hidden(self, key: PRNGKeyArray) -> Hidden:
        """Draws the hidden values of one trajectory; consumes `key`."""
        keys = jax.random.split(key, 3)
        ranges = (self.fill, self.shell_scale, self.friction)
        return Hidden(*(jax.random.uniform(k, (), minval=a, maxval=b) for k, (a, b) in zip(keys, ranges, strict=True)))

    def check(self) -> None:
        """Insists on values that can be simulated.

        Raises:
            ValueError: one cannot; it is named.
        """
        steps = 1 / (self.rate * self.contact.timestep)
        if not (steps >= 1 and abs(steps - round(steps)) < 1e-6):
            raise ValueError(
                f"rate {self.rate}/s times timestep {self.contact.timestep} s must divide 1: "
                f"{steps:.3f} steps per frame; choose another rate"
            )
        _check_range("fill", self.fill, positive=False)
        _check_range("shell_scale", self.shell_scale)
        _check_range("friction", self.friction)
        if self.fill[1] > 1:
            raise ValueError(f"scenario.fill is {self.fill}; a share is at most 1")
        if self.frames < 1:
            raise ValueError(f"scenario.frames is {self.frames}; at least one is needed")


@dataclasses.dataclass(frozen=True)
class Freefall(_Common):
    """An object in any orientation released above the flat pad; in frame 0 it is at rest in the air.

    Paper, "Data Collection". Ranges are uniform.
    """

    symmetries = tuple(range(8))
    condition_scale = ()
    outcomes = (Outcome.RESTS, Outcome.FELL_OFF)

    height: float = 0.05  # m, lowest point of the object above the pad in frame 0
    spread: float = 0.05  # m, radius of the disc from which the object's origin is drawn
    rate: float = 31.25  # frames/s: 32 steps of 1 ms; 60 frames are 1.9 s, after which few objects still move
    frames: int = 60
    fill: tuple[float, float] = (0.0, 1.0)  # share of the interior's volume
    shell_scale: tuple[float, float] = (0.9, 1.1)  # shell's mass over nominal
    friction: tuple[float, float] = (0.4, 0.8)
    contact: Contact = dataclasses.field(default_factory=Contact)

    @property
    def rise(self) -> float:
        """How far (m) an object rises in the interval before frame 0, by semi-implicit Euler's sum t (t - dt) / 2."""
        time = 1 / self.rate
        return G * time * (time - self.contact.timestep) / 2

    def check(self) -> None:
        """See `_Common.check`."""
        super().check()
        _check_length("height", self.height)
        _check_length("spread", self.spread)
        if self.height <= self.rise:
            raise ValueError(
                f"scenario.height is {self.height} m: one interval (1 / rate) before frame 0 an object is "
                f"{self.rise:.4f} m lower, in the pad; raise height or rate"
            )

    def start(self, key: PRNGKeyArray, hull: Float[Array, "n 3"]) -> Start:
        """Draws one start; consumes `key`.

        The object is thrown upwards one interval before frame 0 such that frame 0 is the top of its flight, at rest.

        Args:
            key: one trajectory's.
            hull: (n, 3) m, the hull's vertices in the mesh frame.
        """
        turn, radius, angle = jax.random.split(key, 3)
        quat = _math.random_quat(turn)
        lowest = jnp.min(hull @ _math.quat_matrix(quat)[2])
        position = jnp.append(_in_disc(radius, angle, self.spread), self.height - self.rise - lowest)
        velocity = jnp.zeros(6).at[2].set(G / self.rate)
        return Start(jnp.concatenate([position, quat]), velocity, jnp.zeros(0))

    def gravity(self, time: Float[Array, ""], condition: Float[Array, "0"]) -> Float[Array, "3"]:
        """Gravity in the sensor frame (m/s^2) in the step that begins at a time (s, 0 is frame 0)."""
        del time, condition
        return jnp.array([0.0, 0.0, -G])

    def outcome(self, first: Float[Array, "7"], last: Float[Array, "7"]) -> Int[Array, ""]:
        """`RESTS` or `FELL_OFF`, from the poses of the first and the last frame, true or predicted."""
        del first
        return jnp.where(fell_off(last), Outcome.FELL_OFF, Outcome.RESTS).astype(jnp.int32)


@dataclasses.dataclass(frozen=True)
class Perturbed(_Common):
    """An object that stands upright on the pad, until the pad is jerked sideways for a moment and then coasts.

    Everything is told in the pad's frame: while the pad accelerates, gravity has the opposite of its acceleration.
    The condition is the jerk: acceleration of the pad along x and y (m/s^2) and how long it lasts (s), from frame 0 on.
    Paper, "Data Collection"; ranges are uniform. A fill decides most where the base is narrow: the defaults are for
    bottles.
    """

    symmetries = tuple(range(8))
    condition_scale = (10.0, 10.0, 0.1)  # m/s^2, m/s^2, s
    outcomes = (Outcome.TOPPLES, Outcome.SLIDES, Outcome.STANDS, Outcome.FELL_OFF)

    acceleration: tuple[float, float] = (3.0, 12.0)  # m/s^2, in any direction
    duration: tuple[float, float] = (0.06, 0.12)  # s
    spread: float = 0.02  # m, radius of the disc from which the object's origin is drawn
    rate: float = 31.25  # frames/s
    frames: int = 60
    fill: tuple[float, float] = (0.0, 1.0)  # share of the interior's volume
    shell_scale: tuple[float, float] = (0.9, 1.1)  # shell's mass over nominal
    friction: tuple[float, float] = (0.45, 0.65)
    contact: Contact = SLIDING

    def check(self) -> None:
        """See `_Common.check`."""
        super().check()
        _check_length("spread", self.spread)
        _check_range("acceleration", self.acceleration, positive=False)
        _check_range("duration", self.duration, positive=False)

    def start(self, key: PRNGKeyArray, hull: Float[Array, "n 3"]) -> Start:
        """Draws one start and one jerk; consumes `key`. The object's +z is up; arguments as for `Freefall.start`."""
        turn, radius, angle, push, heading, time = jax.random.split(key, 6)
        yaw = jax.random.uniform(turn, maxval=2 * jnp.pi)
        quat = _math.quat_canonical(_math.quat_from_rotvec(jnp.stack([0.0, 0.0, yaw])))
        position = jnp.append(_in_disc(radius, angle, self.spread), -jnp.min(hull[:, 2]) - STANDING)
        size = jax.random.uniform(push, minval=self.acceleration[0], maxval=self.acceleration[1])
        along = jax.random.uniform(heading, maxval=2 * jnp.pi)
        lasts = jax.random.uniform(time, minval=self.duration[0], maxval=self.duration[1])
        condition = jnp.stack([size * jnp.cos(along), size * jnp.sin(along), lasts])
        return Start(jnp.concatenate([position, quat]), jnp.zeros(6), condition)

    def gravity(self, time: Float[Array, ""], condition: Float[Array, "3"]) -> Float[Array, "3"]:
        """As `Freefall.gravity`; a step in which the jerk ends has the share of it that falls into the step."""
        step = self.contact.timestep
        share = jnp.clip((condition[2] - time) / step, 0, 1) * (time > -step / 2)
        return jnp.append(-condition[:2] * share, -G)

    def outcome(self, first: Float[Array, "7"], last: Float[Array, "7"]) -> Int[Array, ""]:
        """`FELL_OFF`, `TOPPLES` (leans by more than 45 degrees), `SLIDES` (moved by 10 mm) or `STANDS`."""
        leans = _math.quat_matrix(_math.normalize(last[3:]))[2, 2] < math.cos(TOPPLED)
        moved = _math.norm(last[:2] - first[:2]) >= MOVED
        stays = jnp.where(moved, Outcome.SLIDES, Outcome.STANDS)
        ends = jnp.where(fell_off(last), Outcome.FELL_OFF, jnp.where(leans, Outcome.TOPPLES, stays))
        return ends.astype(jnp.int32)


Scenario = Freefall | Perturbed


def fell_off(pose: Float[Array, "*n 7"]) -> Bool[Array, "*n"]:
    """Whether a pose, true or predicted, is one of an object that has left the pad."""
    return pose[..., 2] < FELL_OFF_HEIGHT


def _in_disc(radius: PRNGKeyArray, angle: PRNGKeyArray, size: float) -> Float[Array, "2"]:
    r = size * jnp.sqrt(jax.random.uniform(radius))
    a = jax.random.uniform(angle, maxval=2 * jnp.pi)
    return jnp.stack([r * jnp.cos(a), r * jnp.sin(a)])


def _check_range(name: str, values: tuple[float, float], *, positive: bool = True) -> None:
    low, high = values
    if not (math.isfinite(low) and math.isfinite(high) and low <= high and (low > 0 if positive else low >= 0)):
        raise ValueError(
            f"scenario.{name} is {values}; it must be (low, high), finite and {'above' if positive else 'at least'} 0"
        )


def _check_length(name: str, value: float) -> None:
    if not (math.isfinite(value) and value >= 0):
        raise ValueError(f"scenario.{name} is {value} m; it must be finite and not negative")
