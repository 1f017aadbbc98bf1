"""The sensor's images of an object: both streams, depth and segmentation."""

import dataclasses
import functools
import operator
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, ScalarLike

from sts_jax import _math, geometry, optics, tactile
from sts_jax._loop import looped
from sts_jax._tiles import where_active
from sts_jax.objects.body import FACE_CLASSES, Body, is_traced
from sts_jax.sensor import Sensor

# column, row and a third value of each vertex, and the corner indices of each face
_Corners = tuple[tuple[Float[Array, "v"], Float[Array, "v"], Float[Array, "v"]], Int[Array, "f 3"]]
_UNTOUCHED = 1e-8  # m, an imprint too shallow to change an image, such as the tail of the skin's coupling


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Frame:
    """One moment of the sensor. Images are float32 in [0, 1], row 0 at the top."""

    visual: Float[Array, "*n h w 3"]  # lights off: the view through the skin, sRGB
    tactile: Float[Array, "*n h w 3"]  # lights on: the skin itself
    # m along the optical axis from the pinhole to the object, also behind the housing's walls, inf where there is none
    depth: Float[Array, "*n h w"]
    segmentation: Bool[Array, "*n h w"]  # pixels of the object, where depth is finite
    pose: Float[Array, "*n 7"]  # mesh frame in the sensor frame, as drawn, with the gel in balance
    # whether the gel carries the wrench within its limits, False for a non-finite input or an invalid sensor
    balanced: Bool[Array, "*n"]
    pressure: Float[Array, "*n r c"]  # Pa, on the gel's grid (tactile.cell_centres)
    window: Float[Array, "*n 4"]  # m, (left, top, width, height) of the part of the gel's face in the images

    def __repr__(self) -> str:
        if not hasattr(self.depth, "shape") or len(self.depth.shape) < 2:  # JAX also builds trees of other leaves
            return f"Frame(depth={self.depth!r})"
        *lead, height, width = self.depth.shape
        size = f"{width} x {height} pixels"
        if lead or isinstance(self.depth, jax.core.Tracer) or not isinstance(self.depth, jax.Array | np.ndarray):
            return f"Frame({' x '.join(map(str, lead))}{' frames, ' if lead else ''}{size})"
        seen = np.asarray(self.segmentation).mean()
        pressed = "nothing presses on the gel"
        if np.any(self.pressure > 0):
            pressed = f"pressure up to {np.max(self.pressure) / 1e3:.3g} kPa"
        balance = "balanced" if self.balanced else "not balanced"
        return f"Frame({size}, object in {seen:.1%} of the view, {pressed}, {balance})"


