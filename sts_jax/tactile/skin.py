"""The lit skin: lateral coupling, far and near lights, shadows, Phong reflectance, darkening.

Images are float32, (height, width, 3), and not clipped to [0, 1], because a pixel first sums all its light.
"""

import dataclasses
import functools
import operator

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sts_jax import geometry
from sts_jax._ranges import NOT_NEGATIVE, POSITIVE, STATIC
from sts_jax._sampling import bilinear, shifted

_NEAREST = 1e-4  # m, least distance between a light and a lit point
_BRIGHTEST = 60.0  # log of the largest brightness relative to the reference distance, against overflow
_FAINTEST = 1e-20  # smaller cosines make no highlight, because the gradient of their power would be NaN

Scalar = float | Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Lights:
    """Directional lights in the gel's plane, one from each edge: red, green, blue, white (paper's code)."""

    # unit vectors from the skin towards the lights, sensor frame: left, right, top, bottom edge of the image
    directions: Float[Array, "*n m 3"] = dataclasses.field(
        default_factory=lambda: jnp.array([[-1.0, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0]])
    )
    # intensity per channel, diffuse and specular alike (paper, supplement: 1.0 in each light's own channels)
    colors: Float[Array, "*n m 3"] = dataclasses.field(
        default_factory=lambda: jnp.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]]), metadata=NOT_NEGATIVE
    )


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Leds:
    """Near lights: points at a finite distance. All constants are our choice.

    By default they shine at a grazing angle into the pad's edges, as brightly as the camera's range allows: no pixel of
    the empty pad is clipped. Each side of the pad has its own colour, which lights the flanks that face it.
    """

    # m, sensor frame: 30 mm beyond the pad's left, right, top and bottom edge, 3 mm under the gel's face
    positions: Float[Array, "*n m 3"] = dataclasses.field(
        default_factory=lambda: jnp.array(
            [[-0.105, 0, -0.003], [0.105, 0, -0.003], [0, -0.105, -0.003], [0, 0.105, -0.003]]
        )
    )
    # intensity per channel at the reference distance, diffuse and specular alike
    colors: Float[Array, "*n m 3"] = dataclasses.field(
        default_factory=lambda: jnp.array([[0.7, 0, 0], [0, 0.7, 0], [0, 0, 0.7], [0.7, 0.7, 0.7]]),
        metadata=NOT_NEGATIVE,
    )
    # exponent of the fall-off with distance. 2: a point, 1: a long strip, 0: none
    falloff: Scalar = dataclasses.field(default=1.0, metadata=NOT_NEGATIVE)
    # m, distance at which a light has the intensity `colors`
    reference: Scalar = dataclasses.field(default=0.08, metadata=POSITIVE)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Skin:
    """How the skin follows an object that presses on it, and whether its raised parts cast shadows on each other."""

    # m, standard deviation of the Gaussian that smooths the imprint, 0 as in the paper
    coupling: Scalar = dataclasses.field(default=0.0, metadata=NOT_NEGATIVE)
    # steps along the way to each light, 0 for no shadows as in the paper
    shadow_steps: int = dataclasses.field(default=0, metadata=NOT_NEGATIVE | STATIC)
    # m along the gel's face, longest shadow of a raised part. Our choice.
    shadow_reach: Scalar = dataclasses.field(default=0.02, metadata=POSITIVE)
    # rad, angular height of a light, which is dark where all of it is hidden. Our choice.
    penumbra: Scalar = dataclasses.field(default=0.1, metadata=POSITIVE)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Phong:
    """Reflectance of the skin's inner side."""

    # k_a (paper, supplement "Simulator Details")
    ambient: Scalar = dataclasses.field(default=0.8, metadata=NOT_NEGATIVE)
    diffuse: Scalar = dataclasses.field(default=1.0, metadata=NOT_NEGATIVE)  # k_d (paper, as above)
    specular: Scalar = dataclasses.field(default=0.5, metadata=NOT_NEGATIVE)  # k_s (paper, as above)
    shininess: Scalar = dataclasses.field(default=5.0, metadata=POSITIVE)  # alpha (paper, as above)
    # i_a, per channel. A flat gel is (178, 178, 204) / 255.
    ambient_color: tuple[Scalar, Scalar, Scalar] = dataclasses.field(
        default=(0.8725, 0.8725, 1.0), metadata=NOT_NEGATIVE
    )
    # m, depth at which the skin is 1/e as bright (paper: a mask, without its shape)
    darkening: Scalar = dataclasses.field(default=0.001, metadata=POSITIVE)


