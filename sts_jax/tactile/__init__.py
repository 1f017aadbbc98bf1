"""Tactile image: equilibrium of an object on the gel, shape of the skin, lights, shadows and reflectance.

The skin is the paint on the gel's outer face. The tactile image shows the inner side of the skin while the internal
lights are on.
"""

from sts_jax.tactile.gel import Equilibrium as Equilibrium
from sts_jax.tactile.gel import Gel as Gel
from sts_jax.tactile.gel import cell_area as cell_area
from sts_jax.tactile.gel import cell_centres as cell_centres
from sts_jax.tactile.gel import indent as indent
from sts_jax.tactile.gel import settle as settle
from sts_jax.tactile.normals import surface_normals as surface_normals
from sts_jax.tactile.shear import Markers as Markers
from sts_jax.tactile.shear import Shear as Shear
from sts_jax.tactile.shear import dots as dots
from sts_jax.tactile.shear import shear as shear
from sts_jax.tactile.skin import Leds as Leds
from sts_jax.tactile.skin import Lights as Lights
from sts_jax.tactile.skin import Phong as Phong
from sts_jax.tactile.skin import Skin as Skin
from sts_jax.tactile.skin import couple as couple
from sts_jax.tactile.skin import darken as darken
from sts_jax.tactile.skin import phong as phong
from sts_jax.tactile.skin import shadows as shadows
