"""The scene of all scenarios as MuJoCo and MJX models: a fixed pad and one free object above it.

The pad is a box whose top face lies in the plane z = 0 of the sensor frame. The stop wall stands just beyond the gel,
on the side of +y, and reaches down to the bottom of the pad. The body frame of the object is the mesh frame, so `qpos`
is the object's pose. The model stores the centre of mass separately (`body_ipos`).

MJX steps one template model for all objects (`step`, `template`). Objects differ only in a few arrays and in their
contacts. `compile_scene` compiles the same scene with the object's mesh for C MuJoCo.
"""

import contextlib
import dataclasses
import functools
import importlib.util
import io
from dataclasses import field
from types import ModuleType
from typing import NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull

from sts_jax._ranges import COUNT, NOT_NEGATIVE, POSITIVE
from sts_jax.physics.contact import PAD_CONTACTS, WALL_CONTACTS, Contacts

with contextlib.redirect_stdout(io.StringIO()):  # mjx prints that warp, another engine, is not installed
    from mujoco import mjx as mjx

PAD_DEPTH = 0.2  # m, an object that leaves the pad slides down its side and never gets beneath it
WALL_DEPTH = 0.01  # m, thickness of the stop wall
WALL_OVERHANG = 0.5  # m, reach of the wall beyond the pad on either side, so that no object gets to its ends
CONDIM = 6  # solver rows of a contact: normal, two for sliding, one for torsion, two for rolling
# Largest friction of an object, relative to half the smallest width of its hull. Torsion acts over the contact patch,
# which is no wider than the object: with a sliding friction of 0.75, a patch of that radius has 2/3 * 0.75 = 0.5.
TORSION = 0.5
# Rolling friction widens the base over which an object topples. With this share, a cube can rest within 1.6 degrees of
# its balance on an edge, and none of 1,500 dropped cubes of 5 to 50 mm does. With twice the share, 1 % do.
ROLLING = 0.04
_IMPEDANCE = {"at_least": 0.0001, "at_most": 0.9999}  # MuJoCo cuts impedances off at these limits
SMALLEST_SLIP = 1e-6  # lower bound of |u + alpha v|^2 / |u|^2 in the line search, larger than float32's rounding

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

    timestep: float = field(default=0.0005, metadata=POSITIVE)  # time step (s)
    # time constant of the contact (s), the first number of MuJoCo's solref (with the default, an object is less
    # than 0.1 mm deep in the pad at rest and about 1 mm at impact)
    time_constant: float = field(default=0.003, metadata=POSITIVE)
    # damping ratio of the contact, the second number of MuJoCo's solref (a gel bounces little, but most dropped
    # objects still leave the pad and touch it again)
    damping_ratio: float = field(default=0.8, metadata=POSITIVE)
    # impedance at first touch, the first number of MuJoCo's solimp (with a high value, or with a `width` that is short
    # for the time step, the contact under a sliding object rattles and its friction is wrong by up to 10 %)
    soft: float = field(default=0.02, metadata=_IMPEDANCE)
    # impedance at the depth `width`, the second number of MuJoCo's solimp
    hard: float = field(default=0.99, metadata=_IMPEDANCE)
    # depth over which the impedance rises (m), the third number of MuJoCo's solimp (with a large value, an object that
    # leans over an edge sinks in and tips early, in both engines)
    width: float = field(default=0.00002, metadata=POSITIVE)
    # torsional friction (m, the default of MuJoCo, at most 1/2 of half the smallest width of the object's hull)
    torsional: float = field(default=0.005, metadata=NOT_NEGATIVE)
    # rolling friction (m, must be small, because the base over which an object topples becomes wider by this length, at
    # most 1/25 of half the smallest width of the object's hull)
    rolling: float = field(default=0.0002, metadata=NOT_NEGATIVE)
    # stiffness of friction relative to the normal force (a high value keeps objects at rest from creeping)
    impratio: float = field(default=10.0, metadata=POSITIVE)
    # largest number of Newton iterations in a time step
    iterations: int = field(default=8, metadata=COUNT)
    # largest number of line-search iterations in a Newton iteration
    ls_iterations: int = field(default=8, metadata=COUNT)

    def limited(self, parts: np.ndarray) -> "Contact":
        """The constants for an object with the convex parts `parts`, (p, n, 3) (m), which bound its friction."""
        points = np.unique(np.reshape(parts, (-1, 3)), axis=0).astype(np.float64)
        half = np.ptp(points @ ConvexHull(points).equations[:, :3].T, axis=0).min() / 2
        torsional, rolling = min(self.torsional, TORSION * half), min(self.rolling, ROLLING * half)
        return dataclasses.replace(self, torsional=torsional, rolling=rolling)


class Box(NamedTuple):
    """A fixed box with sides parallel to the axes."""

    centre: Float[np.ndarray, "3"]  # m, sensor frame
    half: Float[np.ndarray, "3"]  # m, half its size


def boxes(pad: tuple[float, float], wall: float) -> list[Box]:
    """The box of the pad (size along x and y, m), and that of the stop wall if its height is > 0 (m)."""
    beneath = WALL_DEPTH if wall else 0.0  # the pad extends beneath the wall
    centre, half = [0, beneath / 2, -PAD_DEPTH / 2], [pad[0] / 2, (pad[1] + beneath) / 2, PAD_DEPTH / 2]
    fixed = [Box(np.array(centre), np.array(half))]
    if wall:
        centre = [0, (pad[1] + WALL_DEPTH) / 2, (wall - PAD_DEPTH) / 2]
        half = [pad[0] / 2 + WALL_OVERHANG, WALL_DEPTH / 2, (wall + PAD_DEPTH) / 2]
        fixed.append(Box(np.array(centre), np.array(half)))
    return fixed


