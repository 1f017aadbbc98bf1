"""`GymLift`: the task as an environment of Gymnasium, in C MuJoCo. The import registers it as `sts_jax/Lift-v0`."""

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from sts_jax.environments.playground import picture, to_uint8
from sts_jax.environments.task import (
    ACTIONS,
    LARGEST,
    PADS,
    STREAMS,
    Start,
    Task,
    judge,
    placed,
    proprioception,
    target,
)
from sts_jax.environments.task import setting as task_setting
from sts_jax.objects.body import Body
from sts_jax.physics.native import quiet
from sts_jax.sensor import Sensor

try:
    import gymnasium
    from gymnasium import spaces
except ImportError as error:
    raise ImportError(
        "the environment of Gymnasium needs the package gymnasium, which is not installed: pip install gymnasium"
    ) from error

EPISODE = 150  # actions of an episode of `gymnasium.make`
_DIVERGED = [int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{name}")) for name in ("QPOS", "QVEL", "QACC", "CTRL")]

Observation = dict[str, np.ndarray]


class GymLift(gymnasium.Env[Observation, np.ndarray]):
    """Close on an object and lift it. Actions and observations are those of `Lift`, but images are uint8 (0 to 255).

    `reset` draws the pose and the friction of the object. The dictionary `info` has the terms of the reward without
    their weights, and the friction. An episode terminates if the object is lost. `gymnasium.make` truncates it after
    EPISODE actions.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012 (Gymnasium's own annotation)

    def __init__(
        self,
        sensor: Sensor | None = None,
        body: Body | None = None,
        task: Task | None = None,
        render_mode: str | None = None,
    ) -> None:
        """Build the scene. The arguments are those of `Lift`; `render_mode` may be "rgb_array"."""
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode is {render_mode!r}, but it must be 'rgb_array' or None")
        self.task, self.render_mode = Task() if task is None else task, render_mode
        self.metadata = {**self.metadata, "render_fps": round(1 / self.task.control_dt)}
        self.setting = task_setting(Sensor.sized(0.04) if sensor is None else sensor, body, self.task)
        self.model, self.data = self.setting.model, mujoco.MjData(self.setting.model)
        self.action_space = spaces.Box(-1, 1, (len(ACTIONS),), np.float32)
        image = spaces.Box(0, 255, (*self.task.resolution, 3), np.uint8)
        images = {f"pixels/{pad}_{name}": image for pad in PADS for name in STREAMS}
        # Gymnasium annotates the space by the type of its values.
        space: Any = spaces.Dict({"state": spaces.Box(-LARGEST, LARGEST, (6,), np.float32), **images})
        self.observation_space = space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict]:
        """Begin an episode with the open gripper around the object, whose pose and friction are drawn."""
        super().reset(seed=seed)
        task, draw = self.task, self.np_random.uniform
        start = Start(draw(-task.offset, task.offset, 2), draw(-task.yaw, task.yaw), draw(*task.friction))
        self.model.geom_friction[self.setting.geoms, 0] = start.friction
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = placed(self.setting, start)
        self.data.ctrl[:] = self.setting.home.ctrl
        mujoco.mj_forward(self.model, self.data)
        return self._observe(), self._judge()[2]

    def step(self, action: np.ndarray | Sequence[float]) -> tuple[Observation, float, bool, bool, dict]:
        """Move the targets of the servos, and advance the physics by `task.control_dt`."""
        if np.shape(action) != (len(ACTIONS),):
            raise ValueError(f"action has the shape {np.shape(action)}, but it must be ({len(ACTIONS)},): {ACTIONS}")
        action = np.asarray(action, np.float32)
        self.data.ctrl[:] = target(self.setting, self.task, self.data.ctrl, action)
        with quiet():
            mujoco.mj_step(self.model, self.data, self.task.substeps)
        reward, lost, info = self._judge()
        # MuJoCo resets what diverges, and takes 0 for an action that is not finite, so the state shows neither.
        diverged = any(self.data.warning[kind].number for kind in _DIVERGED)
        return self._observe(), 0.0 if diverged else reward, lost or diverged, False, info

    def render(self) -> np.ndarray | None:
        """Images of the observation in one, uint8: left and right pad, visual stream above tactile stream."""
        if self.render_mode is None:
            return None
        return picture(self.setting.view(self.data, resolution=self.task.resolution))

    def _judge(self) -> tuple[float, bool, dict[str, float]]:
        wrenches, body = self.setting.view.wrenches(self.data), self.setting.body
        forces = np.array([wrenches[pad]["object"][2] for pad in PADS])
        reward, terms, lost = judge(
            self.task, self.data.xpos[body], self.setting.home.xpos[body, 2], forces, self.data.qpos
        )
        info = {name: float(term) for name, term in terms._asdict().items()}
        return float(reward), bool(lost), info | {"friction": float(self.model.geom_friction[self.setting.geoms[0], 0])}

    def _observe(self) -> Observation:
        frames = self.setting.view(self.data, resolution=self.task.resolution)
        images = {f"pixels/{pad}_{name}": to_uint8(getattr(frames[pad], name)) for pad in PADS for name in STREAMS}
        state = proprioception(self.data.qpos, self.data.qvel, self.data.ctrl)
        return {"state": np.asarray(state), **images}


gymnasium.register("sts_jax/Lift-v0", entry_point="sts_jax.environments.gym:GymLift", max_episode_steps=EPISODE)
