"""Scenarios: how an object starts, under which gravity it moves, and how its outcome is named."""

import dataclasses
import enum
import math
import numbers
from typing import ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from sts_jax import geometry
from sts_jax.physics.roll import SLOW_TIME
from sts_jax.physics.scene import Contact

G = 9.81  # m/s^2
FELL_OFF_HEIGHT = -0.005  # m, height below which an object's origin, inside its hull, has left the pad
MOVED = 0.01  # m, an object that moved less has stayed in place
STANDING = 1.04e-5  # m, depth in the pad of a standing object and of a start at rest
LEVEL = 0.001  # m, points up to this far above the lowest one support an object, since it may rock by a facet
DIRECTIONS = 120  # directions in which an object's support is measured
LET_GO = 0.008  # s from release to frame 0, when a tipping object leans by 0.1 degree and touch has felt it
CLEARANCE = 0.001  # m, smallest distance of a start on the slope from the stop wall
TURNED = math.pi / 4  # rad, an object that leans more topples, and one that turned more rolls


class Outcome(enum.IntEnum):
    """How a trajectory ended. Each scenario has some of these. They print as words: "fell off"."""

    RESTS = 0
    FELL_OFF = 1
    STANDS = 2
    SLIDES = 3
    TOPPLES = 4
    STICKS = 5
    ROLLS = 6

    def __str__(self) -> str:
        return self.name.lower().replace("_", " ")


class Hidden(NamedTuple):
    """Properties that a camera cannot see, one value per trajectory."""

    fill: Float[Array, "*n"]  # share of the interior's volume that is filled
    shell_scale: Float[Array, "*n"]  # shell's mass over its nominal mass
    friction: Float[Array, "*n"]  # coefficient of sliding friction against the pad
    up: Float[Array, "*n 3"]  # unit vector in the mesh frame, upward when the contents settled


class Shape(NamedTuple):
    """The properties of a body that determine where it may start."""

    points: Float[Array | np.ndarray, "*n h 3"]  # m, vertices of its convex hull, mesh frame, padded by repetition
    rests: Float[Array | np.ndarray, "*n k 3"]  # unit vectors in the mesh frame that point up at rest, padded
    shares: Float[Array | np.ndarray, "*n k"]  # share of each rest, see `objects.rest_poses`, 0 for padding
    coms: Float[Array | np.ndarray, "*n m 3"]  # m, mesh frame, centres of mass with some contents or empty


class Start(NamedTuple):
    """The pose of a held object, the time of its release, and the input that the scenario applies."""

    pose: Float[Array, "7"]  # m and quaternion, mesh frame in the sensor frame
    held: Int[Array, ""]  # steps until its release in the interval that ends with frame 0
    condition: Float[Array, "c"]  # SI units


Variant = Literal["default", "off", "wide-friction", "off-centre"]


class _Common:
    """Fields and methods of all scenarios."""

    symmetries: ClassVar[tuple[int, ...]]  # symmetries of the square pad that leave it unchanged, see `dataset.turn`
    condition_scale: ClassVar[tuple[float, ...]]  # typical size (SI) of each number of its condition
    outcomes: ClassVar[tuple[Outcome, ...]]  # its outcomes, the most informative first

    rate: float
    frames: int
    fill: tuple[float, float]
    shell_scale: tuple[float, float]
    friction: tuple[float, float]
    tilt: float
    contact: Contact
    wall: float = 0.0
    must_stand: ClassVar[bool] = False
    by_contents: ClassVar[bool] = False  # whether starts are chosen by the possible contents of an object

    @property
    def steps(self) -> int:
        """Time steps in one frame's interval."""
        return round(1 / (self.rate * self.contact.timestep))

    def hidden(self, key: PRNGKeyArray) -> Hidden:
        """Draw the hidden values of one trajectory. Consumes `key`."""
        fill, shell, friction, high, around = jax.random.split(key, 5)

        def draw(key: PRNGKeyArray, limits: tuple[float, float]) -> Float[Array, ""]:
            return jax.random.uniform(key, minval=limits[0], maxval=limits[1])

        z = draw(high, (math.cos(self.tilt), 1.0))
        angle = draw(around, (0.0, 2 * math.pi))
        radius = jnp.sqrt(jnp.maximum(1 - z**2, 0))
        return Hidden(
            fill=draw(fill, self.fill),
            shell_scale=draw(shell, self.shell_scale),
            friction=draw(friction, self.friction),
            up=jnp.stack([radius * jnp.cos(angle), radius * jnp.sin(angle), z]),
        )

    def check(self) -> None:
        """Raise an error unless the scenario can be simulated.

        Raises:
            ValueError: a field, which the message names, is of another kind or out of range.
        """
        for name, default in vars(type(self)()).items():
            _check_kind(name, getattr(self, name), default)
        for name, default in vars(Contact()).items():
            _check_kind(f"contact.{name}", getattr(self.contact, name), default)
        if not self.rate > 0 or not self.contact.timestep > 0:
            raise ValueError(
                f"scenario.rate is {self.rate}/s and scenario.contact.timestep is {self.contact.timestep} s, but both "
                "must be > 0"
            )
        steps = 1 / (self.rate * self.contact.timestep)
        if not (steps >= 1 and abs(steps - round(steps)) < 1e-6):
            raise ValueError(
                f"scenario.rate is {self.rate}/s, which gives {steps:.3f} steps of {self.contact.timestep} s per "
                "frame, but their number must be whole: choose another rate"
            )
        _check_range("fill", self.fill, positive=False)
        _check_range("shell_scale", self.shell_scale)
        _check_range("friction", self.friction)
        if self.fill[1] > 1:
            raise ValueError(f"scenario.fill is {self.fill}, but a share must be <= 1")
        if not 0 <= self.tilt <= math.pi:
            raise ValueError(f"scenario.tilt is {self.tilt} rad, but it must be from 0 to pi")
        if self.frames < 1:
            raise ValueError(f"scenario.frames is {self.frames}, but it must be >= 1")


