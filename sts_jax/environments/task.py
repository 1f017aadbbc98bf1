"""The task of both environments: close on an object of unknown friction, and lift it with little force."""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from sts_jax import geometry, scene
from sts_jax._checked import checked
from sts_jax.objects.body import Body
from sts_jax.scene.hand import corners
from sts_jax.sensor import Sensor

PADS = ("left", "right")
STREAMS = ("visual", "tactile")
_YAWS = 181  # yaws at which an object must fit between the fingers
LARGEST = 10.0  # largest number in the part of an observation that is no image
ACTIONS = ("lift", "grip")  # an action's components, in the order of the actuators


class Reward(NamedTuple):
    """The terms of the reward, or their weights."""

    touch: Any  # smaller normal force of the two pads, as a share of `Task.touch`, at most 1
    lift: Any  # rise of the object, as a share of `Task.height`, from 0 to 1
    held: Any  # 1 while the object is above `Task.height` and both pads press on it
    squeeze: Any  # larger normal force of the two pads, as a share of `Task.grip`


WEIGHTS = Reward(touch=0.1, lift=1.0, held=1.0, squeeze=-0.5)


@dataclasses.dataclass(frozen=True)
class Task:
    """Constants of the task."""

    resolution: tuple[int, int] = (64, 64)  # height and width of each image (pixels)
    control_dt: float = 0.02  # time between two actions (s)
    timestep: float = 0.001  # time step of the physics (s)
    mass: float = 0.2  # mass of the object (kg)
    friction: tuple[float, float] = (0.3, 1.0)  # range of the object's coefficient of friction, which no one observes
    offset: float = 0.004  # largest distance of the object from its place along x and y at the start (m)
    yaw: float = 0.2  # largest rotation of the object about the vertical at the start (rad)
    speed: tuple[float, float] = (0.2, 0.1)  # speeds of the targets of lift and opening at an action of 1 (m/s)
    grip: float = 10.0  # largest force of each finger (N)
    height: float = 0.05  # rise of the object at which it is lifted (m)
    reach: float = 0.15  # distance of the object from the vertical axis beyond which it is lost (m)
    touch: float = 0.5  # normal force that counts as a firm touch (N)
    weights: Reward = WEIGHTS  # weights of the terms of the reward

    @property
    def substeps(self) -> int:
        """Number of time steps of the physics between two actions."""
        return round(self.control_dt / self.timestep)

    def check(self) -> None:
        """Raise a ValueError that names the field, its value and the limit, if a constant is out of range."""
        for name in ("control_dt", "timestep", "mass", "grip", "height", "reach", "touch"):
            if not 0 < (value := getattr(self, name)) < np.inf:
                raise ValueError(f"task.{name} is {value}, but it must be > 0 and finite")
        for name in ("offset", "yaw"):
            if not 0 <= (value := getattr(self, name)) < np.inf:
                raise ValueError(f"task.{name} is {value}, but it must be >= 0 and finite")
        for name in ("resolution", "friction", "speed"):
            value = getattr(self, name)
            if not isinstance(value, tuple) or len(value) != 2:
                raise ValueError(f"task.{name} is {value!r}, but it must be a tuple of two numbers")
        if not 0 < self.friction[0] <= self.friction[1] < np.inf:
            raise ValueError(f"task.friction is {self.friction}, but it must be a range (low, high) of values > 0")
        if abs(self.substeps * self.timestep - self.control_dt) > 1e-6 * self.control_dt:
            raise ValueError(
                f"task.control_dt is {self.control_dt} s, but it must be a multiple of timestep, {self.timestep} s"
            )


class Start(NamedTuple):
    """What differs between episodes, drawn uniformly from the ranges of the task."""

    offset: Float[Array | np.ndarray, "2"]  # displacement of the object along x and y (m)
    yaw: Float[Array | np.ndarray, ""] | float  # rotation of the object about the vertical (rad)
    friction: Float[Array | np.ndarray, ""] | float  # the object's coefficient of friction


class Setting(NamedTuple):
    """The scene of the task."""

    model: mujoco.MjModel
    view: scene.View
    home: mujoco.MjData  # open gripper around the object
    low: np.ndarray  # least targets of the actuators (m)
    high: np.ndarray  # largest targets (m)
    body: int  # id of the object
    geoms: np.ndarray  # ids of the object's geoms
    free: int  # index of the object's pose in `qpos`


