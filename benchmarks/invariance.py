"""Test whether a shorter time step, a mirrored scene or C MuJoCo changes how often each rest pose or outcome occurs.

    python -m benchmarks.invariance             # about 50 minutes on two idle cores
    python -m benchmarks.invariance --num 300   # about 5 minutes
    python -m benchmarks.invariance --only jerked-bottles

A box or a bottle is released 20 mm above the pad in any orientation (label of a run: the face that is down at the end),
or bottles stand on a jerked pad (label: the outcome). Each case is computed in several ways, called sides:

- "ours": `simulate` with MJX
- the same with half the time step
- the same with start, jerk and object mirrored
- the three sides above with C MuJoCo, instead of MJX, as the engine of `simulate`
- "C MuJoCo": C MuJoCo without `simulate`. The contacts are those that C MuJoCo itself finds for the mesh: at most four
  for a mesh that stands on a face. A round base becomes a square that is up to 30 % narrower, and rocks and walks more
- "C, every vertex": as "C MuJoCo", but with a contact sphere at every vertex of the hull, as on the side "ours". The
  hull itself has contacts only where a rim of the pad touches it between the vertices
- "C, every vertex, driven pad", for jerked bottles only: the same, but the pad is accelerated on slide joints under
  constant gravity. On all other sides, the pad is fixed and the jerk is a change of gravity

The command prints the share of each label on all sides, with the 95 % interval of the difference from "ours". Runs are
paired by their start and hidden properties (Agresti and Min 2005, with half a count added to each cell).
"""

import concurrent.futures
import copy
import dataclasses
import math
import os
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import tyro
from jaxtyping import Array, Float, PRNGKeyArray
from tqdm import tqdm

from sts_jax import geometry, objects, physics
from sts_jax.physics import scene
from sts_jax.physics.scenario import Shape, Start
from sts_jax.sensor import Sensor

MARGIN = 0.05  # limit for the ends of the interval of a difference of shares
BOX = (0.06, 0.04, 0.025)  # m
DROP = physics.Freefall(height=0.02, spread=0.02, frames=36)  # m, m, 1.1 s. Few objects still move at the end
SHAKE = physics.Perturbed(frames=36)
POINT = 1e-6  # m, radius of the contact sphere at each vertex
CARRIAGE = 1e5  # kg, mass of the driven pad, a million times the mass of an object
MESH_GAP = 0.001  # m, depth from which the mesh itself pushes, if its vertices are contacts: reached only at rims
UP = math.cos(math.radians(20))  # cosine of the largest lean of an object that rests on a face


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the command line."""

    num: int = 4000  # number of runs of each case on each side
    only: Literal["box", "bottle", "jerked-bottles"] | None = None  # the only case to compute (default: all)


def mirrored(scenario: Any) -> Any:
    """Make the same scenario with mirrored starts, for objects from `objects.mirror`."""

    class Mirrored(type(scenario)):  # type: ignore[misc]
        def start(self, key: PRNGKeyArray, shape: Shape, pad: tuple[float, float]) -> Start:
            return mirror(super().start(key, mirror_shape(shape), pad))

    return Mirrored(**{field.name: getattr(scenario, field.name) for field in dataclasses.fields(scenario)})


def mirror(start: Start) -> Start:
    """Mirror the start of a trajectory: y becomes -y in its pose and its condition (such as the pad's acceleration)."""
    flip = jnp.array([1.0, -1, 1])
    pose = start.pose * jnp.concatenate([flip, jnp.array([1.0, -1, 1, -1])])
    quat = geometry.quat_canonical(pose[3:])
    return start._replace(
        pose=jnp.concatenate([pose[:3], quat]), condition=start.condition * flip[: len(start.condition)]
    )


def mirror_shape(shape: Shape) -> Shape:
    """Mirror the geometry of a body so that y becomes -y in the mesh frame, as `objects.mirror` does."""
    flip = np.array([1, -1, 1], np.float32)
    return shape._replace(points=shape.points * flip, rests=shape.rests * flip, coms=shape.coms * flip)


class Case(NamedTuple):
    """A scenario, its bodies, and the labels that its final states can have, such as "fell off"."""

    name: str
    scenario: physics.Freefall | physics.Perturbed
    mirrored: physics.Freefall | physics.Perturbed  # the same scenario with mirrored starts
    bodies: list[objects.Body]
    labels: tuple[str, ...]
    label: Callable[[Float[Array, "7"], Float[Array, "7"]], Array]  # index of the label, from the first and last poses


def box() -> objects.Body:
    """Make a solid box of the size BOX and the density 500 kg/m^3."""
    corners = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), -1).reshape(-1, 3) * np.array(BOX) / 2
    mass = 500 * math.prod(BOX)
    x, y, z = np.square(BOX)
    return dataclasses.replace(
        objects.make(jax.random.key(0), "fork"),  # a solid body, whose hull and mass properties are replaced
        hulls=jnp.asarray(np.concatenate([corners, np.repeat(corners[-1:], 24, 0)])[None], jnp.float32),
        shell_mass=jnp.float32(mass),
        shell_com=jnp.zeros(3),
        shell_inertia=jnp.asarray(mass / 12 * np.diag([y + z, x + z, x + y]), jnp.float32),
    )


