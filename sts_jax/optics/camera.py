"""The pinhole camera below the gel, and the part of its view that an image shows.

A window is the rectangle `(left, top, width, height)` in metres on the gel's outer face (z = 0) that an image shows. In
the image, x points to the right and y points down. `left` is therefore the smallest x of the window, and `top` is its
smallest y. The optical axis is perpendicular to the gel's outer face. The cost of an image depends on its number of
pixels and not on the window.
"""

import dataclasses
import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sts_jax._ranges import POSITIVE

Scalar = float | Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Camera:
    """A pinhole on the sensor's z axis, looking out through the gel along +z."""

    # Distance from the pinhole to the gel's outer face (m). Source: paper's code, bottom of the block.
    distance: Scalar = dataclasses.field(default=0.1, metadata=POSITIVE)
    # Vertical field of view (rad). With the default (paper's code), the pad is as high as the image.
    fov: Scalar = dataclasses.field(default=2 * math.atan(0.75), metadata=POSITIVE | {"below": math.pi})
    # Width / height of the whole view. Source: device, 1640 x 1232 pixels, and paper's code, 640 x 480.
    aspect: Scalar = dataclasses.field(default=4 / 3, metadata=POSITIVE)
    # Smallest depth (m). A face of the object is not drawn if one of its corners is nearer to the pinhole.
    near: Scalar = dataclasses.field(default=0.02, metadata=POSITIVE)


def full_window(camera: Camera, resolution: tuple[int, int]) -> Float[Array, "4"]:
    """Compute the largest centred window in the camera's view that has the aspect ratio of an image.

    A window is the rectangle on the gel's outer face that an image shows.

    Args:
        camera: The camera.
        resolution: Height and width of the image (pixels).

    Returns:
        Left edge (smallest x), top edge (smallest y), width along x and height along y of the window (m).
    """
    ratio = resolution[1] / resolution[0]
    height = 2 * camera.distance * jnp.tan(jnp.asarray(camera.fov) / 2)
    width = jnp.minimum(height * camera.aspect, height * ratio)
    height = width / ratio
    return jnp.stack([-width / 2, -height / 2, width, height])


def object_window(
    camera: Camera, points: Float[Array, "v 3"], resolution: tuple[int, int], *, smallest: float = 0.005
) -> Float[Array, "4"]:
    """Compute a window around an object.

    Source: the supplement of Rezaei-Shoshtari et al. 2021, "Training Details".

    A window is the rectangle on the gel's outer face that an image shows. The full window (`full_window`) is the
    largest centred window in the camera's view that has the aspect ratio of the image. The points are projected to the
    gel's outer face. If their bounding box does not overlap the full window, the result is the full window. Otherwise,
    the box is clipped to the full window. The result is then the smallest window that contains the clipped box, has the
    aspect ratio of the image, lies within the full window and has a shorter side of at least `smallest`.

    Args:
        camera: The camera.
        points: Points of the object in the sensor frame (m). Points nearer than `Camera.near` are ignored.
        resolution: Height and width of the image (pixels).
        smallest: Smallest allowed length of the window's shorter side (m).

    Returns:
        Left edge (smallest x), top edge (smallest y), width along x and height along y of the window (m).
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
    scale = jnp.max(jnp.maximum((last - first) / size, smallest / jnp.min(size)))
    side = size * jnp.minimum(scale, 1)
    corner = jnp.clip((first + last - side) / 2, lower, lower + size - side)
    return jnp.where(in_view, jnp.concatenate([corner, side]), full)


def to_pixels(
    camera: Camera, window: Float[Array, "4"], shape: tuple[int, int], points: Float[Array, "v 3"]
) -> tuple[Float[Array, "v 2"], Float[Array, "v"]]:
    """Project points into an image.

    Args:
        camera: The camera.
        window: Rectangle that the image shows on the gel's outer face (z = 0, on which objects lie): x of the left
            edge, y of the top edge (the smallest y), width, height (m), in the sensor frame.
        shape: Height and width of the image (pixels).
        points: Points in the sensor frame (m).

    Returns:
        Columns and rows of the points (pixels), and depths of the points along the optical axis from the pinhole (m).
        The column and the row are whole numbers at the centre of a pixel. A point nearer than `Camera.near` is
        projected as if its depth were `Camera.near`, but its true depth is returned.
    """
    depth = points[:, 2] + camera.distance
    on_face = camera.distance * points[:, :2] / jnp.maximum(depth, camera.near)[:, None]
    scale = jnp.array([shape[1], shape[0]], jnp.float32) / window[2:]
    return (on_face - window[None, :2]) * scale[None, :] - 0.5, depth


def rays(
    camera: Camera, window: Float[Array, "4"], shape: tuple[int, int]
) -> tuple[Float[Array, "h w"], Float[Array, "h w"]]:
    """Compute the slopes x / depth and y / depth of the camera rays through the pixel centres.

    Args:
        camera: The camera.
        window: Rectangle that the image shows on the gel's outer face: left, top, width, height (m).
        shape: Height and width of the image (pixels).

    Returns:
        Slopes in x and in y. The point at depth D on a ray with the slopes (a, b) is (D a, D b, D - camera.distance) in
        the sensor frame.
    """
    x = (window[0] + (jnp.arange(shape[1]) + 0.5) / shape[1] * window[2]) / camera.distance
    y = (window[1] + (jnp.arange(shape[0]) + 0.5) / shape[0] * window[3]) / camera.distance
    x, y = jnp.meshgrid(x, y)
    return x, y
