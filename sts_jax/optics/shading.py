"""How the world above looks through the skin: a lit object in the haze of a translucent gel.

Light is added up in linear units; `to_srgb` is the last step of an image.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sts_jax import _math

Scalar = float | Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Room:
    """The light above the sensor, and what the skin does to it on the way to the camera. Constants are ours."""

    # light that reaches a surface from all sides, what leaks through and under the object included
    ambient: Float[Array, "*n 3"] = dataclasses.field(default_factory=lambda: jnp.array([0.36, 0.36, 0.37]))
    # unit vectors from the object towards a window, a lamp and what the table throws back up
    directions: Float[Array, "*n m 3"] = dataclasses.field(
        default_factory=lambda: jnp.array([[-0.8, -0.5, 0.1], [0.6, 0.3, 0.74], [0.4, -0.5, -0.77]])
    )
    colors: Float[Array, "*n m 3"] = dataclasses.field(
        default_factory=lambda: jnp.array([[0.7, 0.7, 0.68], [0.3, 0.29, 0.27], [0.3, 0.3, 0.31]])
    )
    # sRGB of the empty view; the original's (178, 178, 204) / 255
    background: Float[Array, "*n 3"] = dataclasses.field(default_factory=lambda: jnp.array([178.0, 178, 204]) / 255)
    haze: Scalar = 0.3  # m, height over the skin at which 1/e of an object's own light comes through
    vignette: Scalar = 0.1  # share of light lost at the pad's edge, as the square of the distance from the centre
    exposure: Scalar = 1.0  # how many times longer the camera exposes for the view than for the lit skin (`expose`)
    rim: Scalar = 0.35  # brightness of what lies beyond the pad's edges, of the background's


def to_linear(srgb: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Linear light of sRGB values in [0, 1] (IEC 61966-2-1)."""
    high = srgb > 0.04045
    return jnp.where(high, (jnp.where(high, srgb + 0.055, 1) / 1.055) ** 2.4, srgb / 12.92)


def to_srgb(linear: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """sRGB of linear light (IEC 61966-2-1)."""
    high = linear > 0.0031308
    return jnp.where(high, 1.055 * jnp.where(high, linear, 1) ** (1 / 2.4) - 0.055, 12.92 * linear)


def sample_texture(texture: Float[Array, "t t 3"], uv: Float[Array, "h w 2"]) -> Float[Array, "h w 3"]:
    """Bilinear look-up; u runs to the right, v = 0 is the top row, and both wrap.

    Args:
        texture: any values.
        uv: texture coordinates.

    Returns:
        Values.
    """
    size = texture.shape[0]
    if size == 1:
        return jnp.broadcast_to(texture, (*uv.shape[:2], 3))
    place = uv * size - 0.5
    low = jnp.floor(place)
    part = place - low
    low = low.astype(jnp.int32) % size
    high = (low + 1) % size
    x0, y0, x1, y1 = low[..., 0], low[..., 1], high[..., 0], high[..., 1]
    px, py = part[..., :1], part[..., 1:]
    top = texture[y0, x0] * (1 - px) + texture[y0, x1] * px
    bottom = texture[y1, x0] * (1 - px) + texture[y1, x1] * px
    return top * (1 - py) + bottom * py


def empty_view(room: Room, square_radius: Float[Array, "h w"], on_pad: Float[Array, "h w"]) -> Float[Array, "h w 3"]:
    """What is seen where there is no object, in linear light.

    Args:
        room: its constants.
        square_radius: of the place on the gel's face, from the pad's centre, over half the pad's side.
        on_pad: 1 where the ray passes through the pad, 0 beyond it.

    Returns:
        Image in linear light.
    """
    light = (1 - room.vignette * square_radius) * (room.rim + (1 - room.rim) * on_pad)
    return jnp.maximum(light, 0)[..., None] * to_linear(jnp.asarray(room.background))[None, None, :]


def shade(
    room: Room,
    albedo: Float[Array, "h w 3"],
    normals: Float[Array, "h w 3"],
    heights: Float[Array, "h w"],
    empty: Float[Array, "h w 3"],
) -> Float[Array, "h w 3"]:
    """Colour of an object seen through the skin.

    Lambert's law under ambient and directional light, `E = ambient + sum_m max(0, L_m . N) c_m`; then the skin's haze:
    `exp(-height / haze)` of it comes through, and the empty view takes the rest.

    Args:
        room: its constants.
        albedo: linear, in [0, 1].
        normals: unit.
        heights: over the gel's face (m).
        empty: from `empty_view`.

    Returns:
        Image in linear light.
    """
    incidence = jnp.maximum(normals @ _math.normalize(room.directions).T, 0)
    lit = albedo * (jnp.asarray(room.ambient)[None, None, :] + incidence @ room.colors)
    through = jnp.exp(-jnp.maximum(heights, 0) / room.haze)[..., None]
    return through * lit + (1 - through) * empty
