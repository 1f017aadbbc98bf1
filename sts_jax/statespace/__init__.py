"""A multimodal state-space model: from any subset of vision, touch and pose to the final pose and both streams."""

from sts_jax.statespace.networks import IMAGES, INPUTS, Config, Model, init
from sts_jax.statespace.objective import loss
from sts_jax.statespace.poses import CODE
from sts_jax.statespace.predict import Samples, sample

__all__ = ["CODE", "IMAGES", "INPUTS", "Config", "Model", "Samples", "init", "loss", "sample"]
