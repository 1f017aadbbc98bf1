"""Tactile image from the imprint of an object: smoothing, directional and point lights, shadows, Phong reflectance.

The skin is the paint on the gel's outer face. The tactile image shows its inner side while the internal lights are on.
Images are float32, (height, width, 3), and not clipped to [0, 1]. `sense` clips them as its last step.
"""

import dataclasses
import functools
import operator

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sts_jax import geometry
from sts_jax._ranges import LENGTH, NOT_NEGATIVE, POSITIVE, STATIC
from sts_jax._sampling import bilinear, shifted

_NEAREST = 1e-4  # m, smallest distance between a light and a lit point. Smaller ones are replaced by it
_BRIGHTEST = 60.0  # logarithm of the largest brightness relative to the reference distance, against overflow
_FAINTEST = 1e-20  # smaller cosines make no highlight, because the gradient of their power would be NaN

Scalar = float | Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Lights:
    """Any number m of directional lights inside the sensor.

    The defaults are those of the See-Through-your-Skin paper's code: four lights in the gel's plane, one from each edge
    of the image.
    """

    # Directions from the skin towards the lights, sensor frame. Any length > 0. Defaults: left, right, top and bottom
    # edge of the image.
    directions: Float[Array, "*n m 3"] = dataclasses.field(
        default_factory=lambda: jnp.array([[-1.0, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0]])
    )
    # Intensity of each light in the red, green and blue channel, for diffuse and specular reflection alike. Defaults:
    # red, green, blue, white (paper, supplement).
    colors: Float[Array, "*n m 3"] = dataclasses.field(
        default_factory=lambda: jnp.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]]), metadata=NOT_NEGATIVE
    )


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Leds:
    """Any number m of lights inside the sensor, as points at a finite distance.

    By default, a red, a green, a blue and a white LED shine at a grazing angle into the four edges of the pad. They are
    about as bright as possible without clipped pixels in the image of the untouched pad.
    """

    # Positions in the sensor frame (m). Defaults: 30 mm beyond the pad's left, right, top and bottom edge, 3 mm below
    # the gel's outer face.
    positions: Float[Array, "*n m 3"] = dataclasses.field(
        default_factory=lambda: jnp.array(
            [[-0.105, 0, -0.003], [0.105, 0, -0.003], [0, -0.105, -0.003], [0, 0.105, -0.003]]
        ),
        metadata=LENGTH,
    )
    # Intensity of each light in the red, green and blue channel at the distance `reference`, for diffuse and specular
    # reflection alike.
    colors: Float[Array, "*n m 3"] = dataclasses.field(
        default_factory=lambda: jnp.array([[0.7, 0, 0], [0, 0.7, 0], [0, 0, 0.7], [0.7, 0.7, 0.7]]),
        metadata=NOT_NEGATIVE,
    )
    # Exponent of the decrease of the intensity with distance: 2 for a point, 1 for a long strip, 0 for no decrease.
    falloff: Scalar = dataclasses.field(default=1.0, metadata=NOT_NEGATIVE)
    # Distance at which a light has the intensity `colors` (m).
    reference: Scalar = dataclasses.field(default=0.08, metadata=POSITIVE | LENGTH)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Skin:
    """Smoothing of an imprint, and the shadows that the skin casts on itself."""

    # Standard deviation of the Gaussian that smooths the imprint (m). The default is 0, as in the paper.
    coupling: Scalar = dataclasses.field(default=0.0, metadata=NOT_NEGATIVE | LENGTH)
    # Number of points on the way to each light at which the skin may hide it. The default is 0, no shadows, as in the
    # paper.
    shadow_steps: int = dataclasses.field(default=0, metadata=NOT_NEGATIVE | {"at_most": 1000} | STATIC)
    # Length of the longest shadow along the gel's face (m). Our choice.
    shadow_reach: Scalar = dataclasses.field(default=0.02, metadata=POSITIVE | LENGTH)
    # Angular height of a light, seen from the skin (rad). A point is in partial shadow if only a part of this height is
    # visible from it. Our choice.
    penumbra: Scalar = dataclasses.field(default=0.1, metadata=POSITIVE)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Phong:
    """Constants of Phong's reflectance model for the skin's inner side."""

    # Reflectance k_a of ambient light. Source of this and the next three: paper, supplement "Simulator Details".
    ambient: Scalar = dataclasses.field(default=0.8, metadata=NOT_NEGATIVE)
    diffuse: Scalar = dataclasses.field(default=1.0, metadata=NOT_NEGATIVE)  # Diffuse reflectance k_d.
    specular: Scalar = dataclasses.field(default=0.5, metadata=NOT_NEGATIVE)  # Specular reflectance k_s.
    shininess: Scalar = dataclasses.field(default=5.0, metadata=POSITIVE)  # Exponent alpha of the specular reflection.
    # Ambient light i_a in the red, green and blue channel. With the default, a flat gel has the colour
    # (178, 178, 204) / 255.
    ambient_color: tuple[Scalar, Scalar, Scalar] = dataclasses.field(
        default=(0.8725, 0.8725, 1.0), metadata=NOT_NEGATIVE
    )
    # Depth of the imprint at which the skin is 1/e as bright (m). The paper has a darkening mask, but does not give its
    # shape.
    darkening: Scalar = dataclasses.field(default=0.001, metadata=POSITIVE | LENGTH)


