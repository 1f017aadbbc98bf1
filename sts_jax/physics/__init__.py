"""Physics: objects fall, slide and topple on the pad in MJX; `simulate` gives trajectories in the sensor frame."""

from sts_jax.physics.scenarios import (
    Freefall,
    Hidden,
    Inclined,
    Outcome,
    Perturbed,
    Scenario,
    Variant,
    fell_off,
    variant,
)
from sts_jax.physics.scene import Contact
from sts_jax.physics.simulate import BodyError, Trajectory, refusal, simulate

__all__ = [
    "BodyError",
    "Contact",
    "Freefall",
    "Hidden",
    "Inclined",
    "Outcome",
    "Perturbed",
    "Scenario",
    "Trajectory",
    "Variant",
    "fell_off",
    "refusal",
    "simulate",
    "variant",
]
