"""The contract of a scenario: how objects start, under which gravity they move, and how their ends are named."""

import abc
import dataclasses
import enum
import math
from typing import Any, ClassVar, Literal, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from sts_jax import geometry
from sts_jax.physics.limits import check_kind, check_range
from sts_jax.physics.scene import Contact

G = 9.81  # m/s^2
FELL_OFF_HEIGHT = -0.005  # m, height below which an object's origin, inside its hull, has left the pad
MOVED = 0.01  # m, an object that moved less has stayed in place
TURNED = math.pi / 4  # rad, an object that leans more topples, and one that turned more rolls
LEVEL = 0.001  # m, points up to this far above the lowest one support an object, since it may rock by a facet
STANDING = 1.04e-5  # m, depth in the pad of a standing object and of a start at rest


class Outcome(enum.IntEnum):
    """How a trajectory ended. Each scenario has some of these. They print as words: "fell off"."""

    RESTS = 0
    FELL_OFF = 1
    STANDS = 2
    SLIDES = 3
    TOPPLES = 4
    STICKS = 5
    ROLLS = 6
    RETURNS = 7

    def __str__(self) -> str:
        return in_words(self)


def in_words(outcome: enum.IntEnum) -> str:
    """The name of an outcome in words: "fell off"."""
    return outcome.name.lower().replace("_", " ")


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

    def above(
        self, place: Float[Array, "2"], quat: Float[Array, "4"], height: Float[Array, ""] | float
    ) -> Float[Array, "7"]:
        """The pose with a given orientation, its origin above a given place, and its lowest point at a given height.

        Args:
            place: m, x and y of the origin of the mesh frame.
            quat: unit quaternion.
            height: m, z of the lowest point. The gel's face is at 0.

        Returns:
            Mesh frame in the sensor frame.
        """
        lowest = jnp.min(self.points @ geometry.quat_to_matrix(quat)[2])
        return jnp.concatenate([place, jnp.stack([height - lowest]), quat])


class Start(NamedTuple):
    """The pose of a held object, the time of its release, and the input that the scenario applies."""

    pose: Float[Array, "7"]  # m and quaternion, mesh frame in the sensor frame
    held: Int[Array, ""]  # steps until its release in the interval that ends with frame 0
    condition: Float[Array, "c"]  # SI units
    # Share of its weight that the pad carries in frame 0 if the object is held until then. The hand carries the rest.
    carried: Float[Array, ""] | float = 0.0


class Quantity(NamedTuple):
    """A quantity of a scenario's condition: a number, or a vector (x, y) in the plane of the pad."""

    name: str
    unit: str  # as it is printed
    scale: float  # typical size, in SI units. Networks receive the quantity divided by it
    vector: bool = False  # two numbers, which turn with the pad under its symmetries