def sense(
    sensor: Sensor,
    body: Body,
    pose: Float[Array, "7"],
    wrench: Float[Array, "6"] | None = None,
    *,
    resolution: tuple[int, int] = (64, 64),
    crop: bool = False,
    moving_edges: bool = False,
) -> Frame:
    """Render one object as the sensor sees it.

    With a wrench, the object sinks and tilts until the gel balances Fz, Mx and My (`tactile.settle`). Without one, the
    imprint follows from the pose alone. Both streams show the balanced pose. An object that is wholly below the gel's
    face has fallen off, and the images are those of an empty sensor.

    The images are also empty, and `balanced` is False, if the pose or the wrench is not finite, the squared length of
    the quaternion is zero or overflows, or a traced body has a vertex, normal or colour that is not finite.

    It compiles itself once for each resolution and size class of bodies (faces and texture), and works inside other
    compiled functions, `vmap` and `grad`.

    An invalid sensor (`Sensor.check`) raises an error. Traced constants, such as those of a jitted function's argument,
    have no values to check. If they are invalid, the images are those of an empty sensor with the default constants in
    their place, never NaN, and `balanced` is False.

    Args:
        sensor: constants of the sensor.
        body: the object.
        pose: mesh frame in the sensor frame: position (m), quaternion.
        wrench: of the pad on the object: force (N) and moment about the sensor's origin (N m), sensor frame.
        resolution: (height, width), pixels. Another aspect ratio than the camera's shows the largest centred part.
        crop: show a window of the image's aspect ratio around the object.
        moving_edges: for fitting poses. Adds the effect of the imprint's moving edges to the derivative of the tactile
            image by the pose, accurate on average over a few pixels (`_carried`). The default derivative is that of
            each pixel and ignores them. The images are the same.

    Returns:
        Frame.

    Raises:
        ValueError: the resolution is not two whole numbers above 0, the pose or the wrench has a wrong shape, or the
            body has more faces than can be drawn (all checked under `jit` too), or `check` of the sensor or the body
            raises an error. Traced values are not checked.
        TypeError: `sensor` is not a `Sensor`, `body` is not a `Body`, or `pose` or `wrench` is not an array of numbers.
    """
    _check_kinds(sensor, body)
    pose = _numbers("pose", pose, "(7,), position (m), quaternion")
    wrench = None if wrench is None else _numbers("wrench", wrench, "(6,), force (N) and moment (N m)")
    _check_shapes(body, pose, wrench, resolution)
    sensor, sound = sensor.guard()
    sound = jnp.asarray(sound)
    if is_traced(body):
        for values in (body.vertices, body.normals, body.colors):
            sound &= jnp.all(jnp.isfinite(values))
    # Hulls and interior are not drawn. Without them, bodies of one size class share a program.
    body = dataclasses.replace(body, hulls=jnp.zeros((1, 1, 3)), interior=jnp.zeros((1, 3, 3)))
    height, width = (int(n) for n in resolution)
    # Two programs, so that the first one serves every resolution.
    resting = _balance(sensor.gel, sound, body.vertices, body.faces, body.two_sided, pose, wrench)
    return _draw(sensor, body, resting, resolution=(height, width), crop=bool(crop), moving_edges=bool(moving_edges))


class _Resting(NamedTuple):
    """An object in balance on the gel, before it is drawn and independent of the resolution."""

    points: Float[Array, "v 3"]  # m, vertices, sensor frame
    pose: Float[Array, "7"]  # in balance, or a pose below the pad if the given one is not finite
    shown: Float[Array, "7"]  # in balance, or the given one if it is not finite
    heights: Float[Array, "r c"]  # m, of its underside over the gel's grid
    present: Bool[Array, ""]  # some part is above the gel's face
    pressing: Bool[Array, ""]  # it presses on the gel
    balanced: Bool[Array, ""]
    pressure: Float[Array, "r c"]  # Pa


def _balanced(
    gel: tactile.Gel,
    sound: Bool[Array, ""],
    vertices: Float[Array, "v 3"],
    faces: Int[Array, "f 3"],
    two_sided: Bool[Array, ""],
    pose: Float[Array, "7"],
    wrench: Float[Array, "6"] | None,
) -> _Resting:
    length = geometry.norm(jnp.where(jnp.isfinite(pose), pose, 0)[3:])
    finite = sound & jnp.all(jnp.isfinite(pose)) & (length > 0) & jnp.isfinite(length)
    if wrench is not None:
        finite &= jnp.all(jnp.isfinite(wrench))
        wrench = jnp.where(finite, wrench, 0)
    safe_pose = jnp.where(finite, pose, jnp.array([0.0, 0, -1, 1, 0, 0, 0]))
    safe_pose = jnp.concatenate([safe_pose[:3], geometry.normalize(safe_pose[3:])])

    points = _placed(finite, safe_pose, vertices, jnp.full_like(vertices, -1))
    present = _math.most(points[:, 2]) > 0
    heights, whole = underside(gel, faces, two_sided, points, present)
    if wrench is None:
        contact = tactile.indent(gel, heights)
        pressing = present
    else:
        contact = tactile.settle(gel, heights, jnp.where(present, wrench, 0))
        pressing = present & (wrench[2] > 0)
    turn = geometry.quat_from_rotvec(jnp.concatenate([contact.turn, jnp.zeros(1)]))
    drop = jnp.stack([jnp.float32(0), jnp.float32(0), -contact.sink])
    position = geometry.transform(jnp.concatenate([drop, turn]), safe_pose[:3])
    drawn = jnp.concatenate([position, geometry.quat_canonical(geometry.quat_multiply(turn, safe_pose[3:]))])
    points = _placed(pressing, drawn, vertices, points)
    return _Resting(
        points,
        drawn,
        jnp.where(finite, drawn, pose),
        whole,
        present,
        pressing,
        contact.balanced & finite,
        contact.pressure,
    )


