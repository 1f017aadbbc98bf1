"""`Lift`: the task as an environment in the style of MuJoCo Playground, in MJX."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from sts_jax._checked import in_32_bits
from sts_jax.environments.task import ACTIONS, PADS, STREAMS, Reward, Start, Task, judge, placed, proprioception, target
from sts_jax.environments.task import setting as task_setting
from sts_jax.frame import Frame
from sts_jax.objects.body import Body
from sts_jax.physics.scene import mjx
from sts_jax.sensor import Sensor


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class State:
    """State of an environment, with the fields of Playground's `State`."""

    data: Any  # `mjx.Data`
    obs: dict[str, Any]  # Observation, see `Lift`.
    reward: Any  # Reward of the last action.
    done: Any  # 1 if the object is lost, else 0.
    metrics: dict[str, Any]  # Terms of the reward, without their weights.
    info: dict[str, Any]  # The object's coefficient of friction, and the entries of wrappers.

    def replace(self, **changes: Any) -> "State":
        """Copy the state with other values of some fields."""
        return dataclasses.replace(self, **changes)


class Lift:
    """Close on an object and lift it: `reset` and `step` are pure, and run under `jit` and `vmap`.

    The class has the methods and properties of Playground's `MjxEnv`, so that its wrappers accept it, but does not need
    Playground. Episodes have no length of their own. An observation is a dictionary:

    - `state`: (6,), height and opening of the gripper (m), their velocities (m/s) and their targets (m).
    - `pixels/left_visual`, `pixels/left_tactile`, `pixels/right_visual`, `pixels/right_tactile`: (h, w, 3) in [0, 1].

    An action has the components lift and grip in [-1, 1]: velocities of the targets of the two servos, up and closing.
    """

    @in_32_bits
    def __init__(self, sensor: Sensor | None = None, body: Body | None = None, task: Task | None = None) -> None:
        """Build the scene.

        Args:
            sensor: Sensor on each finger. None for the default sensor at a width of 40 mm.
            body: Object to lift. None for a box.
            task: Constants of the task.
        """
        self.task = Task() if task is None else task
        self.setting = task_setting(Sensor.sized(0.04) if sensor is None else sensor, body, self.task)
        self._mjx_model = mjx.put_model(self.setting.model)  # Playground's randomisation replaces this attribute
        self._data = mjx.make_data(self.setting.model)

    @in_32_bits
    def reset(self, rng: PRNGKeyArray) -> State:
        """Begin an episode with the open gripper around the object, whose pose and friction are drawn."""
        task, keys = self.task, jax.random.split(rng, 3)
        start = Start(
            offset=jax.random.uniform(keys[0], (2,), minval=-task.offset, maxval=task.offset),
            yaw=jax.random.uniform(keys[1], minval=-task.yaw, maxval=task.yaw),
            friction=jax.random.uniform(keys[2], minval=task.friction[0], maxval=task.friction[1]),
        )
        ctrl = jnp.asarray(self.setting.home.ctrl, jnp.float32)
        data = self._data.replace(qpos=placed(self.setting, start), ctrl=ctrl)
        data = mjx.forward(self._with(start.friction), data)
        _, terms, done = self._judge(data)
        return State(
            data=data,
            obs=self._observe(data),
            reward=jnp.zeros(()),
            done=done.astype(jnp.float32),
            metrics=terms._asdict(),
            info={"friction": start.friction},
        )

    @in_32_bits
    def step(self, state: State, action: Float[Array, "2"]) -> State:
        """Move the targets of the servos, and advance the physics by `dt`."""
        ctrl = target(self.setting, self.task, state.data.ctrl, action)
        model = self._with(state.info["friction"])
        data = state.data.replace(ctrl=ctrl)
        data = jax.lax.fori_loop(0, self.n_substeps, lambda _, data: mjx.step(model, data), data)
        reward, terms, done = self._judge(data)
        return state.replace(
            data=data,
            obs=self._observe(data),
            reward=reward,
            done=done.astype(jnp.float32),
            metrics=state.metrics | terms._asdict(),
        )

    def _with(self, friction: Float[ArrayLike, ""]) -> mjx.Model:
        values = self._mjx_model.geom_friction
        return self._mjx_model.replace(geom_friction=values.at[self.setting.geoms, 0].set(friction))

    def _judge(self, data: mjx.Data) -> tuple[Array, Reward, Array]:
        wrenches = self.setting.view.wrenches(data)
        forces = jnp.stack([wrenches[pad]["object"][2] for pad in PADS])
        start = self.setting.home.xpos[self.setting.body, 2]
        return judge(self.task, data.xpos[self.setting.body], start, forces, data.qpos)

    def _observe(self, data: mjx.Data) -> dict[str, Array]:
        frames = self.setting.view(data, resolution=self.task.resolution)
        images = {f"pixels/{pad}_{name}": getattr(frames[pad], name) for pad in PADS for name in STREAMS}
        return {"state": proprioception(data.qpos, data.qvel, data.ctrl), **images}

    def render(
        self, trajectory: State | Sequence[State], height: int = 240, width: int = 320, *ignored: object
    ) -> np.ndarray | list[np.ndarray]:
        """Images of the sensors for each state, uint8: left and right pad, visual stream above tactile stream.

        The further arguments of Playground's method choose a camera outside the sensors, and are ignored.
        """
        if not isinstance(trajectory, State):
            return [np.asarray(self.render(state, height, width)) for state in trajectory]
        return picture(self.setting.view(trajectory.data, resolution=(height, width)))

    @property
    def action_size(self) -> int:
        """Number of components of an action."""
        return len(ACTIONS)

    @property
    def observation_size(self) -> dict[str, tuple[int, ...]]:
        """Shapes of the arrays of an observation."""
        height, width = self.task.resolution
        images = {f"pixels/{pad}_{name}": (height, width, 3) for pad in PADS for name in STREAMS}
        return {"state": (6,), **images}

    @property
    def mj_model(self) -> mujoco.MjModel:
        """Model of C MuJoCo."""
        return self.setting.model

    @property
    def mjx_model(self) -> mjx.Model:
        """Model of MJX."""
        return self._mjx_model

    @property
    def xml_path(self) -> str:
        """Empty: the scene has no file."""
        return ""

    @property
    def dt(self) -> float:
        """Time between two actions (s)."""
        return self.task.control_dt

    @property
    def sim_dt(self) -> float:
        """Time step of the physics (s)."""
        return self.task.timestep

    @property
    def n_substeps(self) -> int:
        """Number of time steps between two actions."""
        return self.task.substeps

    @property
    def unwrapped(self) -> "Lift":
        """The environment itself."""
        return self


def picture(frames: Mapping[str, Frame]) -> np.ndarray:
    """Join the images of both pads into one of uint8, the visual stream above the tactile stream."""
    rows = [np.concatenate([np.asarray(getattr(frames[pad], name)) for pad in PADS], axis=1) for name in STREAMS]
    return to_uint8(np.concatenate(rows))


def to_uint8(image: np.ndarray | Array) -> np.ndarray:
    """Convert an image in [0, 1]."""
    return np.round(255 * np.asarray(image)).astype(np.uint8)
