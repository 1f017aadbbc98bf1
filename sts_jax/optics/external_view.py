"""Pictures of triangles from any viewpoint outside the sensor, drawn by the sensor's rasteriser."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sts_jax import geometry
from sts_jax.optics.camera import Camera, full_window, rays, to_pixels
from sts_jax.optics.shading import to_srgb
from sts_jax.optics.zbuffer import barycentrics, pixel_centres, rasterise

_SKY, _GROUND = (0.62, 0.64, 0.68), (0.34, 0.33, 0.32)  # linear light from above and from below
_LAMP = (0.45, 0.43, 0.40)  # linear light of a lamp over the viewer's left shoulder
_SAMPLES = 3  # samples along each side of a pixel


def photograph(
    vertices: Float[Array, "v 3"],
    faces: Int[Array, "f 3"],
    normals: Float[Array, "f 3 3"],
    albedo: Float[Array, "f 3 3"],
    *,
    eye: Float[Array, "3"],
    target: Float[Array, "3"],
    fov: float = 0.5,
    resolution: tuple[int, int] = (200, 200),
    two_sided: Bool[Array, ""] | bool = False,
) -> Float[Array, "h w 3"]:
    """Draw triangles as seen from any viewpoint, in daylight and lamplight, before a white background. +z is up.

    Args:
        faces: Vertex indices of each face, counter-clockwise as seen from outside the object.
        albedo: Linear RGB colour in [0, 1] at each corner of each face.
        eye: Position of the camera (m). It must not be straight above or below the target.
        target: Point in the middle of the picture (m).
        fov: Vertical field of view (rad).

    Returns:
        Picture, sRGB in [0, 1].
    """
    eye = jnp.asarray(eye, jnp.float32)
    forward = geometry.normalize(jnp.asarray(target, jnp.float32) - eye)
    right = geometry.normalize(jnp.cross(forward, jnp.array([0.0, 0.0, 1.0])))
    turn = jnp.stack([right, jnp.cross(forward, right), forward])
    shape = (resolution[0] * _SAMPLES, resolution[1] * _SAMPLES)
    # The pinhole of a `Camera` is at z = -distance. The origin is therefore the point one metre ahead of the eye.
    camera = Camera(distance=1.0, fov=fov, aspect=resolution[1] / resolution[0], near=0.01)
    window = full_window(camera, shape)
    points = (vertices - eye) @ turn.T - jnp.array([0.0, 0.0, 1.0])
    pixels, depth = to_pixels(camera, window, shape, points)
    inverse = 1 / jnp.maximum(depth, 0.01)
    winner = rasterise(pixels, -inverse, faces, depth > 0.01, jnp.asarray(two_sided), shape)
    nearest = jnp.maximum(winner, 0)
    places = [pixels[faces[:, k]][nearest] for k in range(3)]
    weights = barycentrics([(place[..., 0], place[..., 1]) for place in places], *pixel_centres(shape))
    shares = [w * inverse[faces[:, k]][nearest] for k, w in enumerate(weights)]
    total = shares[0] + shares[1] + shares[2]
    corners = jnp.concatenate([normals, albedo], -1)[nearest]
    values = jnp.einsum("hwk,hwkc->hwc", jnp.stack(shares, -1) / total[..., None], corners)

    x, y = rays(camera, window, shape)
    ray = jnp.stack([x, y, jnp.ones_like(x)], -1) @ turn
    normal = geometry.normalize(values[..., :3])
    normal = jnp.where(jnp.sum(normal * ray, -1, keepdims=True) > 0, -normal, normal)
    lamp = geometry.normalize(-forward - 0.6 * right + jnp.array([0.0, 0.0, 0.8]))
    up = 0.5 + 0.5 * normal[..., 2:]
    light = up * jnp.array(_SKY) + (1 - up) * jnp.array(_GROUND)
    light += jnp.maximum(normal @ lamp, 0)[..., None] * jnp.array(_LAMP)
    image = jnp.where((winner >= 0)[..., None], to_srgb(values[..., 3:] * light), 1.0)
    image = image.reshape(resolution[0], _SAMPLES, resolution[1], _SAMPLES, 3).mean((1, 3))
    return jnp.clip(image, 0, 1)
