"""Shading of the view through the skin: the lit object, its shadow on the skin, and the haze of the translucent gel.

Light is linear RGB, unless stated otherwise. As the last step of rendering, `to_srgb` converts the image to sRGB.
"""

import dataclasses
import functools
import operator
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sts_jax import _cpu_reductions, geometry
from sts_jax._ranges import LENGTH, NOT_NEGATIVE, POSITIVE, SHARE
from sts_jax._sampling import bilinear

Scalar = float | Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Room:
    """External light on the object, and the gel and skin through which the camera sees the object.

    The skin is a translucent paint. Colours are linear RGB, unless stated otherwise. Values for which no reference is
    cited are our choice.
    """

    # Light that reaches a surface from all sides, including the light that leaks through and under the object.
    ambient: Float[Array, "*n 3"] = dataclasses.field(
        default_factory=lambda: jnp.array([0.36, 0.36, 0.37]), metadata=NOT_NEGATIVE
    )
    # Directions from the object towards any number m of lights, sensor frame, of any length > 0. Defaults: a window, a
    # lamp, and the table, which reflects light.
    directions: Float[Array, "*n m 3"] = dataclasses.field(
        default_factory=lambda: jnp.array([[-0.8, -0.5, 0.1], [0.6, 0.3, 0.74], [0.4, -0.5, -0.77]])
    )
    # Light of each of these on a surface that faces it.
    colors: Float[Array, "*n m 3"] = dataclasses.field(
        default_factory=lambda: jnp.array([[0.7, 0.7, 0.68], [0.3, 0.29, 0.27], [0.3, 0.3, 0.31]]),
        metadata=NOT_NEGATIVE,
    )
    # Colour of the view without an object, sRGB. Source: paper's code, (178, 178, 204) / 255.
    background: Float[Array, "*n 3"] = dataclasses.field(
        default_factory=lambda: jnp.array([178.0, 178, 204]) / 255, metadata=SHARE
    )
    # Height above the skin at which 1/e of an object's light reaches the camera (m). Haze replaces the rest.
    haze: Scalar = dataclasses.field(default=3.0, metadata=POSITIVE | LENGTH)
    # Share of the background's light that is scattered by the skin. An object near the skin hides a part of it.
    milk: Scalar = dataclasses.field(default=0.25, metadata=SHARE)
    # Share of an object's light that skin and gel transmit, in each channel. The default is close to the hue of
    # the background.
    tint: Float[Array, "*n 3"] = dataclasses.field(default_factory=lambda: jnp.array([0.8, 0.8, 1.0]), metadata=SHARE)
    # Share of its light that the underside of an object on the skin loses where it hides the whole sky from the skin.
    crease: Scalar = dataclasses.field(default=0.4, metadata=SHARE)
    # Height above the skin at which this loss is 1/e as large (m).
    crease_height: Scalar = dataclasses.field(default=0.015, metadata=POSITIVE | LENGTH)
    # Share of light that is lost at the middle of the pad's edges. The loss grows with the square of the distance from
    # the pad's centre.
    vignette: Scalar = dataclasses.field(default=0.1, metadata=SHARE)
    # Brightness of the housing's walls just below the pad's edge, as an sRGB value relative to the pad's.
    rim: Scalar = dataclasses.field(default=0.3, metadata=NOT_NEGATIVE)
    # Depth below the skin at which the walls are 1/e as bright (m).
    rim_depth: Scalar = dataclasses.field(default=0.03, metadata=POSITIVE | LENGTH)
    # Exposure time of the visual stream divided by that of the tactile stream. `expose` uses it.
    exposure: Scalar = dataclasses.field(default=1.0, metadata=POSITIVE)


_SKY_CELLS = 30  # approximate number of cells along each side of the grid in `hidden_sky`
_SLICES = 4  # number of slices of an object in `hidden_sky`
_LOWEST = 0.01  # smallest height of a slice, relative to the mean side of the pad


