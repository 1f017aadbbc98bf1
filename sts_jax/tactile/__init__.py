"""Tactile image: equilibrium of an object on the gel, shape of the skin, lights, shadows and reflectance.

The skin is the paint on the gel's outer face. The tactile image shows the inner side of the skin while the internal
lights are on.
"""

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
