"""What falls where, under which gravity, and what its end is called."""

import dataclasses
import enum
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from sts_jax import _math
from sts_jax.physics.scene import Contact

G = 9.81  # m/s^2
FELL_OFF_HEIGHT = -0.005  # m; an object's origin lies inside its hull: on the pad it is above, after leaving below


class Outcome(enum.IntEnum):
    """How a trajectory ended."""

    RESTS = 0
    FELL_OFF = 1


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


@dataclasses.dataclass(frozen=True)
class Freefall:
    """An object in any orientation released above the flat pad; in frame 0 it is at rest in the air.

    Paper, "Data Collection". Ranges are uniform.
    """

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

    def hidden(self, key: PRNGKeyArray) -> Hidden:
        """Draws the hidden values of one trajectory; consumes `key`."""
        keys = jax.random.split(key, 3)
        ranges = (self.fill, self.shell_scale, self.friction)
        return Hidden(*(jax.random.uniform(k, (), minval=a, maxval=b) for k, (a, b) in zip(keys, ranges, strict=True)))

    def start(self, key: PRNGKeyArray, hull: Float[Array, "n 3"]) -> Start:
        """Draws one start; consumes `key`.

        The object is thrown upwards one interval before frame 0 such that frame 0 is the top of its flight, at rest.

        Args:
            key: one trajectory's.
            hull: (n, 3) m, the hull's vertices in the mesh frame.
        """
        turn, radius, angle = jax.random.split(key, 3)
        quat = _math.random_quat(turn)
        r = self.spread * jnp.sqrt(jax.random.uniform(radius))
        a = jax.random.uniform(angle, maxval=2 * jnp.pi)
        lowest = jnp.min(hull @ _math.quat_matrix(quat)[2])
        position = jnp.stack([r * jnp.cos(a), r * jnp.sin(a), self.height - self.rise - lowest])
        velocity = jnp.zeros(6).at[2].set(G / self.rate)
        return Start(jnp.concatenate([position, quat]), velocity, jnp.zeros(0))

    def gravity(self, time: Float[Array, ""], condition: Float[Array, "c"]) -> Float[Array, "3"]:
        """Gravity in the sensor frame (m/s^2) at a time (s, 0 is frame 0)."""
        del time, condition  # a slope tilts gravity, a shake varies it with time
        return jnp.array([0.0, 0.0, -G])


def outcome(first_pose: Float[Array, "7"], last_pose: Float[Array, "7"]) -> Int[Array, ""]:
    """How a trajectory of `Freefall` ended, from poses alone, true or predicted: a value of `Outcome`.

    Args:
        first_pose: (7,) of frame 0; where it starts does not matter to a fall.
        last_pose: (7,) of the last frame.
    """
    del first_pose
    return jnp.where(last_pose[2] < FELL_OFF_HEIGHT, Outcome.FELL_OFF, Outcome.RESTS).astype(jnp.int32)