def couple(depth: Float[Array, "h w"], length: Scalar, pitch: Float[Array, "2"]) -> Float[Array, "h w"]:
    """Smooth an imprint with a Gaussian, because real skin does not follow a sharp edge.

    The weight of a pixel at distance r is `exp(-r^2 / (2 length^2))`, divided by the sum of the weights over the image,
    so that a uniform imprint is unchanged, also at the border.

    Args:
        depth: Depth of the imprint (m), finite.
        length: Standard deviation of the Gaussian (m). Below a twentieth of a pixel, the depth is unchanged.
        pitch: Distance between pixels along x and along y (m).
    """

    def band(number: int, step: Array) -> Float[Array, "a a"]:
        sigma = jnp.maximum(length / step, 0.05)  # pixels. At 0.05 the next pixel weighs exp(-200), 0 in float32
        place = jnp.arange(number)
        weights = jnp.exp(-0.5 * ((place[:, None] - place[None, :]) / sigma) ** 2)
        return weights / jnp.sum(weights, axis=1, keepdims=True)

    down, across = band(depth.shape[0], pitch[1]), band(depth.shape[1], pitch[0])
    return jnp.linalg.multi_dot([down, depth, across.T], precision=jax.lax.Precision.HIGHEST)


def shadows(
    skin: Skin, lights: Lights | Leds, depth: Float[Array, "h w"], window: Float[Array, "4"]
) -> Float[Array, "m h w"]:
    """For each light and pixel, compute the share of the light that other parts of the skin do not hide.

    Pressed parts of the skin stand out into the gel, through which the light travels, and cast shadows on the skin
    behind them. The share of a light at a point x of the skin is

        share = clip(1 - (atan(max_t (d(x + t u) - d(x)) / t) - e) / penumbra, 0, 1)

    d is the depth of the skin, u the unit vector along the gel's face from x towards the light, and t the distance
    along u. The arctangent is the largest elevation (rad, above the gel's plane into the gel) of the skin at the points
    x + t u. e is the elevation of the light's lower edge, and e + penumbra that of its upper edge.

    A light in the gel's plane, as in the paper, has e = 0. It does not illuminate flat skin or the tops of pressed
    parts, so its shadows are visible only where one pressed part casts a shadow on a slope of another. The shadow is
    partial where the elevation of the part that casts it is below `penumbra`.

    Args:
        skin: Number of steps n, reach and penumbra. Step k compares the depth at x with the depth at the distance `t =
            shadow_reach (k / n)^2`. Steps are longer far from x, so a distant part that is narrower than a step may
            cast no shadow on x.
        lights: Skin behind a near light (`Leds`) does not hide this light.
        depth: Depth of the skin below the gel's undeformed face (m). Skin outside the image casts no shadow.
        window: Part of the gel's face in the image: left, top, width, height (m).

    Returns:
        Share of each light, from 0 (hidden) to 1 (fully visible). Ambient light (`Phong.ambient`) has no shadow.
    """
    rows, columns = depth.shape
    depth = jnp.asarray(depth, jnp.result_type(float))
    pitch = window[2:] / jnp.array([columns, rows], jnp.float32)
    lengths = skin.shadow_reach * (jnp.arange(1, skin.shadow_steps + 1) / max(skin.shadow_steps, 1)) ** 2
    if isinstance(lights, Lights):
        # The direction to a far light is the same everywhere, so the whole image is shifted.
        places = geometry.normalize(lights.directions)
        around = jnp.pad(depth, ((rows + 1, rows + 1), (columns + 1, columns + 1)))

        def look(across: Array, down: Array) -> Float[Array, "h w"]:
            return shifted(around, across, down, (rows, columns))

    else:
        places = lights.positions
        padded = jnp.pad(depth, 1)
        x = window[0] + (jnp.arange(columns) + 0.5) * pitch[0]
        x, y = jnp.meshgrid(x, window[1] + (jnp.arange(rows) + 0.5) * pitch[1])

        def look(across: Array, down: Array) -> Float[Array, "h w"]:
            column, row = jnp.arange(1, columns + 1)[None, :], jnp.arange(1, rows + 1)[:, None]
            return bilinear(padded, column + across, row + down)

    def share(place: Float[Array, "3"]) -> Float[Array, "h w"]:
        if isinstance(lights, Lights):
            ux, uy = geometry.normalize(place[:2])
            elevation, way = jnp.arctan2(-place[2], geometry.norm(place[:2])), jnp.float32(jnp.inf)
        else:
            ux, uy, way = _unit(place[0] - x, place[1] - y)
            elevation = jnp.arctan2(-place[2] - depth, way)

        def step(horizon: Float[Array, "h w"], length: Float[Array, ""]) -> tuple[Float[Array, "h w"], None]:
            rise = (look(ux * length / pitch[0], uy * length / pitch[1]) - depth) / length
            return jnp.where(length < way, jnp.maximum(horizon, rise), horizon), None

        horizon, _ = jax.lax.scan(step, jnp.full_like(depth, -1e3), lengths)
        return jnp.clip(1 - (jnp.arctan(horizon) - elevation) / skin.penumbra, 0, 1)

    return jnp.stack([share(place) for place in places])


