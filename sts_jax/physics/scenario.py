"""The interface of scenarios: initial poses of objects, gravity that acts on them, and outcomes of trajectories."""

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
FELL_OFF_HEIGHT = -0.005  # m, an object whose origin (a point inside its hull) is below this height has left the pad
MOVED = 0.01  # m, an object that moved less has stayed in place
TURNED = math.pi / 4  # rad, an object that leans more has toppled, and an object that turned more has rolled
LEVEL = 0.001  # m, points up to this height above the lowest one support an object, since it may rock onto them
STANDING = 1.04e-5  # m, depth in the pad of an object that stands or lies at rest


class Outcome(enum.IntEnum):
    """The result of the motion in a trajectory, such as `TOPPLES` or `FELL_OFF`.

    Each scenario uses some of the members. `str` returns words such as "fell off".
    """

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
    """Return the name of an outcome in words, such as "fell off"."""
    return outcome.name.lower().replace("_", " ")


class Hidden(NamedTuple):
    """Invisible properties of an object, such as its friction. Each property has one value per trajectory."""

    fill: Float[Array, "*n"]  # Share of the interior's volume that is filled.
    shell_scale: Float[Array, "*n"]  # Mass of the shell over its nominal mass.
    friction: Float[Array, "*n"]  # Coefficient of sliding friction against the pad.
    up: Float[Array, "*n 3"]  # Unit vector in the mesh frame that pointed up when the contents settled.


class Shape(NamedTuple):
    """Geometry of a body. A scenario needs it to draw random initial poses. Vectors are in the mesh frame."""

    points: Float[Array | np.ndarray, "*n h 3"]  # Vertices of the convex parts (m), padded by repetition.
    rests: Float[Array | np.ndarray, "*n k 3"]  # Unit vector that points up on each stable face, padded by repetition.
    shares: Float[Array | np.ndarray, "*n k"]  # Share of each stable face (`objects.rest_poses`), 0 for padding.
    coms: Float[Array | np.ndarray, "*n m 3"]  # Centres of mass with m random contents, or of the empty body alone (m).

    def above(
        self, place: Float[Array, "2"], quat: Float[Array, "4"], height: Float[Array, ""] | float
    ) -> Float[Array, "7"]:
        """Compute the pose of the body from its place, its orientation and the height of its lowest point.

        Args:
            place: x and y of the origin of the mesh frame (m).
            quat: Orientation as a unit quaternion.
            height: z of the lowest point (m). The gel's face is at 0.

        Returns:
            Mesh frame in the sensor frame, (7,), as position (m) and quaternion.
        """
        lowest = jnp.min(self.points @ geometry.quat_to_matrix(quat)[2])
        return jnp.concatenate([place, jnp.stack([height - lowest]), quat])


class Start(NamedTuple):
    """The start of a trajectory: the initial pose, the time of release, and the condition.

    The condition contains the numbers that `Scenario.quantities` describes, such as the acceleration of the pad.
    """

    pose: Float[Array, "7"]  # Mesh frame in the sensor frame: position (m), quaternion.
    # Number of time steps for which the object is held, from the beginning of the interval that ends with frame 0. With
    # `Scenario.steps`, the object is released at frame 0.
    held: Int[Array, ""]
    condition: Float[Array, "c"]  # Numbers of `Scenario.quantities`, in SI units.
    # Share of the weight that the pad carries in frame 0 if the object is held until then. The hand carries the rest.
    carried: Float[Array, ""] | float = 0.0


class Quantity(NamedTuple):
    """Description of a known quantity of trajectories, such as the acceleration of the pad.

    The scenario samples the value for each trajectory, and predictors receive this value as an input. The value is a
    number, or a vector (x, y) in the plane of the pad.
    """

    name: str  # Name in texts and figures.
    unit: str  # Unit in texts and figures.
    scale: float  # Typical size, in SI units. Networks receive the quantity divided by this size.
    vector: bool = False  # True for a vector, whose two numbers turn with the pad under its symmetries.


