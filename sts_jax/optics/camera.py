"""The pinhole camera below the gel, and the window of its view that an image shows.

A window is the rectangle `(left, top, width, height)` in metres on the gel's outer face (z = 0) that an image shows. In
the image, x points to the right and y points down, so `left` and `top` are the smallest x and y. The optical axis is
perpendicular to the gel's outer face. The cost of an image depends on its number of pixels and not on the window.
"""

import dataclasses
import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sts_jax._ranges import LENGTH, POSITIVE

Scalar = float | Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Camera:
    """A pinhole on the sensor's z axis, looking out through the gel along +z."""

    # Distance from the pinhole to the gel's outer face (m). Source: paper's code, bottom of the block.
    distance: Scalar = dataclasses.field(default=0.1, metadata=POSITIVE | LENGTH)
    # Vertical field of view (rad). With the default (paper's code), the pad is as high as the image.
    fov: Scalar = dataclasses.field(default=2 * math.atan(0.75), metadata=POSITIVE | {"below": math.pi})
    # Width / height of the whole view. Source: device, 1640 x 1232 pixels, and paper's code, 640 x 480.
    aspect: Scalar = dataclasses.field(default=4 / 3, metadata=POSITIVE)
    # Smallest depth (m). A face of the object is not drawn if one of its corners is nearer to the pinhole.
    near: Scalar = dataclasses.field(default=0.02, metadata=POSITIVE | LENGTH)


def full_window(camera: Camera, resolution: tuple[int, int]) -> Float[Array, "4"]:
    """Largest centred window (m) in the view that has the aspect ratio of an image of (height, width) pixels."""
    ratio = resolution[1] / resolution[0]
    height = 2 * camera.distance * jnp.tan(jnp.asarray(camera.fov) / 2)
    width = jnp.minimum(height * camera.aspect, height * ratio)
    height = width / ratio
    return jnp.stack([-width / 2, -height / 2, width, height])


def object_window(
    camera: Camera, points: Float[Array, "v 3"], resolution: tuple[int, int], *, smallest: float | None = None
) -> Float[Array, "4"]:
    """Window (m) around an object (supplement of Rezaei-Shoshtari et al. 2021, "Training Details").

    The smallest window that contains the bounding box of the points, projected to the gel's outer face and clipped to
    the full window (`full_window`), has the aspect ratio of the image, lies within the full window and has a shorter
    side of at least `smallest` (m). If no point is in view, it is the full window.

    Args:
        camera: The camera.
        points: Points of the object in the sensor frame (m). Points nearer than `Camera.near` are ignored.
        resolution: Height and width of the image (pixels).
        smallest: Smallest length of the window's shorter side (m). None: a 30th of that of the full window, which are 5
            mm of the default view.
    """
    full = full_window(camera, resolution)
    lower, size = full[:2], full[2:]
    depth = points[:, 2] + camera.distance
    ahead = depth > camera.near
    seen = camera.distance * points[:, :2] / jnp.where(ahead, depth, 1)[:, None]
    first = jnp.min(jnp.where(ahead[:, None], seen, jnp.inf), axis=0)
    last = jnp.max(jnp.where(ahead[:, None], seen, -jnp.inf), axis=0)
    in_view = jnp.all((first < lower + size) & (last > lower))
    first, last = jnp.clip(first, lower, lower + size), jnp.clip(last, lower, lower + size)
    least = 1 / 30 if smallest is None else smallest / jnp.min(size)
    scale = jnp.max(jnp.maximum((last - first) / size, least))
    side = size * jnp.minimum(scale, 1)
    corner = jnp.clip((first + last - side) / 2, lower, lower + size - side)
    return jnp.where(in_view, jnp.concatenate([corner, side]), full)


def to_pixels(
    camera: Camera, window: Float[Array, "4"], shape: tuple[int, int], points: Float[Array, "v 3"]
) -> tuple[Float[Array, "v 2"], Float[Array, "v"]]:
    """Project points into an image.

    Args:
        camera: The camera.
        window: Window of the image (m).
        shape: Height and width of the image (pixels).
        points: Points in the sensor frame (m).

    Returns:
        Columns and rows (pixels), whole numbers at pixel centres, and depths along the optical axis (m). A point nearer
        than `Camera.near` is projected as if its depth were `Camera.near`, but its true depth is returned.
    """
    depth = points[:, 2] + camera.distance
    on_face = camera.distance * points[:, :2] / jnp.maximum(depth, camera.near)[:, None]
    scale = jnp.array([shape[1], shape[0]], jnp.float32) / window[2:]
    return (on_face - window[None, :2]) * scale[None, :] - 0.5, depth


def rays(
    camera: Camera, window: Float[Array, "4"], shape: tuple[int, int]
) -> tuple[Float[Array, "h w"], Float[Array, "h w"]]:
    """Slopes x / depth and y / depth of the camera rays through the pixel centres of an image.

    The point at depth D on a ray with the slopes (a, b) is (D a, D b, D - camera.distance) in the sensor frame.
    """
    x = (window[0] + (jnp.arange(shape[1]) + 0.5) / shape[1] * window[2]) / camera.distance
    y = (window[1] + (jnp.arange(shape[0]) + 0.5) / shape[0] * window[3]) / camera.distance
    x, y = jnp.meshgrid(x, y)
    return x, y
