"""What a scenario is: starts of objects, gravity that acts on them, outcomes, and the checks of its fields."""

import abc
import dataclasses
import enum
import math
import numbers
from typing import Any, ClassVar, Literal, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from sts_jax import geometry
from sts_jax._ranges import check as check_ranges
from sts_jax.physics.scene import Contact

G = 9.81  # m/s^2
FELL_OFF_HEIGHT = -0.005  # m, an object whose origin (a point inside its hull) is below this height has left the pad
MOVED = 0.01  # m, an object that moved less has stayed in place
TURNED = math.pi / 4  # rad, an object that leans more has toppled, and an object that turned more has rolled
LEVEL = 0.001  # m, points up to this height above the lowest one support an object, since it may rock onto them
MOST_STEPS = 10**7  # time steps in a trajectory
STANDING = 1.04e-5  # m, depth in the pad of an object that stands or lies at rest


class Outcome(enum.IntEnum):
    """The result of the motion in a trajectory. `str` returns words such as "fell off"."""

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
    """The name of an outcome in words, such as "fell off"."""
    return outcome.name.lower().replace("_", " ")


class Hidden(NamedTuple):
    """Hidden properties, with one value per trajectory."""

    fill: Float[Array, "*n"]  # Share of the interior's volume that is filled.
    shell_scale: Float[Array, "*n"]  # Mass of the shell over its nominal mass.
    friction: Float[Array, "*n"]  # Coefficient of sliding friction against the pad.
    up: Float[Array, "*n 3"]  # Unit vector in the mesh frame that pointed up when the contents settled.


class Shape(NamedTuple):
    """Geometry of a body in the mesh frame, from which a scenario draws starts."""

    points: Float[Array | np.ndarray, "*n h 3"]  # Vertices of the convex parts (m), padded by repetition.
    rests: Float[Array | np.ndarray, "*n k 3"]  # Unit vector that points up on each stable face, padded by repetition.
    shares: Float[Array | np.ndarray, "*n k"]  # Share of each stable face (`objects.rest_poses`), 0 for padding.
    coms: Float[Array | np.ndarray, "*n m 3"]  # Centres of mass with m random contents, or of the empty body alone (m).

    def above(
        self, place: Float[Array, "2"], quat: Float[Array, "4"], height: Float[Array, ""] | float
    ) -> Float[Array, "7"]:
        """Pose of the body from x and y of its origin (m), its orientation, and the height of its lowest point (m)."""
        lowest = jnp.min(self.points @ geometry.quat_to_matrix(quat)[2])
        return jnp.concatenate([place, jnp.stack([height - lowest]), quat])


class Start(NamedTuple):
    """The start of a trajectory."""

    pose: Float[Array, "7"]  # Mesh frame in the sensor frame: position (m), quaternion.
    # Number of time steps for which the object is held, from the beginning of the interval that ends with frame 0. With
    # `Scenario.steps`, the object is released at frame 0.
    held: Int[Array, ""]
    condition: Float[Array, "c"]  # Numbers of `Scenario.quantities`, in SI units.
    # Share of the weight that the pad carries in frame 0 if the object is held until then. The hand carries the rest.
    carried: Float[Array, ""] | float = 0.0


class Quantity(NamedTuple):
    """Description of a quantity of the condition: a number, or a vector (x, y) in the plane of the pad."""

    name: str  # Name in texts and figures.
    unit: str  # Unit in texts and figures.
    scale: float  # Typical size, in SI units. Networks receive the quantity divided by this size.
    vector: bool = False  # True for a vector, which is two numbers, in the plane of the pad.