@checked
def setting(sensor: Sensor, body: Body | None, task: Task) -> Setting:
    """Build the scene: `scene.gripper` with a pad on each finger."""
    task.check()
    build = functools.partial(
        scene.gripper, sensor, body, mass=task.mass, grip=task.grip, timestep=task.timestep, friction=task.friction[1]
    )
    # An object that does not fit between the fingers raises an error here: the corner and the yaw that reach farthest.
    yaws = np.linspace(-task.yaw, task.yaw, _YAWS)
    reach = corners(body)[:, :2] @ np.stack([np.cos(yaws), -np.sin(yaws)])
    corner, yaw = np.unravel_index(np.abs(reach).argmax(), reach.shape)
    build(yaw=float(yaws[yaw]), position=(float(np.copysign(task.offset, reach[corner, yaw])), 0.0))
    spec = build()
    for side in PADS:
        scene.attach(spec, f"{side}_tip", sensor, name=side)
    model = spec.compile()
    view = scene.View(model, dict.fromkeys(PADS, sensor), bodies={} if body is None else {"object": body})
    home = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, home, model.key("home").id)
    mujoco.mj_forward(model, home)
    lift = model.joint("lift").range
    if home.ctrl[0] + task.height > lift[1]:
        raise ValueError(
            f"task.height is {task.height} m, but the gripper rises by {lift[1] - home.ctrl[0]:.3f} m at most"
        )
    number = model.body("object").id
    return Setting(
        model=model,
        view=view,
        home=home,
        low=np.array([home.ctrl[0], 0.0]),
        high=np.array([min(lift[1], home.ctrl[0] + 3 * task.height), home.ctrl[1]]),
        body=number,
        geoms=np.flatnonzero(model.geom_bodyid == number),
        free=int(model.joint("object").qposadr[0]),
    )


def placed(setting: Setting, start: Start) -> Float[Array, "q"]:
    """Joint positions at the start of an episode."""
    half = start.yaw / 2
    turn = jnp.stack([jnp.cos(half), 0 * half, 0 * half, jnp.sin(half)])
    qpos, place = jnp.asarray(setting.home.qpos, jnp.float32), setting.free
    qpos = qpos.at[place : place + 2].add(start.offset)
    return qpos.at[place + 3 : place + 7].set(geometry.quat_multiply(turn, qpos[place + 3 : place + 7]))


def target(setting: Setting, task: Task, ctrl: Any, action: Any) -> Float[Array, "2"]:
    """Targets of the actuators after an action in [-1, 1]: rise and close at these shares of the largest speeds."""
    speed = jnp.array(task.speed) * jnp.array([1.0, -1.0]) * task.control_dt
    return jnp.clip(ctrl + speed * jnp.clip(action, -1, 1), setting.low, setting.high)


def proprioception(qpos: Any, qvel: Any, ctrl: Any) -> Float[Array, "6"]:
    """Height and opening of the gripper (m), their velocities (m/s) and their targets (m), within LARGEST."""
    state = jnp.stack([qpos[0], qpos[1] + qpos[2], qvel[0], qvel[1] + qvel[2], *ctrl])
    return jnp.clip(jnp.nan_to_num(state), -LARGEST, LARGEST).astype(jnp.float32)


@functools.partial(jax.jit, static_argnames="task")
def judge(
    task: Task,
    place: Float[ArrayLike, "3"],
    start: Float[ArrayLike, ""],
    forces: Float[ArrayLike, "2"],
    qpos: Float[ArrayLike, "q"],
) -> tuple[Float[Array, ""], Reward, Bool[Array, ""]]:
    """Judge a state.

    Args:
        task: Constants of the task.
        place: Position of the object (m).
        start: Its height at the start (m).
        forces: Normal force of each pad on the object (N).
        qpos: Joint positions.

    Returns:
        Reward, its terms, and whether the episode ends because the object is lost or a value is not finite.
    """
    x, y, z = (jnp.asarray(place)[k] for k in range(3))
    rise = z - start
    terms = Reward(
        touch=jnp.clip(jnp.min(forces) / task.touch, 0, 1),
        lift=jnp.clip(rise / task.height, 0, 1),
        held=((rise >= task.height) & (jnp.min(forces) > 0)).astype(jnp.float32),
        squeeze=jnp.max(forces) / task.grip,
    )
    sound = jnp.all(jnp.isfinite(qpos)) & jnp.all(jnp.isfinite(place)) & jnp.all(jnp.isfinite(forces))
    terms = Reward(*(jnp.where(sound, term, 0) for term in terms))
    lost = jnp.hypot(x, y) > task.reach
    reward = sum(weight * term for weight, term in zip(task.weights, terms, strict=True))
    return jnp.asarray(reward), terms, lost | ~sound
