"""The second of the two compiled programs of `sense`, one for each resolution: it draws the images of an object."""

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
from sts_jax.rendering.lit_skin import lit_skin, passing, smoothed
from sts_jax.rendering.loop import looped
from sts_jax.rendering.tiles import lines, planes, where_active
from sts_jax.sensor import Sensor

_SKY_TOP = 2.0  # height above the gel, relative to the pad's longer side, above which several objects hide no sky


class Images(NamedTuple):
    """Images of one moment, and the part of the gel that they show."""

    visual: Float[Array, "h w 3"]  # view through the skin, sRGB in [0, 1]
    tactile: Float[Array, "h w 3"]  # image of the lit skin in [0, 1]
    depth: Float[Array, "h w"]  # depth from the pinhole (m), `inf` where there is no object
    segmentation: Bool[Array, "h w"]  # pixels of the object
    body: Int[Array, "h w"]  # index of the object that is seen, -1 where there is none
    window: Float[Array, "4"]  # part of the gel's face in the images: left, top, width, height (m)


class Surface(NamedTuple):
    """Faces to draw, of one object, or of n objects whose vertices are in one list."""

    faces: Int[Array, "f 3"]  # vertex indices
    normals: Float[Array, "f 3 3"]  # normals at the corners of each face, mesh frame
    colors: Float[Array, "f 3 3"]  # linear RGB colours at the corners of each face
    uv: Float[Array, "f 3 2"]  # texture coordinates at the corners of each face
    texture: Float[Array, "t t 3"] | optics.Texels  # texture, or those of n objects, multiplied by the colours
    two_sided: Bool[Array, "*f"]  # True if faces, or each face, are also visible from behind
    owner: Int[Array, "f"] | None = None  # object of each face, None for one object


class _Samples(NamedTuple):
    """Grid of samples, one ray each, from which the pixels are filtered, and the object's faces on this grid."""

    seen: Float[Array, "4"]  # part of the gel's face that the grid covers: left, top, width, height (m)
    pitch: Float[Array, "2"]  # distance between samples along x and y on the gel's face (m)
    slopes: tuple[Float[Array, "1 b"], Float[Array, "a 1"]]  # x / depth and y / depth of the rays
    places: tuple[Float[Array, "1 b"], Float[Array, "a 1"]]  # x and y at which the rays cross the gel's face (m)
    on_pad: Bool[Array, "a b"]  # True for rays that pass through the pad
    walls: Float[Array, "a b"]  # brightness relative to the pad: 1 on the pad, less on the housing's walls
    corners: Corners  # vertices on the grid, with the value 1 / depth (1/m)
    winner: Int[Array, "a b"]  # index of the nearest face, -1 where there is none


class _Scene(NamedTuple):
    """Constants of the sensor and the faces, for shading."""

    sensor: Sensor
    corners: Corners  # vertices on the grid of samples
    turn: Float[Array, "*n 3 3"]  # rotation matrix from the mesh frame to the sensor frame
    surface: Surface


@functools.partial(jax.jit, static_argnames=("resolution", "crop", "moving_edges"))
def draw(
    sensor: Sensor, body: Body, resting: Resting, *, resolution: tuple[int, int], crop: bool, moving_edges: bool
) -> Images:
    """Draw the images of an object in the pose that `rendering.equilibrium` found. See `sense`."""

    def drawn(sensor: Sensor, body: Body, resting: Resting) -> Images:
        surface = Surface(body.faces, body.normals, body.colors, body.uv, body.texture, body.two_sided)
        return images_of(sensor, surface, resting, resolution=resolution, crop=crop, moving_edges=moving_edges)

    return looped(drawn)(sensor, body, resting)


@jax.jit
def touch(
    sensor: Sensor, imprint: Float[Array, "h w"], window: Float[Array, "4"], shear: Float[Array, "r c 2"] | None
) -> Float[Array, "h w 3"]:
    """Draw the tactile image of an imprint (m) in a window (m). See `sts_jax.touch`."""
    rows, columns = imprint.shape
    pitch = window[2:] / jnp.array([columns, rows], jnp.float32)
    seen = jnp.concatenate([window[:2] - pitch, window[2:] + 2 * pitch])
    slopes = lines(optics.rays(sensor.camera, seen, (rows + 2, columns + 2)))
    imprint = jnp.where(imprint > 0, jnp.minimum(imprint, sensor.gel.thickness), 0)
    imprint = smoothed(sensor, jnp.pad(imprint, 1, mode="edge"), pitch)
    lit = lit_skin(sensor, imprint, seen, slopes)
    ink = passing(sensor, imprint, pitch, slopes, shear)
    x, y = (slope * sensor.camera.distance for slope in slopes)
    walls = _pad_and_walls(sensor, x[:, 1:-1], y[1:-1])[1]
    return jnp.stack([jnp.clip(channel * walls * ink, 0, 1) for channel in lit], axis=-1)


