"""A body at rest on the flat pad: its stable faces, its pose, and the wrench that carries its weight."""

import math
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, ScalarLike
from scipy.spatial.transform import Rotation

from sts_jax import geometry, objects
from sts_jax.objects import Body
from sts_jax.objects.body import is_traced
from sts_jax.physics.scenario import STANDING, G
from sts_jax.sensor import Sensor

UPRIGHT = math.radians(1)  # rad, largest lean of a body that stands upright


_rigid = jax.jit(objects.rigid)
_transform = jax.jit(geometry.transform)


class StableFaces(NamedTuple):
    """The faces of a body's convex hull on which it can rest, the most likely first."""

    up: Float[np.ndarray, "k 3"]  # unit vectors in the mesh frame that point up while the body rests on the face
    share: Float[np.ndarray, "k"]  # share of the solid angle, see `objects.rest_poses`


class Placement(NamedTuple):
    """The pose of a body at rest and the wrench that carries it, as arguments of `sense`."""

    pose: Float[Array, "7"]  # m and quaternion with w >= 0, mesh frame in the sensor frame
    wrench: Float[Array, "6"]  # N and N m about the sensor's origin, exerted by the pad on the body


def stable_faces(
    body: Body,
    *,
    fill: float = 0.5,
    shell_scale: float = 1.0,
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> StableFaces:
    """The faces on which a body can rest, with its centre of mass above them. Runs on the host, not under `jit`.

    Args:
        body: one body.
        fill: share of the interior's volume that is filled, 0 to 1.
        shell_scale: factor on the shell's mass.
        up: unit vector in the mesh frame, upward when the contents settled.

    Returns:
        The stable faces, none if the body cannot rest on any.

    Raises:
        TypeError: `body` is not a Body, or is traced.
        ValueError: a value of the body is not finite, or its hull spans no volume.
    """
    _check_body(body)
    if is_traced((body, fill, shell_scale, up)):
        raise TypeError(
            "body is traced, but its faces are computed on the host: call this function outside jit, vmap and grad"
        )
    body.check()
    com = np.asarray(_rigid(body, fill, shell_scale, np.asarray(up, np.float32))[1], np.float64)
    points = np.unique(np.asarray(body.hulls, np.float64).reshape(-1, 3), axis=0)
    if np.linalg.matrix_rank(points - points[:1], tol=1e-6) < 3:
        raise ValueError("the points of the body's hulls span no volume: give at least four that are not in one plane")
    ups, shares = objects.rest_poses(points, com)
    order = np.argsort(-shares, kind="stable")
    return StableFaces(ups[order], shares[order])


def weight(
    body: Body,
    pose: Float[Array | np.ndarray, "7"],
    *,
    fill: ScalarLike = 0.5,
    shell_scale: ScalarLike = 1.0,
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> Float[Array, "6"]:
    """The wrench that carries a body's weight on the flat pad, in any pose.

    With the mass m and the centre of mass c in the sensor frame, the force is (0, 0, m g), and its moment about the
    sensor's origin is c x (0, 0, m g) = (c_y m g, -c_x m g, 0). Without the moment, the body would tilt in the gel.

    Args:
        body: one body.
        pose: mesh frame in the sensor frame.
        fill: share of the interior's volume that is filled, 0 to 1.
        shell_scale: factor on the shell's mass.
        up: unit vector in the mesh frame, upward when the contents settled.

    Returns:
        Force (N) and moment (N m).

    Raises:
        TypeError: `body` is not a Body.
        ValueError: the shape of `pose` is not (7,).
    """
    _check_body(body)
    mass, com, _ = _rigid(body, fill, shell_scale, jnp.asarray(up, jnp.float32))
    x, y, _ = _transform(jnp.asarray(pose), com)
    zero = jnp.zeros_like(mass)
    return G * mass * jnp.stack([zero, zero, zero + 1, y, -x, zero])


def place(
    body: Body,
    sensor: Sensor,
    *,
    face: int | Literal["upright"] = 0,
    yaw: float = 0.0,
    position: tuple[float, float] = (0.0, 0.0),
    fill: float = 0.5,
    shell_scale: float = 1.0,
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> Placement:
    """Place a body at rest on the flat pad, on one of its stable faces and under its own weight.

    The body penetrates the pad by 0.01 mm, as at rest in a simulation, so a simulation that starts there stays there.
    The indentation of the gel is much deeper. `sense` computes it from the wrench. Runs on the host, not under `jit`.

    Args:
        body: one body.
        sensor: `sensor.gel.size` is the pad's size.
        face: index into its `stable_faces`, 0 for the most likely one, or "upright" for the face with +z up.
        yaw: rad, about the vertical. At 0, the +z of a lying body points to the top of the image, and so does the -y
            of a standing one, upright or upside down.
        position: m, x and y of the middle of the body's extent.
        fill: share of the interior's volume that is filled, 0 to 1.
        shell_scale: factor on the shell's mass.
        up: unit vector in the mesh frame, upward when the contents settled. They stay there when the body is placed.

    Returns:
        Pose and wrench.

    Raises:
        TypeError: an argument is traced, or `body` or `sensor` is of another type.
        ValueError: there is no such face, or no stable face at all, the centre of mass does not lie above the pad, or
            an argument is out of range or not finite.
    """
    _check_body(body)
    if not isinstance(sensor, Sensor):
        raise TypeError(f"sensor is {sensor!r}, but it must be a Sensor, for instance sts.Sensor()")
    _check_numbers(yaw, position, fill, shell_scale, up)
    faces = stable_faces(body, fill=fill, shell_scale=shell_scale, up=up)
    above = faces.up[_index(faces, face)]
    ahead = np.array([0.0, 0, 1]) if abs(above[2]) < 0.7 else np.array([0.0, -1, 0])
    down = above @ ahead * above - ahead
    down /= np.linalg.norm(down)
    across, along = math.cos(yaw), math.sin(yaw)
    turn = np.array([[across, -along, 0], [along, across, 0], [0, 0, 1]]) @ np.stack(
        [np.cross(down, above), down, above]
    )
    points = np.asarray(body.hulls, np.float64).reshape(-1, 3) @ turn.T
    low, high = points.min(axis=0), points.max(axis=0)
    x, y = position - (low + high)[:2] / 2
    quat = Rotation.from_matrix(turn).as_quat(canonical=True, scalar_first=True)
    pose = jnp.asarray([x, y, -STANDING - low[2], *quat], jnp.float32)
    wrench = weight(body, pose, fill=fill, shell_scale=shell_scale, up=up)
    com = np.array([-wrench[4], wrench[3]]) / float(wrench[2])
    half = np.asarray(sensor.gel.size) / 2
    if not (np.abs(com) < half).all():
        raise ValueError(
            f"position is {position} m, so the centre of mass lies at ({com[0]:.3f}, {com[1]:.3f}) m, beyond the pad, "
            f"and the body would fall off: its |x| must be < {half[0]:g} m and its |y| < {half[1]:g} m"
        )
    return Placement(pose, wrench)


def _check_body(body: object) -> None:
    if not isinstance(body, Body):
        raise TypeError(
            f"body is {body!r:.60}, but it must be one Body: objects.make draws one, objects.load reads a mesh file"
        )


def _index(faces: StableFaces, face: int | str) -> int:
    count = len(faces.up)
    if not count:
        raise ValueError(
            "the body rests on no face, because its centre of mass lies outside its hull or less than 0.5 mm inside "
            "the edge of every face: give `sense` a pose of your own"
        )
    numbered = f"it rests on {count} faces, 0 (the most likely) to {count - 1}" if count > 1 else "it rests on face 0"
    if isinstance(face, str):
        if face != "upright":
            raise ValueError(f"face is {face!r}, but it must be a number or 'upright': {numbered}")
        best = int(np.argmax(faces.up[:, 2]))
        if faces.up[best, 2] < math.cos(UPRIGHT):
            raise ValueError(f"face is 'upright', but the body does not stand with its +z up: {numbered}")
        return best
    if isinstance(face, bool) or not isinstance(face, int | np.integer) or not 0 <= face < count:
        raise ValueError(f"face is {face!r}, but the body has no such face: {numbered}")
    return int(face)


def _check_numbers(
    yaw: float,
    position: tuple[float, float],
    fill: float,
    shell_scale: float,
    up: tuple[float, float, float],
) -> None:
    given = {"yaw": (yaw, ()), "position": (position, (2,)), "fill": (fill, ()), "shell_scale": (shell_scale, ())}
    for name, (value, shape) in (given | {"up": (up, (3,))}).items():
        array = np.asarray(value)
        if array.shape != shape or array.dtype.kind not in "iuf" or not np.isfinite(array).all():
            wanted = "one finite number" if shape == () else f"{shape[0]} finite numbers"
            raise ValueError(f"{name} is {value!r}, but it must be {wanted}")
    if not 0 <= fill <= 1:
        raise ValueError(f"fill is {fill}, but a share of the interior's volume must be from 0 to 1")
    if not shell_scale > 0:
        raise ValueError(f"shell_scale is {shell_scale}, but it must be > 0")
    length = float(np.linalg.norm(np.asarray(up, float)))
    if abs(length - 1) > 1e-3:
        raise ValueError(f"up is {up!r} with length {length:.3g}, but it must be a unit vector")
