"""Motion of objects on the pad, simulated in MuJoCo (`simulate`), and poses of objects at rest (`place`)."""

from sts_jax.physics.bodies import BodyError, Rigid, refusal, rigids
from sts_jax.physics.engines import Engine
from sts_jax.physics.forces import wrench
from sts_jax.physics.freefall import Freefall
from sts_jax.physics.inclined import Inclined
from sts_jax.physics.perturbed import Perturbed
from sts_jax.physics.released import Released
from sts_jax.physics.rest import Placement, StableFaces, place, stable_faces, weight
from sts_jax.physics.scenario import (
    Hidden,
    Outcome,
    Quantity,
    Scenario,
    Shape,
    Start,
    Variant,
    fell_off,
    variant,
)
from sts_jax.physics.scene import Contact
from sts_jax.physics.simulation import Starts, Trajectory, simulate, starts

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
    "Quantity",
    "Released",
    "Rigid",
    "Scenario",
    "Shape",
    "StableFaces",
    "Start",
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
    "wrench",
]
