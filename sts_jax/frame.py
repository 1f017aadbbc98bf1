"""Images that the sensor takes of an object: visual image, tactile image, depth and segmentation."""

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
    """Images that the sensor takes at one time, with the object's pose and the pressure on the gel.

    The images `visual` and `tactile` are float32 in [0, 1]. Row 0 of every image is at the top.
    """

    # View through the skin with the internal light off, sRGB.
    visual: Float[Array, "*n h w 3"]
    # Image of the skin's inner side with the internal light on.
    tactile: Float[Array, "*n h w 3"]
    # Depth of the object along the optical axis, from the pinhole (m), `inf` in pixels without object. The walls of the
    # housing hide nothing in this image.
    depth: Float[Array, "*n h w"]
    # Pixels of the object: True where `depth` is finite.
    segmentation: Bool[Array, "*n h w"]
    # Pose that is drawn, after the object has sunk into the gel: mesh frame in the sensor frame, position (m) and
    # quaternion.
    pose: Float[Array, "*n 7"]
    # True if the gel balances the wrench within its limits of depth and tilt, or if no wrench presses on it. False for
    # an invalid sensor, or a pose, wrench or body with values that are not finite.
    balanced: Bool[Array, "*n"]
    # Pressure on the cells of the gel's grid (Pa). `tactile.cell_centres` returns the centres of the cells.
    pressure: Float[Array, "*n r c"]
    # Part of the gel's outer face that the images show: left, top, width, height (m).
    window: Float[Array, "*n 4"]

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
    """Render the images that the sensor takes of one object.

    With a wrench, the object sinks and tilts until the gel balances Fz, Mx and My (`tactile.settle`), and the images
    show the object in this balanced pose. Without a wrench, the object stays in the given pose. The gel's outer face
    is the plane z = 0 of the sensor frame, and the camera is at z < 0. If the whole object is at z < 0, inside the
    sensor, the images show an empty sensor.

    In each of the following cases, the images also show an empty sensor, and `Frame.balanced` is False:

    - The pose or the wrench is not finite.
    - The squared length of the quaternion is zero or infinite in float32.
    - The body is traced, and one of its vertices, normals or colours is not finite.
    - The sensor is traced, and a constant is out of range (`Sensor.check`). The images are then rendered with the
      default values of all traced constants. A sensor that is not traced raises an error instead.

    The function is compiled once for each resolution and each size of the body's arrays (faces, vertices and texture).
    Bodies are padded to a few sizes, so that many bodies share a compiled program. The function can be called under
    `jit`, `vmap` and `grad`.

    Args:
        sensor: Constants of the sensor.
        body: The object.
        pose: Pose of the object's mesh frame in the sensor frame, position (m) and quaternion [w, x, y, z].
        wrench: Wrench of the pad on the object in the sensor frame: force (N) and moment about the origin (N m). None
            draws the object in the given pose.
        resolution: Height and width of the images (pixels). If the aspect ratio differs from the camera's, the images
            show the largest centred part of the view.
        crop: If True, the images show only a window around the object, with the aspect ratio of `resolution`.
        moving_edges: If True, the derivative of the tactile image with respect to the pose includes the motion of the
            imprint's edges across pixels. This derivative serves to fit poses. Its mean over a few neighbouring pixels
            is accurate, but its value at a single pixel can be inaccurate. If False, the derivative ignores moving
            edges. The images are the same in both cases.

    Returns:
        The images, with the pose that is drawn and the pressure on the gel.

    Raises:
        ValueError: `resolution` is not two whole numbers above 0, `pose` or `wrench` has a wrong shape, the body has
            too many faces, a constant of the sensor is out of range (`Sensor.check`), or the body is invalid
            (`Body.check`). Traced constants and traced bodies raise an error only for a wrong shape.
        TypeError: `sensor` is not a `Sensor`, `body` is not a `Body`, or `pose` or `wrench` is not an array of numbers.
    """
    _check_kinds(sensor, body)
    pose = _numbers("pose", pose, "(7,): position (m) and quaternion")
    wrench = None if wrench is None else _numbers("wrench", wrench, "(6,): force (N) and moment (N m)")
    _check_shapes(body, pose, wrench, resolution)
    sensor, sound = sensor.guard()
    sound = jnp.asarray(sound)
    if is_traced(body):
        for values in (body.vertices, body.normals, body.colors):
            sound &= jnp.all(jnp.isfinite(values))
    # Hulls and interior are not drawn. Without them, bodies of one size class share a program.
    body = dataclasses.replace(body, hulls=jnp.zeros((1, 1, 3)), interior=jnp.zeros((1, 3, 3)))
    height, width = (int(n) for n in resolution)
    # Two programs, so that a new resolution compiles only the second one.
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
    """Render a frame with the internal light at any level between off and full.

    The image is a mixture of both streams, computed in linear light:

        image = ((1 - l) V + l k T) / (1 - l + l k)

    V is the visual stream, T is the tactile stream, l is `light`, and k is the ratio of the exposure time of V to the
    exposure time of T (`Room.exposure`). The denominator is the ratio of the exposure time at level 0 to the exposure
    time at level l. With V = T, the image equals V for every l. A pixel that is equally bright in both streams is
    therefore equally bright at every level.

    Args:
        sensor: Sensor that made the frame.
        frame: One frame or a batch of frames with any leading axes.
        light: Level of the internal light, from 0 (off) to 1 (full power). Traced values outside this range are
            clipped, and a traced NaN counts as 0.

    Returns:
        Image, sRGB in [0, 1]. It equals `frame.visual` at level 0 and `frame.tactile` at level 1.

    Raises:
        TypeError: `sensor` is not a `Sensor`, `frame` is not a `Frame`, or `light` is not a number.
        ValueError: `light` is outside [0, 1] or is an array with axes, or a constant of the sensor is out of range
            (`Sensor.check`). A traced value causes an error only if its shape is wrong. If a traced constant of the
            sensor is out of range, the image is rendered with the default values of all traced constants.
    """
    _check_sensor(sensor)
    sensor, _ = sensor.guard()
    if not isinstance(frame, Frame):
        raise TypeError(f"frame is a {type(frame).__name__}, but it must be the Frame that sts.sense(...) returns")
    _check_light(light)
    light = jnp.asarray(light, jnp.float32)
    light = jnp.where(light >= 0, jnp.where(light <= 1, light, 1), 0)
    bright = light * sensor.room.exposure
    share = bright / (1 - light + bright)
    mixed = optics.to_srgb((1 - share) * optics.to_linear(frame.visual) + share * optics.to_linear(frame.tactile))
    # The conversion to linear light and back rounds. At 0 and 1, the difference is added, so that the image is exact.
    ends = jnp.where(share == 0, frame.visual - mixed, jnp.where(share == 1, frame.tactile - mixed, 0))
    return jnp.clip(mixed + jax.lax.stop_gradient(ends), 0, 1)


