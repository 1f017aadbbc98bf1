"""What the sensor sees of an object: both streams, depth, segmentation."""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sts_jax import _math, optics, tactile
from sts_jax.objects.body import Body
from sts_jax.sensor import Sensor


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Frame:
    """One moment of the sensor. Images are float32 in [0, 1], row 0 at the top."""

    visual: Float[Array, "*n h w 3"]  # lights off: the view through the skin, sRGB
    tactile: Float[Array, "*n h w 3"]  # lights on: the skin itself
    depth: Float[Array, "*n h w"]  # m along the optical axis from the pinhole to the object, inf where there is none
    segmentation: Bool[Array, "*n h w"]  # the object
    pose: Float[Array, "*n 7"]  # the pose drawn: the object's mesh frame in the sensor frame, gel in balance
    balanced: Bool[Array, "*n"]  # whether the gel carries the wrench within its limits; False for a non-finite input
    pressure: Float[Array, "*n r c"]  # Pa, on the gel's grid (tactile.cell_centres)
    window: Float[Array, "*n 4"]  # m, (left, top, width, height) on the gel's face that the images show


def sense(
    sensor: Sensor,
    body: Body,
    pose: Float[Array, "7"],
    wrench: Float[Array, "6"] | None = None,
    *,
    resolution: tuple[int, int] = (64, 64),
    crop: bool = False,
) -> Frame:
    """What the sensor sees of one object.

    With a wrench the object sinks and tilts until the gel balances Fz, Mx and My (`tactile.settle`); without one the
    imprint follows from the pose alone. Both streams show the balanced pose. An object that lies wholly below the
    gel's face has fallen off: the images are those of an empty sensor. So they are where pose or wrench are not
    finite; `balanced` is False then.

    Args:
        sensor: its constants.
        body: what touches it.
        pose: mesh frame in the sensor frame: position (m), quaternion.
        wrench: of the pad on the object: force (N) and moment about the sensor's origin (N m), sensor frame.
        resolution: (height, width), pixels. Another aspect than the camera's shows the largest centred part.
        crop: show the square (the image's aspect) around the object.

    Returns:
        Frame.
    """
    finite = jnp.all(jnp.isfinite(pose)) & (_math.norm(jnp.where(jnp.isfinite(pose), pose, 0)[3:]) > 0)
    if wrench is not None:
        finite &= jnp.all(jnp.isfinite(wrench))
        wrench = jnp.where(finite, wrench, 0)
    away = jnp.array([0.0, 0, -1, 1, 0, 0, 0])
    safe_pose = jnp.where(finite, pose, away)
    safe_pose = jnp.concatenate([safe_pose[:3], _math.normalize(safe_pose[3:])])

    points = _math.transform(safe_pose, body.vertices)
    present = jnp.max(points[:, 2]) > 0
    heights = underside(sensor.gel, body, points, present)
    if wrench is None:
        contact = tactile.indent(sensor.gel, heights)
        pressing = present
    else:
        contact = tactile.settle(sensor.gel, heights, jnp.where(present, wrench, 0))
        pressing = present & (wrench[2] > 0)
    turn = _math.quat_from_rotvec(jnp.concatenate([contact.turn, jnp.zeros(1)]))
    drop = jnp.stack([jnp.float32(0), jnp.float32(0), -contact.sink])
    position = _math.transform(jnp.concatenate([drop, turn]), safe_pose[:3])
    drawn = jnp.concatenate([position, _math.quat_multiply(turn, safe_pose[3:])])
    points = _math.transform(drawn, body.vertices)

    if crop:
        window = optics.object_window(
            sensor.camera, jnp.where(present, points, jnp.array([[0.0, 0.0, -1.0]])), resolution
        )
    else:
        window = optics.full_window(sensor.camera, resolution)

    fine = min(resolution) < sensor.fine_below
    if fine:
        # Every other sample is a pixel's centre; the others lie half way between.
        shape = (2 * resolution[0] + 1, 2 * resolution[1] + 1)
        pitch = window[2:] / jnp.array([resolution[1], resolution[0]], jnp.float32) / 2
        seen = jnp.concatenate([window[:2] - pitch / 2, pitch * jnp.array([shape[1], shape[0]], jnp.float32)])
    else:
        shape, seen = resolution, window

    visual, touch, depth, hit = _draw(sensor, body, points, drawn, present, pressing, seen, shape)
    if fine:
        visual, touch = _filter(visual), _filter(touch)
        depth, hit = depth[1::2, 1::2], hit[1::2, 1::2]
    return Frame(
        visual=jnp.clip(optics.to_srgb(visual), 0, 1),
        tactile=jnp.clip(touch, 0, 1),
        depth=jnp.where(hit, depth, jnp.inf),
        segmentation=hit,
        pose=jnp.where(finite, drawn, pose),
        balanced=contact.balanced & finite,
        pressure=contact.pressure,
        window=window,
    )


