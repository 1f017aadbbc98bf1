"""Simulation of one trajectory in MJX by pure functions, with one record of the object's state per frame."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sts_jax import geometry
from sts_jax.physics import scene
from sts_jax.physics.contact import PAD_CONTACTS, WALL_CONTACTS, Contacts, Hull, collide, turned
from sts_jax.physics.forces import wrench
from sts_jax.physics.scene import mjx

# An object has settled if it has been slower than SLOW_SPEED and SLOW_TURN for SLOW_TIME, in contact with pad or wall.
SLOW_SPEED = 0.005  # m/s
SLOW_TURN = 0.1  # rad/s
SLOW_TIME = 0.2  # s
PARTED_TIME = 0.005  # s, shortest time without contact between two touches
GONE_DEPTH = 0.01  # m, an object entirely this far below the gel's face has left the pad


class State(NamedTuple):
    """State of one trajectory between two time steps."""

    qpos: Float[Array, "7"]  # pose: position (m), quaternion
    qvel: Float[Array, "6"]  # m/s in the sensor frame, rad/s in the mesh frame (MuJoCo's free joint)
    warmstart: Float[Array, "6"]  # acceleration (MuJoCo's qacc) from which the solver starts
    held: Int[Array, ""]  # steps until the release. The state is frozen until then
    gone: Bool[Array, ""]  # the object has left the pad. The state is frozen from then on
    slow: Int[Array, ""]  # consecutive slow steps with a contact in the last PARTED_TIME
    apart: Int[Array, ""]  # consecutive steps without contact
    touches: Int[Array, ""]  # number of contacts that began after at least PARTED_TIME without contact
    sunk: Float[Array, ""]  # m, largest depth of a hull vertex or a contact so far
    finite: Bool[Array, ""]  # all states so far were finite
    wrenches: Float[Array, "6"]  # wrench summed over the steps of the unbroken contact within this frame's interval
    loaded: Int[Array, ""]  # number of steps in `wrenches`
    wall: Bool[Array, ""]  # the stop wall pushes the object


class Record(NamedTuple):
    """State of the object in one frame."""

    pose: Float[Array | np.ndarray, "*n 7"]  # position (m), quaternion with w >= 0
    velocity: Float[Array | np.ndarray, "*n 6"]  # m/s of the mesh frame's origin and rad/s, sensor frame
    wrench: Float[Array | np.ndarray, "*n 6"]  # mean N, N m about the sensor's origin, of the pad on the object
    contact: Bool[Array | np.ndarray, "*n"]  # the pad pushes the object in the last step
    wall: Bool[Array | np.ndarray, "*n"]  # the stop wall pushes the object in the last step


def initial(pose: Float[Array, "7"], velocity: Float[Array, "6"], held: Int[Array, ""] | int = 0) -> State:
    """Create the state before the first of `held` time steps until the release with a velocity (sensor frame)."""
    turn = velocity[3:] @ geometry.quat_to_matrix(pose[3:])
    zero = jnp.zeros((), jnp.int32)
    return State(
        qpos=pose,
        qvel=jnp.concatenate([velocity[:3], turn]),
        warmstart=jnp.zeros(6),
        held=jnp.asarray(held, jnp.int32),
        gone=jnp.zeros((), bool),
        slow=zero,
        apart=jnp.full((), 2**20, jnp.int32),
        touches=zero,
        sunk=jnp.zeros(()),
        finite=jnp.ones((), bool),
        wrenches=jnp.zeros(6),
        loaded=zero,
        wall=jnp.zeros((), bool),
    )


class _Top(NamedTuple):
    """The top of a fixed box."""

    centre: Float[Array, "3"]  # m
    half: Float[Array, "2"]  # m, half its size along x and y


def _tops(model: mjx.Model) -> list[_Top]:
    """The top of the pad, and the top of the wall if there is one."""
    centre, half = model.geom_pos, model.geom_size
    fixed = np.flatnonzero(model.geom_bodyid == 0)
    return [_Top(centre[i] + jnp.zeros(3).at[2].set(half[i, 2]), half[i, :2]) for i in fixed]


def _contacts(model: mjx.Model, hull: Hull, pose: Float[Array, "7"]) -> Contacts:
    """Find the contacts with the pad, followed by those with the wall if there is one."""
    boxes = []
    kinds = ((PAD_CONTACTS, (0, 1)), (WALL_CONTACTS, (0, 2)))  # the pad lies in x y, the wall's face in x z
    for top, (num, plane) in zip(_tops(model), kinds, strict=False):
        contacts = collide(hull, pose.at[:3].add(-top.centre), top.half, num, plane)
        boxes.append(contacts._replace(pos=contacts.pos + top.centre))
    return jax.tree.map(lambda *x: jnp.concatenate(x), *boxes)


def _depth(points: Float[Array, "3 h"], model: mjx.Model) -> Float[Array, ""]:
    """Depth (m) of the deepest point in the pad or the wall, 0 if all points are outside."""
    depths = []
    for top in _tops(model):
        x, y, z = points - top.centre[:, None]
        depths.append(jnp.minimum(-z, jnp.minimum(top.half[0] - jnp.abs(x), top.half[1] - jnp.abs(y))))
    return jnp.max(jnp.stack(depths), initial=0.0)


def step(model: mjx.Model, data: mjx.Data, hull: Hull, state: State, gravity: Float[Array, "3"]) -> State:
    """Advance a state by one time step under a gravity (m/s^2, sensor frame)."""
    old = state
    model = model.tree_replace({"opt.gravity": gravity})
    data = data.replace(qpos=old.qpos, qvel=old.qvel, qacc_warmstart=old.warmstart)
    contacts = _contacts(model, hull, old.qpos)
    new = scene.step(model, data, contacts)

    of_pad = wrench(model, new, "pad")
    contact = jnp.any(of_pad != 0)
    has_wall = len(contacts.dist) > PAD_CONTACTS
    wall = jnp.any(wrench(model, new, "wall") != 0) if has_wall else jnp.zeros((), bool)

    points = turned(geometry.quat_to_matrix(new.qpos[3:]), jnp.reshape(hull.vertices, (3, -1))) + new.qpos[:3, None]
    timestep = model.opt.timestep
    slow = (geometry.norm(new.qvel[:3]) < SLOW_SPEED) & (geometry.norm(new.qvel[3:]) < SLOW_TURN)
    touched = contact | wall
    begun = touched & (old.apart * timestep >= PARTED_TIME)
    apart = jnp.where(touched, 0, old.apart + 1)
    slow &= apart * timestep < PARTED_TIME
    now = State(
        qpos=new.qpos,
        qvel=new.qvel,
        warmstart=new.qacc_warmstart,
        held=old.held,
        gone=jnp.max(points[2]) < -GONE_DEPTH,
        slow=jnp.where(slow, old.slow + 1, 0),
        apart=apart,
        touches=old.touches + begun,
        sunk=jnp.maximum(old.sunk, jnp.maximum(_depth(points, model), -jnp.min(contacts.dist))),
        finite=old.finite & jnp.all(jnp.isfinite(new.qpos)) & jnp.all(jnp.isfinite(new.qvel)),
        wrenches=jnp.where(contact, old.wrenches + of_pad, 0),
        loaded=jnp.where(contact, old.loaded + 1, 0),
        wall=wall,
    )
    return _unless_frozen(old, now)


def _unless_frozen(old: State, now: State) -> State:
    """The state after a step, or the state before it if the object is held (it keeps its velocity) or gone."""
    nothing = jax.tree.map(jnp.zeros_like, old)
    frozen = old._replace(
        qvel=jnp.where(old.gone, nothing.qvel, old.qvel),
        held=jnp.maximum(old.held - 1, 0),
        wrenches=nothing.wrenches,
        loaded=nothing.loaded,
        wall=nothing.wall,
    )
    return jax.tree.map(lambda a, b: jnp.where(old.gone | (old.held > 0), a, b), frozen, now)


def _record(state: State) -> Record:
    turn = geometry.quat_to_matrix(state.qpos[3:]) @ state.qvel[3:]
    contact = state.loaded > 0
    return Record(
        pose=jnp.concatenate([state.qpos[:3], geometry.quat_canonical(state.qpos[3:])]),
        velocity=jnp.concatenate([state.qvel[:3], turn]),
        wrench=jnp.where(contact, state.wrenches / jnp.maximum(state.loaded, 1), 0),
        contact=contact,
        wall=state.wall,
    )


def roll(
    model: mjx.Model,
    data: mjx.Data,
    hull: Hull,
    state: State,
    gravity: Float[Array, "frames steps 3"],
) -> tuple[State, Record]:
    """Simulate one trajectory under gravity (m/s^2, sensor frame), and record a frame after each interval of steps."""

    def interval(state: State, gravity: Float[Array, "steps 3"]) -> tuple[State, Record]:
        state = state._replace(wrenches=jnp.zeros(6), loaded=jnp.zeros((), jnp.int32))
        state, _ = jax.lax.scan(lambda s, g: (step(model, data, hull, s, g), None), state, gravity)
        return state, _record(state)

    return jax.lax.scan(interval, state, gravity)
