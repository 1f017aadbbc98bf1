"""Physics: objects fall, slide and topple on the pad in MuJoCo (`simulate`), or lie there at rest (`place`)."""

from sts_jax.physics.rest import Placement, StableFaces, place, stable_faces, weight
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
from sts_jax.physics.simulate import BodyError, Engine, Trajectory, refusal, simulate

__all__ = [
    "BodyError",
    "Contact",
    "Engine",
    "Freefall",
    "Hidden",
    "Inclined",
    "Outcome",
    "Perturbed",
    "Placement",
    "Scenario",
    "StableFaces",
    "Trajectory",
    "Variant",
    "fell_off",
    "place",
    "refusal",
    "simulate",
    "stable_faces",
    "variant",
    "weight",
]
