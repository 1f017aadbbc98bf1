"""The sensor's images of an object: both streams, depth and segmentation."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, ScalarLike

from sts_jax import optics
from sts_jax.objects.body import FACE_CLASSES, Body, is_traced
from sts_jax.rendering import drawing, equilibrium
from sts_jax.sensor import Sensor


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

    The function is compiled once for each resolution and size class of bodies (faces and texture). It also works inside
    other compiled functions, `vmap` and `grad`.

    An invalid sensor (`Sensor.check`) raises an error. Traced constants, such as those of a jitted function's argument,
    have no values to check. If they are invalid, the images are those of an empty sensor with the default constants and
    never contain NaN, and `balanced` is False.

    Args:
        sensor: constants of the sensor.
        body: the object.
        pose: mesh frame in the sensor frame: position (m), quaternion.
        wrench: force (N) and moment about the sensor's origin (N m) of the pad on the object, sensor frame.
        resolution: (height, width), pixels. Another aspect ratio than the camera's shows the largest centred part.
        crop: show a window of the image's aspect ratio around the object.
        moving_edges: add the effect of the imprint's moving edges to the derivative of the tactile image by the pose,
            for fitting poses. It is accurate on average over a few pixels (`rendering.edges`). By default, the
            derivative is that of each pixel and ignores this effect. The images are the same.

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
    resting = equilibrium.balance(sensor.gel, sound, body.vertices, body.faces, body.two_sided, pose, wrench)
    images = drawing.draw(
        sensor, body, resting, resolution=(height, width), crop=bool(crop), moving_edges=bool(moving_edges)
    )
    return Frame(
        visual=images.visual,
        tactile=images.tactile,
        depth=images.depth,
        segmentation=images.segmentation,
        pose=resting.shown,
        balanced=resting.balanced,
        pressure=resting.pressure,
        window=images.window,
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
        TypeError: `frame` is not a `Frame`, or `light` is not a number.
        ValueError: `light` is outside [0, 1] or has an axis, or `Sensor.check` raises an error. Traced values are
            not checked. If the constants of a traced sensor are invalid, the default exposure is used.
    """
    _check_sensor(sensor)
    sensor, _ = sensor.guard()
    if not isinstance(frame, Frame):
        raise TypeError(f"frame is a {type(frame).__name__}, but it must be the Frame that sense returns")
    _check_light(light)
    light = jnp.asarray(light, jnp.float32)
    light = jnp.where(light >= 0, jnp.where(light <= 1, light, 1), 0)
    bright = light * sensor.room.exposure
    share = bright / (1 - light + bright)
    mixed = optics.to_srgb((1 - share) * optics.to_linear(frame.visual) + share * optics.to_linear(frame.tactile))
    # The conversion to linear light and back rounds. At 0 and 1, the difference from the stream is added back.
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
        (`Sensor.fine_below`). If traced constants or a traced window are invalid, it shows flat skin in the whole view
        with the default constants.

    Raises:
        TypeError: `imprint` is not an array.
        ValueError: the imprint is not an image or has whole numbers, the window has no area or is not finite, or
            `Sensor.check` raises an error. Traced values are not checked.
    """
    _check_sensor(sensor)
    imprint = _imprint_in_metres(imprint)
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
    return drawing.touch(sensor, jnp.where(sound, imprint, 0), window)


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
        raise TypeError(
            f"{name} is a {type(value).__name__}, but it must be an array of shape {wanted}. Unpack it with *"
        )
    try:
        return jnp.asarray(value, float)
    except (TypeError, ValueError):
        raise TypeError(f"{name} is {value!r}, but it must be an array of shape {wanted}") from None


def _imprint_in_metres(imprint: Any) -> Float[Array, "h w"]:
    """The imprint as an image. Whole numbers raise an error, because they cannot be metres."""
    try:
        imprint = jnp.asarray(imprint)
    except (TypeError, ValueError):
        raise TypeError(f"imprint is {imprint!r}, but it must be an array (height, width) in metres") from None
    if not jnp.issubdtype(imprint.dtype, jnp.floating):
        raise ValueError(
            f"imprint has the type {imprint.dtype}, but it must be floating-point, in metres (0.0005 is half a "
            "millimetre). Multiply a depth image of whole numbers by the metres of one unit first"
        )
    if imprint.ndim != 2 or 0 in imprint.shape:
        raise ValueError(
            f"imprint has the shape {imprint.shape}, but it must be (height, width). For several use jax.vmap"
        )
    return jnp.asarray(imprint, float)


def _check_light(light: Any) -> None:
    known = not isinstance(light, jax.core.Tracer)
    if known and np.asarray(light).dtype.kind not in "iuf":
        raise TypeError(f"light is {light!r}, but it must be one number from 0 (visual) to 1 (tactile)")
    if jnp.ndim(light):
        raise ValueError(f"light has the shape {jnp.shape(light)}, but it must be one number. For several use jax.vmap")
    if known and not 0 <= np.asarray(light) <= 1:
        raise ValueError(f"light is {light}, but it must be a share of the LEDs' power, from 0 (visual) to 1 (tactile)")


def _check_shapes(body: Body, pose: Array, wrench: Array | None, resolution: Any) -> None:
    whole = isinstance(resolution, Sequence) and all(isinstance(n, int | np.integer) for n in resolution)
    if not whole or len(resolution) != 2 or min(resolution) < 1:
        raise ValueError(
            f"resolution is {resolution!r}, but it must be two whole numbers of pixels, (height, width), both > 0"
        )
    if pose.shape != (7,):
        raise ValueError(
            f"pose has the shape {pose.shape}, but it must be (7,): the position (m) and the quaternion [w, x, y, z]. "
            "For several poses use jax.vmap"
        )
    if wrench is not None and wrench.shape != (6,):
        raise ValueError(
            f"wrench has the shape {wrench.shape}, but it must be (6,): force (N) and moment (N m). For several "
            "wrenches use jax.vmap"
        )
    if len(body.faces) > FACE_CLASSES[-1]:
        raise ValueError(
            f"body has {len(body.faces):,} faces, but at most {FACE_CLASSES[-1]:,} can be drawn. Decimate the mesh "
            "file with objects.load(..., faces=)"
        )