def touch(
    sensor: Sensor, imprint: Float[Array, "h w"], window: Float[Array, "4"] | None = None
) -> Float[Array, "h w 3"]:
    """Render the tactile image of a given imprint, such as the result of another contact model.

    Args:
        sensor: Constants of the sensor.
        imprint: Depth of the skin below the gel's undeformed face at the point that each pixel shows (m), 0 without
            contact. The depth is clipped to [0, `Gel.thickness`], and NaN counts as 0.
        window: Part of the gel's outer face that the image shows: left, top, width, height (m). None selects the
            largest centred part of the camera's view with the aspect ratio of `imprint`.

    Returns:
        Image in [0, 1]. If its shorter side has at least `Sensor.fine_below` pixels, it equals the image
        `Frame.tactile` that `sense` renders for the same imprint. For smaller images, `sense` samples more finely than
        `touch`. An invalid number in a traced `window` or in a traced constant of the sensor raises no error. Instead,
        the image shows flat skin in the default window (`window=None`). If a constant is invalid, this image is
        rendered with the default values of all traced constants.

    Raises:
        TypeError: `sensor` is not a `Sensor`, or `imprint` or `window` is not an array of numbers.
        ValueError: `imprint` is empty, is not two-dimensional or has an integer type. The error is also raised if
            `window` does not have the shape (4,), is not finite or has no area, or if a constant of the sensor is out
            of range (`Sensor.check`). A traced value causes an error only if its shape or type is wrong.
    """
    _check_sensor(sensor)
    imprint = _imprint_in_metres(imprint)
    sensor, sound = sensor.guard()
    rows, columns = imprint.shape
    full = optics.full_window(sensor.camera, (rows, columns))
    window = full if window is None else _numbers("window", window, "(4,): left, top, width, height (m)")
    if window.shape != (4,):
        raise ValueError(f"window has the shape {window.shape}, but it must be (4,): left, top, width, height (m)")
    somewhere = jnp.all(jnp.isfinite(window)) & jnp.all(window[2:] > 0)
    if not isinstance(somewhere, jax.core.Tracer) and not somewhere:
        raise ValueError(
            f"window is {window}, but it must be four finite numbers, left, top, width, height (m), with a width and "
            "a height > 0"
        )
    sound &= somewhere
    window = jnp.where(sound, window, full)
    return drawing.touch(sensor, jnp.where(sound, imprint, 0), window)


