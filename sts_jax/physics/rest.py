"""A body at rest or held on the flat pad: its stable faces, its pose, and the wrench of the pad."""

import math
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, ScalarLike
from scipy.spatial.transform import Rotation

from sts_jax import geometry, objects, tactile
from sts_jax._checked import in_32_bits
from sts_jax.objects import Body
from sts_jax.objects.body import is_traced
from sts_jax.physics.scenario import STANDING, G
from sts_jax.rendering.equilibrium import underside
from sts_jax.sensor import Sensor

UPRIGHT = math.radians(1)  # rad, largest lean of a body that counts as upright
DEEPEST = 0.98  # largest depth of a held object, as a share of the gel's largest depth
HALVINGS = 50  # bisection steps for the depth

_transform = jax.jit(geometry.transform)


class StableFaces(NamedTuple):
    """The faces of a body's convex hull on which the body can rest."""

    up: Float[np.ndarray, "k 3"]  # Unit vector in the mesh frame that points up while the body rests on each face.
    # Solid angle of each face, seen from the centre of mass, as a share of the sum over all stable faces.
    share: Float[np.ndarray, "k"]


class Placement(NamedTuple):
    """Pose of a body at rest on the pad, and wrench of the pad on it, for `sense`."""

    pose: Float[Array, "7"]  # Mesh frame in the sensor frame: position (m) and quaternion with w >= 0.
    wrench: Float[Array, "6"]  # Force (N) and moment about the sensor's origin (N m) of the pad on the body.


