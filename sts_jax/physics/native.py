"""Simulation of several trajectories of the same body in C MuJoCo, the engine for CPUs, as in `roll` for MJX.

The state of one trajectory in MuJoCo is called a world. A tiny sphere at each vertex of the object's hull collides with
the pad and the wall, so every vertex can be a contact point, as in `contact`. Without these spheres, MuJoCo would keep
only four contacts of a mesh that stands on a face, and a round base would act like a square base. The mesh itself also
collides, because the rims of the pad and the wall touch the hull between its vertices.
"""

import contextlib
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import mujoco
import mujoco.batch
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from sts_jax.physics import scene
from sts_jax.physics.roll import GONE_DEPTH, PARTED_TIME, SLOW_SPEED, SLOW_TURN, Record
from sts_jax.physics.scenario import Start

POINT = 1e-6  # m, radius of the contact sphere at each vertex
MESH_GAP = 0.0001  # m, the mesh pushes where it is deeper than this, which is more than the depth of vertices at rest
BLOCK = 8  # frames in a row, after which worlds that have ended are no longer simulated
# An object in contact that was slower than these for STILL_TIME under constant gravity is assumed to stay at rest.
STILL_SPEED = 0.001  # m/s
STILL_TURN = 0.02  # rad/s
STILL_TIME = 0.5  # s

FORCE = mujoco.mjtState.mjSTATE_XFRC_APPLIED  # the part of the state that the caller sets in every step
# Columns of the sensor data. A rollout runs without Python, so sensors measure what `forces.wrench` returns.
_PAD, _WALL = slice(0, 9), slice(11, 17)  # pad: force, torque, position. Wall: force, torque
_DEEPEST = slice(9, 11)  # > 0 if there is a contact, and the distance of the deepest one
_SENSORS = """
<sensor>
  <contact geom1="pad" subtree2="object" reduce="netforce" data="force torque pos"/>
  <contact body1="world" subtree2="object" reduce="mindist" data="found dist"/>
  {wall}
</sensor>
</mujoco>
"""
_WALL_SENSOR = '<contact geom1="wall" subtree2="object" reduce="netforce" data="force torque"/>'


class Ends(NamedTuple):
    """State at the end of n trajectories, with fields as in `roll.State`."""

    gone: Bool[np.ndarray, "n"]
    slow: Int[np.ndarray, "n"]
    touches: Int[np.ndarray, "n"]
    sunk: Float[np.ndarray, "n"]
    finite: Bool[np.ndarray, "n"]


class _Counts(NamedTuple):
    """What one block of frames passes to the next besides MuJoCo's own state."""

    gone: Bool[np.ndarray, "n"]
    slow: Int[np.ndarray, "n"]
    still: Int[np.ndarray, "n"]  # as `slow`, but slower than STILL_SPEED and STILL_TURN
    apart: Int[np.ndarray, "n"]
    touches: Int[np.ndarray, "n"]
    sunk: Float[np.ndarray, "n"]


class _Steps(NamedTuple):
    """States and sensor data of n worlds after each of t steps."""

    qpos: Float[np.ndarray, "n t 7"]
    qvel: Float[np.ndarray, "n t 6"]
    sensors: Float[np.ndarray, "n t k"]
    gone: Int[np.ndarray, "n"]  # index of the step after which the object has left the pad, t for none

    @property
    def moving(self) -> Bool[np.ndarray, "n t"]:
        return np.arange(self.qpos.shape[1]) <= self.gone[:, None]


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Keep MuJoCo's warnings, which `Ends.finite` reports, from standard error and from a file MUJOCO_LOG.TXT."""
    before, silent = mujoco.MjLogConfig.get(), mujoco.MjLogConfig.get()
    silent.logto_console = silent.logto_file = False
    silent.set()
    try:
        yield
    finally:
        if before.logto_console or before.logto_file:  # else another thread restores it
            before.set()