def to_linear(srgb: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Convert sRGB values in [0, 1] to linear light (IEC 61966-2-1)."""
    high = srgb > 0.04045
    return jnp.where(high, (jnp.where(high, srgb + 0.055, 1) / 1.055) ** 2.4, srgb / 12.92)


def to_srgb(linear: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Convert linear light to sRGB values (IEC 61966-2-1)."""
    high = linear > 0.0031308
    return jnp.where(high, 1.055 * jnp.exp(jnp.log(jnp.where(high, linear, 1)) / 2.4) - 0.055, 12.92 * linear)


def sample_texture(texture: Float[Array, "t t 3"], uv: Float[Array, "*n 2"]) -> Float[Array, "*n 3"]:
    """Look up values in a square texture by bilinear interpolation. It repeats beyond its borders.

    u from 0 to 1 runs from the left to the right edge, and v from the top to the bottom.
    """
    size = texture.shape[0]
    if size == 1:
        return jnp.broadcast_to(texture[0], (*uv.shape[:-1], 3))
    place = uv * size - 0.5
    return bilinear(texture, place[..., 0], place[..., 1], wrap=True)


class Texels(NamedTuple):
    """Square textures of n bodies in one list of texels, row by row."""

    colors: Float[Array, "t 3"]  # linear light, [0, 1]
    first: Int[Array, "n"]  # place of the first texel of each texture
    side: Int[Array, "n"]  # number of rows of each texture


def sample_texels(texels: Texels, of: Int[Array, "*n"], uv: Float[Array, "*n 2"]) -> Float[Array, "*n 3"]:
    """`sample_texture` with the texture `of` for each point."""
    first, side = texels.first[of], texels.side[of]
    if texels.colors.shape[0] == texels.first.shape[0]:  # one texel for each
        return texels.colors[of]
    place = uv * side[..., None] - 0.5
    before = jnp.floor(place)
    x, y = (share[..., None] for share in jnp.moveaxis(place - before, -1, 0))
    left, top = jnp.moveaxis(before.astype(jnp.int32) % side[..., None], -1, 0)
    right, bottom = (left + 1) % side, (top + 1) % side
    upper = texels.colors[first + top * side + left] * (1 - x) + texels.colors[first + top * side + right] * x
    lower = texels.colors[first + bottom * side + left] * (1 - x) + texels.colors[first + bottom * side + right] * x
    return upper * (1 - y) + lower * y


def hidden_sky(
    heights: Float[Array, "r c"],
    size: tuple[Scalar, Scalar],
    top: Float[Array, ""],
    x: Float[Array, "w"],
    y: Float[Array, "h"],
) -> Float[Array, "h w"]:
    """Share of the sky that an object hides from points on the skin, weighted by the cosine to the vertical.

    The object is approximated by horizontal slices at a few heights z, from its lowest to its highest point. Within the
    outline of the object seen from above, the slice at z is opaque where the underside is below z, and transparent
    where it is above 2 z. In between, the opacity decreases linearly.

    The share of the sky that a half-plane at the height z hides from a point is `f(d) = (1 - d / sqrt(d^2 + z^2)) / 2`.
    Here d is the horizontal distance from the point to the edge of the half-plane, and d is negative if the half-plane
    extends over the point. A strip hides the difference of the shares of two half-planes. On a grid of about 30 x 30
    cells, the share that one cell of a slice hides is approximated by the share of the strip over its row times the
    share of the strip over its column, so

        hidden = max_z Y_z slice_z X_z^T

    slice_z is the opacity of the slice in each cell, times the fraction of the cell inside the outline. X_z[i, j] is
    the share that a strip over column j at the height z hides from the centre of column i, and Y_z likewise for rows.
    Quadratic splines interpolate between the cells.

    Args:
        heights: Heights of the object's underside above the gel's face (m), on a uniform grid over the pad, `inf` where
            there is no object. Row 0 has the smallest y, and column 0 has the smallest x.
        size: Width along x and height along y of the pad (m), centred on the sensor's z axis.
        top: Height of the object's highest point (m).
        x: x of each column of a grid of points on the skin (m).
        y: y of each row of this grid (m).

    Returns:
        Shares in [0, 1]. Points outside the pad have the share of the nearest point inside.
    """
    blocks = [max(1, round(cells / _SKY_CELLS)) for cells in heights.shape]
    padding = [(0, -cells % block) for cells, block in zip(heights.shape, blocks, strict=True)]

    def pool(value: Float[Array, "r c"]) -> Float[Array, "a b"]:
        value = jnp.pad(value, padding)
        value = functools.reduce(operator.add, (value[k :: blocks[0]] for k in range(blocks[0])))
        return functools.reduce(operator.add, (value[:, k :: blocks[1]] for k in range(blocks[1])))

    there = jnp.isfinite(heights)
    count = pool(there.astype(heights.dtype))
    height = pool(jnp.where(there, heights, 0)) / jnp.maximum(count, 1)
    covered = count / (blocks[0] * blocks[1])
    rows, columns = covered.shape
    pitch_y, pitch_x = (s / n * b for s, n, b in zip(size[::-1], heights.shape, blocks, strict=True))

    least = (size[0] + size[1]) * (_LOWEST / 2)
    lowest = jnp.clip(_cpu_reductions.minimum(jnp.min(heights, axis=0)), least, 1)
    highest = jnp.maximum(top, lowest)
    hidden = jnp.zeros_like(covered)
    for share in (k / (_SLICES - 1) for k in range(_SLICES)):
        z = lowest ** (1 - share) * highest**share
        part = covered * jnp.clip(2 - height / z, 0, 1) * (top > 0)
        hidden = jnp.maximum(hidden, _cast(rows, pitch_y / z) @ part @ _cast(columns, pitch_x / z).T)
    across = _spline(jnp.eye(columns), (x + size[0] / 2) / pitch_x - 0.5)
    return _spline(hidden @ across.T, (y + size[1] / 2) / pitch_y - 0.5)


def _cast(number: int, pitch: Scalar) -> Float[Array, "n n"]:
    """Share of the sky that strip j, one cell wide and at height 1, hides from the centre of cell i, at [i, j]."""
    index = jnp.arange(number, dtype=jnp.float32)
    away = (index[None, :] - index[:, None] - 0.5) * pitch
    edge = away + pitch
    return 0.5 * (edge / jnp.sqrt(edge * edge + 1) - away / jnp.sqrt(away * away + 1))


def _spline(rows: Float[Array, "n k"], place: Float[Array, "m"]) -> Float[Array, "m k"]:
    """Evaluate a quadratic spline. Row i of `rows` is the control point at position i. It is constant outside."""
    last = rows.shape[0] - 1
    place = jnp.clip(place, 0, last)
    nearest = jnp.round(place)
    off = (place - nearest)[:, None]
    weights = 0.5 * (0.5 - off) ** 2, 0.75 - off * off, 0.5 * (0.5 + off) ** 2
    index = nearest.astype(jnp.int32)
    before, behind = jnp.maximum(index - 1, 0), jnp.minimum(index + 1, last)
    return weights[0] * rows[before] + weights[1] * rows[index] + weights[2] * rows[behind]


def housing(
    room: Room,
    on_pad: Bool[Array, "*n"],
    places: Float[Array, "*n 2"],
    size: tuple[Scalar, Scalar],
    distance: Scalar,
) -> Float[Array, "*n"]:
    """Brightness of the sensor's housing, which the camera sees beside the pad, relative to the pad (sRGB ratio).

    A dark wall extends from each edge of the pad towards the camera. At the depth t below the gel's outer face, its
    brightness is `rim exp(-t / rim_depth)`, with the fields of `room`.

    Args:
        room: Constants of the external light.
        on_pad: True for rays that pass through the pad, where the result is 1.
        places: x and y at which the rays cross the plane of the gel's outer face (m).
        size: Width along x and height along y of the pad (m).
        distance: Distance from the pinhole to the plane of the gel's outer face (m).
    """
    beyond = jnp.maximum(2 * jnp.abs(places[..., 0]) / size[0], 2 * jnp.abs(places[..., 1]) / size[1])
    below = distance * (1 - 1 / jnp.maximum(beyond, 1))
    return jnp.where(on_pad, 1, room.rim * jnp.exp(-below / room.rim_depth))


def empty_view(
    room: Room, square_radius: Float[Array, "*n"], walls: Float[Array, "*n"], hidden: Float[Array, "*n"]
) -> Float[Array, "*n 3"]:
    """Linear light of the pad and the housing's walls with the shadow of the object, but without the object.

    Args:
        room: Constants of the external light.
        square_radius: `(2 x / width)^2 + (2 y / height)^2` on the pad, 1 at the middle of each edge.
        walls: Brightness from `housing`, a ratio of sRGB values. Its square approximates the ratio of linear light.
        hidden: Share of the sky that the object hides, from `hidden_sky`.
    """
    light = (1 - room.vignette * square_radius) * walls * walls * (1 - room.milk * hidden)
    return jnp.maximum(light, 0)[..., None] * jnp.broadcast_to(to_linear(room.background), (*light.shape, 3))


def shade(
    room: Room,
    albedo: Float[Array, "*n 3"],
    normals: Float[Array, "*n 3"],
    heights: Float[Array, "*n"],
    empty: Float[Array, "*n 3"],
    hidden: Float[Array, "*n"],
) -> Float[Array, "*n 3"]:
    """Linear light of an object as seen through the skin.

    1. Lambert's law: `albedo * (ambient + sum_m max(0, L_m . N) c_m)`, with the normal N, and the unit direction L_m
    and
       colour c_m of each light m.
    2. Contact shade: the share `crease * hidden * exp(-height / crease_height)` of this light is lost.
    3. Haze: the share `t = exp(-height / haze)` of the remaining light is transmitted and multiplied by `tint`. The
       share `1 - t` of the background `empty` is added.
    4. Milky skin: the share `1 - milk` of the result is transmitted. The skin adds `milk * (1 - hidden)` times the
       light that the camera would receive at the same pixels without the object.

    Args:
        room: Constants of the external light.
        albedo: Linear RGB colour of the object in [0, 1].
        normals: Unit normals of the object.
        heights: Heights of the object's points above the gel's outer face (m). Negative heights count as 0.
        empty: Background at the same pixels, with the object's shadow, from `empty_view`.
        hidden: Share of the sky that the object hides from the skin at the same pixels, from `hidden_sky`.
    """
    # Channel by channel, because XLA on a CPU is slow along an axis of three.
    directions, colors = geometry.normalize(room.directions), room.colors
    ambient, tint = jnp.asarray(room.ambient), jnp.asarray(room.tint)
    incidence = [jnp.maximum(_dot(direction, normals), 0) for direction in directions]
    heights = jnp.maximum(heights, 0)
    lit = 1 - room.crease * hidden * jnp.exp(-heights / room.crease_height)
    through = jnp.exp(-heights / room.haze)
    # `empty` lacks the hidden part of the scattered light, so divide by its remaining share.
    veil = room.milk * (1 - hidden) / jnp.maximum(1 - room.milk * hidden, 1e-3)
    channels = []
    for k in range(3):
        light = jnp.broadcast_to(ambient[k], heights.shape)
        for share, color in zip(incidence, colors, strict=True):
            light += share * color[k]
        seen = through * lit * tint[k] * albedo[..., k] * light + (1 - through) * empty[..., k]
        channels.append((1 - room.milk) * seen + veil * empty[..., k])
    return jnp.stack(channels, axis=-1)


def _dot(direction: Float[Array, "3"], vectors: Float[Array, "*n 3"]) -> Float[Array, "*n"]:
    return direction[0] * vectors[..., 0] + direction[1] * vectors[..., 1] + direction[2] * vectors[..., 2]
