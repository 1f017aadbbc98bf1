"""The scene of all scenarios as MuJoCo and MJX models: a fixed pad and one free object above it.

The pad is a box whose top face lies in the plane z = 0 of the sensor frame. If `Scenario.wall` is > 0, as in
`Inclined`, a stop wall stands just beyond the gel, on the side of +y. The wall reaches down to the bottom of the pad.
The body frame of the object is the mesh frame, so `qpos` is the object's pose. The model stores the centre of mass
separately (`body_ipos`).

MJX steps one template model for all objects (`step`, `template`). Objects differ only in a few arrays and in their
contacts. `compile_scene` compiles the same scene with the object's mesh for C MuJoCo.
"""

import dataclasses
import functools
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Array, Float

from sts_jax.physics.contact import PAD_CONTACTS, WALL_CONTACTS, Contacts
from sts_jax.physics.solver import SOLVER, mjx

PAD_DEPTH = 0.2  # m, an object that leaves the pad slides down its side and never gets beneath it
WALL_DEPTH = 0.01  # m, thickness of the stop wall
WALL_OVERHANG = 0.5  # m, reach of the wall beyond the pad on either side, so that no object gets to its ends
CONDIM = 6  # solver rows of a contact: normal, two for sliding, one for torsion, two for rolling

_SCENE = """
<mujoco>
  <option timestep="{timestep}" cone="elliptic" impratio="{impratio}" iterations="{iterations}"
          ls_iterations="{ls_iterations}">
    <flag eulerdamp="disable"/>
  </option>
  <default>
    <geom condim="{condim}" solref="{time_constant} {damping_ratio}" solimp="{soft} {hard} {width}"/>
  </default>
  {asset}
  <worldbody>
    {fixed}
    <body name="object">
      <freejoint/>
      <inertial pos="0 0 0.001" mass="1" fullinertia="2e-4 2e-4 3e-4 0 0 1e-5"/>
      {shapes}
    </body>
  </worldbody>
</mujoco>
"""


@dataclasses.dataclass(frozen=True)
class Contact:
    """The contact and solver constants of a scenario, as MuJoCo defines them."""

    timestep: float = 0.0005  # time step (s)
    # time constant of the contact (s), the first number of MuJoCo's solref (with the default, an object is less
    # than 0.1 mm deep in the pad at rest and about 1 mm at impact)
    time_constant: float = 0.003
    # damping ratio of the contact, the second number of MuJoCo's solref (a gel bounces little, but most dropped
    # objects still leave the pad and touch it again)
    damping_ratio: float = 0.8
    # impedance at first touch, the first number of MuJoCo's solimp (with a high value, or with a `width` that is short
    # for the time step, the contact under a sliding object rattles and its friction is wrong by up to 10 %)
    soft: float = 0.02
    hard: float = 0.99  # impedance at the depth `width`, the second number of MuJoCo's solimp
    # depth over which the impedance rises (m), the third number of MuJoCo's solimp (with a large value, an object that
    # leans over an edge sinks in and tips early, in both engines)
    width: float = 0.00002
    torsional: float = 0.005  # torsional friction (m, the default of MuJoCo)
    # rolling friction (m, must be small, because the base over which an object topples becomes wider by this length)
    rolling: float = 0.0002
    # stiffness of friction relative to the normal force (a high value keeps objects at rest from creeping)
    impratio: float = 10.0
    iterations: int = 8  # largest number of Newton iterations in a time step
    ls_iterations: int = 8  # largest number of line-search iterations in a Newton iteration


class Box(NamedTuple):
    """A fixed box with sides parallel to the axes."""

    centre: Float[np.ndarray, "3"]  # m, sensor frame
    half: Float[np.ndarray, "3"]  # m, half its size