_balance = jax.jit(looped(_balanced))


def _placed(
    so: Bool[Array, ""], pose: Float[Array, "7"], vertices: Float[Array, "v 3"], otherwise: Float[Array, "v 3"]
) -> Float[Array, "v 3"]:
    """Vertices in the sensor frame if `so`, else `otherwise`, with separate memory for x, y and z."""
    # XLA keeps the result of a condition. It would recompute any other value at each use.
    planes = jax.lax.cond(so, lambda: tuple(geometry.transform(pose, vertices).T), lambda: tuple(otherwise.T))
    return jnp.stack(planes, axis=-1)


def _check_sensor(sensor: Any) -> None:
    if not isinstance(sensor, Sensor):
        raise TypeError(f"sensor is {sensor!r}, but it must be a Sensor, for instance sts.Sensor()")


def _check_kinds(sensor: Any, body: Any) -> None:
    _check_sensor(sensor)
    if not isinstance(body, Body):
        several = isinstance(body, Sequence) and not isinstance(body, str)
        remedy = "For several use objects.stack and jax.vmap" if several else "objects.load reads a mesh file"
        raise TypeError(f"body is {body!r}, but it must be one Body. {remedy}")
    if body.vertices.ndim != 2 or not is_traced(body):
        body.check()


def _numbers(name: str, value: Any, wanted: str) -> Array:
    """The value as a floating-point array. A named tuple, such as a whole `Placement`, raises an error."""
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        raise TypeError(f"{name} is a {type(value).__name__}, but must be an array of shape {wanted}. Unpack it with *")
    try:
        return jnp.asarray(value, float)
    except (TypeError, ValueError):
        raise TypeError(f"{name} is {value!r}, but it must be an array of shape {wanted}") from None


def _check_shapes(body: Body, pose: Array, wrench: Array | None, resolution: Any) -> None:
    whole = isinstance(resolution, Sequence) and all(isinstance(n, int | np.integer) for n in resolution)
    if not whole or len(resolution) != 2 or min(resolution) < 1:
        raise ValueError(
            f"resolution is {resolution!r}, but it must be two whole numbers of pixels, (height, width), both > 0"
        )
    if pose.shape != (7,):
        raise ValueError(
            f"pose has the shape {pose.shape}, but it must be (7,), position (m), quaternion. For several poses use "
            "jax.vmap"
        )
    if wrench is not None and wrench.shape != (6,):
        raise ValueError(
            f"wrench has the shape {wrench.shape}, but it must be (6,), force (N) and moment (N m). For several "
            "wrenches use jax.vmap"
        )
    if len(body.faces) > FACE_CLASSES[-1]:
        raise ValueError(
            f"body has {len(body.faces):,} faces, but at most {FACE_CLASSES[-1]:,} can be drawn. Decimate the mesh "
            "file with objects.load(..., faces=)"
        )


