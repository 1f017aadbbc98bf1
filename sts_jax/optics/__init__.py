"""Camera, rasteriser and shading for images through the skin (visual stream) and for pictures from outside."""

from sts_jax.optics.camera import Camera as Camera
from sts_jax.optics.camera import full_window as full_window
from sts_jax.optics.camera import object_window as object_window
from sts_jax.optics.camera import rays as rays
from sts_jax.optics.camera import to_pixels as to_pixels
from sts_jax.optics.external_view import photograph as photograph
from sts_jax.optics.shading import Room as Room
from sts_jax.optics.shading import Texels as Texels
from sts_jax.optics.shading import empty_view as empty_view
from sts_jax.optics.shading import hidden_sky as hidden_sky
from sts_jax.optics.shading import housing as housing
from sts_jax.optics.shading import sample_texels as sample_texels
from sts_jax.optics.shading import sample_texture as sample_texture
from sts_jax.optics.shading import shade as shade
from sts_jax.optics.shading import to_linear as to_linear
from sts_jax.optics.shading import to_srgb as to_srgb
from sts_jax.optics.zbuffer import barycentrics as barycentrics
from sts_jax.optics.zbuffer import pixel_centres as pixel_centres
from sts_jax.optics.zbuffer import rasterise as rasterise
