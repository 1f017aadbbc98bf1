"""Images that the sensor takes of an object: visual image, tactile image, depth and segmentation."""

import dataclasses
import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Real

from sts_jax import optics
from sts_jax._checked import checked, in_32_bits, warn
from sts_jax._plausible import placement_problem
from sts_jax._ranges import MOST_PIXELS
from sts_jax.objects.body import FACE_CLASSES, Body, is_traced
from sts_jax.rendering import drawing, equilibrium
from sts_jax.rendering.group import draw_group, group
from sts_jax.sensor import Sensor

_SHORTEST = 0.002  # m, length of edges that may be clipped if the camera is traced, for pads of at least 8 mm


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Frame:
    """Images of one moment, with the object's pose and the pressure on the gel.

    `visual` and `tactile` are float32 in [0, 1]. Row 0 of every image is at the top.
    """

    visual: Float[Array, "*n h w 3"]  # View through the skin with the internal light off, sRGB.
    tactile: Float[Array, "*n h w 3"]  # Image of the skin's inner side with the internal light on.
    # Depth along the optical axis, from the pinhole (m), `inf` without object. The housing's walls hide nothing.
    depth: Float[Array, "*n h w"]
    segmentation: Bool[Array, "*n h w"]  # Pixels of the object: True where `depth` is finite.
    # Pose that is drawn, after the object has sunk into the gel: mesh frame in the sensor frame, position (m) and
    # quaternion. With b bodies (*n, b, 7).
    pose: Float[Array, "*k 7"]
    # True if the gel balances the wrench within its limits of depth and tilt, or if no wrench presses on it. False for
    # an invalid sensor, or a pose, wrench or body with values that are not finite. With b bodies (*n, b).
    balanced: Bool[Array, "*k"]
    # Pressure on the cells of the gel's grid (Pa). `tactile.cell_centres` returns the centres of the cells.
    pressure: Float[Array, "*n r c"]
    window: Float[Array, "*n 4"]  # Part of the gel's outer face that the images show: left, top, width, height (m).
    body: Int[Array, "*n h w"]  # Index of the body that each pixel shows, -1 where there is none.
    # Displacement of the skin along x and y under the tangential load, on the gel's grid (m). None without markers.
    shear: Float[Array, "*n r c 2"] | None = None

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
        balance = "balanced" if np.all(self.balanced) else "not balanced"
        return f"Frame({size}, object in {seen:.1%} of the view, {pressed}, {balance})"


