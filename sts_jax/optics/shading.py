"""Shading of the view through the skin: the lit object, its shadow on the skin, and the haze of the translucent gel.

Light is linear RGB, unless stated otherwise. As the last step of rendering, `to_srgb` converts the image to sRGB. In
the shapes of arguments, `*n` stands for any number of leading axes.
"""

import dataclasses
import functools
import operator

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sts_jax import _cpu_reductions, geometry
from sts_jax._ranges import NOT_NEGATIVE, POSITIVE, SHARE
from sts_jax._sampling import bilinear

Scalar = float | Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Room:
    """Constants of the external light on the object, and of the gel and skin through which the camera sees the object.

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
    haze: Scalar = dataclasses.field(default=3.0, metadata=POSITIVE)
    # Share of the background's light that is scattered by the skin. An object near the skin hides a part of it.
    milk: Scalar = dataclasses.field(default=0.25, metadata=SHARE)
    # Share of an object's light that skin and gel transmit, in each channel. The default is close to the hue of
    # the background.
    tint: Float[Array, "*n 3"] = dataclasses.field(default_factory=lambda: jnp.array([0.8, 0.8, 1.0]), metadata=SHARE)
    # Share of its light that the underside of an object on the skin loses where it hides the whole sky from the skin.
    crease: Scalar = dataclasses.field(default=0.4, metadata=SHARE)
    # Height above the skin at which this loss is 1/e as large (m).
    crease_height: Scalar = dataclasses.field(default=0.015, metadata=POSITIVE)
    # Share of light that is lost at the middle of the pad's edges. The loss grows with the square of the distance from
    # the pad's centre.
    vignette: Scalar = dataclasses.field(default=0.1, metadata=SHARE)
    # Brightness of the housing's walls just below the pad's edge, as an sRGB value relative to the pad's.
    rim: Scalar = dataclasses.field(default=0.3, metadata=NOT_NEGATIVE)
    # Depth below the skin at which the walls are 1/e as bright (m).
    rim_depth: Scalar = dataclasses.field(default=0.03, metadata=POSITIVE)
    # Exposure time of the visual stream divided by that of the tactile stream. `expose` uses it.
    exposure: Scalar = dataclasses.field(default=1.0, metadata=POSITIVE)


_SKY_CELLS = 30  # approximate number of cells along each side of the grid in `hidden_sky`
_SLICES = 4  # number of slices of an object in `hidden_sky`
_LOWEST = 0.0015  # m, smallest height of a slice


def to_linear(srgb: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Convert sRGB values in [0, 1] to linear light (IEC 61966-2-1)."""
    high = srgb > 0.04045
    return jnp.where(high, (jnp.where(high, srgb + 0.055, 1) / 1.055) ** 2.4, srgb / 12.92)