def boxes(pad: tuple[float, float], wall: float) -> list[Box]:
    """Return the box of the pad, followed by the box of the stop wall if there is one.

    Args:
        pad: Size of the pad along x and y (m).
        wall: Height of the stop wall (m), 0 for none.
    """
    beneath = WALL_DEPTH if wall else 0.0  # the pad extends beneath the wall
    centre, half = [0, beneath / 2, -PAD_DEPTH / 2], [pad[0] / 2, (pad[1] + beneath) / 2, PAD_DEPTH / 2]
    found = [Box(np.array(centre), np.array(half))]
    if wall:
        centre = [0, (pad[1] + WALL_DEPTH) / 2, (wall - PAD_DEPTH) / 2]
        half = [pad[0] / 2 + WALL_OVERHANG, WALL_DEPTH / 2, (wall + PAD_DEPTH) / 2]
        found.append(Box(np.array(centre), np.array(half)))
    return found


def _xml(pad: tuple[float, float], wall: float, contact: Contact, shapes: list[str], asset: str, inert: str) -> str:
    """Write the scene as MuJoCo's XML, with geoms `shapes` for the object and attributes `inert` for the wall."""
    friction = f"0.5 {contact.torsional} {contact.rolling}"
    fixed = [
        f'<geom name="{name}" type="box" pos="{" ".join(map(str, box.centre))}" size="{" ".join(map(str, box.half))}" '
        f'friction="0 0 0" {extra}/>'
        for name, extra, box in zip(("pad", "wall"), ("", inert), boxes(pad, wall), strict=False)
    ]
    return _SCENE.format(
        shapes="\n".join(f'<geom {shape} friction="{friction}"/>' for shape in shapes),
        asset=asset,
        fixed="\n".join(fixed),
        condim=CONDIM,
        **dataclasses.asdict(contact),
    )


def compile_scene(parts: np.ndarray, pad: tuple[float, float], contact: Contact, wall: float = 0.0) -> mujoco.MjModel:
    """Compile the scene for C MuJoCo: the pad, a stop wall at one edge of the pad, and the object.

    The object has one mesh for each convex part, and MuJoCo finds the contacts of these meshes. The object has
    placeholder mass properties, which `set_rigid` replaces.

    Args:
        parts: Points of the p convex parts that form the collision shape of the object, n points for each part,
            (p, n, 3), in the mesh frame (m).
        pad: Size of the pad along x and y (m).
        contact: Contact and solver constants.
        wall: Height of the stop wall (m), 0 for none.
    """
    return mujoco.MjModel.from_xml_string(scene_xml(parts, pad, contact, wall))


def scene_xml(parts: np.ndarray, pad: tuple[float, float], contact: Contact, wall: float = 0.0) -> str:
    """Return the scene as MuJoCo's XML. See `compile_scene` for the arguments."""
    meshes, shapes = [], []
    for index, part in enumerate(np.unique(parts, axis=0)):
        points = " ".join(f"{x:.9g}" for x in np.unique(part, axis=0).ravel())
        meshes.append(f'<mesh name="hull{index}" inertia="convex" vertex="{points}"/>')
        shapes.append(f'type="mesh" mesh="hull{index}"')
    return _xml(pad, wall, contact, shapes, f"<asset>{''.join(meshes)}</asset>", "")


def set_rigid(
    model: mujoco.MjModel, data: mujoco.MjData, mass: float, com: np.ndarray, inertia: np.ndarray, friction: float
) -> None:
    """Write the mass properties and the friction of an object into a model.

    All constants that MuJoCo derives from these values are updated, too (`mj_setConst`). Outdated constants would
    change the stiffness of the contacts.

    Args:
        model: Model of the scene. It is changed in place.
        data: Data of the same scene, overwritten by MuJoCo.
        mass: Mass (kg).
        com: Centre of mass in the mesh frame, (3,) (m).
        inertia: Inertia about the centre of mass, along the mesh axes, (3, 3) (kg m^2).
        friction: Coefficient of sliding friction against the pad.

    Raises:
        ValueError: Mass, friction or a principal moment of inertia is not positive, or a value is not finite.
    """
    if not (np.isfinite(mass) and mass > 0):
        raise ValueError(f"mass is {mass} kg, but it must be positive and finite")
    if not (np.isfinite(friction) and friction > 0):
        raise ValueError(f"friction is {friction}, but it must be positive and finite")
    for name, value in (("com", com), ("inertia", inertia)):
        if not np.isfinite(value).all():
            raise ValueError(f"{name} is {np.asarray(value).tolist()}, but all its values must be finite")
    principal, axes = (x[..., ::-1].copy() for x in np.linalg.eigh(inertia))  # largest first, as in MuJoCo
    if principal[2] <= 0:
        raise ValueError(
            f"principal moments of inertia are {principal} kg m^2, but they must be positive: "
            "check shell_inertia of the body"
        )
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    body = model.body("object")
    body.mass = mass
    body.ipos = com
    body.inertia = principal
    mujoco.mju_mat2Quat(model.body_iquat[body.id], axes.ravel())
    model.geom_friction[model.geom_bodyid > 0, 0] = friction
    mujoco.mj_setConst(model, data)
    model.stat.meaninertia = model.dof_M0.mean()  # scales the solver's tolerance. Only the compiler sets it


