"""The tactile stream: the skin with an imprint, lit from inside."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sts_jax import tactile
from sts_jax.rendering.tiles import planes, where_active
from sts_jax.sensor import Sensor

_UNTOUCHED = 1e-8  # m, an imprint too shallow to change an image, such as the tail of the skin's coupling


def lit_skin(
    sensor: Sensor,
    imprint: Float[Array, "a b"],
    window: Float[Array, "4"],
    pitch: Float[Array, "2"],
    slopes: tuple[Float[Array, "1 b"], Float[Array, "a 1"]],
) -> list[Float[Array, "h w"]]:
    """The lit skin at the samples of an imprint.

    Args:
        sensor: constants of the camera, skin, lights and reflectance.
        imprint: depth at the samples (m).
        window: part of the gel's face that the samples cover (m).
        pitch: of the samples along x and y (m).
        slopes: x / depth along the first row, and y / depth along the first column.

    Returns:
        Three channels, not clipped, without the outermost samples, which serve for the normals of their neighbours.
    """
    coupled = sensor.skin.coupling > 0
    imprint = jax.lax.cond(coupled, tactile.couple, lambda *given: given[0], imprint, sensor.skin.coupling, pitch)
    shares = tactile.shadows(sensor.skin, sensor.lights, imprint, window) if sensor.skin.shadow_steps else ()
    x, y = slopes[0][:, 1:-1] * sensor.camera.distance, slopes[1][1:-1] * sensor.camera.distance
    flat = jnp.stack(jnp.broadcast_arrays(x, y, jnp.zeros(())), axis=-1)
    untouched = tactile.phong(
        sensor.phong, sensor.lights, jnp.broadcast_to(jnp.array([[[0.0, 0.0, -1.0]]]), flat.shape), flat
    )
    pressed = _near(imprint > _UNTOUCHED)
    return where_active(_skin, pressed, sensor, (*slopes, imprint, *shares), planes(untouched), ring=1)


def _skin(sensor: Sensor, images: tuple[Array, ...]) -> list[Float[Array, "h w *tiles"]]:
    """The lit skin from the rays, the imprint and the lights' shares, which have one more pixel on each side."""
    slope_x, slope_y, imprint, *shares = images
    depth = sensor.camera.distance - imprint
    surface = slope_x * depth, slope_y * depth, -imprint
    points = jnp.stack([part[1:-1, 1:-1] for part in surface], axis=-1)
    arriving = jnp.stack([share[1:-1, 1:-1] for share in shares]) if shares else None
    light = tactile.phong(sensor.phong, sensor.lights, tactile.surface_normals(surface), points, arriving)
    dark = tactile.darken(sensor.phong, imprint[1:-1, 1:-1])
    return [channel * dark for channel in planes(light)]


def _near(flags: Bool[Array, "a b"]) -> Bool[Array, "h w"]:
    """Whether any pixel of a 3x3 neighbourhood is flagged, for all but the outermost pixels."""
    rows = flags[:-2] | flags[1:-1] | flags[2:]
    return rows[:, :-2] | rows[:, 1:-1] | rows[:, 2:]