def box_face(first: Float[Array, "7"], last: Float[Array, "7"]) -> Array:
    """Label of the box: the axis that is vertical at the end (0, 1 or 2), 3 for no axis, 4 if the box fell off."""
    del first
    vertical = jnp.abs(geometry.quat_to_matrix(geometry.normalize(last[3:]))[2])
    face = jnp.where(jnp.max(vertical) > UP, jnp.argmax(vertical), 3)
    return jnp.where(physics.fell_off(last), 4, face)


def bottle_side(first: Float[Array, "7"], last: Float[Array, "7"]) -> Array:
    """Label of the bottle: 0 if it stands, 1 if it stands on its head, 2 if it lies, 3 if it fell off."""
    del first
    up = geometry.quat_to_matrix(geometry.normalize(last[3:]))[2, 2]
    side = jnp.where(up > UP, 0, jnp.where(up < -UP, 1, 2))
    return jnp.where(physics.fell_off(last), 3, side)


def cases() -> list[Case]:
    """Make the three cases: a dropped box, a dropped bottle, and standing bottles on a pad that is jerked sideways."""
    bottles = [objects.make(jax.random.key(i), "bottle") for i in range(4)]
    squat = objects.make(jax.random.key(27), "bottle")  # 101 mm high, 44 mm wide
    small, middle, large = (f"on {1e3 * a:.0f} x {1e3 * b:.0f} mm" for a, b in ((BOX[1], BOX[2]), BOX[::2], BOX[:2]))
    dropped, shaken = mirrored(DROP), mirrored(SHAKE)
    outcomes = tuple(outcome.name.lower() for outcome in physics.Outcome)
    return [
        Case("box", DROP, dropped, [box()], (small, middle, large, "on no face", "fell off"), box_face),
        Case("bottle", DROP, dropped, [squat], ("stands", "on its head", "lies", "fell off"), bottle_side),
        Case("jerked-bottles", SHAKE, shaken, bottles, outcomes, SHAKE.outcome),
    ]