def compile_body(
    parts: np.ndarray, pad: tuple[float, float], contact: scene.Contact, wall: float = 0.0
) -> mujoco.MjModel:
    """Compile `scene.compile_scene` with contact sensors, and with a contact point at each vertex in `parts`."""
    sensors = _SENSORS.format(wall=_WALL_SENSOR if wall else "")
    spec = mujoco.MjSpec.from_string(scene.scene_xml(parts, pad, contact, wall).replace("</mujoco>", sensors))
    owner = spec.body("object")
    friction = owner.geoms[0].friction
    for mesh in owner.geoms:
        mesh.gap = MESH_GAP
    for point in np.unique(parts.reshape(-1, 3), axis=0):
        owner.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[POINT, 0, 0], pos=point, friction=friction)
    return spec.compile()


def _run(before: Int[np.ndarray, "n"], holds: Bool[np.ndarray, "n t"]) -> Int[np.ndarray, "n t"]:
    """Count, up to each step, the steps in a row in which a condition `holds`. `before` is the count before step 0."""
    step = np.arange(holds.shape[1])
    return step - np.maximum.accumulate(np.where(holds, -1 - before[:, None], step), axis=1)


def _gone(qpos: Float[np.ndarray, "n t 7"], points: Float[np.ndarray, "h 3"], lowest: float) -> Int[np.ndarray, "n"]:
    """Find the first step after which the whole object is GONE_DEPTH below the gel's face, t for none."""
    low = qpos[..., 2] < lowest
    gone = np.zeros(low.shape, bool)
    w, x, y, z = qpos[low][:, 3:].T
    up = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=-1)
    gone[low] = (up @ points.T).max(axis=1, initial=-np.inf) + qpos[low][:, 2] < -GONE_DEPTH
    return np.where(gone.any(axis=1), gone.argmax(axis=1), qpos.shape[1])


def _count(steps: _Steps, counts: _Counts, timestep: float) -> _Counts:
    speed, turn = (np.linalg.norm(steps.qvel[..., part], axis=-1) for part in (slice(3), slice(3, 6)))
    sensors, moving = steps.sensors, steps.moving
    touched = (np.any(sensors[..., _PAD], axis=-1) | np.any(sensors[..., _WALL], axis=-1)) & moving
    apart = _run(counts.apart, ~touched)
    before = np.concatenate([counts.apart[:, None], apart[:, :-1]], axis=1)
    parted = round(PARTED_TIME / timestep)
    begun, near = touched & (before >= parted), apart < parted
    deepest = np.where((sensors[..., _DEEPEST][..., 0] > 0) & moving, -sensors[..., _DEEPEST][..., 1], 0)
    return _Counts(
        gone=counts.gone | (steps.gone < speed.shape[1]),
        slow=_run(counts.slow, near & (speed < SLOW_SPEED) & (turn < SLOW_TURN))[:, -1],
        still=_run(counts.still, near & (speed < STILL_SPEED) & (turn < STILL_TURN))[:, -1],
        apart=apart[:, -1],
        touches=counts.touches + begun.sum(axis=1),
        sunk=np.maximum(counts.sunk, deepest.max(axis=1)),
    )


def _record(steps: _Steps, frames: int) -> Record:
    """Record the state at the end of each frame's interval, and the mean wrench of the unbroken contact until then."""
    worlds, count = steps.gone.shape[0], steps.qpos.shape[1] // frames
    ends = np.arange(frames) * count + count - 1
    last = np.minimum(ends, steps.gone[:, None])[..., None]
    over = (ends > steps.gone[:, None])[..., None]
    qpos = np.take_along_axis(steps.qpos, last, axis=1)
    qvel = np.where(over, 0, np.take_along_axis(steps.qvel, last, axis=1))

    force, torque, place = np.split(steps.sensors[..., _PAD], 3, axis=-1)
    wrench = np.concatenate([force, torque + np.cross(place, force)], axis=-1).reshape(worlds * frames, count, 6)
    pushed = np.any(wrench != 0, axis=-1)
    loaded = _run(np.zeros(len(pushed), int), pushed)[:, -1]
    ending = np.arange(count) >= count - loaded[:, None]
    mean = np.sum(wrench, axis=1, where=ending[..., None]) / np.maximum(loaded, 1)[:, None]
    wall = np.any(steps.sensors[:, ends, _WALL], axis=-1)
    quat = qpos[..., 3:] / np.linalg.norm(qpos[..., 3:], axis=-1, keepdims=True)
    quat = np.where(quat[..., :1] < 0, -quat, quat)
    turn = Rotation.from_quat(quat.reshape(-1, 4), scalar_first=True).apply(qvel[..., 3:].reshape(-1, 3))
    return Record(
        pose=np.concatenate([qpos[..., :3], quat], axis=-1),
        velocity=np.concatenate([qvel[..., :3], turn.reshape(worlds, frames, 3)], axis=-1),
        wrench=np.where(over, 0, mean.reshape(worlds, frames, 6)),
        contact=(loaded > 0).reshape(worlds, frames) & ~over[..., 0],
        wall=wall & ~over[..., 0],
    )


