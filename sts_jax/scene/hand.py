"""A parallel gripper over a table, with one object between its fingers, as a MuJoCo specification.

The world's z axis points up, and the table's top lies in the plane z = 0. The fingers close along x, and the middle
between them is x = y = 0. The sites `left_tip` (at x < 0) and `right_tip` are where `attach` puts the sensors: their
z axes point to each other, and their y axes point down, so that the images are upright.
"""

import math

import mujoco
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation

from sts_jax._checked import checked
from sts_jax.objects.body import Body
from sts_jax.sensor import Sensor

CLEARANCE = 0.002  # m, least height of the lower edges of the sensors above the table
BOX = (0.03, 0.04, 0.05)  # m, size of the object without a `Body`
REACH = 0.15  # m, from the middle of the sensors up to the palm
MAST = 0.3  # m, largest height of the middle of the sensors
HAND_MASS, FINGER_MASS = 0.6, 0.1  # kg
SLIPPERY = 1e-5  # friction of the table, so that the object's counts. Without any, MJX makes NaN (C takes this value)
LIFT_GAINS = 2e4, 400.0  # N/m, N s/m, of the servo that lifts the hand: 22 Hz, critically damped with a full hand
GRIP_GAINS = 4e3, 40.0  # N/m, N s/m, of the servo that closes the fingers, whose force is limited

_SCENE = """
<mujoco model="gripper">
  <option timestep="{timestep}" cone="elliptic" impratio="10" integrator="implicitfast"/>
  <default>
    <geom condim="6" solref="0.004 1"/>
    <default class="shown"><geom type="box" contype="0" conaffinity="0" mass="0" rgba=".25 .27 .3 1"/></default>
  </default>
  <asset>{mesh}</asset>
  <worldbody>
    <light pos="0 0 1.5" castshadow="false"/>
    <geom name="table" type="plane" size=".3 .3 .05" friction="{slippery} {slippery} {slippery}" rgba=".62 .5 .38 1"/>
    <body name="hand" pos="0 0 {height}" gravcomp="1">
      <inertial pos="0 0 {reach}" mass="{hand}" diaginertia="1e-3 1e-3 1e-3"/>
      <joint name="lift" type="slide" axis="0 0 1" ref="{height}" range="0 {mast}"/>
      <geom class="shown" name="palm" pos="0 0 {reach}" size="{widest} {half_width} .01"/>
      {fingers}
    </body>
    <body name="object" pos="{place}" quat="{turn}"><freejoint name="object"/>{shape}</body>
  </worldbody>
  <tendon>
    <fixed name="opening"><joint joint="left" coef="1"/><joint joint="right" coef="1"/></fixed>
  </tendon>
  <equality><joint joint1="left" joint2="right" solref="0.004 1"/></equality>
  <actuator>
    <position name="lift" joint="lift" kp="{lift[0]}" kv="{lift[1]}"/>
    <position name="grip" tendon="opening" kp="{close[0]}" kv="{close[1]}" forcerange="-{grip} {grip}"/>
  </actuator>
  <keyframe><key name="home" qpos="{qpos}" ctrl="{height} {opening}"/></keyframe>
</mujoco>
"""
_FINGER = """
<body name="{side}" pos="{out} 0 0" gravcomp="1">
  <inertial pos="0 0 0" mass="{mass}" diaginertia="1e-4 1e-4 1e-4"/>
  <joint name="{side}" type="slide" axis="{sign} 0 0" ref="{half}" range="0 {half}" damping="1"/>
  <geom class="shown" name="{side}_finger" pos="{middle} 0 {rise}" size="{deep} {half_width} {long}"/>
  <site name="{side}_tip" quat="{turn}"/>
</body>
"""
# Rows: the axes of the sites in the world
_TIPS = {"left": [[0, -1, 0], [0, 0, -1], [1, 0, 0]], "right": [[0, 1, 0], [0, 0, -1], [-1, 0, 0]]}