@in_32_bits
def stable_faces(
    body: Body,
    *,
    fill: float = 0.5,
    shell_scale: float = 1.0,
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> StableFaces:
    """Find the faces of a body's convex hull on which it can rest on a level plane. Not under `jit`, `vmap` or `grad`.

    The body rests on a face if its centre of mass lies above the face and at least 0.5 mm inside its outline.

    Args:
        body: One body.
        fill: Share of the interior's volume that is filled.
        shell_scale: Factor on the shell's mass.
        up: Direction that was up when the contents settled, as a unit vector in the mesh frame.

    Returns:
        The stable faces, the most likely first. There may be none.
    """
    _check_body(body)
    if is_traced((body, fill, shell_scale, up)):
        raise TypeError("`body`, `fill`, `shell_scale` or `up` is traced: call this outside jit, vmap and grad")
    body.check()
    com = np.asarray(objects.rigid(body, fill, shell_scale, np.asarray(up, np.float32))[1], np.float64)
    points = np.unique(np.asarray(body.hulls, np.float64).reshape(-1, 3), axis=0)
    if np.linalg.matrix_rank(points - points[:1], tol=1e-6) < 3:
        raise ValueError("the points of the body's hulls span no volume: they are in one plane")
    ups, shares = objects.rest_poses(points, com)
    order = np.argsort(-shares, kind="stable")
    return StableFaces(ups[order], shares[order])


@in_32_bits
def weight(
    body: Body,
    pose: Float[Array | np.ndarray, "7"],
    *,
    fill: ScalarLike = 0.5,
    shell_scale: ScalarLike = 1.0,
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> Float[Array, "6"]:
    """Wrench with which the level pad carries the weight of a body: m g (0, 0, 1, c_y, -c_x, 0).

    c is the centre of mass in the sensor frame. Without the moment, the body would tilt in the gel. `fill`,
    `shell_scale` and `up` are those of `stable_faces`.
    """
    _check_body(body)
    mass, com, _ = objects.rigid(body, fill, shell_scale, jnp.asarray(up, jnp.float32))
    x, y, _ = _transform(jnp.asarray(pose), com)
    zero = jnp.zeros_like(mass)
    return G * mass * jnp.stack([zero, zero, zero + 1, y, -x, zero])


@in_32_bits
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
    """Place a body at rest on the level pad under its own weight. Not under `jit`, `vmap` or `grad`.

    The body is placed 0.01 mm deep, where it stays at rest in a simulation. `sense` computes its larger depth in the
    soft gel from the returned wrench.

    Args:
        body: One body.
        sensor: Sensor whose `gel.size` is the size of the pad.
        face: Index of a face of `stable_faces` for the same `fill`, `shell_scale` and `up`, or "upright" for +z up.
        yaw: Rotation about the sensor's z axis (rad). At 0, the +z axis of a lying body points to the top of the image.
            If the body stands upright or upside down, its -y axis points there instead.
        position: x and y of the centre of the body's bounding box (m).
        fill: As in `stable_faces`.
        shell_scale: As in `stable_faces`.
        up: As in `stable_faces`.
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
            f"position is {position} m, but the body would fall off, because its centre of mass would lie at "
            f"({com[0]:.3f}, {com[1]:.3f}) m: it must have |x| < {half[0]:g} m and |y| < {half[1]:g} m"
        )
    return Placement(pose, wrench)


def _check_body(body: object) -> None:
    if not isinstance(body, Body):
        raise TypeError(f"body is {body!r:.60}, but it must be one Body, from objects.make or objects.load")


def _index(faces: StableFaces, face: int | str) -> int:
    count = len(faces.up)
    if not count:
        raise ValueError("the body cannot rest on any of its faces: give `sense` a pose of your own")
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


def _check_numbers(yaw: Any, position: Any, fill: Any, shell_scale: Any, up: Any) -> None:
    given = {"yaw": (yaw, ()), "position": (position, (2,)), "fill": (fill, ()), "shell_scale": (shell_scale, ())}
    for name, (value, shape) in (given | {"up": (up, (3,))}).items():
        array = np.asarray(value)
        if array.shape != shape or array.dtype.kind not in "iuf" or not np.isfinite(array).all():
            wanted = "one finite number" if shape == () else f"{shape[0]} finite numbers"
            raise ValueError(f"{name} is {value!r}, but it must be {wanted}")
    if not 0 <= fill <= 1:
        raise ValueError(f"fill is {fill}, but it must be from 0 to 1")
    if not shell_scale > 0:
        raise ValueError(f"shell_scale is {shell_scale}, but it must be > 0")
    length = float(np.linalg.norm(np.asarray(up, float)))
    if abs(length - 1) > 1e-3:
        raise ValueError(f"`up` is {up!r} of length {length:.6g}, but it must have the length 1")


def held_wrench(gel: tactile.Gel, body: Body, pose: Float[np.ndarray, "7"], force: float) -> Float[np.ndarray, "6"]:
    """Wrench without friction on an object that a hand holds on the gel, so that it keeps its orientation.

    The object sinks until the gel carries `force` (N), or until the gel allows no more (`Gel.max_depth`), as under a
    sharp corner. The pressure in a cell of the gel's grid is `p = k max(0, d - h)`. Here k is `gel.stiffness`, d is the
    depth of the object's lowest point, and h is the height of its underside above this point. `sense` computes the same
    depth d from the wrench. The z of `pose` has no effect.
    """
    x, y = (np.asarray(part, np.float64) for part in tactile.cell_centres(gel))
    heights = np.asarray(_heights(gel, body.vertices, body.faces, body.two_sided, jnp.asarray(pose)), np.float64)
    if not np.isfinite(heights).any():
        return np.zeros(6)
    heights = heights - heights.min()
    stiffness = float(gel.stiffness) * float(tactile.cell_area(gel))  # N/m of one cell
    low, high = 0.0, DEEPEST * float(gel.max_depth)
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if stiffness * np.sum(np.maximum(middle - heights, 0)) < force else (low, middle)
    push = stiffness * np.maximum(high - heights, 0)
    return np.array([0.0, 0.0, np.sum(push), np.sum(push * y), -np.sum(push * x), 0.0])


@jax.jit
def _heights(
    gel: tactile.Gel, vertices: Array, faces: Array, two_sided: Array, pose: Float[Array, "7"]
) -> Float[Array, "r c"]:
    """Height of the object's underside over each cell (m), `inf` where no face is in the gel's reach."""
    return underside(gel, faces, two_sided, geometry.transform(pose, vertices), jnp.bool_(True))[0]