def expose(sensor: Sensor, frame: Frame, light: ScalarLike) -> Float[Array, "*n h w 3"]:
    """The image with the internal light between off, `Frame.visual`, and full, `Frame.tactile`.

    The LEDs' light adds to the light through the skin, in linear values. The camera exposes the visual stream V k times
    as long as the tactile stream T (`Room.exposure`). At a share l of the LEDs' power, the exposure preserves the
    brightness of pixels that are equally bright in both streams:

        image = ((1 - l) V + l k T) / (1 - l + l k)

    Args:
        sensor: the sensor of the frame.
        frame: one frame or a batch, with any leading axes.
        light: share of the LEDs' full power, 0 to 1. Under `jit` and `vmap`, where no error can be raised, it is
            clipped, and NaN counts as 0.

    Returns:
        Image, sRGB in [0, 1], which equals `frame.visual` at 0 and `frame.tactile` at 1.

    Raises:
        TypeError: `frame` is no `Frame`, or `light` is no number.
        ValueError: `light` is outside [0, 1] or has an axis, or `Sensor.check` raises an error. Traced values are
            not checked. If the constants of a traced sensor are invalid, the default exposure is used.
    """
    _check_sensor(sensor)
    sensor, _ = sensor.guard()
    if not isinstance(frame, Frame):
        raise TypeError(f"frame is a {type(frame).__name__}, but it must be the Frame that sense returns")
    if not isinstance(light, jax.core.Tracer) and np.asarray(light).dtype.kind not in "iuf":
        raise TypeError(f"light is {light!r}, but it must be one number from 0 (visual) to 1 (tactile)")
    if jnp.ndim(light):
        raise ValueError(f"light has the shape {jnp.shape(light)}, but it must be one number. For several use jax.vmap")
    if not isinstance(light, jax.core.Tracer) and not 0 <= np.asarray(light) <= 1:
        raise ValueError(f"light is {light}, but it must be a share of the LEDs' power, from 0 (visual) to 1 (tactile)")
    light = jnp.asarray(light, jnp.float32)
    light = jnp.where(light >= 0, jnp.where(light <= 1, light, 1), 0)
    bright = light * sensor.room.exposure
    share = bright / (1 - light + bright)
    mixed = optics.to_srgb((1 - share) * optics.to_linear(frame.visual) + share * optics.to_linear(frame.tactile))
    # The conversion to linear light and back rounds. At 0 and 1 the difference to the stream is added back.
    ends = jnp.where(share == 0, frame.visual - mixed, jnp.where(share == 1, frame.tactile - mixed, 0))
    return jnp.clip(mixed + jax.lax.stop_gradient(ends), 0, 1)


def touch(
    sensor: Sensor, imprint: Float[Array, "h w"], window: Float[Array, "4"] | None = None
) -> Float[Array, "h w 3"]:
    """Render the tactile image of a given imprint, whatever its source.

    Args:
        sensor: constants of the camera, gel, skin, lights, reflectance and housing.
        imprint: depth of the imprint (m) where the ray of each pixel meets the skin, 0 without contact. Clipped to the
            gel's thickness. NaN counts as 0.
        window: part of the gel's face in the image, (left, top, width, height) (m). Default: the whole view.

    Returns:
        Image in [0, 1], equal to `Frame.tactile` of this imprint, except that `sense` samples small images more finely
        (`Sensor.fine_below`). If traced constants or a traced window are invalid, it shows flat skin in the whole view,
        with default constants in the place of invalid ones.

    Raises:
        TypeError: `imprint` is no array.
        ValueError: the imprint is not an image or has whole numbers, the window has no area or is not finite, or
            `Sensor.check` raises an error. Traced values are not checked.
    """
    _check_sensor(sensor)
    try:
        imprint = jnp.asarray(imprint)
    except (TypeError, ValueError):
        raise TypeError(f"imprint is {imprint!r}, but it must be an array (height, width) in metres") from None
    if not jnp.issubdtype(imprint.dtype, jnp.floating):
        raise ValueError(
            f"imprint has the type {imprint.dtype}, but it must be floating-point, in metres (0.0005 is half a "
            "millimetre). Multiply a depth image of whole numbers by the metres of one unit first"
        )
    imprint = jnp.asarray(imprint, float)
    if imprint.ndim != 2 or 0 in imprint.shape:
        raise ValueError(
            f"imprint has the shape {imprint.shape}, but it must be (height, width). For several use jax.vmap"
        )
    sensor, sound = sensor.guard()
    rows, columns = imprint.shape
    full = optics.full_window(sensor.camera, (rows, columns))
    window = full if window is None else _numbers("window", window, "(4,), left, top, width, height (m)")
    if window.shape != (4,):
        raise ValueError(f"window has the shape {window.shape}, but it must be (4,), left, top, width, height (m)")
    somewhere = jnp.all(jnp.isfinite(window)) & jnp.all(window[2:] > 0)
    if not isinstance(somewhere, jax.core.Tracer) and not somewhere:
        raise ValueError(f"window is {window}, but it needs finite left, top, width, height (m), the last two > 0")
    sound &= somewhere
    window = jnp.where(sound, window, full)
    return _touch(sensor, jnp.where(sound, imprint, 0), window)


