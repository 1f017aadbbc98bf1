"""`wrench`: what some geoms of a MuJoCo model exert on all others."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float, Int

from sts_jax import geometry
from sts_jax._checked import checked, in_32_bits
from sts_jax.objects.body import is_traced
from sts_jax.physics.scene import mjx

from mujoco.mjx._src import support  # isort: skip  (after `scene`, which imports MJX silently)


@in_32_bits
@checked
def wrench(
    model: mujoco.MjModel | mjx.Model,
    data: mujoco.MjData | mjx.Data,
    geoms: int | str | Sequence[int | str] | Int[np.ndarray, "k"],
    frame: str | Float[np.ndarray | Array, "7"] | None = None,
) -> Float[np.ndarray | Array, "6"]:
    """Force and moment that some geoms exert on all other geoms, summed over their contacts.

    A pad under an object at rest gives a force m g upwards. Contacts among `geoms` do not count. After a step, the
    contact forces and the positions are those at its beginning.

    Args:
        model: Model of C MuJoCo or of MJX in its JAX implementation.
        data: Data of the same engine.
        geoms: Name or id of a geom, or several of them.
        frame: Name of a site, or pose in the world. None for the world's own frame.

    Returns:
        Force (N) and moment about the origin of `frame` (N m), along the axes of `frame`.
    """
    origin, axes = _frame(model, data, frame)
    forces: Any = _c_forces if isinstance(data, mujoco.MjData) else _mjx_forces
    sign, contact, local = forces(model, data, _geoms(model, geoms))
    xp: Any = np if isinstance(data, mujoco.MjData) else jnp
    world = sign[:, None, None] * (local.reshape(-1, 2, 3) @ contact.frame.reshape(-1, 3, 3))
    moment = xp.cross(contact.pos - origin, world[:, 0]) + world[:, 1]
    return xp.concatenate([world[:, 0].sum(axis=0) @ axes, moment.sum(axis=0) @ axes])


def _c_forces(model: mujoco.MjModel, data: mujoco.MjData, geoms: Int[np.ndarray, "k"]) -> tuple[Any, Any, Any]:
    """Signs (0 for contacts that do not count), contacts, and forces on their second geom in the contact's frame."""
    if model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP and (data.tree_asleep >= 0).any():
        raise ValueError("data has sleeping bodies, whose contacts MuJoCo does not keep: remove <flag sleep='enable'/>")
    given = np.isin(data.contact.geom, geoms)
    sign = given[:, 0].astype(float) - given[:, 1]
    local = np.zeros((data.ncon, 6))
    for index in np.flatnonzero(sign):
        mujoco.mj_contactForce(model, data, index, local[index])
    return sign, data.contact, local


def _mjx_forces(model: mjx.Model, data: mjx.Data, geoms: Int[np.ndarray, "k"]) -> tuple[Any, Any, Any]:
    """As `_c_forces`. MJX has no public contacts, so that private fields are read here."""
    contact = data._impl.contact
    given = jnp.any(contact.geom[..., None] == geoms, axis=-1)
    sign = (given[:, 0].astype(float) - given[:, 1]) * (contact.dist < contact.includemargin)
    if not len(contact.dim):
        return sign, contact, jnp.zeros((0, 6))
    groups = [support.contact_force_dim(model, data, dim) for dim in np.unique(contact.dim)]
    forces = jnp.concatenate([values for values, _ in groups])
    if len(groups) > 1:
        forces = forces[np.argsort(np.concatenate([rows for _, rows in groups]))]
    return sign, contact, forces


def _geoms(model: Any, geoms: Any) -> Int[np.ndarray, "k"]:
    several = [geoms] if isinstance(geoms, int | str) else list(geoms)
    ids = [_id(model, "geom", geom) if isinstance(geom, str) else int(geom) for geom in several]
    for geom in ids:
        if not 0 <= geom < model.ngeom:
            raise ValueError(f"geoms contains {geom}, but the model has geoms 0 to {model.ngeom - 1}")
    return np.array(ids)


def _id(model: Any, kind: str, name: str) -> int:
    number = mjx.name2id(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), name)
    if number < 0:
        raise ValueError(f"the model has no {kind} {name!r}")
    return int(number)


def _frame(model: Any, data: Any, frame: Any) -> tuple[Any, Any]:
    """Origin of a frame, and its axes as the columns of a matrix, in the world."""
    if frame is None:
        return np.zeros(3), np.eye(3)
    if isinstance(frame, str):
        site = _id(model, "site", frame)
        return data.site_xpos[site], data.site_xmat[site].reshape(3, 3)
    if not is_traced(frame) and abs(np.linalg.norm(frame[3:]) - 1) > 1e-3:
        raise ValueError(f"frame has a quaternion of length {np.linalg.norm(frame[3:]):.4g}, but it must be 1")
    if isinstance(data, mjx.Data):
        return frame[:3], geometry.quat_to_matrix(jnp.asarray(frame[3:]))
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, np.asarray(frame[3:], float))
    return np.asarray(frame[:3]), axes.reshape(3, 3)
