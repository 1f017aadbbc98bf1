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

UPRIGHT = math.radians(1)  # rad, largest lean of a body that counts as upright


_rigid = jax.jit(objects.rigid)
_transform = jax.jit(geometry.transform)


class StableFaces(NamedTuple):
    """The faces of a body's convex hull on which the body can rest."""

    up: Float[np.ndarray, "k 3"]  # Unit vector in the mesh frame that points up while the body rests on each face.
    # Solid angle of each face, seen from the centre of mass, as a share of the sum over all stable faces.
    share: Float[np.ndarray, "k"]


class Placement(NamedTuple):
    """Pose of a body at rest on the pad, and wrench of the pad on the body. Both are arguments of `sense`."""

    pose: Float[Array, "7"]  # Mesh frame in the sensor frame: position (m) and quaternion with w >= 0.
    wrench: Float[Array, "6"]  # Force (N) and moment about the sensor's origin (N m) of the pad on the body.


def stable_faces(
    body: Body,
    *,
    fill: float = 0.5,
    shell_scale: float = 1.0,
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> StableFaces:
    """Find the faces of a body's convex hull on which the body can rest on a level plane.

    The body rests on a face if its centre of mass lies above the face and at least 0.5 mm inside the outline of the
    face. The function runs on the host and cannot be called under `jit`, `vmap` or `grad`.

    Args:
        body: One body.
        fill: Share of the interior's volume that is filled, 0 to 1.
        shell_scale: Factor on the shell's mass.
        up: Direction that was up when the contents settled, as a unit vector in the mesh frame.

    Returns:
        The stable faces, the most likely first. If the body cannot rest on any face, both arrays of `StableFaces` are
        empty.

    Raises:
        TypeError: `body` is not a Body, or an argument is traced.
        ValueError: The body has an invalid value (`Body.check`), or its hulls span no volume.
    """
    _check_body(body)
    if is_traced((body, fill, shell_scale, up)):
        raise TypeError(
            "`body`, `fill`, `shell_scale` or `up` is traced, but stable faces are computed on the host: call "
            "`stable_faces` outside jit, vmap and grad"
        )
    body.check()
    com = np.asarray(_rigid(body, fill, shell_scale, np.asarray(up, np.float32))[1], np.float64)
    points = np.unique(np.asarray(body.hulls, np.float64).reshape(-1, 3), axis=0)
    if np.linalg.matrix_rank(points - points[:1], tol=1e-6) < 3:
        raise ValueError(
            "the points of the body's hulls span no volume: give at least four points that are not in one plane"
        )
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
    """Compute the wrench with which the level pad carries the weight of a body in a given pose.

    With the mass m, gravity g and the centre of mass c in the sensor frame, the force is (0, 0, m g). Its moment about
    the sensor's origin is c x (0, 0, m g) = (c_y m g, -c_x m g, 0). If `sense` receives the force without the moment,
    the body tilts in the gel.

    Args:
        body: One body.
        pose: Pose of the mesh frame in the sensor frame, (7,): position (m), quaternion (w, x, y, z).
        fill: Share of the interior's volume that is filled, 0 to 1.
        shell_scale: Factor on the shell's mass.
        up: Direction that was up when the contents settled, as a unit vector in the mesh frame.

    Returns:
        Force (N) and moment about the sensor's origin (N m), (6,).

    Raises:
        TypeError: `body` is not a Body.
        ValueError: The shape of `pose` is not (7,).
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
    """Place a body at rest on the level pad, on one of its stable faces and under its own weight.

    The simulation treats the pad as almost rigid: an object at rest penetrates it by 0.01 mm. The body is placed at
    this depth, so it stays at rest in a simulation from this pose. In contrast, `sense` treats the pad as a soft gel,
    into which the body sinks deeper. `sense` computes this larger depth from the wrench that this function returns. The
    function runs on the host and cannot be called under `jit`, `vmap` or `grad`.

    Args:
        body: One body.
        sensor: Sensor whose `gel.size` is the size of the pad.
        face: Index of a face in the result of `stable_faces` for the same `fill`, `shell_scale` and `up`. Face 0 is the
            most likely one. "upright" is the face on which the body rests with its +z axis up.
        yaw: Rotation about the sensor's z axis (rad). At 0, the +z axis of a lying body points to the top of the image.
            If the body stands upright or upside down, its -y axis points there instead.
        position: x and y of the centre of the body's bounding box (m).
        fill: Share of the interior's volume that is filled, 0 to 1.
        shell_scale: Factor on the shell's mass, > 0.
        up: Direction that was up when the contents settled, as a unit vector in the mesh frame. Placing the body
            does not move the contents.

    Returns:
        Pose of the body, and wrench of the pad on the body.

    Raises:
        TypeError: An argument is traced, or `body` or `sensor` has the wrong type.
        ValueError: The body has no stable face or cannot rest on `face`, its centre of mass does not lie above the pad,
            or an argument is out of range or not finite.
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
            f"position is {position} m, but the body would fall off, because its centre of mass would lie beyond the "
            f"pad, at ({com[0]:.3f}, {com[1]:.3f}) m: give a position nearer to (0, 0), so that the centre of mass has "
            f"|x| < {half[0]:g} m and |y| < {half[1]:g} m"
        )
    return Placement(pose, wrench)


def _check_body(body: object) -> None:
    if not isinstance(body, Body):
        raise TypeError(
            f"body is {body!r:.60}, but it must be one Body: objects.make generates one, objects.load reads a mesh file"
        )


def _index(faces: StableFaces, face: int | str) -> int:
    count = len(faces.up)
    if not count:
        raise ValueError(
            "the body cannot rest on any of its faces. A body rests on a face if its centre of mass lies above the "
            "face, at least 0.5 mm inside the face's outline. Give `sense` a pose of your own."
        )
    numbers = f"faces 0 (the most likely) to {count - 1}" if count > 1 else "face 0 only"
    numbered = f"the body can rest on {numbers}"
    if isinstance(face, str):
        if face != "upright":
            raise ValueError(f"`face` is {face!r}, but it must be the index of a face or 'upright': {numbered}")
        best = int(np.argmax(faces.up[:, 2]))
        if faces.up[best, 2] < math.cos(UPRIGHT):
            raise ValueError(f"`face` is 'upright', but the body does not stand stably with its +z up: {numbered}")
        return best
    if isinstance(face, bool) or not isinstance(face, int | np.integer) or not 0 <= face < count:
        raise ValueError(f"`face` is {face!r}, but the body has no such face: {numbered}")
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
        raise ValueError(f"fill is {fill}, but it must be from 0 to 1, as a share of the interior's volume")
    if not shell_scale > 0:
        raise ValueError(f"shell_scale is {shell_scale}, but it must be > 0")
    length = float(np.linalg.norm(np.asarray(up, float)))
    if abs(length - 1) > 1e-3:
        raise ValueError(
            f"`up` is {up!r}, which has the length {length:.6g}, but it must have the length 1: divide it by its length"
        )