@jax.jit
def _touch(sensor: Sensor, imprint: Float[Array, "h w"], window: Float[Array, "4"]) -> Float[Array, "h w 3"]:
    rows, columns = imprint.shape
    pitch = window[2:] / jnp.array([columns, rows], jnp.float32)
    seen = jnp.concatenate([window[:2] - pitch, window[2:] + 2 * pitch])
    slopes = _lines(optics.rays(sensor.camera, seen, (rows + 2, columns + 2)))
    imprint = jnp.where(imprint > 0, jnp.minimum(imprint, sensor.gel.thickness), 0)
    lit = _lit(sensor, jnp.pad(imprint, 1, mode="edge"), seen, pitch, slopes)
    x, y = (slope * sensor.camera.distance for slope in slopes)
    walls = _pad(sensor, x[:, 1:-1], y[1:-1])[1]
    return jnp.stack([jnp.clip(channel * walls, 0, 1) for channel in lit], axis=-1)


def underside(
    gel: tactile.Gel,
    faces: Int[Array, "f 3"],
    two_sided: Bool[Array, ""],
    points: Float[Array, "v 3"],
    present: Bool[Array, ""],
) -> tuple[Float[Array, "r c"], Float[Array, "r c"]]:
    """Heights of an object's underside over the gel's face, on the gel's grid.

    Args:
        gel: the gel, which has the grid.
        faces: vertex indices of the object's faces.
        two_sided: whether faces are visible from behind too.
        points: vertices, sensor frame (m).
        present: whether there is an object at all.

    Returns:
        Two height maps (m): of the faces within the gel's reach, which alone can press on it, and of all faces, which
        block the light. Both are `inf` where no face lies over a cell.
    """
    rows, columns = gel.cells
    across, down, height = (points[:, k] for k in range(3))
    # Parts that are farther above the lowest point than the largest depth and tilt can lower them never press.
    extent = sum(_math.most(part) - _math.least(part) for part in (across, down))
    reach = _math.least(height) + gel.max_depth + jnp.tan(gel.max_tilt) * extent
    across = (across / gel.size[0] + 0.5) * columns - 0.5
    down = (down / gel.size[1] + 0.5) * rows - 0.5
    keep = jnp.broadcast_to(present, height.shape)
    places = jnp.stack([across, down], axis=-1)
    near, winner = optics.rasterise(places, height, faces, keep, two_sided, gel.cells, within=reach)
    corners = (across, down, height), faces
    images = (winner, *_lines(optics.pixel_centres(gel.cells)))
    whole = where_active(_height, winner >= 0, corners, images, jnp.full(gel.cells, jnp.inf))
    return jnp.where(winner == near, whole, jnp.inf), whole


@functools.partial(jax.jit, static_argnames=("resolution", "crop", "moving_edges"))
def _draw(
    sensor: Sensor, body: Body, resting: _Resting, *, resolution: tuple[int, int], crop: bool, moving_edges: bool
) -> Frame:
    drawn = functools.partial(_drawn, resolution=resolution, crop=crop, moving_edges=moving_edges)
    return looped(drawn)(sensor, body, resting)


