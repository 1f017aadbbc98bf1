"""Environments for reinforcement learning: a gripper with two sensors closes on an object and lifts it.

`Lift` runs in MJX, in the style of MuJoCo Playground. The module `sts_jax.environments.gym` has the same task as an
environment of Gymnasium in C MuJoCo, and needs the package gymnasium.
"""

from sts_jax.environments.playground import Lift as Lift
from sts_jax.environments.playground import State as State
from sts_jax.environments.task import Reward as Reward
from sts_jax.environments.task import Task as Task