def couple(depth: Float[Array, "h w"], length: Scalar, pitch: Float[Array, "2"]) -> Float[Array, "h w"]:
    """Smooth an imprint by a Gaussian. Real skin does not follow a sharp edge.

    The weights are `exp(-r^2 / (2 length^2))` at the pixels' distances r, divided by their sum over the image, so that
    a uniform imprint is unchanged, at the border too. Two dense products compute this, exactly for any length.

    Args:
        depth: of the imprint (m), finite.
        length: standard deviation (m). 0, or less than a twentieth of a pixel, returns `depth` unchanged.
        pitch: of a pixel along x and y (m).

    Returns:
        Depth of the skin (m).
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
    """Share of each light that reaches each pixel past raised parts of the skin.

    Pressed parts of the skin stand out towards the camera, into the gel through which the light travels. Along the way
    from a point to a light, the horizon is the steepest rise to the skin there. It hides the lower part of a light
    whose angular height is `penumbra` and whose lower end has the elevation e over the gel's plane:

        share = 1 - (atan max_t (d(x + t u) - d(x)) / t - e) / penumbra,   clipped to [0, 1]

    A light in the gel's plane, such as the paper's, has e = 0. It lights only flanks, and only the parts of a flank
    that rise above everything on the way to the light. Flat skin and the tops of pressed parts receive no light from it
    (L . N = 0), so its shadows are visible only on flanks behind other raised parts. The shadows of a point light in
    this plane would be endless. With a penumbra, they end where a raised part appears lower than `penumbra`. A flank
    that faces away from a light is dark because of its normal, whether it is in shadow or not.

    Args:
        skin: number of steps, reach and penumbra. Steps are short near the point and longer away from it
            (`t = reach (k / steps)^2`). A part narrower than a step may therefore cast no shadow far away.
        lights: far or near. Skin behind a near light does not hide it.
        depth: of the skin below the gel's face (m). Skin beyond the image casts no shadow.
        window: part of the gel's face in the image, (left, top, width, height) (m).

    Returns:
        Shares, 1 where all of the light arrives. Ambient light (`Phong.ambient`) has no shadow.
    """
    rows, columns = depth.shape
    pitch = window[2:] / jnp.array([columns, rows], jnp.float32)
    lengths = skin.shadow_reach * (jnp.arange(1, skin.shadow_steps + 1) / max(skin.shadow_steps, 1)) ** 2
    if isinstance(lights, Lights):
        # The way to a far light is the same everywhere, so the whole image is shifted.
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
    """Phong's reflection of the lights by the skin.

        I = k_a i_a + sum_m (k_d (L_m . N) + k_s (R_m . V)^alpha) i_m,   R_m = 2 (L_m . N) N - L_m

    Both products are clipped at 0. V is the optical axis, as for a distant viewer, so that flat skin under far lights
    is uniform. For a near light at p_m, L_m points to p_m and the intensity is `(reference / |p_m - x|)^falloff i_m`.
    Distances below 0.1 mm count as 0.1 mm.

    Args:
        phong: constants of the skin's reflectance.
        lights: far (directions need not be of unit length) or near.
        normals: unit, towards the camera.
        points: of the skin, sensor frame (m). Far lights do not need them.
        shares: share of each light that arrives, from `shadows`. Default: 1.

    Returns:
        Image, not clipped (paper, equation "phong").
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
    """Components of a vector divided by its length, and this length, which is at least `_NEAREST`."""
    square = functools.reduce(operator.add, (p * p for p in parts))
    length = jnp.sqrt(jnp.maximum(square, _NEAREST**2))
    return (*(p / length for p in parts), length)


def darken(phong: Phong, depth: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Relative brightness of skin at a depth (m) of the imprint, `exp(-depth / darkening)`."""
    return jnp.exp(-depth / phong.darkening)
