"""The pinhole under the gel, and the part of its view that an image shows.

A window is `(left, top, width, height)` in metres on the gel's outer face (z = 0), which the camera sees square on:
a smaller window is a smaller frustum, so a crop costs its own pixels and no more.
"""

import dataclasses
import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Scalar = float | Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Camera:
    """A pinhole on the sensor's z axis, looking out through the gel along +z."""

    distance: Scalar = 0.1  # m, from the pinhole to the gel's outer face (the original's camera: bottom of the block)
    fov: Scalar = 2 * math.atan(0.75)  # rad, vertical field of view (the original's): the pad's edges touch the image's
    aspect: Scalar = 4 / 3  # width / height of the native view (the device's 1640x1232, the original's 640x480)
    near: Scalar = 0.02  # m, a face with a corner nearer to the pinhole than this is not drawn


def full_window(camera: Camera, resolution: tuple[int, int]) -> Float[Array, "4"]:
    """The largest centred part of the view that has the aspect of an image: nothing is squeezed.

    Args:
        camera: whose view it is.
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
    """The window of an image's aspect around an object, as the paper crops (supplement, "Training Details").

    It is as small as it can be while it holds all that the full window shows of the projected points in front of the
    camera, and it never leaves the full window. With nothing in view it is the full window.

    Args:
        camera: whose view it is.
        points: points of the object, sensor frame (m).
        resolution: (height, width) of the image, pixels.
        smallest: shortest side (m).

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
    """Where points land in an image: `(column, row)`, whole numbers at pixel centres, and their depth.

    Args:
        camera: the pinhole.
        window: what the image shows (m).
        shape: (height, width) of the image, pixels.
        points: sensor frame (m).

    Returns:
        Columns and rows (pixels), and depth along the optical axis (m). Points nearer than `camera.near` are
        projected from there.
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
        window: what the image shows (m).
        shape: (height, width) of the image, pixels.

    Returns:
        Both slopes; the point at depth D on a ray is (D x, D y, D - camera.distance).
    """
    x = (window[0] + (jnp.arange(shape[1]) + 0.5) / shape[1] * window[2]) / camera.distance
    y = (window[1] + (jnp.arange(shape[0]) + 0.5) / shape[0] * window[3]) / camera.distance
    x, y = jnp.meshgrid(x, y)
    return x, y