class Scenario(abc.ABC):
    """How objects start, under which gravity they move, and how their ends are named.

    A scenario is a frozen dataclass that derives from this class. It defines `outcomes`, `start`, `gravity` and
    `outcome`. All other members have the defaults below, which a class attribute or a field of the dataclass replaces.
    The methods are pure functions of JAX for one trajectory.
    """

    __dataclass_fields__: ClassVar[dict[str, Any]]  # for type checkers: it is a dataclass

    # The outcomes, the most informative first: members of `Outcome` or of another IntEnum with other numbers.
    # `Outcome.FELL_OFF` must be one of them.
    outcomes: ClassVar[tuple[enum.IntEnum, ...]]
    # The quantities of the condition, vectors first. A predictor gets the condition and the first frame only.
    quantities: ClassVar[tuple[Quantity, ...]] = ()
    symmetries: ClassVar[tuple[int, ...]] = (0,)  # symmetries of the square pad that leave it unchanged, `dataset.turn`
    must_stand: ClassVar[bool] = False  # whether it refuses objects that do not stand with +z up
    by_contents: ClassVar[bool] = False  # whether `start` needs centres of mass for several contents in `Shape.coms`

    rate: float = 31.25  # frames/s
    frames: int = 60
    fill: tuple[float, float] = (0.0, 1.0)  # share of the interior's volume
    shell_scale: tuple[float, float] = (0.9, 1.1)  # shell's mass over nominal
    friction: tuple[float, float] = (0.4, 0.8)
    tilt: float = 0.0  # rad, largest lean of the contents' up from the object's +z, in any direction
    wall: float = 0.0  # m, height of the stop wall at the edge of large y, 0 for none
    contact: Contact = Contact()

    @abc.abstractmethod
    def start(self, key: PRNGKeyArray, shape: Shape, pad: tuple[float, float]) -> Start:
        """Draw one start. Consumes `key`.

        Args:
            key: key of one trajectory.
            shape: shape of the body.
            pad: m, size of the pad along x and y.
        """

    @abc.abstractmethod
    def gravity(self, time: Float[Array, ""], condition: Float[Array, "c"]) -> Float[Array, "3"]:
        """Gravity in the sensor frame, less the acceleration of the pad (m/s^2), for one time step.

        Args:
            time: s, at which the step begins, 0 at frame 0.
            condition: of the start.
        """

    @abc.abstractmethod
    def outcome(self, first: Float[Array, "7"], last: Float[Array, "7"]) -> Int[Array, ""]:
        """The number of the outcome, from the true or predicted poses of the first and the last frame."""

    def velocity(self, condition: Float[Array, "c"]) -> Float[Array, "6"]:
        """Velocity of the object on its release: m/s of the mesh frame's origin, rad/s; sensor frame."""
        del condition
        return jnp.zeros(6)

    def drift(self, condition: Float[Array, "c"]) -> Float[Array, "2"]:
        """Velocity over the pad (m/s, x and y) that a freely sliding object receives. Figures show it as an arrow."""
        return self.velocity(condition)[:2]

    @property
    def steps(self) -> int:
        """Time steps in one frame's interval."""
        return round(1 / (self.rate * self.contact.timestep))

    @property
    def condition_scale(self) -> tuple[float, ...]:
        """Typical size (SI units) of each number of its condition."""
        return tuple(q.scale for q in self.quantities for _ in range(2 if q.vector else 1))

    @property
    def vectors(self) -> int:
        """Number of vectors (x, y) at the front of the condition. The numbers after them are scalars."""
        return sum(quantity.vector for quantity in self.quantities)

    @property
    def stays(self) -> tuple[enum.IntEnum, ...]:
        """The outcomes of objects that stay on the pad."""
        return tuple(outcome for outcome in self.outcomes if outcome != Outcome.FELL_OFF)

    def named(self, number: int) -> str:
        """The outcome with a number in words: "fell off".

        Raises:
            ValueError: the scenario has no such outcome.
        """
        names = {int(outcome): in_words(outcome) for outcome in self.outcomes}
        if number not in names:
            raise ValueError(f"number is {number}, but the outcomes of {type(self).__name__} are {names}")
        return names[number]

    def described(self, condition: Float[Array | np.ndarray, "c"]) -> str:
        """A condition in words: "acceleration (3.1, -7.2) m/s², duration 0.085 s"."""
        words, rest = [], np.asarray(condition).tolist()
        for quantity in self.quantities:
            own, rest = (rest[:2], rest[2:]) if quantity.vector else (rest[:1], rest[1:])
            values = ", ".join(f"{value:.3g}" for value in own)
            words.append(f"{quantity.name} {f'({values})' if quantity.vector else values} {quantity.unit}")
        return ", ".join(words)

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
        _check_kinds(self)
        _check_times(self)
        _check_meanings(self)
        check_range("fill", self.fill, positive=False)
        check_range("shell_scale", self.shell_scale)
        check_range("friction", self.friction)
        if self.fill[1] > 1:
            raise ValueError(f"scenario.fill is {self.fill}, but a share must be <= 1")
        if not 0 <= self.tilt <= math.pi:
            raise ValueError(f"scenario.tilt is {self.tilt} rad, but it must be from 0 to pi")


def _check_kinds(scenario: Scenario) -> None:
    defaults = {name: getattr(Scenario, name) for name in ("rate", "frames", *_RANGES, "tilt", "wall", "contact")}
    for field in dataclasses.fields(scenario):
        if field.default_factory is not dataclasses.MISSING:
            defaults[field.name] = field.default_factory()
        elif field.default is not dataclasses.MISSING:
            defaults[field.name] = field.default
    for name, default in defaults.items():
        check_kind(name, getattr(scenario, name), default)
    for name, default in vars(Contact()).items():
        check_kind(f"contact.{name}", getattr(scenario.contact, name), default)