def roll(
    case: Case,
    num: int,
    *,
    bodies: Sequence[objects.Body] | None = None,
    scenario: physics.Scenario | None = None,
    seed: int = 0,
    engine: physics.Engine = "mjx",
) -> physics.Trajectory:
    """Simulate trajectories of a case, which consists of a scenario and bodies."""
    items = list(case.bodies if bodies is None else bodies)
    each = -(-num // len(items))
    with tqdm(total=each * len(items), desc=case.name, leave=False, disable=None) as bar:
        traj = physics.simulate(
            jax.random.key(seed),
            items,
            Sensor(),
            case.scenario if scenario is None else scenario,
            each,
            progress=lambda n: bar.update(n - bar.n),
            engine=engine,
        )
    return jax.tree.map(np.asarray, traj)


def halved(scenario: physics.Freefall | physics.Perturbed) -> physics.Freefall | physics.Perturbed:
    """Halve the time step of a scenario."""
    return dataclasses.replace(
        scenario, contact=dataclasses.replace(scenario.contact, timestep=scenario.contact.timestep / 2)
    )


def c_model(body: objects.Body, contact: physics.Contact, every_vertex: bool, driven: bool) -> mujoco.MjModel:
    """Compile the scene for C MuJoCo."""
    gel, parts = Sensor().gel.size, np.asarray(body.hulls)
    xml = scene.scene_xml(parts, (float(gel[0]), float(gel[1])), contact)
    if driven:
        start = xml.index('<geom name="pad"')
        end = xml.index("/>", start) + 2
        slides = '<joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/>'
        weight = f'<inertial pos="0 0 0" mass="{CARRIAGE}" diaginertia="1 1 1"/>'
        xml = f'{xml[:start]}<body name="carriage">{slides}{weight}{xml[start:end]}</body>{xml[end:]}'
    spec = mujoco.MjSpec.from_string(xml)
    if every_vertex:
        owner = spec.body("object")
        mesh = owner.geoms[0]
        mesh.gap = MESH_GAP
        for point in np.unique(parts.reshape(-1, 3), axis=0):
            owner.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[POINT, 0, 0], pos=point, friction=mesh.friction)
    return spec.compile()


def last_in_c(case: Case, traj: physics.Trajectory, *, every_vertex: bool = False, driven: bool = False) -> np.ndarray:
    """Simulate given trajectories again, from their first frames, in C MuJoCo."""
    scenario = case.scenario
    times = np.arange(scenario.steps * (scenario.frames - 1)) * scenario.contact.timestep
    gravities = jax.jit(jax.vmap(jax.vmap(scenario.gravity, (0, None)), (None, 0)))
    compiled = [c_model(body, scenario.contact, every_vertex, driven) for body in case.bodies]
    rigid = jax.jit(jax.vmap(objects.rigid, (None, 0, 0, 0)))

    def one(model: mujoco.MjModel, pose: np.ndarray, velocity: np.ndarray, gravity: np.ndarray) -> np.ndarray:
        data = mujoco.MjData(model)
        data.qpos[-7:], data.qvel[-6:-3] = pose, velocity[:3]
        mujoco.mju_rotVecQuat(data.qvel[-3:], velocity[3:], pose[3:] * [1, -1, -1, -1])
        changes = np.flatnonzero(np.any(np.diff(gravity, axis=0), axis=1)) + 1
        for part in np.split(gravity, changes):
            model.opt.gravity[2] = part[0, 2]
            if driven:
                data.qfrc_applied[:2] = -CARRIAGE * part[0, :2]
            else:
                model.opt.gravity[:2] = part[0, :2]
            mujoco.mj_step(model, data, nstep=len(part))
        return data.qpos[-7:] - ([*data.qpos[:2], 0, 0, 0, 0, 0] if driven else 0)

    ends: list[np.ndarray] = []
    with concurrent.futures.ThreadPoolExecutor(os.cpu_count()) as pool:
        for index, body in enumerate(case.bodies):
            own = traj.body == index
            hidden = jax.tree.map(lambda x, own=own: x[own], traj.hidden)
            properties = [np.asarray(x, np.float64) for x in rigid(body, hidden.fill, hidden.shell_scale, hidden.up)]
            models = []
            for mass, com, inertia, friction in zip(*properties, hidden.friction, strict=True):
                models.append(copy.copy(compiled[index]))
                scene.set_rigid(models[-1], mujoco.MjData(models[-1]), mass, com, inertia, float(friction))
                if driven:  # the solver converges slowly for the masses of the carriage and of an object
                    models[-1].stat.meaninertia = models[-1].dof_M0[2:].mean()
                    models[-1].opt.iterations, models[-1].opt.tolerance = 100, 1e-12
            starts = (traj.pose[own, 0].astype(np.float64), traj.velocity[own, 0].astype(np.float64))
            gravity = np.asarray(gravities(times, traj.condition[own]), np.float64)
            ends += pool.map(one, models, *starts, gravity)
    return np.array(ends, np.float32)


