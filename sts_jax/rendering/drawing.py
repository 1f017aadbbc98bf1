"""The second program of `sense`: both streams and depth of an object in balance, at one resolution."""

import functools
import operator
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sts_jax import _cpu_reductions, geometry, optics
from sts_jax.objects.body import Body
from sts_jax.rendering.corners import Corners, weighted
from sts_jax.rendering.edges import with_moving_edges
from sts_jax.rendering.equilibrium import Resting
from sts_jax.rendering.lit_skin import lit_skin
from sts_jax.rendering.loop import looped
from sts_jax.rendering.tiles import lines, planes, where_active
from sts_jax.sensor import Sensor


class Images(NamedTuple):
    """The images of one moment."""

    visual: Float[Array, "h w 3"]  # sRGB in [0, 1]
    tactile: Float[Array, "h w 3"]  # in [0, 1]
    depth: Float[Array, "h w"]  # m from the pinhole, `inf` where there is no object
    segmentation: Bool[Array, "h w"]  # pixels of the object
    window: Float[Array, "4"]  # m, (left, top, width, height) of the part of the gel's face in the images


class _Samples(NamedTuple):
    """The grid of samples from which the pixels are filtered, and the object's faces on it."""

    seen: Float[Array, "4"]  # m, the window of the samples
    pitch: Float[Array, "2"]  # m, between samples
    slopes: tuple[Float[Array, "1 b"], Float[Array, "a 1"]]  # x / depth and y / depth of the rays
    places: tuple[Float[Array, "1 b"], Float[Array, "a 1"]]  # m, x and y where the rays cross the gel's face
    on_pad: Bool[Array, "a b"]  # whether the ray passes through the pad
    walls: Float[Array, "a b"]  # brightness relative to the pad
    corners: Corners  # with 1 / depth (1/m) as their value
    winner: Int[Array, "a b"]  # the nearest face, -1 where there is none


class _Surface(NamedTuple):
    """Constants and the object's surface, for shading."""

    sensor: Sensor
    corners: Corners
    turn: Float[Array, "3 3"]  # from the mesh frame to the sensor frame
    normals: Float[Array, "f 3 3"]
    colors: Float[Array, "f 3 3"]
    uv: Float[Array, "f 3 2"]
    texture: Float[Array, "t t 3"]
    two_sided: Bool[Array, ""]


@functools.partial(jax.jit, static_argnames=("resolution", "crop", "moving_edges"))
def draw(
    sensor: Sensor, body: Body, resting: Resting, *, resolution: tuple[int, int], crop: bool, moving_edges: bool
) -> Images:
    """Draw an object in balance. `sense` describes the arguments."""
    drawn = functools.partial(_draw, resolution=resolution, crop=crop, moving_edges=moving_edges)
    return looped(drawn)(sensor, body, resting)


@jax.jit
def touch(sensor: Sensor, imprint: Float[Array, "h w"], window: Float[Array, "4"]) -> Float[Array, "h w 3"]:
    """Draw the tactile image of an imprint. `sts_jax.touch` describes the arguments."""
    rows, columns = imprint.shape
    pitch = window[2:] / jnp.array([columns, rows], jnp.float32)
    seen = jnp.concatenate([window[:2] - pitch, window[2:] + 2 * pitch])
    slopes = lines(optics.rays(sensor.camera, seen, (rows + 2, columns + 2)))
    imprint = jnp.where(imprint > 0, jnp.minimum(imprint, sensor.gel.thickness), 0)
    lit = lit_skin(sensor, jnp.pad(imprint, 1, mode="edge"), seen, pitch, slopes)
    x, y = (slope * sensor.camera.distance for slope in slopes)
    walls = _pad_and_walls(sensor, x[:, 1:-1], y[1:-1])[1]
    return jnp.stack([jnp.clip(channel * walls, 0, 1) for channel in lit], axis=-1)