def _drawn(
    sensor: Sensor, body: Body, resting: _Resting, *, resolution: tuple[int, int], crop: bool, moving_edges: bool
) -> Frame:
    points, present, pressing = resting.points, resting.present, resting.pressing
    if crop:
        corners_seen = jnp.where(present, points, jnp.array([[0.0, 0.0, -1.0]]))
        window = optics.object_window(sensor.camera, corners_seen, resolution)
    else:
        window = optics.full_window(sensor.camera, resolution)
    camera, gel = sensor.camera, sensor.gel
    # One sample per pixel. In small images every second sample is a pixel centre, and the others lie half-way between.
    # One more ring of samples is needed for the normals of the outermost ones.
    stride = 2 if min(resolution) < sensor.fine_below else 1
    shape = (stride * resolution[0] + stride + 1, stride * resolution[1] + stride + 1)
    pitch = window[2:] / jnp.array([resolution[1], resolution[0]], jnp.float32) / stride
    before = pitch * (stride + 1) / 2
    seen = jnp.concatenate([window[:2] - before, pitch * jnp.array([shape[1], shape[0]], jnp.float32)])
    pixels, far = optics.to_pixels(camera, seen, shape, points)
    inverse = 1 / jnp.maximum(far, camera.near)
    winner = optics.rasterise(pixels, -inverse, body.faces, present & (far > camera.near), body.two_sided, shape)

    # the visual stream: the view through the skin
    slopes = _lines(optics.rays(camera, seen, shape))
    x, y = (slope * camera.distance for slope in slopes)  # where the rays cross the gel's face
    on_pad, walls = _pad(sensor, x, y)
    hidden = optics.hidden_sky(resting.heights, gel.size, _math.most(points[:, 2]), x[0], y[:, 0])
    square_radius = (x * 2 / gel.size[0]) ** 2 + (y * 2 / gel.size[1]) ** 2
    empty = _planes(optics.empty_view(sensor.room, square_radius, walls, hidden))
    surface = (body.normals, body.colors, body.uv, body.texture, body.two_sided)
    corners = (pixels[:, 0], pixels[:, 1], inverse), body.faces
    params = (sensor, surface, corners, geometry.quat_to_matrix(resting.pose[3:]))
    images = (winner, on_pad, *_lines(optics.pixel_centres(shape)), *slopes, hidden, *empty)
    depth, *visual = where_active(_look, winner >= 0, params, images, [jnp.full(shape, jnp.inf), *empty])
    visual = _pixels([channel[1:-1, 1:-1] for channel in visual], stride)
    visual = [jnp.clip(optics.to_srgb(channel), 0, 1) for channel in visual]

    # the tactile stream: the skin itself
    face = jnp.asarray(camera.distance)
    touched = on_pad & pressing & (depth < face)
    followed = jax.lax.stop_gradient(depth) if moving_edges else depth
    imprint = jnp.where(touched, jnp.minimum(face - followed, gel.thickness), 0)
    if moving_edges:
        follows = touched & (face - depth < gel.thickness)
        imprint = _carried(imprint, corners, (winner, *optics.pixel_centres(shape)), depth, on_pad, follows)
    lit = [channel * walls[1:-1, 1:-1] for channel in _lit(sensor, imprint, seen, pitch, slopes)]
    lit = [jnp.clip(channel, 0, 1) for channel in _pixels(lit, stride)]
    depth = depth[1:-1, 1:-1] if stride == 1 else depth[2:-1:2, 2:-1:2]
    return Frame(
        visual=jnp.stack(visual, axis=-1),
        tactile=jnp.stack(lit, axis=-1),
        depth=depth,
        segmentation=jnp.isfinite(depth),
        pose=resting.shown,
        balanced=resting.balanced,
        pressure=resting.pressure,
        window=window,
    )