def difference(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    """Return the 95 % confidence interval of the difference between the shares of one label in two sets of runs."""
    gained, lost, count = np.sum(b & ~a) + 0.5, np.sum(a & ~b) + 0.5, len(a) + 2
    middle = (gained - lost) / count
    return middle, 1.96 * math.sqrt((gained + lost) / count - middle**2) / math.sqrt(count)


def sides(case: Case, num: int) -> dict[str, np.ndarray]:
    """Simulate a case in several ways, such as with MJX and with C MuJoCo, and label each run by its final state."""
    other_hand = [objects.mirror(body) for body in case.bodies]
    rolled: dict[str, physics.Trajectory] = {}
    sides_of: dict[str, physics.Engine] = {"ours": "mjx", "simulate in C": "mujoco"}
    for name, engine in sides_of.items():
        rolled[name] = roll(case, num, engine=engine)
        rolled[f"{name}, half step"] = roll(case, num, scenario=halved(case.scenario), engine=engine)
        rolled[f"{name}, mirrored"] = roll(case, num, scenario=case.mirrored, bodies=other_hand, engine=engine)
    ours = rolled["ours"]
    first = ours.pose[:, 0]
    print(
        f"{case.name}: {len(first)} runs a side, unsettled {100 * np.mean(~ours.settled):.1f} %, drawn again "
        f"{', '.join(f'{int(traj.resampled.sum())} ({name})' for name, traj in rolled.items())}"
    )
    ends: dict[str, Array | np.ndarray] = {name: traj.pose[:, -1] for name, traj in rolled.items()}
    ends["C MuJoCo"] = last_in_c(case, ours)
    ends["C, every vertex"] = last_in_c(case, ours, every_vertex=True)
    if ours.condition.shape[1]:
        ends["C, every vertex, driven pad"] = last_in_c(case, ours, every_vertex=True, driven=True)
    label = jax.vmap(case.label)
    starts = {name: traj.pose[:, 0] for name, traj in rolled.items()}
    return {name: np.asarray(label(starts.get(name, first), jnp.asarray(last))) for name, last in ends.items()}


def compare(found: dict[str, np.ndarray], labels: Sequence[str], margin: float = MARGIN) -> bool:
    """Print how often the runs end in each way, and compare the side "ours" with each of the other sides."""
    ours, within = found["ours"], True
    for side, theirs in list(found.items())[1:]:
        print(f"    {side}: {100 * np.mean(ours == theirs):.1f} % of the runs end alike")
        for index in np.union1d(ours, theirs):
            a, b = ours == index, theirs == index
            middle, half = difference(a, b)
            inside = abs(middle) + half < margin
            within &= inside
            print(
                f"        {labels[index]:16s} {100 * a.mean():5.1f} % and {100 * b.mean():5.1f} %, difference "
                f"{100 * middle:+5.2f} [{100 * (middle - half):+5.2f}, {100 * (middle + half):+5.2f}]"
                f"{'' if inside else '   OUTSIDE'}"
            )
    return within


def main(args: Args) -> None:
    """Simulate each case in several ways, and print a comparison of the results."""
    within = [compare(sides(case, args.num), case.labels) for case in cases() if args.only in (None, case.name)]
    print(f"every interval within {100 * MARGIN:.0f} points: {'yes' if all(within) else 'NO'}")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