def phong(
    phong: Phong,
    lights: Lights | Leds,
    normals: Float[Array, "*n 3"],
    points: Float[Array, "*n 3"],
    shares: Float[Array, "m *n"] | None = None,
) -> Float[Array, "*n 3"]:
    """Light that the skin reflects to the camera, by Phong's model, as in the See-Through-your-Skin paper.

        I = k_a i_a + sum_m (k_d (L_m . N) + k_s (R_m . V)^alpha) i_m,   R_m = 2 (L_m . N) N - L_m

    k_a, i_a, k_d, k_s and alpha are the fields `ambient`, `ambient_color`, `diffuse`, `specular` and `shininess` of
    `Phong`. N is the normal, L_m the unit vector to light m, and i_m the colour of light m. Negative (L_m . N) and
    (R_m . V) count as 0. V = (0, 0, -1) at all points, as for a distant viewer, so that flat skin under far lights is
    uniform. The colour of a near light at p_m is multiplied by `(reference / |p_m - x|)^falloff` at the point x, where
    distances below 0.1 mm count as 0.1 mm.

    Args:
        phong: Constants of the skin's reflectance.
        lights: Far lights (`Lights`), of any length > 0, or near lights (`Leds`).
        normals: Unit normals towards the camera.
        points: Points of the skin in the sensor frame (m). Only near lights use them.
        shares: Share of each light that reaches each point, from `shadows`. None for no shadows.

    Returns:
        Image of the skin, not clipped.
    """
    nx, ny, nz = (normals[..., k] for k in range(3))
    places = geometry.normalize(lights.directions) if isinstance(lights, Lights) else lights.positions
    image = [jnp.broadcast_to(jnp.asarray(phong.ambient * i, nx.dtype), nx.shape) for i in phong.ambient_color]
    for m in range(places.shape[0]):
        lx, ly, lz = (places[m, k] for k in range(3))
        if isinstance(lights, Leds):
            lx, ly, lz, distance = _unit(lx - points[..., 0], ly - points[..., 1], lz - points[..., 2])
        incidence = lx * nx + ly * ny + lz * nz
        towards = lz - 2 * incidence * nz  # R . V with V = (0, 0, -1)
        shines = towards > _FAINTEST
        highlight = jnp.where(shines, jnp.exp(phong.shininess * jnp.log(jnp.where(shines, towards, 1))), 0)
        strength = phong.diffuse * jnp.maximum(incidence, 0) + phong.specular * highlight
        if isinstance(lights, Leds):
            strength *= jnp.exp(jnp.minimum(lights.falloff * jnp.log(lights.reference / distance), _BRIGHTEST))
        if shares is not None:
            strength *= shares[m]
        image = [channel + strength * lights.colors[m, k] for k, channel in enumerate(image)]
    return jnp.stack(image, axis=-1)


def _unit(*parts: Float[Array, "*n"]) -> tuple[Float[Array, "*n"], ...]:
    """Divide a vector by its length, replaced by `_NEAREST` if smaller. Return the components and the length."""
    square = functools.reduce(operator.add, (p * p for p in parts))
    length = jnp.sqrt(jnp.maximum(square, _NEAREST**2))
    return (*(p / length for p in parts), length)


def darken(phong: Phong, depth: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Brightness of the skin at the depth (m) of the imprint, relative to flat skin: `exp(-depth / darkening)`."""
    return jnp.exp(-depth / phong.darkening)