@dataclasses.dataclass(frozen=True)
class Freefall(_Common):
    """An object is released in any orientation above the flat pad. In frame 0 it is at rest in the air.

    The frames must last at least as long as the fall to the pad plus 0.2 s, the time at rest after which an object
    counts as settled: `(frames - 1) / rate >= sqrt(2 height / g) + 0.2 s`. Shorter trajectories are refused. They have
    no outcome, since no object can have come to rest by their end. After 1.9 s, the default, few objects still move
    (`Trajectory.settled`).

    Ranges are uniform. Source: paper, "Data Collection".
    """

    symmetries = tuple(range(8))
    condition_scale = ()
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
        """See `_Common.check`."""
        super().check()
        _check_length("height", self.height)
        _check_length("spread", self.spread)
        lasts, needed = (self.frames - 1) / self.rate, math.sqrt(2 * self.height / G) + SLOW_TIME
        if lasts < needed:
            raise ValueError(
                f"scenario.frames is {self.frames}, which last {lasts:.3g} s, but an object released {self.height:g} m "
                f"above the pad needs at least {needed:.3g} s to fall and come to rest: give at least "
                f"{math.ceil(needed * self.rate) + 1} frames or a smaller height"
            )

    def start(self, key: PRNGKeyArray, shape: Shape, pad: tuple[float, float]) -> Start:
        """Draw one start. Consumes `key`.

        Args:
            key: key of one trajectory.
            shape: shape of the body.
            pad: m, size of the pad along x and y.
        """
        del pad
        turn, radius, angle = jax.random.split(key, 3)
        quat = geometry.random_quat(turn)
        pose = _above(_in_disc(radius, angle, self.spread), quat, shape, self.height)
        return Start(pose, jnp.asarray(self.steps), jnp.zeros(0))

    def gravity(self, time: Float[Array, ""], condition: Float[Array, "0"]) -> Float[Array, "3"]:
        """Gravity in the sensor frame (m/s^2) for the step that begins at `time` (s, 0 at frame 0)."""
        del time, condition
        return jnp.array([0.0, 0.0, -G])

    def outcome(self, first: Float[Array, "7"], last: Float[Array, "7"]) -> Int[Array, ""]:
        """`RESTS` or `FELL_OFF`, from the true or predicted poses of the first and the last frame."""
        del first
        return jnp.where(fell_off(last), Outcome.FELL_OFF, Outcome.RESTS).astype(jnp.int32)