def underside(
    gel: tactile.Gel, body: Body, points: Float[Array, "v 3"], present: Bool[Array, ""]
) -> Float[Array, "r c"]:
    """Heights of an object's underside over the gel's face, on the gel's grid.

    Args:
        gel: whose grid.
        body: the object.
        points: its vertices, sensor frame (m).
        present: whether there is anything at all.

    Returns:
        Heights (m), `inf` where nothing within the gel's reach lies over a cell.
    """
    rows, columns = gel.cells
    scale = jnp.stack([columns / jnp.asarray(gel.size[0]), rows / jnp.asarray(gel.size[1])])
    middle = jnp.array([columns, rows], jnp.float32) / 2
    places = points[:, :2] * scale[None, :] + middle[None, :] - 0.5
    height = points[:, 2]
    # No part can reach the gel that is higher over first touch than depth and tilts bring it down.
    reach = gel.max_depth + jnp.tan(gel.max_tilt) * (gel.size[0] + gel.size[1])
    keep = present & (jnp.min(height[body.faces], axis=1) < jnp.min(height) + reach)
    winner = optics.rasterise(places, height, body.faces, keep, body.two_sided, gel.cells)
    weights = optics.barycentrics(places, body.faces, winner)
    corners = height[body.faces][jnp.maximum(winner, 0)]
    value = sum(weights[k] * corners[..., k] for k in range(3))
    return jnp.where(winner >= 0, value, jnp.inf)


def _draw(
    sensor: Sensor,
    body: Body,
    points: Float[Array, "v 3"],
    pose: Float[Array, "7"],
    present: Bool[Array, ""],
    pressing: Bool[Array, ""],
    window: Float[Array, "4"],
    shape: tuple[int, int],
) -> tuple[Float[Array, "h w 3"], Float[Array, "h w 3"], Float[Array, "h w"], Bool[Array, "h w"]]:
    camera, gel = sensor.camera, sensor.gel
    pixels, far = optics.to_pixels(camera, window, shape, points)
    inverse = 1 / jnp.maximum(far, camera.near)
    keep = present & jnp.all(far[body.faces] > camera.near, axis=1)
    winner = optics.rasterise(pixels, -inverse, body.faces, keep, body.two_sided, shape)
    hit = winner >= 0
    nearest = jnp.maximum(winner, 0)

    corners = inverse[body.faces][nearest]
    weights = [w * corners[..., k] for k, w in enumerate(optics.barycentrics(pixels, body.faces, winner))]
    depth = 1 / sum(weights)
    weights = [w * depth for w in weights]
    # Kept as they are: XLA would work them out again for each of the neighbours that a normal needs.
    depth, weights, nearest = jax.lax.optimization_barrier((depth, weights, nearest))
    slopes = optics.rays(camera, window, shape)

    # seen through the skin
    on_face = slopes * camera.distance
    half = jnp.stack([jnp.asarray(gel.size[0]), jnp.asarray(gel.size[1])]) / 2
    on_pad = jnp.all(jnp.abs(on_face) <= 1.0001 * half[None, None, :], axis=-1)  # its edge is the image's: no rounding
    square_radius = jnp.sum((on_face / half[None, None, :]) ** 2, axis=-1)
    empty = optics.empty_view(sensor.room, square_radius, on_pad.astype(jnp.float32))
    turned = body.normals @ _math.quat_matrix(pose[3:]).T
    corners = jnp.concatenate([turned, body.colors, body.uv], axis=-1).reshape(-1, 24)[nearest]
    values = sum(weights[k][..., None] * corners[..., 8 * k : 8 * k + 8] for k in range(3))
    normals = _math.normalize(values[..., :3])
    towards = normals[..., 0] * slopes[..., 0] + normals[..., 1] * slopes[..., 1] + normals[..., 2]
    normals = jnp.where((body.two_sided & (towards > 0))[..., None], -normals, normals)
    albedo = values[..., 3:6] * optics.sample_texture(body.texture, values[..., 6:])
    shaded = optics.shade(sensor.room, albedo, normals, depth - camera.distance, empty)
    visual = jnp.where(hit[..., None], shaded, empty)

    # the skin itself
    face = jnp.asarray(camera.distance)
    skin = jnp.where(hit & on_pad & pressing, jnp.clip(depth, face - gel.thickness, face), face)
    surface = jnp.concatenate([slopes * skin[..., None], (skin - face)[..., None]], axis=-1)
    skin_normals = tactile.surface_normals(jax.lax.optimization_barrier(surface))
    light = tactile.phong(sensor.phong, sensor.lights, jax.lax.optimization_barrier(skin_normals), surface)
    dark = tactile.darken(sensor.phong, face - skin) * jnp.where(on_pad, 1, sensor.room.rim)
    return visual, light * dark[..., None], depth, hit


def _filter(samples: Float[Array, "a b 3"]) -> Float[Array, "h w 3"]:
    """A tent one pixel wide at half height: from samples half a pixel apart to pixels."""

    def tent(number: int) -> Float[Array, "n a"]:
        off = jnp.abs(jnp.arange(2 * number + 1)[None, :] - 2 * jnp.arange(number)[:, None] - 1)
        return jnp.maximum(0.5 - 0.25 * off, 0)

    down, across = tent(samples.shape[0] // 2), tent(samples.shape[1] // 2)
    return jnp.einsum("ia,jb,abk->ijk", down, across, samples)