def images_of(
    sensor: Sensor, surface: Surface, resting: Resting, *, resolution: tuple[int, int], crop: bool, moving_edges: bool
) -> Images:
    """Draw one item: sample, shade, light, and filter to pixels."""
    if crop:
        corners_seen = jnp.where(resting.present, resting.points, jnp.array([[0.0, 0.0, -1.0]]))
        window = optics.object_window(sensor.camera, corners_seen, resolution)
    else:
        window = optics.full_window(sensor.camera, resolution)
    # Large images have one sample per pixel. In small ones, every second sample is a pixel centre, and the others lie
    # half-way between.
    stride = 2 if min(resolution) < sensor.fine_below else 1
    samples = _sample(sensor, surface, resting, window, resolution, stride)
    depth, light = _see(sensor, surface, resting, samples)
    owner = jnp.zeros((), jnp.int32) if surface.owner is None else surface.owner[jnp.maximum(samples.winner, 0)]
    pressing = resting.pressing if surface.owner is None else resting.pressing[owner]
    imprint = _imprint(sensor, pressing, samples, depth, moving_edges)
    imprint = smoothed(sensor, imprint, samples.pitch)
    lit = lit_skin(sensor, imprint, samples.seen, samples.slopes)
    ink = passing(sensor, imprint, samples.pitch, samples.slopes, resting.shear)
    visual = _pixels([channel[1:-1, 1:-1] * ink for channel in light], stride)
    visual = [jnp.clip(optics.to_srgb(channel), 0, 1) for channel in visual]
    lit = _pixels([channel * samples.walls[1:-1, 1:-1] * ink for channel in lit], stride)
    lit = [jnp.clip(channel, 0, 1) for channel in lit]
    body = jnp.where(samples.winner >= 0, owner, -1)
    depth, body = (image[1:-1, 1:-1] if stride == 1 else image[2:-1:2, 2:-1:2] for image in (depth, body))
    return Images(
        visual=jnp.stack(visual, axis=-1),
        tactile=jnp.stack(lit, axis=-1),
        depth=depth,
        segmentation=jnp.isfinite(depth),
        body=body,
        window=window,
    )


def _sample(
    sensor: Sensor,
    surface: Surface,
    resting: Resting,
    window: Float[Array, "4"],
    resolution: tuple[int, int],
    stride: int,
) -> _Samples:
    """Project and rasterise the faces on a grid with `stride` samples per pixel in each direction.

    The grid extends beyond the image by the samples that the filter needs, and by one more ring for the normals.
    """
    camera = sensor.camera
    shape = (stride * resolution[0] + stride + 1, stride * resolution[1] + stride + 1)
    pitch = window[2:] / jnp.array([resolution[1], resolution[0]], jnp.float32) / stride
    before = pitch * (stride + 1) / 2
    seen = jnp.concatenate([window[:2] - before, pitch * jnp.array([shape[1], shape[0]], jnp.float32)])
    pixels, far = optics.to_pixels(camera, seen, shape, resting.points)
    inverse = 1 / jnp.maximum(far, camera.near)
    keep = resting.present & (far > camera.near)
    distant = surface.owner is not None
    winner = optics.rasterise(pixels, -inverse, surface.faces, keep, surface.two_sided, shape, distant=distant)
    slopes = lines(optics.rays(camera, seen, shape))
    x, y = (slope * camera.distance for slope in slopes)
    on_pad, walls = _pad_and_walls(sensor, x, y)
    corners = Corners(pixels[:, 0], pixels[:, 1], inverse, surface.faces)
    return _Samples(seen, pitch, slopes, (x, y), on_pad, walls, corners, winner)


def _see(
    sensor: Sensor, surface: Surface, resting: Resting, samples: _Samples
) -> tuple[Float[Array, "a b"], list[Float[Array, "a b"]]]:
    """Depth (m), and the three channels of the view through the skin in linear light."""
    size, winner, (x, y) = sensor.gel.size, samples.winner, samples.places
    top = _cpu_reductions.maximum(resting.points[:, 2])
    if surface.owner is not None:  # walls beside the pad would spread the slices over their height
        top = jnp.minimum(top, _SKY_TOP * jnp.maximum(*size))
    hidden = optics.hidden_sky(resting.heights, size, top, x[0], y[:, 0])
    square_radius = (x * 2 / size[0]) ** 2 + (y * 2 / size[1]) ** 2
    empty = planes(optics.empty_view(sensor.room, square_radius, samples.walls, hidden))
    scene = _Scene(sensor, samples.corners, geometry.quat_to_matrix(resting.pose[..., 3:]), surface)
    centres = lines(optics.pixel_centres(winner.shape))
    images = (winner, samples.on_pad, *centres, *samples.slopes, hidden, *empty)
    depth, *light = where_active(_shade, winner >= 0, scene, images, [jnp.full(winner.shape, jnp.inf), *empty])
    return depth, light