def _draw(
    sensor: Sensor, body: Body, resting: Resting, *, resolution: tuple[int, int], crop: bool, moving_edges: bool
) -> Images:
    if crop:
        corners_seen = jnp.where(resting.present, resting.points, jnp.array([[0.0, 0.0, -1.0]]))
        window = optics.object_window(sensor.camera, corners_seen, resolution)
    else:
        window = optics.full_window(sensor.camera, resolution)
    # One sample per pixel. In small images every second sample is a pixel centre, and the others lie half-way between.
    stride = 2 if min(resolution) < sensor.fine_below else 1
    samples = _sample(sensor, body, resting, window, resolution, stride)
    depth, light = _see(sensor, body, resting, samples)
    visual = _pixels([channel[1:-1, 1:-1] for channel in light], stride)
    visual = [jnp.clip(optics.to_srgb(channel), 0, 1) for channel in visual]
    imprint = _imprint(sensor, resting, samples, depth, moving_edges)
    lit = lit_skin(sensor, imprint, samples.seen, samples.pitch, samples.slopes)
    lit = _pixels([channel * samples.walls[1:-1, 1:-1] for channel in lit], stride)
    lit = [jnp.clip(channel, 0, 1) for channel in lit]
    depth = depth[1:-1, 1:-1] if stride == 1 else depth[2:-1:2, 2:-1:2]
    return Images(
        visual=jnp.stack(visual, axis=-1),
        tactile=jnp.stack(lit, axis=-1),
        depth=depth,
        segmentation=jnp.isfinite(depth),
        window=window,
    )


def _sample(
    sensor: Sensor, body: Body, resting: Resting, window: Float[Array, "4"], resolution: tuple[int, int], stride: int
) -> _Samples:
    """Project and rasterise the object on a grid with `stride` samples per pixel in each direction.

    The grid has one more ring of samples around the image, for the normals of the outermost ones.
    """
    camera = sensor.camera
    shape = (stride * resolution[0] + stride + 1, stride * resolution[1] + stride + 1)
    pitch = window[2:] / jnp.array([resolution[1], resolution[0]], jnp.float32) / stride
    before = pitch * (stride + 1) / 2
    seen = jnp.concatenate([window[:2] - before, pitch * jnp.array([shape[1], shape[0]], jnp.float32)])
    pixels, far = optics.to_pixels(camera, seen, shape, resting.points)
    inverse = 1 / jnp.maximum(far, camera.near)
    keep = resting.present & (far > camera.near)
    winner = optics.rasterise(pixels, -inverse, body.faces, keep, body.two_sided, shape)
    slopes = lines(optics.rays(camera, seen, shape))
    x, y = (slope * camera.distance for slope in slopes)
    on_pad, walls = _pad_and_walls(sensor, x, y)
    corners = Corners(pixels[:, 0], pixels[:, 1], inverse, body.faces)
    return _Samples(seen, pitch, slopes, (x, y), on_pad, walls, corners, winner)


def _see(
    sensor: Sensor, body: Body, resting: Resting, samples: _Samples
) -> tuple[Float[Array, "a b"], list[Float[Array, "a b"]]]:
    """The visual stream: depth (m), and the view through the skin in linear light, channel by channel."""
    size, winner, (x, y) = sensor.gel.size, samples.winner, samples.places
    hidden = optics.hidden_sky(resting.heights, size, _cpu_reductions.maximum(resting.points[:, 2]), x[0], y[:, 0])
    square_radius = (x * 2 / size[0]) ** 2 + (y * 2 / size[1]) ** 2
    empty = planes(optics.empty_view(sensor.room, square_radius, samples.walls, hidden))
    surface = _Surface(
        sensor=sensor,
        corners=samples.corners,
        turn=geometry.quat_to_matrix(resting.pose[3:]),
        normals=body.normals,
        colors=body.colors,
        uv=body.uv,
        texture=body.texture,
        two_sided=body.two_sided,
    )
    centres = lines(optics.pixel_centres(winner.shape))
    images = (winner, samples.on_pad, *centres, *samples.slopes, hidden, *empty)
    depth, *light = where_active(_shade, winner >= 0, surface, images, [jnp.full(winner.shape, jnp.inf), *empty])
    return depth, light


