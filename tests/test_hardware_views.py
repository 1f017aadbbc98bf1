"""Views and moments of recorded trajectories."""

import jax
import numpy as np
import pytest
from recorded_session import LENS, RESOLUTION, record

import sts_jax as sts
from sts_jax import hardware
from sts_jax.hardware import twin

POSE = [0.012, -0.02, 0.025, 1, 0, 0, 0]


def pair(visual, tactile):
    """A raw pair with images alone."""
    lit = hardware.Lit((0,) * 4, 1, 1, 0.0, 0.0)
    return hardware.Pair(
        *(hardware.Shot(image, stream, 0.0, 0, 0, lit, 0.0) for image, stream in ((visual, "visual"), (tactile, "tactile")))
    )
