"""The view through the skin: a lit object, its shadow on the skin, the haze of a translucent gel.

Light is summed in linear units, and `to_srgb` is the last step of an image. Functions of samples accept any shape.
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
    """The light above the sensor, and its way through the skin to the camera. Constants are our choice."""

    # light that reaches a surface from all sides, including the light that leaks through and under the object
    ambient: Float[Array, "*n 3"] = dataclasses.field(
        default_factory=lambda: jnp.array([0.36, 0.36, 0.37]), metadata=NOT_NEGATIVE
    )
    # unit vectors from the object towards a window, a lamp and the table, which reflects light
    directions: Float[Array, "*n m 3"] = dataclasses.field(
        default_factory=lambda: jnp.array([[-0.8, -0.5, 0.1], [0.6, 0.3, 0.74], [0.4, -0.5, -0.77]])
    )
    # linear light of each, on a surface that faces it
    colors: Float[Array, "*n m 3"] = dataclasses.field(
        default_factory=lambda: jnp.array([[0.7, 0.7, 0.68], [0.3, 0.29, 0.27], [0.3, 0.3, 0.31]]),
        metadata=NOT_NEGATIVE,
    )
    # sRGB of the empty view (paper's code: (178, 178, 204) / 255)
    background: Float[Array, "*n 3"] = dataclasses.field(
        default_factory=lambda: jnp.array([178.0, 178, 204]) / 255, metadata=SHARE
    )
    # m, height over the skin at which 1/e of an object's own light comes through
    haze: Scalar = dataclasses.field(default=3.0, metadata=POSITIVE)
    # share of the empty view that is scattered by the skin, where no object hides the sky
    milk: Scalar = dataclasses.field(default=0.25, metadata=SHARE)
    # share of an object's light that skin and gel transmit, close to the background's tint
    tint: Float[Array, "*n 3"] = dataclasses.field(default_factory=lambda: jnp.array([0.8, 0.8, 1.0]), metadata=SHARE)
    # share of its light that an object on the skin loses where it hides all of the sky
    crease: Scalar = dataclasses.field(default=0.4, metadata=SHARE)
    # m, height over the skin at which 1/e of this is lost
    crease_height: Scalar = dataclasses.field(default=0.015, metadata=POSITIVE)
    # share of light lost at the pad's edge, as the square of the distance from the centre
    vignette: Scalar = dataclasses.field(default=0.1, metadata=SHARE)
    # sRGB value of the housing's walls just below the pad's edge, relative to the pad
    rim: Scalar = dataclasses.field(default=0.3, metadata=NOT_NEGATIVE)
    # m, depth below the skin at which the walls are 1/e as bright
    rim_depth: Scalar = dataclasses.field(default=0.03, metadata=POSITIVE)
    # exposure time of the visual stream over that of the tactile stream (`expose`)
    exposure: Scalar = dataclasses.field(default=1.0, metadata=POSITIVE)


_SKY_CELLS = 30  # approximate number of cells along each side of the grid of `hidden_sky`
_SLICES = 4  # slices of an object in `hidden_sky`
_LOWEST = 0.0015  # m, minimum height of a slice


def to_linear(srgb: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Linear light of sRGB values in [0, 1] (IEC 61966-2-1)."""
    high = srgb > 0.04045
    return jnp.where(high, (jnp.where(high, srgb + 0.055, 1) / 1.055) ** 2.4, srgb / 12.92)


