"""Renders an object and the sensor's pad as seen from outside the sensor, obliquely from above."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, ScalarLike

from sts_jax import geometry, optics
from sts_jax.objects import Body

_THICKNESS = 0.012  # m, thickness of the box that is drawn as the housing of the sensor
_PAD = optics.to_linear(jnp.array([178.0, 178.0, 204.0]) / 255)
_HOUSING = jnp.array([0.05, 0.05, 0.055])


@functools.partial(jax.jit, static_argnames=("resolution",))
def outside(
    body: Body,
    pose: Float[Array, "7"],
    size: Float[Array, "2"],
    up: Float[Array, "3"] | None = None,
    wall: ScalarLike = 0.0,
    *,
    resolution: tuple[int, int] = (160, 160),
) -> Float[Array, "h w 3"]:
    """Render the object and the pad from outside, obliquely from above.

    Args:
        body: The object.
        pose: Pose of the object's mesh frame in the sensor frame, position (m) and quaternion (w, x, y, z). The mesh
            frame is the coordinate system of the vertices. The face of the pad is the plane z = 0 of the sensor frame.
        size: Size of the pad along x and y (m).
        up: Vector of any length that points upwards, in the sensor frame. It determines the tilt of the pad (default:
            the pad is level).
        wall: Height of the stop wall at the edge of the pad with the largest y (m). 0 draws no wall.
        resolution: Height h and width w of the image (pixels).

    Returns:
        Image, sRGB in [0, 1].
    """
    half = jnp.stack([size[0], size[1], jnp.float32(_THICKNESS)]) / 2
    corners = jnp.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-2, 0)], jnp.float32)
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    box = jnp.asarray(np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]), jnp.int32)
    thick = half[:2] + jnp.array([0.0, 0.003]) * (jnp.asarray(wall) > 0)
    stop = jnp.stack(
        [jnp.stack([x * half[0], y, z * wall]) for x in (-1, 1) for y in (half[1], thick[1]) for z in (0, 1)]
    )
    vertices = jnp.concatenate([geometry.transform(pose, body.vertices), corners * half, stop])
    faces = jnp.concatenate([body.faces, box + len(body.vertices), box + len(body.vertices) + 8])
    flat = jnp.array([[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]], jnp.float32)
    flat = jnp.broadcast_to(jnp.tile(flat, (4, 1))[:, None], (24, 3, 3))
    normals = jnp.concatenate([body.normals @ geometry.quat_to_matrix(pose[3:]).T, flat])
    top = (flat[..., 2:] > 0) & (jnp.arange(24) < 12)[:, None, None]
    if up is not None:
        axis, along = jnp.cross(up, jnp.array([0.0, 0.0, 1.0])), geometry.norm(up)
        level = geometry.quat_from_rotvec(
            geometry.normalize(axis) * jnp.arctan2(geometry.norm(axis) / along, up[2] / along)
        )
        vertices, normals = (x @ geometry.quat_to_matrix(level).T for x in (vertices, normals))
    albedo = body.colors * optics.sample_texture(body.texture, body.uv)
    albedo = jnp.concatenate([albedo, jnp.where(top, _PAD, _HOUSING)])
    return optics.photograph(
        vertices,
        faces,
        normals,
        albedo,
        eye=jnp.array([0.25, 0.53, 0.38]),
        target=jnp.array([0.0, 0.0, 0.03]),
        fov=0.44,
        resolution=resolution,
        two_sided=body.two_sided,
    )