class Scenario(abc.ABC):
    """Base class of scenarios, which define the starts, the gravity and the outcomes of trajectories.

    A scenario is a frozen dataclass that derives from this class. It defines `outcomes`, `start`, `gravity` and
    `outcome`. All other members have defaults. To replace a default, the dataclass defines a class attribute, a field
    or a method of the same name. `start`, `gravity`, `outcome`, `velocity`, `drift` and `hidden` are pure JAX functions
    for one trajectory.

    The condition of a trajectory is an array of c numbers that `start` draws, such as the acceleration of the pad.
    `quantities` describes them. The condition is an input of predictors, besides the first frame.
    """

    # This is not a `typing.Protocol`. The command line calls `issubclass` to find the options of a scenario, and a
    # protocol with fields raises an error there.
    __dataclass_fields__: ClassVar[dict[str, Any]]  # for type checkers: it is a dataclass

    # possible outcomes, the most informative first: members of `Outcome`, or of another IntEnum with numbers that
    # `Outcome` does not use (`Outcome.FELL_OFF` must be one of them)
    outcomes: ClassVar[tuple[enum.IntEnum, ...]]
    # quantities of the condition, vectors first
    quantities: ClassVar[tuple[Quantity, ...]] = ()
    # symmetries of the square pad under which the scenario does not change, as numbers of `dataset.turn`
    symmetries: ClassVar[tuple[int, ...]] = (0,)
    must_stand: ClassVar[bool] = False  # True if the scenario refuses objects that cannot stand with +z up
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
        """Draw the random start of one trajectory.

        Args:
            key: Random key that is used for nothing else.
            shape: Geometry of the body.
            pad: Size of the pad along x and y (m).

        Returns:
            Initial pose, time of release, and condition (the numbers that `quantities` describes).
        """

    @abc.abstractmethod
    def gravity(self, time: Float[Array, ""], condition: Float[Array, "c"]) -> Float[Array, "3"]:
        """Return gravity minus the acceleration of the pad during one time step (m/s^2, sensor frame).

        Args:
            time: Time at which the step begins (s), 0 at frame 0.
            condition: Known quantities of the trajectory in SI units, such as an acceleration, (c,). The attribute
                `quantities` describes them.
        """

    @abc.abstractmethod
    def outcome(self, first: Float[Array, "7"], last: Float[Array, "7"]) -> Int[Array, ""]:
        """Return the outcome of one trajectory, as the integer value of a member of `outcomes`.

        Args:
            first: Pose in the first frame, (7,), simulated or predicted.
            last: Pose in the last frame, (7,), simulated or predicted.
        """

    def velocity(self, condition: Float[Array, "c"]) -> Float[Array, "6"]:
        """Return the velocity of the object on its release, by default 0.

        Args:
            condition: Known quantities of the trajectory in SI units, such as an acceleration, (c,). The attribute
                `quantities` describes them.

        Returns:
            Velocity of the mesh frame's origin (m/s) and angular velocity (rad/s), (6,), in the sensor frame.
        """
        del condition
        return jnp.zeros(6)

    def drift(self, condition: Float[Array, "c"]) -> Float[Array, "2"]:
        """Return the velocity that an object without friction would have relative to the pad.

        Figures draw this velocity as an arrow. Unless a subclass overrides this method, the result is the horizontal
        velocity of the object on its release.

        Args:
            condition: Known quantities of the trajectory in SI units, such as an acceleration, (c,). The attribute
                `quantities` describes them.

        Returns:
            Velocity along x and y, (2,) (m/s).
        """
        return self.velocity(condition)[:2]

    @property
    def steps(self) -> int:
        """Number of time steps from one frame to the next."""
        return round(1 / (self.rate * self.contact.timestep))

    @property
    def condition_scale(self) -> tuple[float, ...]:
        """Typical magnitude of each number in a trajectory's condition, in SI units.

        The condition contains the numbers that `quantities` describes, such as the acceleration of the pad.
        """
        return tuple(q.scale for q in self.quantities for _ in range(2 if q.vector else 1))

    @property
    def vectors(self) -> int:
        """Number of vectors (x, y) among the known quantities of a trajectory, which are called its condition.

        The field `quantities` lists the vectors and the scalars of the condition. The vectors come first.
        """
        return sum(quantity.vector for quantity in self.quantities)

    @property
    def stays(self) -> tuple[enum.IntEnum, ...]:
        """All members of `outcomes` except `Outcome.FELL_OFF`: the outcomes of objects that stay on the pad."""
        return tuple(outcome for outcome in self.outcomes if outcome != Outcome.FELL_OFF)

    def named(self, number: int) -> str:
        """Return the name of an outcome in words, such as "fell off".

        Args:
            number: Number of the outcome, as in `Trajectory.outcome`.

        Raises:
            ValueError: The scenario has no outcome with this number.
        """
        names = {int(outcome): in_words(outcome) for outcome in self.outcomes}
        if number not in names:
            raise ValueError(
                f"`number` is {number}, but it must be the number of an outcome of {type(self).__name__}: {names}"
            )
        return names[number]

    def described(self, condition: Float[Array | np.ndarray, "c"]) -> str:
        """Describe a condition in words, such as "acceleration (3.1, -7.2) m/s², duration 0.085 s".

        Args:
            condition: Known quantities of a trajectory in SI units, such as an acceleration, (c,). The attribute
                `quantities` describes them.
        """
        words, rest = [], np.asarray(condition).tolist()
        for quantity in self.quantities:
            own, rest = (rest[:2], rest[2:]) if quantity.vector else (rest[:1], rest[1:])
            values = ", ".join(f"{value:.3g}" for value in own)
            words.append(f"{quantity.name} {f'({values})' if quantity.vector else values} {quantity.unit}")
        return ", ".join(words)

    def hidden(self, key: PRNGKeyArray) -> Hidden:
        """Draw the hidden properties (friction, mass of the shell, and contents) of one trajectory.

        Args:
            key: Random key that is used for nothing else.
        """
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
            ValueError: A field has a value of the wrong type or out of range. The message names the field.
        """
        _check_kinds(self)
        _check_times(self)
        _check_meanings(self)
        check_range("fill", self.fill, positive=False)
        check_range("shell_scale", self.shell_scale)
        check_range("friction", self.friction)
        if self.fill[1] > 1:
            raise ValueError(
                f"scenario.fill is {self.fill}, but both limits must be from 0 to 1 (share of the interior's volume)"
            )
        if not 0 <= self.tilt <= math.pi:
            raise ValueError(
                f"scenario.tilt is {self.tilt} rad, but it must be from 0 to pi. For an angle in degrees, use "
                "math.radians"
            )


def _check_kinds(scenario: Scenario) -> None:
    """Raise a ValueError unless each field has a value of the same kind as its default."""
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
    """Raise a ValueError unless there is a frame, and the interval of a frame is a whole number of time steps."""
    rate, timestep = scenario.rate, scenario.contact.timestep
    if not rate > 0 or not timestep > 0:
        raise ValueError(
            f"scenario.rate is {rate}/s and scenario.contact.timestep is {timestep} s, but both must be > 0"
        )
    steps = 1 / (rate * timestep)
    if not (steps >= 1 and abs(steps - round(steps)) < 1e-6):
        raise ValueError(
            f"scenario.rate is {rate}/s, which gives {steps:.3f} time steps (of {timestep} s) per frame, but the "
            "number of time steps must be whole: choose another scenario.rate or scenario.contact.timestep"
        )
    if scenario.frames < 1:
        raise ValueError(f"scenario.frames is {scenario.frames}, but it must be >= 1")


def _check_meanings(scenario: Scenario) -> None:
    """Raise a ValueError unless the numbers of the outcomes are unique and vectors come first in the condition."""
    numbers = [int(outcome) for outcome in scenario.outcomes]
    if int(Outcome.FELL_OFF) not in numbers:
        raise ValueError(
            f"scenario.outcomes is {scenario.outcomes}, but it must contain physics.Outcome.FELL_OFF, because any "
            "object can leave the pad: add physics.Outcome.FELL_OFF"
        )
    taken = [o for o in scenario.outcomes if not isinstance(o, Outcome) and int(o) in {int(known) for known in Outcome}]
    if taken or len(set(numbers)) < len(numbers):
        raise ValueError(
            f"scenario.outcomes has the numbers {numbers}, but each outcome needs a unique number, and 0 "
            f"to {int(max(Outcome))} are reserved for physics.Outcome: number your own outcomes from 100 on"
        )
    kinds = [quantity.vector for quantity in scenario.quantities]
    if sorted(kinds, reverse=True) != kinds:
        names = ", ".join(quantity.name for quantity in scenario.quantities)
        raise ValueError(
            f"scenario.quantities has the order {names}, but vectors must come before scalars: move the vectors to the "
            "front"
        )


Variant = Literal["default", "off", "wide-friction", "off-centre"]
_RANGES = ("fill", "shell_scale", "friction")  # fields with ranges of hidden properties
_AnyScenario = TypeVar("_AnyScenario", bound=Scenario)


def variant(scenario: _AnyScenario, name: str) -> _AnyScenario:
    """Return a copy of a scenario with other ranges of its hidden properties.

    Args:
        scenario: Scenario to copy. Its other fields stay the same.
        name: Name of the variant. "default" changes nothing. "off" fixes each hidden property at the middle of its
            range, and the contents of an object lie at its base. "wide-friction" draws friction from 0.3 to 0.9.
            "off-centre" sets `tilt` to pi. This field is the largest angle between the object's +z and the upward
            direction while the contents settle. With pi, the object can have any orientation, so the contents can lie
            at any side of the object, as in `Inclined()`.

    Returns:
        A scenario of the same class.

    Raises:
        ValueError: The name is unknown, or the scenario lacks a field that the variant changes.
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
        raise ValueError(
            f"the variant {name!r} changes fields that the scenario {type(scenario).__name__} lacks: "
            f"declare {', '.join(lacking)} in the scenario's dataclass"
        )
    return dataclasses.replace(scenario, **changes[name])