class Scenario(abc.ABC):
    """Base class of scenarios.

    A scenario is a frozen dataclass that derives from this class. It defines `outcomes`, `start`, `gravity` and
    `outcome`. All other members have defaults, which a class attribute, a field or a method of the same name replaces.
    The methods from `start` to `drift`, and `hidden`, are pure JAX functions for one trajectory. Their argument
    `condition` has the numbers of `quantities` in SI units.
    """

    # This is not a `typing.Protocol`. The command line calls `issubclass` to find the options of a scenario, and a
    # protocol with fields raises an error there.
    __dataclass_fields__: ClassVar[dict[str, Any]]  # for type checkers: it is a dataclass

    # possible outcomes, the most informative first: members of `Outcome`, or of another IntEnum with numbers that
    # `Outcome` does not use (`Outcome.FELL_OFF` must be one of them)
    outcomes: ClassVar[tuple[enum.IntEnum, ...]]
    # quantities of the condition, vectors first
    quantities: ClassVar[tuple[Quantity, ...]] = ()
    must_stand: ClassVar[bool] = False  # True if the scenario refuses objects that cannot stand with +z up
    symmetric: ClassVar[bool] = False  # True if neither side of x = 0 is preferred
    by_contents: ClassVar[bool] = False  # True if `Shape.coms` must have centres of mass for random contents

    rate: float = 31.25  # frame rate (frames/s)
    frames: int = 60  # number of frames
    fill: tuple[float, float] = (0.0, 1.0)  # range of the share of the interior's volume that is filled
    shell_scale: tuple[float, float] = (0.9, 1.1)  # range of the shell's mass over its nominal mass
    friction: tuple[float, float] = (0.4, 0.8)  # range of the coefficient of friction against the pad
    # largest angle between the object's +z and the upward direction in which its contents settled (rad)
    tilt: float = 0.0
    wall: float = 0.0  # height of the stop wall at the edge of the pad towards +y (m, 0 for no wall)
    contact: Contact = Contact()  # contact and solver constants

    @abc.abstractmethod
    def start(self, key: PRNGKeyArray, shape: Shape, pad: tuple[float, float]) -> Start:
        """Draw the start of one trajectory on a pad of the given size along x and y (m)."""

    @abc.abstractmethod
    def gravity(self, time: Float[Array, ""], condition: Float[Array, "c"]) -> Float[Array, "3"]:
        """Gravity minus the acceleration of the pad (m/s^2, sensor frame) in the time step from `time` on (s)."""

    @abc.abstractmethod
    def outcome(self, first: Float[Array, "7"], last: Float[Array, "7"]) -> Int[Array, ""]:
        """Number of the outcome of one trajectory, from its first and last pose, simulated or predicted."""

    def velocity(self, condition: Float[Array, "c"]) -> Float[Array, "6"]:
        """Velocity of the object on its release: of its origin (m/s) and angular (rad/s), in the sensor frame."""
        del condition
        return jnp.zeros(6)

    def drift(self, condition: Float[Array, "c"]) -> Float[Array, "2"]:
        """Velocity along x and y that an object without friction would have relative to the pad (m/s), for figures."""
        return self.velocity(condition)[:2]

    @property
    def steps(self) -> int:
        """Number of time steps from one frame to the next."""
        return round(1 / (self.rate * self.contact.timestep))

    @property
    def condition_scale(self) -> tuple[float, ...]:
        """Typical magnitude of each number of the condition, in SI units."""
        return tuple(q.scale for q in self.quantities for _ in range(2 if q.vector else 1))

    @property
    def vectors(self) -> int:
        """Number of vectors (x, y) at the beginning of the condition."""
        return sum(quantity.vector for quantity in self.quantities)

    @property
    def stays(self) -> tuple[enum.IntEnum, ...]:
        """The outcomes of objects that stay on the pad."""
        return tuple(outcome for outcome in self.outcomes if outcome != Outcome.FELL_OFF)

    def named(self, number: int) -> str:
        """The name of an outcome in words, such as "fell off", from its number."""
        names = {int(outcome): in_words(outcome) for outcome in self.outcomes}
        if number not in names:
            raise ValueError(
                f"`number` is {number}, but it must be the number of an outcome of {type(self).__name__}: {names}"
            )
        return names[number]

    def described(self, condition: Float[Array | np.ndarray, "c"]) -> str:
        """Describe a condition in words, such as "acceleration (3.1, -7.2) m/s², duration 0.085 s"."""
        words, rest = [], np.asarray(condition).tolist()
        for quantity in self.quantities:
            part, rest = (rest[:2], rest[2:]) if quantity.vector else (rest[:1], rest[1:])
            values = ", ".join(f"{value:.3g}" for value in part)
            words.append(f"{quantity.name} {f'({values})' if quantity.vector else values} {quantity.unit}")
        return ", ".join(words)

    def hidden(self, key: PRNGKeyArray) -> Hidden:
        """Draw the hidden properties of one trajectory."""
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
        """Raise a ValueError that names a field of the wrong type or out of range."""
        _check_kinds(self)
        _check_times(self)
        _check_meanings(self)
        check_range("fill", self.fill, positive=False)
        check_range("shell_scale", self.shell_scale)
        check_range("friction", self.friction)
        if self.fill[1] > 1:
            raise ValueError(f"scenario.fill is {self.fill}, but both limits must be from 0 to 1")
        if not 0 <= self.tilt <= math.pi:
            raise ValueError(f"scenario.tilt is {self.tilt} rad, but it must be from 0 to pi: use math.radians")