@dataclasses.dataclass(frozen=True)
class Perturbed(_Common):
    """An object stands upright on the pad, which is jerked sideways for a moment and then coasts.

    The simulation runs in the pad's frame. While the pad accelerates, gravity contains the opposite of its
    acceleration. The condition is the jerk: acceleration of the pad along x and y (m/s^2) and duration (s), from frame
    0 on. The fill matters most for a narrow base, so the defaults are for bottles.

    Ranges are uniform. Source: paper, "Data Collection".
    """

    symmetries = tuple(range(8))
    condition_scale = (10.0, 10.0, 0.1)  # m/s^2, m/s^2, s
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
        """See `_Common.check`."""
        super().check()
        _check_length("spread", self.spread)
        _check_range("acceleration", self.acceleration, positive=False)
        _check_range("duration", self.duration, positive=False)

    def start(self, key: PRNGKeyArray, shape: Shape, pad: tuple[float, float]) -> Start:
        """Draw one start with +z up and one jerk. Consumes `key`. Arguments as for `Freefall.start`."""
        del pad
        turn, radius, angle, push, heading, time = jax.random.split(key, 6)
        pose = _above(_in_disc(radius, angle, self.spread), _yaw(turn), shape, -STANDING)
        size = jax.random.uniform(push, minval=self.acceleration[0], maxval=self.acceleration[1])
        along = jax.random.uniform(heading, maxval=2 * jnp.pi)
        lasts = jax.random.uniform(time, minval=self.duration[0], maxval=self.duration[1])
        condition = jnp.stack([size * jnp.cos(along), size * jnp.sin(along), lasts])
        return Start(pose, jnp.asarray(0), condition)

    def gravity(self, time: Float[Array, ""], condition: Float[Array, "3"]) -> Float[Array, "3"]:
        """As `Freefall.gravity`. The step in which the jerk ends has the share of the jerk that lies in it."""
        step = self.contact.timestep
        share = jnp.clip((condition[2] - time) / step, 0, 1) * (time > -step / 2)
        return jnp.append(-condition[:2] * share, -G)

    def outcome(self, first: Float[Array, "7"], last: Float[Array, "7"]) -> Int[Array, ""]:
        """`FELL_OFF`, `TOPPLES` (leans by more than 45 degrees), `SLIDES` (moved by 10 mm or more) or `STANDS`."""
        leans = geometry.quat_to_matrix(geometry.normalize(last[3:]))[2, 2] < math.cos(TURNED)
        moved = geometry.norm(last[:2] - first[:2]) >= MOVED
        stays = jnp.where(moved, Outcome.SLIDES, Outcome.STANDS)
        ends = jnp.where(fell_off(last), Outcome.FELL_OFF, jnp.where(leans, Outcome.TOPPLES, stays))
        return ends.astype(jnp.int32)


@dataclasses.dataclass(frozen=True)
class Inclined(_Common):
    """An object is laid on the tilted pad or released just above it. Downhill is +y, with a stop wall at the edge.

    On the slope, weight reveals little, but the centre of pressure reveals where the contents lie. They are therefore
    frozen in any direction. Whatever its contents, an object that lies flat holds and one that stands high tips, so
    objects are laid in poses in which the contents decide.

    Ranges are uniform. Source: paper, "Data Collection".
    """

    symmetries = (0, 6)  # x -> -x
    condition_scale = ()
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
        """See `_Common.check`."""
        super().check()
        if not 0 <= self.slope < math.pi / 2:
            raise ValueError(
                f"scenario.slope is {self.slope} rad, but it must be >= 0 and < pi / 2 "
                "(give degrees as math.radians(30))"
            )
        _check_length("wall", self.wall)
        _check_length("across", self.across)
        _check_range("gap", self.gap, positive=False)
        if not (math.isfinite(sum(self.along)) and self.along[0] <= self.along[1]):
            raise ValueError(f"scenario.along is {self.along}, but it must be (low, high), finite and low <= high")
        if self.tries < 1:
            raise ValueError(f"scenario.tries is {self.tries}, but it must be >= 1")
        if not 0 <= self.resting <= 1:
            raise ValueError(f"scenario.resting is {self.resting}, but a share must be from 0 to 1")

    def start(self, key: PRNGKeyArray, shape: Shape, pad: tuple[float, float]) -> Start:
        """Draw one start outside the wall. Consumes `key`. Arguments as for `Freefall.start`.

        A start at rest has the best of `tries` faces and turns: the one in which some contents hold by the widest
        margin and others tip by it.
        """
        kind, face, turn, free, gap, x, y = jax.random.split(key, 7)
        rests = jax.random.uniform(kind) < self.resting
        faces = shape.rests[jax.random.categorical(face, jnp.log(shape.shares), shape=(self.tries,))]
        turns = jax.vmap(_yaw)(jax.random.split(turn, self.tries))
        laid = jax.vmap(geometry.quat_multiply)(turns, jax.vmap(_upright)(faces))
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
        return Start(_above(place, geometry.quat_canonical(quat), shape, height), held, jnp.zeros(0))

    def gravity(self, time: Float[Array, ""], condition: Float[Array, "0"]) -> Float[Array, "3"]:
        """As `Freefall.gravity`."""
        del time, condition
        return G * jnp.array([0.0, math.sin(self.slope), -math.cos(self.slope)])

    def outcome(self, first: Float[Array, "7"], last: Float[Array, "7"]) -> Int[Array, ""]:
        """`FELL_OFF`, `ROLLS` (turned by 45 degrees or more, about any axis), `SLIDES` (moved by 10 mm) or `STICKS`."""
        same = jnp.abs(geometry.normalize(first[3:]) @ geometry.normalize(last[3:]))
        moved = geometry.norm(last[:2] - first[:2]) >= MOVED
        stays = jnp.where(moved, Outcome.SLIDES, Outcome.STICKS)
        ends = jnp.where(fell_off(last), Outcome.FELL_OFF, jnp.where(same < math.cos(TURNED / 2), Outcome.ROLLS, stays))
        return ends.astype(jnp.int32)