@checked
def gripper(
    sensor: Sensor,
    body: Body | None = None,
    *,
    mass: float = 0.1,
    friction: float = 0.6,
    grip: float = 10.0,
    opening: float = 0.1,
    height: float | None = None,
    yaw: float = 0.0,
    position: tuple[float, float] = (0.0, 0.0),
    timestep: float = 0.001,
) -> mujoco.MjSpec:
    """Build a parallel gripper with fingers of the sensor's size, a table, and one object that stands on the table.

    The joints, in the order of `qpos`, are `lift` (height of the middle of the sensors above the table), `left` and
    `right` (distance of each sensor's face from the middle plane), and the free joint `object`, whose pose is that of
    the mesh frame. An equality couples the two fingers. The actuators are position servos: `lift` (m), and `grip` for
    the distance between the sensors' faces (m), which presses with at most the force `grip`. The keyframe `home` has
    the open gripper around the object at rest.

    The sensors are added with `attach` at the sites `left_tip` and `right_tip`.

    Args:
        sensor: Sensor whose gel determines the size of the fingers.
        body: The object, which collides as its hulls. None for a box of 30 x 40 x 50 mm.
        mass: Mass of the object (kg). Its centre and its inertia are those of the empty `body`, scaled to this mass.
        friction: Coefficient of sliding friction of the object.
        grip: Largest force of each finger (N).
        opening: Largest distance between the sensors' faces, which is that of `home` (m).
        height: Height of the middle of the sensors in `home` (m). None: as low as the table allows.
        yaw: Rotation of the object about the vertical (rad).
        position: x and y of the origin of the object's frame (m).
        timestep: Time step (s).
    """
    size, thickness = np.asarray(sensor.gel.size, float), float(sensor.gel.thickness)
    height = size[1] / 2 + CLEARANCE if height is None else height
    _check(mass=mass, friction=friction, grip=grip, opening=opening, height=height, timestep=timestep)
    points = corners(body)
    turn = Rotation.from_rotvec([0, 0, yaw])
    placed = turn.apply(points) + np.array([*position, 0])
    if 2 * np.abs(placed[:, 0]).max() >= opening:
        raise ValueError(
            f"opening is {opening} m, but the object reaches from x = {placed[:, 0].min():.3f} to "
            f"{placed[:, 0].max():.3f} m: it must be more than {2 * np.abs(placed[:, 0]).max():.3f} m, or give another "
            "yaw or position"
        )
    if not size[1] / 2 <= height <= MAST:
        raise ValueError(
            f"height is {height} m, but it must be from {size[1] / 2:g} m, where the sensors touch the table, to "
            f"{MAST} m"
        )
    place = np.array([*position, -placed[:, 2].min()])
    quat = turn.as_quat(canonical=True, scalar_first=True)
    mesh, shape = _object(body, mass, friction)
    deep = (float(sensor.camera.distance) - thickness) / 2  # half of the housing between the gel and the camera
    fingers = [
        _FINGER.format(
            side=side,
            sign=sign,
            out=sign * opening / 2,
            mass=FINGER_MASS,
            half=opening / 2,
            turn=_row(Rotation.from_matrix(np.transpose(axes)).as_quat(scalar_first=True)),
            middle=sign * (thickness + deep),
            rise=(REACH - size[1] / 2) / 2,
            deep=deep,
            half_width=size[0] / 2,
            long=(REACH + size[1] / 2) / 2,
        )
        for (side, axes), sign in zip(_TIPS.items(), (-1, 1), strict=True)
    ]
    xml = _SCENE.format(
        timestep=timestep,
        slippery=SLIPPERY,
        mesh=mesh,
        height=height,
        reach=REACH,
        hand=HAND_MASS,
        mast=MAST,
        widest=opening / 2 + thickness + 2 * deep,
        half_width=size[0] / 2,
        fingers="".join(fingers),
        place=_row(place),
        turn=_row(quat),
        shape=shape,
        lift=LIFT_GAINS,
        close=GRIP_GAINS,
        grip=grip,
        qpos=_row([height, opening / 2, opening / 2, *place, *quat]),
        opening=opening,
    )
    return mujoco.MjSpec.from_string(xml)


def corners(body: Body | None) -> Float[np.ndarray, "n 3"]:
    """Corners of the object in its mesh frame (m)."""
    if body is None:
        return np.array(np.meshgrid(*([-side / 2, side / 2] for side in BOX))).reshape(3, -1).T
    body.check()
    return np.asarray(body.hulls, np.float64).reshape(-1, 3)


def _check(**numbers: float) -> None:
    for name, value in numbers.items():
        if not (math.isfinite(value) and value > 0):
            raise ValueError(f"{name} is {value}, but it must be > 0 and finite")


def _object(body: Body | None, mass: float, friction: float) -> tuple[str, str]:
    """The object's meshes, and its inertia and geoms, as XML."""
    look = f'friction="{friction} .003 .0001" rgba=".75 .3 .25 1"'
    if body is None:
        return "", f'<geom name="object" type="box" size="{_row(np.array(BOX) / 2)}" mass="{mass}" {look}/>'
    hulls = np.unique(np.asarray(body.hulls, np.float64), axis=0)
    corners = [_row(np.unique(hull, axis=0).ravel()) for hull in hulls]
    meshes = [f'<mesh name="hull{i}" inertia="convex" vertex="{points}"/>' for i, points in enumerate(corners)]
    names = ["object", *(f"object{i}" for i in range(1, len(hulls)))]
    geoms = [f'<geom name="{name}" type="mesh" mesh="hull{i}" {look}/>' for i, name in enumerate(names)]
    scale = mass / float(body.shell_mass)
    moments = scale * np.asarray(body.shell_inertia, np.float64)[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    com = np.asarray(body.shell_com, np.float64)
    inertia = f'<inertial pos="{_row(com)}" mass="{mass}" fullinertia="{_row(moments)}"/>'
    return "".join(meshes), inertia + "".join(geoms)


def _row(numbers: Float[np.ndarray | Array, "n"] | list[float]) -> str:
    return " ".join(f"{number:.9g}" for number in np.asarray(numbers, np.float64))