def _check_kinds(scenario: Scenario) -> None:
    """Raise a ValueError unless each field has a value of the same kind as its default."""
    defaults = {name: getattr(Scenario, name) for name in ("rate", "frames", *_RANGES, "tilt", "wall", "contact")}
    for field in dataclasses.fields(scenario):
        if field.default_factory is not dataclasses.MISSING:
            defaults[field.name] = field.default_factory()
        elif field.default is not dataclasses.MISSING:
            defaults[field.name] = field.default
    for name, default in defaults.items():
        _check_kind(name, getattr(scenario, name), default)
    for name, default in vars(Contact()).items():
        _check_kind(f"contact.{name}", getattr(scenario.contact, name), default)
    check_ranges(scenario.contact, "scenario.contact.")


def _check_kind(name: str, value: object, default: object) -> None:
    pair = isinstance(default, tuple) and len(default) == 2 and all(map(_is_number, default))
    if isinstance(default, Contact):
        fits, wanted = isinstance(value, Contact), "a physics.Contact"
    elif pair:
        fits = isinstance(value, tuple) and len(value) == 2 and all(map(_is_number, value))
        wanted = "a tuple of two numbers (low, high) of a Python or NumPy type"
    elif not _is_number(default):
        return
    elif isinstance(default, int):
        fits = _is_number(value) and isinstance(value, numbers.Integral)
        wanted = "a whole number of a Python or NumPy type"
    else:
        fits, wanted = _is_number(value), "a number of a Python or NumPy type"
    if not fits:
        raise ValueError(f"scenario.{name} is {value!r}, but it must be {wanted}")


def _is_number(value: object) -> bool:
    return isinstance(value, numbers.Real) and not isinstance(value, bool | np.bool_)


def check_range(name: str, values: tuple[float, float], *, positive: bool = True) -> None:
    """Raise a ValueError unless a field is a range (low, high) of finite numbers with 0 < low (or 0 <= low) <= high."""
    low, high = values
    if not (math.isfinite(low) and math.isfinite(high) and low <= high and (low > 0 if positive else low >= 0)):
        raise ValueError(
            f"scenario.{name} is {values}, but it must be (low, high) with finite numbers and "
            f"0 {'<' if positive else '<='} low <= high"
        )


def check_length(name: str, value: float) -> None:
    """Raise a ValueError unless a field is a finite length >= 0 (m)."""
    if not (math.isfinite(value) and value >= 0):
        raise ValueError(f"scenario.{name} is {value} m, but it must be finite and >= 0")


def _check_times(scenario: Scenario) -> None:
    rate, timestep = scenario.rate, scenario.contact.timestep
    if not 1e-9 < rate < 1e9:
        raise ValueError(f"scenario.rate is {rate}/s, but it must be > 0 and finite")
    steps = 1 / (rate * timestep)
    if not (steps >= 1 and abs(steps - round(steps)) < 1e-6):
        raise ValueError(
            f"scenario.rate is {rate}/s, which gives {steps:.3f} time steps (of {timestep} s) per frame: give a rate "
            "or a contact.timestep for which the number is whole"
        )
    if not 1 <= scenario.frames <= MOST_STEPS / round(steps):
        raise ValueError(
            f"scenario.frames is {scenario.frames} with {round(steps)} time steps each, but it must be from 1 to "
            f"{MOST_STEPS // round(steps):,} ({MOST_STEPS:,} time steps)"
        )


