"""Physics: objects fall on the pad in MJX; `simulate` gives trajectories in the sensor frame."""

from sts_jax.physics.scenarios import Freefall, Hidden, Outcome, Perturbed, Scenario, fell_off
from sts_jax.physics.scene import Contact
from sts_jax.physics.simulate import Trajectory, simulate

__all__ = ["Contact", "Freefall", "Hidden", "Outcome", "Perturbed", "Scenario", "Trajectory", "fell_off", "simulate"]