class _Simulation(NamedTuple):
    """The worlds of n trajectories of the same body. The records of the worlds are written in place."""

    batch: mujoco.batch.Batch
    points: Float[np.ndarray, "h 3"]  # m, vertices of the hull in the mesh frame
    lowest: float  # m, an object whose origin is higher cannot have left the pad
    change: Float[np.ndarray, "n f s 3"]  # N, weight in each step minus the weight in the final step
    timestep: float  # s
    records: Record


def roll(
    models: Sequence[mujoco.MjModel],
    points: Float[np.ndarray, "h 3"],
    start: Start,
    gravity: Float[np.ndarray, "n f s 3"],
    velocity: Float[np.ndarray, "n 6"] | None = None,
    *,
    freeze: bool = True,
) -> tuple[Ends, Record]:
    """Simulate n independent trajectories of the same body, each from its start to its last frame.

    A MuJoCo model has a constant gravity: the last one of the trajectory. In time steps with another gravity, the
    difference acts as a force on the object's centre of mass.

    Args:
        models: A copy of the result of `compile_body` for each trajectory. Their gravity is overwritten.
        points: Vertices of the hull in the mesh frame (m).
        start: Starts of the n trajectories.
        gravity: Gravity in the s time steps that lead to each of the f frames (m/s^2, sensor frame).
        velocity: Velocity on release in the sensor frame (m/s, rad/s). None for objects at rest.
        freeze: True to end the simulation of a still object (STILL_TIME), which keeps its pose and wrench.
    """
    count, frames, steps, _ = gravity.shape
    worlds = _simulation(models, points, start, gravity, np.zeros((count, 6)) if velocity is None else velocity)
    none = np.zeros(count, int)
    counts = _Counts(none > 0, none, none, none + 2**20, none, np.zeros(count))
    held = np.asarray(start.held)
    for steps_held in np.unique(held[held < steps]):
        counts = _advance(worlds, counts, np.flatnonzero(held == steps_held), 0, 1, steps - int(steps_held))
    changing = np.any(worlds.change, axis=(2, 3))
    # The first frame from which on gravity is constant.
    calm = np.where(changing.any(axis=1), frames - changing[:, ::-1].argmax(axis=1), 0)
    active = np.arange(count)
    for begin in range(1, frames, BLOCK):
        end = min(begin + BLOCK, frames)
        counts = _advance(worlds, counts, active, begin, end, steps)
        calm_steps = np.minimum(counts.still, (end - calm) * steps)
        still = (calm_steps * worlds.timestep >= STILL_TIME) & freeze & ~counts.gone
        ended = active[(counts.gone | still)[active]]
        _keep(worlds.records, end, ended, active[still[active]])
        counts = counts._replace(slow=np.where(still, counts.slow + (frames - end) * steps, counts.slow))
        active = np.setdiff1d(active, ended)
        if not len(active):
            break
    ends = Ends(counts.gone, counts.slow, counts.touches, counts.sunk, _finite(worlds))
    return ends, Record(*(x if x.dtype == bool else x.astype(np.float32) for x in worlds.records))


