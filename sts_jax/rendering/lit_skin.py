"""Tactile image: the skin of the gel, deformed by an imprint, under the lights inside the sensor."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sts_jax import tactile
from sts_jax.rendering.tiles import planes, where_active
from sts_jax.sensor import Sensor

# Part of the gel's thickness. A shallower imprint does not change the image, such as the tail of the smoothing.
_UNTOUCHED = 2e-6


def smoothed(sensor: Sensor, imprint: Float[Array, "a b"], pitch: Float[Array, "2"]) -> Float[Array, "a b"]:
    """Depth of the skin (m) from that of the imprint. `pitch` is the distance between rays on the gel's face (m)."""
    coupled = sensor.skin.coupling > 0
    return jax.lax.cond(coupled, tactile.couple, lambda *given: given[0], imprint, sensor.skin.coupling, pitch)


def lit_skin(
    sensor: Sensor,
    imprint: Float[Array, "a b"],
    window: Float[Array, "4"],
    slopes: tuple[Float[Array, "1 b"], Float[Array, "a 1"]],
) -> list[Float[Array, "h w"]]:
    """Red, green and blue light of the skin for a grid of camera rays, not clipped, from the depth of the skin (m).

    `window` is the part of the gel's face that the grid covers (m), and `slopes` are x / depth and y / depth. The
    outermost rows and columns, which have no normals, are dropped.
    """
    shares = tactile.shadows(sensor.skin, sensor.lights, imprint, window) if sensor.skin.shadow_steps else None
    x, y = slopes[0][:, 1:-1] * sensor.camera.distance, slopes[1][1:-1] * sensor.camera.distance
    flat = jnp.stack(jnp.broadcast_arrays(x, y, jnp.zeros(())), axis=-1)
    normals = jnp.broadcast_to(jnp.array([[[0.0, 0.0, -1.0]]]), flat.shape)
    arriving = None if shares is None else shares[:, 1:-1, 1:-1]  # pressed parts also shade flat skin
    untouched = tactile.phong(sensor.phong, sensor.lights, normals, flat, arriving)
    pressed = _near(imprint > _UNTOUCHED * sensor.gel.thickness)
    images = (*slopes, imprint) if shares is None else (*slopes, imprint, *shares)
    return where_active(_skin, pressed, sensor, images, planes(untouched), ring=1)


def passing(
    sensor: Sensor,
    imprint: Float[Array, "a b"],
    pitch: Float[Array, "2"],
    slopes: tuple[Float[Array, "1 b"], Float[Array, "a 1"]],
    shear: Float[Array, "r c 2"] | None,
) -> Float[Array, "h w"] | float:
    """Share of the light that the dots in the skin let through, without the outermost rows and columns."""
    if sensor.markers is None:
        return 1.0
    depth = (sensor.camera.distance - imprint)[1:-1, 1:-1]
    shear = jnp.zeros((*sensor.gel.cells, 2)) if shear is None else shear
    x, y = slopes[0][:, 1:-1] * depth, slopes[1][1:-1] * depth
    return tactile.dots(sensor.gel, sensor.markers, shear, x, y, pitch[0])


def _skin(sensor: Sensor, images: tuple[Array, ...]) -> list[Float[Array, "h w *tiles"]]:
    """Brightness of pressed skin.

    `images` are the slopes of the rays in x and y, the imprint (m) and the share of each light, with one more pixel on
    each side than the result.
    """
    slope_x, slope_y, imprint, *shares = images
    depth = sensor.camera.distance - imprint
    surface = slope_x * depth, slope_y * depth, -imprint
    points = jnp.stack([part[1:-1, 1:-1] for part in surface], axis=-1)
    arriving = jnp.stack([share[1:-1, 1:-1] for share in shares]) if shares else None
    light = tactile.phong(sensor.phong, sensor.lights, tactile.surface_normals(surface), points, arriving)
    dark = tactile.darken(sensor.phong, imprint[1:-1, 1:-1])
    return [channel * dark for channel in planes(light)]


def _near(flags: Bool[Array, "a b"]) -> Bool[Array, "h w"]:
    """True for pixels with a true flag in their 3x3 neighbourhood. The outermost pixels are dropped."""
    rows = flags[:-2] | flags[1:-1] | flags[2:]
    return rows[:, :-2] | rows[:, 1:-1] | rows[:, 2:]
