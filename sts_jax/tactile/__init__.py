"""Images of the lit skin (tactile stream): equilibrium of the gel, shape of the skin, lights, shadows, reflectance."""

from sts_jax.tactile.gel import Equilibrium, Gel, cell_area, cell_centres, indent, settle
from sts_jax.tactile.normals import surface_normals
from sts_jax.tactile.skin import Leds, Lights, Phong, Skin, couple, darken, phong, shadows

__all__ = [
    "Equilibrium",
    "Gel",
    "Leds",
    "Lights",
    "Phong",
    "Skin",
    "cell_area",
    "cell_centres",
    "couple",
    "darken",
    "indent",
    "phong",
    "settle",
    "shadows",
    "surface_normals",
]