def _simulation(
    models: Sequence[mujoco.MjModel],
    points: Float[np.ndarray, "h 3"],
    start: Start,
    gravity: Float[np.ndarray, "n f s 3"],
    velocity: Float[np.ndarray, "n 6"],
) -> _Simulation:
    """Create the worlds at their starts, with records of objects that stay there."""
    count, frames, _, _ = gravity.shape
    mass = np.array([model.body("object").mass[0] for model in models])
    for model, pull in zip(models, gravity[:, -1, -1], strict=True):
        model.opt.gravity[:] = pull
    radius = np.linalg.norm(points, axis=1).max()
    outside = ConvexHull(points).equations[:, 3].max() > 0

    batch = mujoco.batch.Batch(models[0], count, nthread=1)
    batch.set_models(models)
    batch.qpos = start.pose
    pose = np.asarray(start.pose, np.float64)
    turn = Rotation.from_quat(pose[:, 3:], scalar_first=True).apply(velocity[:, 3:], inverse=True)
    batch.qvel = np.concatenate([velocity[:, :3], turn], axis=1)

    pose[pose[:, 3] < 0, 3:] *= -1
    shapes = {"pose": 7, "velocity": 6, "wrench": 6}
    records = Record(
        **{name: np.zeros((count, frames, width)) for name, width in shapes.items()},
        contact=np.zeros((count, frames), bool),
        wall=np.zeros((count, frames), bool),
    )
    records.pose[:] = pose[:, None]
    records.velocity[:, 0] = velocity
    return _Simulation(
        batch=batch,
        points=points,
        lowest=-GONE_DEPTH + (radius if outside else 0.0),
        change=mass[:, None, None, None] * (gravity - gravity[:, -1:, -1:]),
        timestep=models[0].opt.timestep,
        records=records,
    )


def _advance(
    worlds: _Simulation, counts: _Counts, which: Int[np.ndarray, "k"], begin: int, end: int, per_frame: int
) -> _Counts:
    """Simulate `per_frame` steps for each of the frames from `begin` to `end` in the worlds `which`."""
    steps = worlds.change.shape[2]
    push = np.zeros((len(which), (end - begin) * per_frame, 2, 6))
    push[:, :, 1, :3] = worlds.change[which, begin:end, steps - per_frame :].reshape(len(which), -1, 3)
    worlds.batch.bind("xfrc_applied")[which] = 0
    control = push.reshape(*push.shape[:2], 12) if push.any() else None
    recorded = ("qpos", "qvel", "sensordata")
    result = worlds.batch.rollout(push.shape[1], control, int(FORCE), record=recorded, ids=which)
    qpos = result["qpos"]
    rolled = _Steps(qpos, result["qvel"], result["sensordata"], _gone(qpos, worlds.points, worlds.lowest))
    for field, new in zip(worlds.records, _record(rolled, end - begin), strict=True):
        field[which, begin:end] = new
    after = _count(rolled, _Counts(*(x[which] for x in counts)), worlds.timestep)
    whole = [x.copy() for x in counts]
    for field, new in zip(whole, after, strict=True):
        field[which] = new
    return _Counts(*whole)


def _keep(records: Record, end: int, ended: Int[np.ndarray, "k"], still: Int[np.ndarray, "m"]) -> None:
    """Copy frame end - 1 to all later frames: poses of ended worlds, and wrenches and contacts of still objects."""
    records.pose[ended, end:] = records.pose[ended, end - 1 : end]
    for field in (records.wrench, records.contact, records.wall):
        field[still, end:] = field[still, end - 1 : end]


def _finite(worlds: _Simulation) -> Bool[np.ndarray, "n"]:
    """Whether MuJoCo gave no warning and all recorded poses and velocities are finite."""
    failed = worlds.batch.warning[..., 1].any(axis=1) | (worlds.batch.status != 0)
    pose, velocity = worlds.records.pose, worlds.records.velocity
    return ~failed & np.isfinite(pose).all(axis=(1, 2)) & np.isfinite(velocity).all(axis=(1, 2))
