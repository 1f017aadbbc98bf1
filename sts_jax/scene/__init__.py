"""The sensor in any MuJoCo scene."""

from sts_jax.scene.gripper import gripper as gripper