def _check_times(scenario: Scenario) -> None:
    rate, timestep = scenario.rate, scenario.contact.timestep
    if not rate > 0 or not timestep > 0:
        raise ValueError(
            f"scenario.rate is {rate}/s and scenario.contact.timestep is {timestep} s, but both must be > 0"
        )
    steps = 1 / (rate * timestep)
    if not (steps >= 1 and abs(steps - round(steps)) < 1e-6):
        raise ValueError(
            f"scenario.rate is {rate}/s, which gives {steps:.3f} steps of {timestep} s per "
            "frame, but their number must be whole: choose another rate"
        )
    if scenario.frames < 1:
        raise ValueError(f"scenario.frames is {scenario.frames}, but it must be >= 1")


def _check_meanings(scenario: Scenario) -> None:
    """Raise an error unless outcomes have numbers of their own, and vectors come first in the condition."""
    numbers = [int(outcome) for outcome in scenario.outcomes]
    if int(Outcome.FELL_OFF) not in numbers:
        raise ValueError(
            f"scenario.outcomes is {scenario.outcomes}, but any object can leave the pad: add physics.Outcome.FELL_OFF"
        )
    taken = [o for o in scenario.outcomes if not isinstance(o, Outcome) and int(o) in {int(known) for known in Outcome}]
    if taken or len(set(numbers)) < len(numbers):
        raise ValueError(
            f"scenario.outcomes has the numbers {numbers}, but each outcome needs one of its own, and 0 to "
            f"{max(Outcome)} are those of physics.Outcome: number others from 100"
        )
    kinds = [quantity.vector for quantity in scenario.quantities]
    if sorted(kinds, reverse=True) != kinds:
        names = ", ".join(quantity.name for quantity in scenario.quantities)
        raise ValueError(f"scenario.quantities has {names} in this order, but vectors must come before numbers")


Variant = Literal["default", "off", "wide-friction", "off-centre"]
_RANGES = ("fill", "shell_scale", "friction")  # of hidden values
_AnyScenario = TypeVar("_AnyScenario", bound=Scenario)


def variant(scenario: _AnyScenario, name: str) -> _AnyScenario:
    """Change the ranges of a scenario's hidden values.

    Args:
        scenario: its other fields stay the same.
        name: one of `Variant`. `off` hides nothing: every value is the middle of its range, and contents have settled
            at the base. `wide-friction` draws friction from U(.3, .9) in any scenario. `off-centre` freezes contents in
            any direction, as on the slope by default.

    Returns:
        A scenario of the same class.

    Raises:
        ValueError: the name is unknown, or the scenario lacks a field that the variant changes.
    """
    middle = {field: (sum(getattr(scenario, field)) / 2,) * 2 for field in _RANGES}
    changes: dict[str, dict[str, Any]] = {
        "default": {},
        "off": {**middle, "tilt": 0.0},
        "wide-friction": {"friction": (0.3, 0.9)},
        "off-centre": {"tilt": math.pi},
    }
    if name not in changes:
        raise ValueError(f"unknown variant {name!r} of the hidden values: name must be one of {', '.join(changes)}")
    lacking = sorted(set(changes[name]) - {field.name for field in dataclasses.fields(scenario)})
    if lacking:
        raise ValueError(
            f"name is {name!r}, but the scenario {scenario} has no field {', '.join(lacking)} to change: declare each "
            "as a field of its dataclass"
        )
    return dataclasses.replace(scenario, **changes[name])


def fell_off(pose: Float[Array, "*n 7"]) -> Bool[Array, "*n"]:
    """Whether an object has left the pad, from its true or predicted pose."""
    return pose[..., 2] < FELL_OFF_HEIGHT


def upright(up: Float[Array, "3"]) -> Float[Array, "4"]:
    """The shortest turn that takes a unit vector to +z."""
    upside_down = up[2] < -0.9999
    turn = jnp.stack([1 + up[2], up[1], -up[0], 0.0])
    return geometry.normalize(jnp.where(upside_down, jnp.array([0.0, 1.0, 0.0, 0.0]), turn))


def random_yaw(key: PRNGKeyArray) -> Float[Array, "4"]:
    """Draw a turn about the vertical."""
    angle = jax.random.uniform(key, maxval=2 * jnp.pi)
    return geometry.quat_canonical(geometry.quat_from_rotvec(jnp.stack([0.0, 0.0, angle])))


def random_place(radius: PRNGKeyArray, angle: PRNGKeyArray, size: float) -> Float[Array, "2"]:
    """Draw a place (m) from a disc of some radius (m) about the pad's centre."""
    r = size * jnp.sqrt(jax.random.uniform(radius))
    a = jax.random.uniform(angle, maxval=2 * jnp.pi)
    return jnp.stack([r * jnp.cos(a), r * jnp.sin(a)])