def _shade(scene: _Scene, images: tuple[Array, ...]) -> list[Float[Array, "h w"]]:
    """Depth of the object (m), and the three channels of its colour through the skin in linear light."""
    winner, on_pad, column, row, slope_x, slope_y, hidden, *empty = images
    nearest = jnp.maximum(winner, 0)
    surface, turn = scene.surface, scene.turn
    two_sided = surface.two_sided
    if surface.owner is not None:
        owner = surface.owner[nearest]
        turn, two_sided = jnp.moveaxis(turn[owner], (-2, -1), (0, 1)), two_sided[nearest]
    shares = weighted(scene.corners, winner, column, row)
    depth = 1 / functools.reduce(operator.add, shares)
    shares = [share * depth for share in shares]

    def inside(values: Float[Array, "f 3 k"]) -> list[Float[Array, "h w"]]:
        size = values.shape[-1]
        of_face = values.reshape(-1, 3 * size)[nearest]
        of_corner = [[share * of_face[..., size * k + i] for k, share in enumerate(shares)] for i in range(size)]
        return [first + second + third for first, second, third in of_corner]

    # Component by component, because arithmetic along an axis of three is slow on a CPU. Components are stacked only
    # for functions of vectors.
    across = inside(surface.normals)
    nx, ny, nz = (row[0] * across[0] + row[1] * across[1] + row[2] * across[2] for row in turn)
    square = nx * nx + ny * ny + nz * nz
    scale = jnp.where(square > 0, 1 / jnp.sqrt(jnp.where(square > 0, square, 1)), 0)
    scale = jnp.where(two_sided & (nx * slope_x + ny * slope_y + nz > 0), -scale, scale)
    normal = jnp.stack([scale * nx, scale * ny, scale * nz], axis=-1)
    places = jnp.stack(inside(surface.uv), axis=-1)
    if isinstance(surface.texture, optics.Texels):
        sampled = optics.sample_texels(surface.texture, owner, places)
    else:
        sampled = optics.sample_texture(surface.texture, places)
    albedo = jnp.stack([color * sampled[..., k] for k, color in enumerate(inside(surface.colors))], axis=-1)
    height = depth - scene.sensor.camera.distance
    color = planes(optics.shade(scene.sensor.room, albedo, normal, height, jnp.stack(empty, axis=-1), hidden))
    return [depth, *(jnp.where(on_pad, seen, behind) for seen, behind in zip(color, empty, strict=True))]


def _imprint(
    sensor: Sensor, pressing: Bool[Array, "..."], samples: _Samples, depth: Float[Array, "a b"], moving_edges: bool
) -> Float[Array, "a b"]:
    """Depth of the imprint at the samples (m), 0 where the object does not touch the gel."""
    thickness, face = sensor.gel.thickness, jnp.asarray(sensor.camera.distance)
    touched = samples.on_pad & pressing & (depth < face)
    if not moving_edges:
        return jnp.where(touched, jnp.minimum(face - depth, thickness), 0)
    imprint = jnp.where(touched, jnp.minimum(face - jax.lax.stop_gradient(depth), thickness), 0)
    images = (samples.winner, *optics.pixel_centres(samples.winner.shape))
    follows = touched & (face - depth < thickness)
    return with_moving_edges(imprint, samples.corners, images, depth, samples.on_pad, follows)


def _pad_and_walls(
    sensor: Sensor, x: Float[Array, "1 b"], y: Float[Array, "a 1"]
) -> tuple[Bool[Array, "a b"], Float[Array, "a b"]]:
    """Mask of the rays that pass through the pad, and brightness relative to the pad: 1 on it, less on the walls."""
    width, height = sensor.gel.size
    # The edges of the pad and of the image coincide, so a margin absorbs rounding.
    on_pad = (jnp.abs(x * 2 / width) <= 1.0001) & (jnp.abs(y * 2 / height) <= 1.0001)
    # Beyond a corner of the pad, a ray meets one of two walls first, at the larger depth. This wall is the darker one.
    sides = (jnp.stack([x, 0 * x], axis=-1), jnp.stack([0 * y, y], axis=-1))
    walls = (
        optics.housing(sensor.room, jnp.zeros(side.shape[:-1], bool), side, sensor.gel.size, sensor.camera.distance)
        for side in sides
    )
    return on_pad, jnp.where(on_pad, 1, jnp.minimum(*walls))


def _pixels(samples: list[Float[Array, "a b"]], stride: int) -> list[Float[Array, "h w"]]:
    """Filter samples half a pixel apart with the weights 1/4, 1/2, 1/4 along both axes. Stride 1 needs no filter."""
    if stride == 1:
        return samples
    rows = [0.5 * s[1:-1:2] + 0.25 * (s[:-2:2] + s[2::2]) for s in samples]
    return [0.5 * r[:, 1:-1:2] + 0.25 * (r[:, :-2:2] + r[:, 2::2]) for r in rows]
