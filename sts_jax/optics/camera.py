"""The pinhole under the gel, and the part of its view that an image shows.

A window is `(left, top, width, height)` in metres on the gel's outer face (z = 0), to which the optical axis is
perpendicular. A smaller window is a smaller frustum, so a crop costs its own pixels only.
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

    # m, from the pinhole to the gel's outer face (paper's code: bottom of the block)
    distance: Scalar = dataclasses.field(default=0.1, metadata=POSITIVE)
    # rad, vertical field of view (paper's code): the pad is as high as the image
    fov: Scalar = dataclasses.field(default=2 * math.atan(0.75), metadata=POSITIVE | {"below": math.pi})
    # width / height of the native view (device: 1640x1232, paper's code: 640x480)
    aspect: Scalar = dataclasses.field(default=4 / 3, metadata=POSITIVE)
    # m, a face with a corner nearer to the pinhole than this is not drawn
    near: Scalar = dataclasses.field(default=0.02, metadata=POSITIVE)


def full_window(camera: Camera, resolution: tuple[int, int]) -> Float[Array, "4"]:
    """The largest centred part of the view with the aspect ratio of an image, which is then not stretched.

    Args:
        camera: the pinhole.
        resolution: (height, width) of the image, pixels.

    Returns:
        Window (m).
    """
    ratio = resolution[1] / resolution[0]
    height = 2 * camera.distance * jnp.tan(jnp.asarray(camera.fov) / 2)
    width = jnp.minimum(height * camera.aspect, height * ratio)
    height = width / ratio
    return jnp.stack([-width / 2, -height / 2, width, height])


def object_window(
    camera: Camera, points: Float[Array, "v 3"], resolution: tuple[int, int], *, smallest: float = 0.005
) -> Float[Array, "4"]:
    """The window around an object with the aspect ratio of an image, as in the paper (supplement, "Training Details").

    It is the smallest one that lies in the full window and contains the visible part of the bounding box of the
    projected points. Points nearer than `near` do not count. If nothing is in view, it is the full window.

    Args:
        camera: the pinhole.
        points: points of the object, sensor frame (m).
        resolution: (height, width) of the image, pixels.
        smallest: minimum length of the shorter side (m).

    Returns:
        Window (m).
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
    """Project points into an image: `(column, row)`, whole numbers at pixel centres, and depth.

    Args:
        camera: the pinhole.
        window: part of the gel's face in the image (m).
        shape: (height, width) of the image, pixels.
        points: sensor frame (m).

    Returns:
        Columns and rows (pixels), and depth along the optical axis (m). Points nearer than `camera.near` are projected
        as if they were at this depth.
    """
    depth = points[:, 2] + camera.distance
    on_face = camera.distance * points[:, :2] / jnp.maximum(depth, camera.near)[:, None]
    scale = jnp.array([shape[1], shape[0]], jnp.float32) / window[2:]
    return (on_face - window[None, :2]) * scale[None, :] - 0.5, depth


def rays(
    camera: Camera, window: Float[Array, "4"], shape: tuple[int, int]
) -> tuple[Float[Array, "h w"], Float[Array, "h w"]]:
    """Slopes (x / depth, y / depth) of the rays through the pixel centres.

    Args:
        camera: the pinhole.
        window: part of the gel's face in the image (m).
        shape: (height, width) of the image, pixels.

    Returns:
        Both slopes, x and y. The point at depth D on a ray is (D x, D y, D - camera.distance).
    """
    x = (window[0] + (jnp.arange(shape[1]) + 0.5) / shape[1] * window[2]) / camera.distance
    y = (window[1] + (jnp.arange(shape[0]) + 0.5) / shape[0] * window[3]) / camera.distance
    x, y = jnp.meshgrid(x, y)
    return x, y