@in_32_bits
@checked
def sense(
    sensor: Sensor,
    body: Body | list[Body] | tuple[Body, ...],
    pose: Float[ArrayLike, "7"] | Float[ArrayLike, "b 7"] | tuple,
    wrench: Float[ArrayLike, "6"] | Float[ArrayLike, "b 6"] | None = None,
    *,
    resolution: tuple[int, int] = (64, 64),
    crop: bool = False,
    moving_edges: bool = False,
) -> Frame:
    """Render the images that the sensor takes of one object, or of several. Works under `jit`, `vmap` and `grad`.

    With a wrench, the object sinks and tilts until the gel balances Fz, Mx and My (`tactile.settle`). Without one, it
    stays in the given pose. An object that is wholly inside the sensor (z < 0) is not drawn: z = -1 m gives images of
    the empty sensor. With `Sensor.markers`, Fx, Fy and Mz shear the skin and move its dots (`tactile.shear`).

    Several bodies are a list of any bodies, such as an object, the opposite finger and a table. The nearest surface of
    all is drawn. Each body sinks and tilts under its own wrench. With Fz <= 0 it stays in its pose and leaves no
    imprint. Large faces, such as those of a floor, are clipped at `Camera.near`. Bodies that `jit` traces are not
    clipped, and their padding is drawn too, so close over them.

    The images also show an empty sensor, and `Frame.balanced` is False, if the pose or the wrench is not finite, the
    quaternion's squared length is zero or infinite in float32, or a traced sensor or body has invalid values. An
    invalid sensor or body that is not traced raises a ValueError (`Sensor.check`, `Body.check`). A pose or wrench that
    is not traced and probably wrong is drawn with a warning: not finite, in millimetres, out of view, below the pad, or
    a load far beyond what the pad bears.

    Args:
        body: One body, or a list of b bodies. For one body in each of several frames use `objects.stack` and
            `jax.vmap`.
        pose: Mesh frame in the sensor frame: position (m) and quaternion [w, x, y, z]. For several bodies (b, 7).
        wrench: Wrench of the pad on the object in the sensor frame: force (N) and moment about the origin (N m). For
            several bodies (b, 6).
        resolution: Height and width of the images (pixels). With another aspect ratio than the camera's, the images
            show the largest centred part of the view.
        crop: True to show only a window around the object, with the aspect ratio of `resolution`.
        moving_edges: True to include the motion of the imprint's edges in the derivative of the tactile image with
            respect to the pose. It serves to fit poses, and is accurate on average over a few pixels.
    """
    if isinstance(pose, tuple):
        raise TypeError(f"pose is a {type(pose).__name__}: unpack it with *, as in sense(sensor, body, *placement)")
    if not all(1 <= side <= MOST_PIXELS for side in resolution):
        raise ValueError(f"resolution (height, width) must be from 1 to {MOST_PIXELS:,} pixels, got {resolution}")
    bodies = [body] if isinstance(body, Body) else list(body)
    _check_bodies(bodies)
    _check_shapes(None if isinstance(body, Body) else len(bodies), pose, wrench)
    placed = sensor, body, pose, wrench  # as given, with the hulls
    pose = jnp.asarray(pose, float)
    wrench = None if wrench is None else jnp.asarray(wrench, float)
    camera = sensor.camera
    sensor, sound = sensor.guard()
    sound = jnp.asarray(sound)
    for each in filter(is_traced, bodies):
        for values in (each.vertices, each.normals, each.colors):
            sound &= jnp.all(jnp.isfinite(values))
    if isinstance(body, Body):
        # Hulls and interior are not drawn. Without them, bodies of one size class share a program.
        body = dataclasses.replace(body, hulls=jnp.zeros((1, 1, 3)), interior=jnp.zeros((1, 3, 3)))
        # Two programs, so that a new resolution compiles only the second one.
        resting = equilibrium.balance(
            sensor.gel, sound, body.vertices, body.faces, body.two_sided, pose, wrench, sensor.markers
        )
        images = drawing.draw(sensor, body, resting, resolution=resolution, crop=crop, moving_edges=moving_edges)
        drawn = images._asdict() | {"pose": resting.shown, "balanced": resting.balanced}
        drawn |= {"pressure": resting.pressure, "shear": resting.shear}
    else:
        # A face that reaches from before `near` into the view beyond the gel has a longer edge.
        longest = _SHORTEST if is_traced(camera) else (float(camera.distance) - float(camera.near)) / 2
        together = group(bodies, longest)
        drawn = draw_group(
            sensor,
            together,
            pose,
            wrench,
            resolution=resolution,
            crop=crop,
            moving_edges=moving_edges,
            sound=sound,
        )._asdict()
    if not is_traced(placed) and (problem := placed_wrongly(*placed, resolution)):  # JAX draws meanwhile
        warn(problem)
    return Frame(**drawn)


def _check_bodies(bodies: list[Body]) -> None:
    if not bodies:
        raise ValueError("body is an empty list, but it must have at least one body")
    for body in bodies:
        if body.vertices.ndim != 2 or not is_traced(body):
            body.check()
    number = sum(len(body.faces) for body in bodies)
    if len(bodies) > 1 and number > FACE_CLASSES[-1]:
        number = sum(len(b.faces) if is_traced(b) else int(np.asarray(b.faces).any(axis=1).sum()) for b in bodies)
    if number > FACE_CLASSES[-1]:
        raise ValueError(
            f"body has {number:,} faces, but at most {FACE_CLASSES[-1]:,} can be drawn: decimate the mesh "
            f"with objects.load(path, faces={FACE_CLASSES[-1]})"
        )


def _check_shapes(number: int | None, pose: ArrayLike, wrench: ArrayLike | None) -> None:
    """Raise a TypeError unless there is one pose and wrench for one body (None), or for each of several."""
    for name, value, width in (("pose", pose, 7), ("wrench", wrench, 6)):
        shape = (width,) if number is None else (number, width)
        if value is not None and np.shape(value) != shape:
            whose = "one body" if number is None else f"a list of {number}"
            raise TypeError(f"parameter '{name}' has the shape {np.shape(value)}, but for {whose} it must be {shape}")


