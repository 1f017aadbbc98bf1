"""Touch: the gel's equilibrium, the skin's normals, lights and reflectance."""

from sts_jax.tactile.gel import Equilibrium, Gel, cell_area, cell_centres, indent, settle
from sts_jax.tactile.skin import Lights, Phong, darken, phong, surface_normals

__all__ = [
    "Equilibrium",
    "Gel",
    "Lights",
    "Phong",
    "cell_area",
    "cell_centres",
    "darken",
    "indent",
    "phong",
    "settle",
    "surface_normals",
]