def _pad(
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


def _lit(
    sensor: Sensor,
    imprint: Float[Array, "a b"],
    window: Float[Array, "4"],
    pitch: Float[Array, "2"],
    slopes: tuple[Float[Array, "1 b"], Float[Array, "a 1"]],
) -> list[Float[Array, "h w"]]:
    """The lit skin at the samples of an imprint, without the outermost, which serve for their neighbours' normals."""
    coupled = sensor.skin.coupling > 0
    imprint = jax.lax.cond(coupled, tactile.couple, lambda *given: given[0], imprint, sensor.skin.coupling, pitch)
    shares = tactile.shadows(sensor.skin, sensor.lights, imprint, window) if sensor.skin.shadow_steps else ()
    x, y = slopes[0][:, 1:-1] * sensor.camera.distance, slopes[1][1:-1] * sensor.camera.distance
    flat = jnp.stack(jnp.broadcast_arrays(x, y, jnp.zeros(())), axis=-1)
    untouched = tactile.phong(
        sensor.phong, sensor.lights, jnp.broadcast_to(jnp.array([[[0.0, 0.0, -1.0]]]), flat.shape), flat
    )
    pressed = _near(imprint > _UNTOUCHED)
    return where_active(_skin, pressed, sensor, (*slopes, imprint, *shares), _planes(untouched), ring=1)


@jax.custom_jvp
def _carried(
    imprint: Float[Array, "h w"],
    corners: _Corners,
    images: tuple[Array, Array, Array],
    depth: Float[Array, "h w"],
    on_pad: Bool[Array, "h w"],
    follows: Bool[Array, "h w"],
) -> Float[Array, "h w"]:
    """Return the imprint, with the derivative of a shape that moves along with the faces' corners.

    The derivative of interpolated depth ignores edges that move, and the imprint of a flat object with upright walls
    changes at its edges alone. With the velocity v of the visible surface (pixels) and the rate at which it sinks,

        d imprint = rate - v . grad imprint

    where each of two neighbouring pixels gets half of their difference, with the v of the one nearer to the camera: a
    micro-edge (Pidhorskyi et al. 2024, "Rasterized Edge Gradients"). It is accurate on average over a few pixels.
    """
    return imprint


@_carried.defjvp
def _carried_jvp(primals: tuple, tangents: tuple) -> tuple[Float[Array, "h w"], Float[Array, "h w"]]:
    imprint, (values, faces), (winner, column, row), depth, on_pad, follows = primals
    of_face = faces[jnp.maximum(winner, 0)]
    of_face = [of_face[..., k] for k in range(3)]
    weights = optics.barycentrics([(values[0][k], values[1][k]) for k in of_face], column, row)
    motion = [[part[k] for part in tangents[1][0]] for k in of_face]
    across, down, nearing = (
        functools.reduce(operator.add, (weight * m[i] for weight, m in zip(weights, motion, strict=True)))
        for i in range(3)
    )
    change = tangents[0] + jnp.where(follows, nearing * jnp.where(follows, depth, 1) ** 2, 0)
    for axis, speed in ((0, down), (1, across)):
        (d0, d1), (v0, v1), (i0, i1), (p0, p1) = (
            (jax.lax.slice_in_dim(image, 0, -1, axis=axis), jax.lax.slice_in_dim(image, 1, None, axis=axis))
            for image in (depth, speed, imprint, on_pad)
        )
        flow = 0.5 * jnp.where(p0 & p1, i1 - i0, 0) * jnp.where(d0 < d1, v0, v1)
        before, after = [[(0, 0), (0, 0)] for _ in range(2)]
        before[axis], after[axis] = (1, 0), (0, 1)
        change = change - jnp.pad(flow, before) - jnp.pad(flow, after)
    return imprint, change


def _look(params: tuple[Sensor, tuple[Array, ...], _Corners, Array], images: tuple[Array, ...]) -> list[Array]:
    """The object's depth, and its colour through the skin in linear light."""
    sensor, (normals, colors, uv, texture, two_sided), corners, turn = params
    winner, on_pad, column, row, slope_x, slope_y, hidden, *empty = images
    nearest = jnp.maximum(winner, 0)
    shares = _shares(corners, winner, column, row)
    depth = 1 / functools.reduce(operator.add, shares)
    shares = [share * depth for share in shares]

    def inside(values: Float[Array, "f 3 k"]) -> list[Float[Array, "h w"]]:
        size = values.shape[-1]
        of_face = values.reshape(-1, 3 * size)[nearest]
        of_corner = [[share * of_face[..., size * k + i] for k, share in enumerate(shares)] for i in range(size)]
        return [first + second + third for first, second, third in of_corner]

    # Plane by plane, and stacked only for functions of vectors: arithmetic along an axis of three is slow on a CPU.
    across = inside(normals)
    nx, ny, nz = (row[0] * across[0] + row[1] * across[1] + row[2] * across[2] for row in turn)
    square = nx * nx + ny * ny + nz * nz
    scale = jnp.where(square > 0, 1 / jnp.sqrt(jnp.where(square > 0, square, 1)), 0)
    scale = jnp.where(two_sided & (nx * slope_x + ny * slope_y + nz > 0), -scale, scale)
    normal = jnp.stack([scale * nx, scale * ny, scale * nz], axis=-1)
    sampled = optics.sample_texture(texture, jnp.stack(inside(uv), axis=-1))
    albedo = jnp.stack([color * sampled[..., k] for k, color in enumerate(inside(colors))], axis=-1)
    height = depth - sensor.camera.distance
    color = _planes(optics.shade(sensor.room, albedo, normal, height, jnp.stack(empty, axis=-1), hidden))
    return [depth, *(jnp.where(on_pad, own, behind) for own, behind in zip(color, empty, strict=True))]


def _skin(sensor: Sensor, images: tuple[Array, ...]) -> list[Array]:
    """The lit skin from the rays, the imprint and the lights' shares, which have one more pixel on each side."""
    slope_x, slope_y, imprint, *shares = images
    depth = sensor.camera.distance - imprint
    surface = slope_x * depth, slope_y * depth, -imprint
    points = jnp.stack([part[1:-1, 1:-1] for part in surface], axis=-1)
    arriving = jnp.stack([share[1:-1, 1:-1] for share in shares]) if shares else None
    light = tactile.phong(sensor.phong, sensor.lights, tactile.surface_normals(surface), points, arriving)
    dark = tactile.darken(sensor.phong, imprint[1:-1, 1:-1])
    return [channel * dark for channel in _planes(light)]


def _height(corners: _Corners, images: tuple[Array, Array, Array]) -> Float[Array, "h w"]:
    """Height of the winning faces, interpolated linearly on the gel's grid."""
    return functools.reduce(operator.add, _shares(corners, *images))


def _shares(
    corners: _Corners, winner: Int[Array, "h w"], column: Float[Array, "h w"], row: Float[Array, "h w"]
) -> list[Float[Array, "h w"]]:
    """Weight of each corner of the winning face times the corner's third value (`_Corners`)."""
    values, faces = corners
    of_face = faces[jnp.maximum(winner, 0)]
    corner = [of_face[..., k] for k in range(3)]
    weights = optics.barycentrics([(values[0][k], values[1][k]) for k in corner], column, row)
    return [weight * values[2][k] for weight, k in zip(weights, corner, strict=True)]


def _pixels(samples: list[Float[Array, "a b"]], stride: int) -> list[Float[Array, "h w"]]:
    """Filter samples half a pixel apart by a tent that is one pixel wide at half height. At stride 1, do nothing."""
    if stride == 1:
        return samples
    rows = [0.5 * s[1:-1:2] + 0.25 * (s[:-2:2] + s[2::2]) for s in samples]
    return [0.5 * r[:, 1:-1:2] + 0.25 * (r[:, :-2:2] + r[:, 2::2]) for r in rows]


def _lines(images: tuple[Float[Array, "a b"], Float[Array, "a b"]]) -> tuple[Float[Array, "1 b"], Float[Array, "a 1"]]:
    """The first row of an image of x values and the first column of one of y values, since all others are equal."""
    return images[0][:1], images[1][:, :1]


def _planes(image: Float[Array, "h w *n 3"]) -> list[Float[Array, "h w *n"]]:
    return [image[..., k] for k in range(3)]


def _near(flags: Bool[Array, "a b"]) -> Bool[Array, "h w"]:
    """Whether any pixel of a 3x3 neighbourhood is flagged, for all but the outermost pixels."""
    rows = flags[:-2] | flags[1:-1] | flags[2:]
    return rows[:, :-2] | rows[:, 1:-1] | rows[:, 2:]