Scenario = Freefall | Inclined | Perturbed


def variant(scenario: Scenario, name: str) -> Scenario:
    """Change the ranges of a scenario's hidden values.

    Args:
        scenario: its other fields stay the same.
        name: one of `Variant`. `off` hides nothing: every value is the middle of its range, and contents have settled
            at the base. `wide-friction` draws friction from U(.3, .9) in any scenario. `off-centre` freezes contents in
            any direction, as on the slope by default.

    Raises:
        ValueError: the name is unknown.
    """
    middle = {field: (sum(getattr(scenario, field)) / 2,) * 2 for field in ("fill", "shell_scale", "friction")}
    changes: dict[str, dict] = {
        "default": {},
        "off": {**middle, "tilt": 0.0},
        "wide-friction": {"friction": (0.3, 0.9)},
        "off-centre": {"tilt": math.pi},
    }
    if name not in changes:
        raise ValueError(f"unknown variant {name!r} of the hidden values: name must be one of {', '.join(changes)}")
    return dataclasses.replace(scenario, **changes[name])


def fell_off(pose: Float[Array, "*n 7"]) -> Bool[Array, "*n"]:
    """Whether an object has left the pad, from its true or predicted pose."""
    return pose[..., 2] < FELL_OFF_HEIGHT


def _above(
    place: Float[Array, "2"], quat: Float[Array, "4"], shape: Shape, height: Float[Array, ""] | float
) -> Float[Array, "7"]:
    """The pose with its origin above a place (m) and its lowest point at a height (m)."""
    lowest = jnp.min(shape.points @ geometry.quat_to_matrix(quat)[2])
    return jnp.concatenate([place, jnp.stack([height - lowest]), quat])


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


def _yaw(key: PRNGKeyArray) -> Float[Array, "4"]:
    angle = jax.random.uniform(key, maxval=2 * jnp.pi)
    return geometry.quat_canonical(geometry.quat_from_rotvec(jnp.stack([0.0, 0.0, angle])))


def _upright(up: Float[Array, "3"]) -> Float[Array, "4"]:
    """The shortest turn that takes a unit vector to +z."""
    upside_down = up[2] < -0.9999
    turn = jnp.stack([1 + up[2], up[1], -up[0], 0.0])
    return geometry.normalize(jnp.where(upside_down, jnp.array([0.0, 1.0, 0.0, 0.0]), turn))


def _in_disc(radius: PRNGKeyArray, angle: PRNGKeyArray, size: float) -> Float[Array, "2"]:
    r = size * jnp.sqrt(jax.random.uniform(radius))
    a = jax.random.uniform(angle, maxval=2 * jnp.pi)
    return jnp.stack([r * jnp.cos(a), r * jnp.sin(a)])


def _check_kind(name: str, value: object, default: object) -> None:
    """Raise an error unless a value is of its default's kind: whole number, number, two numbers or `Contact`."""
    if isinstance(default, Contact):
        fits, wanted = isinstance(value, Contact), "a physics.Contact"
    elif isinstance(default, tuple):
        fits = isinstance(value, tuple) and len(value) == len(default) and all(map(_is_number, value))
        wanted = "a tuple of two numbers of Python or NumPy, (low, high)"
    elif isinstance(default, int):
        fits, wanted = _is_number(value) and isinstance(value, numbers.Integral), "a whole number of Python or NumPy"
    else:
        fits, wanted = _is_number(value), "a number of Python or NumPy"
    if not fits:
        raise ValueError(f"scenario.{name} is {value!r}, but it must be {wanted}")


def _is_number(value: object) -> bool:
    return isinstance(value, numbers.Real) and not isinstance(value, bool | np.bool_)


def _check_range(name: str, values: tuple[float, float], *, positive: bool = True) -> None:
    low, high = values
    if not (math.isfinite(low) and math.isfinite(high) and low <= high and (low > 0 if positive else low >= 0)):
        raise ValueError(
            f"scenario.{name} is {values}, but it must be (low, high), finite, low <= high and "
            f"{'>' if positive else '>='} 0"
        )


def _check_length(name: str, value: float) -> None:
    if not (math.isfinite(value) and value >= 0):
        raise ValueError(f"scenario.{name} is {value} m, but it must be finite and >= 0")
