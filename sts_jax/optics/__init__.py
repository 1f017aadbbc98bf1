"""Camera, rasteriser and shading for images through the skin (visual stream) and for pictures from outside."""

from sts_jax.optics.camera import Camera, full_window, object_window, rays, to_pixels
from sts_jax.optics.external_view import photograph
from sts_jax.optics.shading import (
    Room,
    empty_view,
    hidden_sky,
    housing,
    sample_texture,
    shade,
    to_linear,
    to_srgb,
)
from sts_jax.optics.zbuffer import barycentrics, pixel_centres, rasterise

__all__ = [
    "Camera",
    "Room",
    "barycentrics",
    "empty_view",
    "full_window",
    "hidden_sky",
    "housing",
    "object_window",
    "photograph",
    "pixel_centres",
    "rasterise",
    "rays",
    "sample_texture",
    "shade",
    "to_linear",
    "to_pixels",
    "to_srgb",
]