def placed_wrongly(
    sensor: Sensor, body: Body | Sequence[Body], pose: ArrayLike, wrench: ArrayLike | None, resolution: tuple[int, int]
) -> str | None:
    """What is probably wrong with a placement. Values that an accelerator still computes are not waited for."""
    for value in (pose, wrench):
        if jax.default_backend() != "cpu" and not getattr(value, "is_ready", lambda: True)():
            return None
    camera, gel = sensor.camera, sensor.gel
    high = float(camera.distance) * math.tan(float(camera.fov) / 2)
    wide = high * min(float(camera.aspect), resolution[1] / resolution[0])
    view = np.array([wide, wide * resolution[0] / resolution[1]])
    bodies = [body] if isinstance(body, Body) else body
    poses = np.asarray(pose, np.float64).reshape(-1, 7)
    wrenches = [None] * len(poses) if wrench is None else np.asarray(wrench, np.float64).reshape(-1, 6)
    for index, (each, at, load) in enumerate(zip(bodies, poses, wrenches, strict=True)):
        points = np.asarray(each.hulls).reshape(-1, 3)
        if problem := placement_problem(at, load, points, view, float(camera.distance), gel):
            return problem if isinstance(body, Body) else f"body {index}: {problem}"
    return None


@in_32_bits
@checked
def expose(sensor: Sensor, frame: Frame, light: Real[ArrayLike, ""]) -> Float[Array, "*n h w 3"]:
    """Render a frame with the internal light at any level between off and full, as a mixture in linear light.

        image = ((1 - l) V + l k T) / (1 - l + l k)

    V is the visual stream, T the tactile stream, l the level, and k the exposure time of V divided by that of T
    (`Room.exposure`). A pixel that is equally bright in both streams is equally bright at every level.

    Args:
        frame: One frame or a batch of frames with any leading axes.
        light: Level of the internal light, from 0 (off) to 1 (full power). Traced values are clipped, and NaN is 0.

    Returns:
        Image, sRGB in [0, 1]: exactly `frame.visual` at level 0 and `frame.tactile` at level 1.
    """
    sensor, _ = sensor.guard()
    if not isinstance(light, jax.core.Tracer) and not 0 <= np.asarray(light) <= 1:
        raise ValueError(f"light is {light}, but it must be from 0 (visual) to 1 (tactile)")
    light = jnp.asarray(light, jnp.float32)
    light = jnp.where(light >= 0, jnp.where(light <= 1, light, 1), 0)
    bright = light * sensor.room.exposure
    share = bright / (1 - light + bright)
    mixed = optics.to_srgb((1 - share) * optics.to_linear(frame.visual) + share * optics.to_linear(frame.tactile))
    # The conversion to linear light and back rounds. At 0 and 1, the difference is added, so that the image is exact.
    ends = jnp.where(share == 0, frame.visual - mixed, jnp.where(share == 1, frame.tactile - mixed, 0))
    return jnp.clip(mixed + jax.lax.stop_gradient(ends), 0, 1)


@in_32_bits
@checked
def touch(
    sensor: Sensor,
    imprint: Float[ArrayLike, "h w"],
    window: Float[ArrayLike, "4"] | None = None,
    *,
    shear: Float[ArrayLike, "r c 2"] | None = None,
) -> Float[Array, "h w 3"]:
    """Render the tactile image of a given imprint, such as the result of another contact model.

    Args:
        imprint: Depth of the skin below the gel's undeformed face at the point that each pixel shows (m), 0 without
            contact. The depth is clipped to [0, `Gel.thickness`], and NaN counts as 0.
        window: Part of the gel's outer face that the image shows: left, top, width, height (m). None selects the
            largest centred part of the camera's view with the aspect ratio of `imprint`.
        shear: Displacement of the skin along x and y on the gel's grid (m), which moves the dots of `Sensor.markers`.

    Returns:
        Image in [0, 1]. If its shorter side has at least `Sensor.fine_below` pixels, it equals `Frame.tactile` for the
        same imprint; below, `sense` samples more finely. An invalid traced sensor or window gives flat skin.
    """
    imprint = jnp.asarray(imprint, float)
    sensor, sound = sensor.guard()
    full = optics.full_window(sensor.camera, (imprint.shape[0], imprint.shape[1]))
    window = full if window is None else jnp.asarray(window, float)
    has_area = jnp.all(jnp.isfinite(window)) & jnp.all(window[2:] > 0)
    if not isinstance(has_area, jax.core.Tracer) and not has_area:
        raise ValueError(f"window must be finite left, top, width > 0, height > 0 (m), got {window}")
    sound &= has_area
    if shear is not None and (sensor.markers is None or np.shape(shear) != (*sensor.gel.cells, 2)):
        raise ValueError(
            f"shear has the shape {np.shape(shear)}, but it must have the shape {(*sensor.gel.cells, 2)} of the gel's "
            "grid, and the sensor must have markers: use Sensor(markers=tactile.Markers())"
        )
    shear = None if shear is None else jnp.asarray(shear, float)
    return drawing.touch(sensor, jnp.where(sound, imprint, 0), jnp.where(sound, window, full), shear)