def fell_off(pose: Float[Array, "*n 7"]) -> Bool[Array, "*n"]:
    """Return for each pose, (..., 7), whether the object's origin is more than 5 mm below the face of the gel."""
    return pose[..., 2] < FELL_OFF_HEIGHT


def upright(up: Float[Array, "3"]) -> Float[Array, "4"]:
    """Return the quaternion of the shortest rotation that turns a unit vector to +z."""
    upside_down = up[2] < -0.9999
    turn = jnp.stack([1 + up[2], up[1], -up[0], 0.0])
    return geometry.normalize(jnp.where(upside_down, jnp.array([0.0, 1.0, 0.0, 0.0]), turn))


def random_yaw(key: PRNGKeyArray) -> Float[Array, "4"]:
    """Draw the quaternion of a rotation about the vertical by a uniformly random angle."""
    angle = jax.random.uniform(key, maxval=2 * jnp.pi)
    return geometry.quat_canonical(geometry.quat_from_rotvec(jnp.stack([0.0, 0.0, angle])))


def random_place(radius: PRNGKeyArray, angle: PRNGKeyArray, size: float) -> Float[Array, "2"]:
    """Draw x and y (m) uniformly from a disc about the pad's centre.

    Args:
        radius: Random key for the distance from the centre.
        angle: Random key for the direction.
        size: Radius of the disc (m).
    """
    r = size * jnp.sqrt(jax.random.uniform(radius))
    a = jax.random.uniform(angle, maxval=2 * jnp.pi)
    return jnp.stack([r * jnp.cos(a), r * jnp.sin(a)])