def _xml(pad: tuple[float, float], wall: float, contact: Contact, shapes: list[str], asset: str, beside: str) -> str:
    """Write the scene as MuJoCo's XML, with geoms `shapes` for the object and attributes `beside` for the wall."""
    friction = f"0.5 {contact.torsional} {contact.rolling}"
    fixed = [
        f'<geom name="{name}" type="box" pos="{" ".join(map(str, box.centre))}" size="{" ".join(map(str, box.half))}" '
        f'friction="0 0 0" {extra}/>'
        for name, extra, box in zip(("pad", "wall"), ("", beside), boxes(pad, wall), strict=False)
    ]
    return _SCENE.format(
        shapes="\n".join(f'<geom {shape} friction="{friction}"/>' for shape in shapes),
        asset=asset,
        fixed="\n".join(fixed),
        condim=CONDIM,
        **dataclasses.asdict(contact),
    )


def compile_scene(parts: np.ndarray, pad: tuple[float, float], contact: Contact, wall: float = 0.0) -> mujoco.MjModel:
    """Compile the scene for C MuJoCo, which finds the contacts. `set_rigid` replaces its placeholder masses.

    `parts` are the points of the object's convex parts, (p, n, 3) (m).
    """
    return mujoco.MjModel.from_xml_string(scene_xml(parts, pad, contact, wall))


def scene_xml(parts: np.ndarray, pad: tuple[float, float], contact: Contact, wall: float = 0.0) -> str:
    """The scene of `compile_scene` as XML."""
    meshes, shapes = [], []
    for index, part in enumerate(np.unique(parts, axis=0)):
        points = " ".join(f"{x:.9g}" for x in np.unique(part, axis=0).ravel())
        meshes.append(f'<mesh name="hull{index}" inertia="convex" vertex="{points}"/>')
        shapes.append(f'type="mesh" mesh="hull{index}"')
    return _xml(pad, wall, contact.limited(parts), shapes, f"<asset>{''.join(meshes)}</asset>", "")


def set_rigid(
    model: mujoco.MjModel, data: mujoco.MjData, mass: float, com: np.ndarray, inertia: np.ndarray, friction: float
) -> None:
    """Write the values of a `bodies.Rigid` into a model, with all constants that MuJoCo derives from them."""
    for name, value in (("mass", mass), ("friction", friction)):
        if not (np.isfinite(value) and value > 0):
            raise ValueError(f"{name} is {value}, but it must be positive and finite")
    if not (np.isfinite(com).all() and np.isfinite(inertia).all()):
        raise ValueError(f"com is {com} and inertia is {inertia}, but all their values must be finite")
    principal, axes = (x[..., ::-1].copy() for x in np.linalg.eigh(inertia))  # largest first, as in MuJoCo
    if principal[2] <= 0:
        raise ValueError(f"principal moments of inertia are {principal} kg m^2, but they must be positive")
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    body = model.body("object")
    body.mass = mass
    body.ipos = com
    body.inertia = principal
    mujoco.mju_mat2Quat(model.body_iquat[body.id], axes.ravel())
    model.geom_friction[model.geom_bodyid > 0, 0] = friction
    mujoco.mj_setConst(model, data)  # outdated constants would change the stiffness of the contacts
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
    """The scene that MJX uses for all objects: MuJoCo's model, MJX's model and MJX's data.

    The model has small boxes in place of an object: for each, MJX reserves memory for four contacts of `collide`.
    """
    box, of_wall = 'type="box" size=".01 .01 .01"', 'contype="2" conaffinity="2"'
    shapes = [box] * (PAD_CONTACTS // 4) + [f"{box} {of_wall}"] * (WALL_CONTACTS // 4 if wall else 0)
    model = mujoco.MjModel.from_xml_string(_xml(pad, wall, contact, shapes, "", of_wall))
    return model, mjx.put_model(model), mjx.make_data(model)


def drawn(model: mujoco.MjModel, like: mjx.Model) -> dict[str, np.ndarray]:
    """Read those fields of a C MuJoCo model that depend on the object, with the dtypes of the fields of `like`."""
    fields = {name: np.array(getattr(model, name), getattr(like, name).dtype) for name in DRAWN}
    return fields | {"stat.meaninertia": np.array(model.stat.meaninertia, np.float32)}


def _sound_solver() -> ModuleType:
    """Load a copy of MJX 3.17's solver whose line search never computes NaN.

    At each step length alpha, the line search computes the root of |u + alpha v|^2 = uu + alpha (2 uv + alpha vv), with
    the tangential part u of a contact's residual and its change v along the search direction. In float32 the sum can be
    negative where u is zero, as in free fall, and the search then stops: velocities were wrong by up to 0.15 m/s.
    """
    spec = importlib.util.find_spec("mujoco.mjx._src.solver")
    assert spec is not None
    assert spec.loader is not None
    solver = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(solver)
    create = solver._LSPoint.create

    # MJX's own signature, for which there are no public types.
    def point(m, d, ctx, alpha, jv, quad, quad_gauss, uu, v0, uv, vv):  # type: ignore[no-untyped-def]
        short = SMALLEST_SLIP * uu - (uu + alpha * (2 * uv + alpha * vv))
        return create(m, d, ctx, alpha, jv, quad, quad_gauss, uu + jnp.maximum(0, short), v0, uv, vv)

    solver._LSPoint.create = point
    return solver


_SOLVER = _sound_solver()


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
    return mjx.euler(model, _SOLVER.solve(model, data))
