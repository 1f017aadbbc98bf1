"""The sensor in any MuJoCo scene: `attach` adds its pad to a model, and `View` renders what it sees and feels."""

from sts_jax.scene.hand import gripper as gripper
from sts_jax.scene.pad import Press as Press
from sts_jax.scene.pad import attach as attach
from sts_jax.scene.view import View as View