def to_srgb(linear: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Convert linear light to sRGB values (IEC 61966-2-1)."""
    high = linear > 0.0031308
    return jnp.where(high, 1.055 * jnp.exp(jnp.log(jnp.where(high, linear, 1)) / 2.4) - 0.055, 12.92 * linear)


def sample_texture(texture: Float[Array, "t t 3"], uv: Float[Array, "*n 2"]) -> Float[Array, "*n 3"]:
    """Look up values in a texture by bilinear interpolation. The texture repeats beyond its borders.

    Args:
        texture: Square texture of any values.
        uv: Texture coordinates. u from 0 to 1 runs from the left to the right edge, and v from the top to the bottom.

    Returns:
        Values at the coordinates.
    """
    size = texture.shape[0]
    if size == 1:
        return jnp.broadcast_to(texture[0], (*uv.shape[:-1], 3))
    place = uv * size - 0.5
    return bilinear(texture, place[..., 0], place[..., 1], wrap=True)


def hidden_sky(
    heights: Float[Array, "r c"],
    size: tuple[Scalar, Scalar],
    top: Float[Array, ""],
    x: Float[Array, "w"],
    y: Float[Array, "h"],
) -> Float[Array, "h w"]:
    """Compute the share of the sky that an object hides from points on the skin, which is the paint on the gel's face.

    Parts of the sky are weighted by the cosine of their angle to the vertical. The object is approximated by horizontal
    slices at a few heights z, from its lowest to its highest point. Each slice has the outline of the object as seen
    from above. Within the outline, the slice at z is opaque where the underside of the object is below z, and
    transparent where the underside is above 2 z. In between, the opacity decreases linearly from 1 to 0.

    The share of the sky that a half-plane at the height z hides from a point is `f(d) = (1 - d / sqrt(d^2 + z^2)) / 2`.
    Here d is the horizontal distance from the point to the edge of the half-plane, and d is negative if the half-plane
    extends over the point. A strip between two parallel lines is the difference of two half-planes, and it hides the
    difference of their shares. The shares are computed on a grid of about 30 x 30 cells. The share that one cell of a
    slice hides is approximated by the share of the strip over its row times the share of the strip over its column.
    The sum over all cells of a slice is therefore a product of three matrices:

        hidden = max_z Y_z slice_z X_z^T

    slice_z is the opacity of the slice in each cell, times the fraction of the cell's area that is inside the outline.
    X_z[i, j] is the share of the sky that a strip over column j at the height z hides from the centre of column i. Y_z
    is the same matrix for rows instead of columns. The maximum over the slices is taken in each cell. Quadratic splines
    interpolate between the cells.

    Args:
        heights: Heights of the object's underside above the gel's face (m), on a uniform grid of r rows and c columns
            over the pad, `inf` where there is no object. Row 0 has the smallest y, and column 0 has the smallest x.
        size: Width along x and height along y of the pad (m). The pad is centred on the sensor's z axis.
        top: Height of the object's highest point (m).
        x: x coordinate of each column of a grid of points on the skin (m).
        y: y coordinate of each row of this grid (m).

    Returns:
        Shares from 0 to 1 at the points of the grid. Points outside the pad have the share of the nearest point inside.
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

    lowest = jnp.clip(_cpu_reductions.minimum(jnp.min(heights, axis=0)), _LOWEST, 1)
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
    """Compute the brightness of the sensor's housing, which the camera sees beside the pad.

    The housing has a dark wall at each edge of the pad. Each wall is perpendicular to the gel's outer face and extends
    towards the camera. A camera ray that passes beside the pad ends at a wall. The brightness of a wall decreases with
    the distance t from the plane of the gel's outer face: `rim exp(-t / rim_depth)`. `rim` and `rim_depth` (m) are
    fields of the argument `room`.

    Args:
        room: Constants of the external light.
        on_pad: True for rays that pass through the pad.
        places: x and y at which the rays cross the plane of the gel's outer face (m).
        size: Width along x and height along y of the pad (m).
        distance: Distance from the pinhole to the plane of the gel's outer face (m).

    Returns:
        Brightness for each ray, as an sRGB value divided by the sRGB value of the pad. It is 1 on the pad, and at most
        `rim` on the walls.
    """
    beyond = jnp.maximum(2 * jnp.abs(places[..., 0]) / size[0], 2 * jnp.abs(places[..., 1]) / size[1])
    below = distance * (1 - 1 / jnp.maximum(beyond, 1))
    return jnp.where(on_pad, 1, room.rim * jnp.exp(-below / room.rim_depth))


def empty_view(
    room: Room, square_radius: Float[Array, "*n"], walls: Float[Array, "*n"], hidden: Float[Array, "*n"]
) -> Float[Array, "*n 3"]:
    """Render the pad and the housing's walls with the shadow of the object, but without the object itself.

    Args:
        room: Constants of the external light.
        square_radius: Squared distance from the pad's centre on the gel's face, `(2 x / width)^2 + (2 y / height)^2`
            with the width and height of the pad. It is 1 at the middle of each edge.
        walls: Brightness of the housing's walls relative to the pad, from `housing`, as a ratio of sRGB values.
            `empty_view` squares the ratio to approximate the ratio of linear light.
        hidden: Share of the sky that the object hides, from `hidden_sky`. Zeros give the view of the empty sensor.

    Returns:
        Linear RGB light.
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
    """Compute the colour of an object as seen through the skin.

    The colour is computed in four steps. `ambient`, `crease`, `crease_height`, `haze`, `tint` and `milk` are fields of
    the argument `room`.

    1. Light on the object by Lambert's law: `albedo * (ambient + sum_m max(0, L_m . N) c_m)`, with the normal N, and
       the unit direction L_m and colour c_m of each light m.
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

    Returns:
        Linear RGB light.
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
