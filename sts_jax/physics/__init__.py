"""Physics: objects fall, slide and topple on the pad in MuJoCo (`simulate`) or rest on it (`place`)."""

from sts_jax.physics.draws import Starts, starts
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
from sts_jax.physics.simulate import BodyError, Engine, Rigid, Trajectory, refusal, rigids, simulate

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
    "Rigid",
    "Scenario",
    "StableFaces",
    "Starts",
    "Trajectory",
    "Variant",
    "fell_off",
    "place",
    "refusal",
    "rigids",
    "simulate",
    "stable_faces",
    "starts",
    "variant",
    "weight",
]