def _shade(surface: _Surface, images: tuple[Array, ...]) -> list[Float[Array, "h w"]]:
    """The object's depth, and its colour through the skin in linear light."""
    winner, on_pad, column, row, slope_x, slope_y, hidden, *empty = images
    nearest = jnp.maximum(winner, 0)
    shares = weighted(surface.corners, winner, column, row)
    depth = 1 / functools.reduce(operator.add, shares)
    shares = [share * depth for share in shares]

    def inside(values: Float[Array, "f 3 k"]) -> list[Float[Array, "h w"]]:
        size = values.shape[-1]
        of_face = values.reshape(-1, 3 * size)[nearest]
        of_corner = [[share * of_face[..., size * k + i] for k, share in enumerate(shares)] for i in range(size)]
        return [first + second + third for first, second, third in of_corner]

    # Plane by plane, and stacked only for functions of vectors: arithmetic along an axis of three is slow on a CPU.
    across = inside(surface.normals)
    nx, ny, nz = (row[0] * across[0] + row[1] * across[1] + row[2] * across[2] for row in surface.turn)
    square = nx * nx + ny * ny + nz * nz
    scale = jnp.where(square > 0, 1 / jnp.sqrt(jnp.where(square > 0, square, 1)), 0)
    scale = jnp.where(surface.two_sided & (nx * slope_x + ny * slope_y + nz > 0), -scale, scale)
    normal = jnp.stack([scale * nx, scale * ny, scale * nz], axis=-1)
    sampled = optics.sample_texture(surface.texture, jnp.stack(inside(surface.uv), axis=-1))
    albedo = jnp.stack([color * sampled[..., k] for k, color in enumerate(inside(surface.colors))], axis=-1)
    height = depth - surface.sensor.camera.distance
    color = planes(optics.shade(surface.sensor.room, albedo, normal, height, jnp.stack(empty, axis=-1), hidden))
    return [depth, *(jnp.where(on_pad, own, behind) for own, behind in zip(color, empty, strict=True))]


def _imprint(
    sensor: Sensor, resting: Resting, samples: _Samples, depth: Float[Array, "a b"], moving_edges: bool
) -> Float[Array, "a b"]:
    """Depth of the imprint at the samples (m), 0 where the object does not touch the gel."""
    thickness, face = sensor.gel.thickness, jnp.asarray(sensor.camera.distance)
    touched = samples.on_pad & resting.pressing & (depth < face)
    if not moving_edges:
        return jnp.where(touched, jnp.minimum(face - depth, thickness), 0)
    imprint = jnp.where(touched, jnp.minimum(face - jax.lax.stop_gradient(depth), thickness), 0)
    images = (samples.winner, *optics.pixel_centres(samples.winner.shape))
    follows = touched & (face - depth < thickness)
    return with_moving_edges(imprint, samples.corners, images, depth, samples.on_pad, follows)


def _pad_and_walls(
    sensor: Sensor, x: Float[Array, "1 b"], y: Float[Array, "a 1"]
) -> tuple[Bool[Array, "a b"], Float[Array, "a b"]]:
    """Whether each ray passes through the pad, and the brightness relative to the pad: 1 on it, less on the walls."""
    width, height = sensor.gel.size
    # The pad's edge coincides with the image's, so a margin absorbs rounding.
    on_pad = (jnp.abs(x * 2 / width) <= 1.0001) & (jnp.abs(y * 2 / height) <= 1.0001)
    # In a corner the ray meets the wall beyond whose edge it is farther out, which is the darker one.
    sides = (jnp.stack([x, 0 * x], axis=-1), jnp.stack([0 * y, y], axis=-1))
    walls = (
        optics.housing(sensor.room, jnp.zeros(side.shape[:-1], bool), side, sensor.gel.size, sensor.camera.distance)
        for side in sides
    )
    return on_pad, jnp.where(on_pad, 1, jnp.minimum(*walls))


def _pixels(samples: list[Float[Array, "a b"]], stride: int) -> list[Float[Array, "h w"]]:
    """Filter samples half a pixel apart by a tent that is one pixel wide at half height. At stride 1, do nothing."""
    if stride == 1:
        return samples
    rows = [0.5 * s[1:-1:2] + 0.25 * (s[:-2:2] + s[2::2]) for s in samples]
    return [0.5 * r[:, 1:-1:2] + 0.25 * (r[:, :-2:2] + r[:, 2::2]) for r in rows]