def _check_sensor(sensor: Any) -> None:
    if not isinstance(sensor, Sensor):
        raise TypeError(f"sensor is {sensor!r}, but it must be a Sensor, for instance sts.Sensor()")


def _check_kinds(sensor: Any, body: Any) -> None:
    _check_sensor(sensor)
    if not isinstance(body, Body):
        if isinstance(body, Sequence) and not isinstance(body, str):
            found, remedy = f"a {type(body).__name__}", "For several bodies use objects.stack and jax.vmap"
        else:
            found, remedy = repr(body), "objects.load reads a mesh file"
        raise TypeError(f"body is {found}, but it must be one Body. {remedy}")
    if body.vertices.ndim != 2 or not is_traced(body):
        body.check()


def _numbers(name: str, value: Any, wanted: str) -> Array:
    """Convert an argument to a floating-point array.

    Args:
        name: Name of the argument, for error messages.
        value: Value of the argument.
        wanted: Shape and meaning of the array that the argument must be, for error messages.

    Raises:
        TypeError: The value is a named tuple, such as a whole `Placement`, or not an array of numbers.
    """
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        raise TypeError(
            f"{name} is a {type(value).__name__}, but it must be an array of shape {wanted}. Unpack a tuple of several "
            "arguments with *, as in sense(sensor, body, *placement)"
        )
    try:
        return jnp.asarray(value, float)
    except (TypeError, ValueError):
        raise TypeError(f"{name} is {value!r}, but it must be an array of shape {wanted}") from None


def _imprint_in_metres(imprint: Any) -> Float[Array, "h w"]:
    """Convert an imprint to a floating-point image. Integers raise an error, because they cannot be metres."""
    try:
        imprint = jnp.asarray(imprint)
    except (TypeError, ValueError):
        raise TypeError(f"imprint is {imprint!r}, but it must be an array (height, width) in metres") from None
    if not jnp.issubdtype(imprint.dtype, jnp.floating):
        raise ValueError(
            f"imprint has the type {imprint.dtype}, but it must be a floating-point array in metres (0.0005 is half a "
            "millimetre). Convert integers to metres first, for instance with 1e-6 * imprint if they are micrometres"
        )
    if imprint.ndim != 2 or 0 in imprint.shape:
        raise ValueError(
            f"imprint has the shape {imprint.shape}, but it must be (height, width), both > 0. For several imprints "
            "use jax.vmap"
        )
    return jnp.asarray(imprint, float)


def _check_light(light: Any) -> None:
    known = not isinstance(light, jax.core.Tracer)
    if known and np.asarray(light).dtype.kind not in "iuf":
        raise TypeError(f"light is {light!r}, but it must be one number from 0 (visual) to 1 (tactile)")
    if jnp.ndim(light):
        raise ValueError(
            f"light has the shape {jnp.shape(light)}, but it must be one number. For several values of light, use "
            "jax.vmap"
        )
    if known and not 0 <= np.asarray(light) <= 1:
        raise ValueError(f"light is {light}, but it must be from 0 (visual) to 1 (tactile)")


def _check_shapes(body: Body, pose: Array, wrench: Array | None, resolution: Any) -> None:
    """Raise a ValueError if the resolution, the shape of the pose or wrench, or the number of faces is not allowed."""
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
            f"file with objects.load(path, faces={FACE_CLASSES[-1]})"
        )