def to_srgb(linear: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """sRGB of linear light (IEC 61966-2-1)."""
    high = linear > 0.0031308
    return jnp.where(high, 1.055 * jnp.exp(jnp.log(jnp.where(high, linear, 1)) / 2.4) - 0.055, 12.92 * linear)


def sample_texture(texture: Float[Array, "t t 3"], uv: Float[Array, "*n 2"]) -> Float[Array, "*n 3"]:
    """Bilinear look-up in a texture that repeats. u runs to the right, and v = 0 is the top row.

    Args:
        texture: any values.
        uv: texture coordinates.

    Returns:
        Values.
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
    """Share of the sky, weighted by the cosine, that an object hides from points on the skin.

    The object is cut at a few heights z, from its lowest point to its top. A slice is the part of its underside below
    z. At a distance d from a straight edge, a slice hides (1 - d / sqrt(d^2 + z^2)) / 2. K_z integrates the derivative
    of this term over each cell, along y and along x. Then `hidden = max_z K_z slice_z K_z^T` on a grid of about 5 mm,
    with quadratic splines between its cells.

    Args:
        heights: of the object's underside over the gel's face (m), `inf` where there is none, on a uniform grid.
        size: of this grid along x and y (m), which is the pad, centred on the sensor's axis.
        top: height of the object's highest point (m).
        x: of the points, along an image's rows (m).
        y: of the points, along its columns (m).

    Returns:
        Shares in [0, 1]. Points beyond the pad have the share at its edge.
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
    """Share of the sky that a strip, one cell wide at a height of 1, hides from the centre of each cell."""
    index = jnp.arange(number, dtype=jnp.float32)
    away = (index[None, :] - index[:, None] - 0.5) * pitch
    edge = away + pitch
    return 0.5 * (edge / jnp.sqrt(edge * edge + 1) - away / jnp.sqrt(away * away + 1))


def _spline(rows: Float[Array, "n k"], place: Float[Array, "m"]) -> Float[Array, "m k"]:
    """Quadratic spline over rows at whole numbers, constant beyond the ends."""
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
    """sRGB value of the housing's walls, relative to the pad, for rays that pass beside the pad.

    A dark wall stands below each edge of the pad. With the light that enters there, its value is
    `rim exp(-t / rim_depth)` at a depth t below the skin.

    Args:
        room: its constants.
        on_pad: whether the rays pass through the pad.
        places: where the rays cross the plane of the gel's face (m).
        size: of the pad along x and y (m).
        distance: of the pinhole from that plane (m).

    Returns:
        Relative values, 1 on the pad.
    """
    beyond = jnp.maximum(2 * jnp.abs(places[..., 0]) / size[0], 2 * jnp.abs(places[..., 1]) / size[1])
    below = distance * (1 - 1 / jnp.maximum(beyond, 1))
    return jnp.where(on_pad, 1, room.rim * jnp.exp(-below / room.rim_depth))


def empty_view(
    room: Room, square_radius: Float[Array, "*n"], walls: Float[Array, "*n"], hidden: Float[Array, "*n"]
) -> Float[Array, "*n 3"]:
    """The view without an object, in linear light.

    Args:
        room: its constants.
        square_radius: squared distance from the pad's centre on the gel's face, in units of half the pad's side.
        walls: sRGB values relative to the pad, from `housing`. Their squares approximate linear light.
        hidden: share of the sky, from `hidden_sky`.

    Returns:
        Linear light.
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
    """Colour of an object seen through the skin.

    Lambert's law gives the light on the object, `E = ambient + sum_m max(0, L_m . N) c_m`. Near the skin it loses the
    share `crease hidden exp(-height / crease_height)`. Haze transmits `exp(-height / haze)` of the object's colour,
    tinted, and replaces the rest by the empty view. The milky skin transmits `1 - milk` of the sum and adds
    `milk (1 - hidden)` of the sky's light.

    Args:
        room: its constants.
        albedo: linear, in [0, 1].
        normals: unit.
        heights: over the gel's face (m).
        empty: view without the object, from `empty_view`.
        hidden: share of the sky, from `hidden_sky`, at the points of the skin in front of the samples.

    Returns:
        Linear light.
    """
    # Channel by channel, because XLA on a CPU is slow along an axis of three.
    directions, colors = geometry.normalize(room.directions), room.colors
    ambient, tint = jnp.asarray(room.ambient), jnp.asarray(room.tint)
    incidence = [jnp.maximum(_dot(direction, normals), 0) for direction in directions]
    heights = jnp.maximum(heights, 0)
    lit = 1 - room.crease * hidden * jnp.exp(-heights / room.crease_height)
    through = jnp.exp(-heights / room.haze)
    # `empty` is the sky's light without the hidden part of the scattered light.
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