def _check_meanings(scenario: Scenario) -> None:
    numbers = [int(outcome) for outcome in scenario.outcomes]
    if int(Outcome.FELL_OFF) not in numbers:
        raise ValueError(f"scenario.outcomes is {scenario.outcomes}: add physics.Outcome.FELL_OFF")
    taken = [o for o in scenario.outcomes if not isinstance(o, Outcome) and int(o) in {int(known) for known in Outcome}]
    if taken or len(set(numbers)) < len(numbers):
        raise ValueError(
            f"scenario.outcomes has the numbers {numbers}, but each outcome needs a unique number, and 0 "
            f"to {int(max(Outcome))} are reserved for physics.Outcome: number your own outcomes from 100 on"
        )
    kinds = [quantity.vector for quantity in scenario.quantities]
    if sorted(kinds, reverse=True) != kinds:
        names = ", ".join(quantity.name for quantity in scenario.quantities)
        raise ValueError(f"scenario.quantities has the order {names}, but vectors must come before scalars")


Variant = Literal["default", "off", "wide-friction", "off-centre"]
_RANGES = ("fill", "shell_scale", "friction")  # fields with ranges of hidden properties
_AnyScenario = TypeVar("_AnyScenario", bound=Scenario)


def variant(scenario: _AnyScenario, name: str) -> _AnyScenario:
    """Return a copy of a scenario with other ranges of its hidden properties.

    "off" fixes each hidden property at the middle of its range, with the contents at the base. "wide-friction" draws
    friction from 0.3 to 0.9. "off-centre" freezes the contents on any side of the object (`tilt` = pi).
    """
    middle = {field: (sum(getattr(scenario, field)) / 2,) * 2 for field in _RANGES}
    changes: dict[str, dict[str, Any]] = {
        "default": {},
        "off": {**middle, "tilt": 0.0},
        "wide-friction": {"friction": (0.3, 0.9)},
        "off-centre": {"tilt": math.pi},
    }
    if name not in changes:
        raise ValueError(f"the name of the variant is {name!r}, but it must be one of {', '.join(changes)}")
    lacking = sorted(set(changes[name]) - {field.name for field in dataclasses.fields(scenario)})
    if lacking:
        raise ValueError(f"the variant {name!r} needs the fields {', '.join(lacking)} in {type(scenario).__name__}")
    return dataclasses.replace(scenario, **changes[name])


def fell_off(pose: Float[Array, "*n 7"]) -> Bool[Array, "*n"]:
    """Whether the object's origin is more than 5 mm below the face of the gel."""
    return pose[..., 2] < FELL_OFF_HEIGHT


def upright(up: Float[Array, "3"]) -> Float[Array, "4"]:
    """Quaternion of the shortest rotation that turns a unit vector to +z."""
    across = up[0] ** 2 + up[1] ** 2
    upside_down = (up[2] < 0) & (across < 1e-10)  # within 1e-5 rad, where the axis is arbitrary
    # 1 + z loses all digits near z = -1
    turn = jnp.stack([jnp.where(up[2] < 0, across / (1 - up[2]), 1 + up[2]), up[1], -up[0], 0.0])
    return geometry.normalize(jnp.where(upside_down, jnp.array([0.0, 1.0, 0.0, 0.0]), turn))


def random_yaw(key: PRNGKeyArray) -> Float[Array, "4"]:
    """Draw the quaternion of a rotation about the vertical by a uniformly random angle."""
    angle = jax.random.uniform(key, maxval=2 * jnp.pi)
    return geometry.quat_canonical(geometry.quat_from_rotvec(jnp.stack([0.0, 0.0, angle])))


def random_place(radius: PRNGKeyArray, angle: PRNGKeyArray, size: float) -> Float[Array, "2"]:
    """Draw x and y (m) uniformly from a disc about the pad's centre with a radius `size` (m)."""
    r = size * jnp.sqrt(jax.random.uniform(radius))
    a = jax.random.uniform(angle, maxval=2 * jnp.pi)
    return jnp.stack([r * jnp.cos(a), r * jnp.sin(a)])