# The fields of mjx.Model that `set_rigid` changes. A test compares all fields with a freshly compiled model's.
DRAWN = (
    "body_mass",
    "body_subtreemass",
    "body_ipos",
    "body_iquat",
    "body_inertia",
    "body_invweight0",
    "dof_invweight0",
    "dof_M0",
    "geom_friction",
)


@functools.cache
def template(
    pad: tuple[float, float], contact: Contact, wall: float = 0.0
) -> tuple[mujoco.MjModel, mjx.Model, mjx.Data]:
    """Return the scene that MJX uses for all objects: MuJoCo's model, MJX's model and MJX's data.

    The model has small boxes in place of an object. For each box, MJX reserves memory for four contacts with the pad.
    The contacts of an object with the pad and the wall come from `collide`, not from the boxes.

    Args:
        pad: Size of the pad along x and y (m).
        contact: Contact and solver constants.
        wall: Height of the stop wall (m), 0 for none.
    """
    count = (PAD_CONTACTS + (WALL_CONTACTS if wall else 0)) // 4
    shapes = ['type="box" size=".01 .01 .01"'] * count
    model = mujoco.MjModel.from_xml_string(_xml(pad, wall, contact, shapes, "", 'contype="0" conaffinity="0"'))
    return model, mjx.put_model(model), mjx.make_data(model)


def drawn(model: mujoco.MjModel, like: mjx.Model) -> dict[str, np.ndarray]:
    """Read those fields of a C MuJoCo model that depend on the object, such as `body_mass` and `geom_friction`.

    Args:
        model: Model of C MuJoCo.
        like: Model of MJX. The returned arrays have the dtypes of its fields.

    Returns:
        Arrays by the name of the field in `mjx.Model`.
    """
    fields = {name: np.array(getattr(model, name), getattr(like, name).dtype) for name in DRAWN}
    return fields | {"stat.meaninertia": np.array(model.stat.meaninertia, np.float32)}


def position(model: mjx.Model, data: mjx.Data, contacts: Contacts) -> mjx.Data:
    """Run the position stage of `mjx.forward`, with `contacts` in place of the contacts that MJX finds."""
    data = mjx.factor_m(model, mjx.crb(model, mjx.com_pos(model, mjx.kinematics(model, data))))
    data = mjx.collision(model, data)
    # MJX has no public way to pass contacts in. If this path moves, `tree_replace` fails at the first step.
    data = data.tree_replace({f"_impl.contact.{name}": value for name, value in contacts._asdict().items()})
    return mjx.make_constraint(model, data)


def step(model: mjx.Model, data: mjx.Data, contacts: Contacts) -> mjx.Data:
    """Advance the data by one `mjx.step` (semi-implicit Euler) with the given contacts."""
    data = mjx.fwd_velocity(model, position(model, data, contacts))
    data = mjx.fwd_acceleration(model, mjx.fwd_actuation(model, data))
    return mjx.euler(model, SOLVER.solve(model, data))


def push(data: mjx.Data, contacts: slice) -> Float[Array, "6"]:
    """Return the total force and the total moment that some contacts exert on the object.

    Args:
        data: Data of MJX after `step`.
        contacts: Indices of the contacts, as a slice with start and stop.

    Returns:
        Force (N, sensor frame) and moment about the object's origin (N m, mesh frame), (6,).
    """
    rows = slice(contacts.start * CONDIM, contacts.stop * CONDIM)
    return data._impl.efc_force[rows] @ data._impl.efc_J[rows]
