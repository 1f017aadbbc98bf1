"""The first of the two compiled programs of `sense`: an object sinks and tilts until the gel balances the wrench.

The program does not depend on the resolution of the images.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sts_jax import _cpu_reductions, geometry, optics, tactile
from sts_jax.rendering.corners import Corners, interpolated
from sts_jax.rendering.loop import looped
from sts_jax.rendering.tiles import lines, where_active


class Resting(NamedTuple):
    """An object, or n objects (`rendering.group`), in balance on the gel."""

    points: Float[Array, "v 3"]  # vertices in the sensor frame (m)
    pose: Float[Array, "*n 7"]  # pose in balance, or a pose below the pad if an input is invalid
    shown: Float[Array, "*n 7"]  # pose in balance, or the given pose if an input is invalid
    heights: Float[Array, "r c"]  # heights of the underside above the gel's face, on the gel's grid (m)
    present: Bool[Array, ""]  # True if a part of an object is above the gel's face
    pressing: Bool[Array, "*n"]  # True if it is present, and Fz > 0 or no wrench is given
    balanced: Bool[Array, "*n"]  # True if the gel balances the wrench within its limits
    pressure: Float[Array, "r c"]  # pressure on the gel's grid (Pa)
    shear: Float[Array, "r c 2"] | None  # displacement of the skin (m), None for a sensor without markers


def _balance(
    gel: tactile.Gel,
    sound: Bool[Array, ""],
    vertices: Float[Array, "v 3"],
    faces: Int[Array, "f 3"],
    two_sided: Bool[Array, ""],
    pose: Float[Array, "7"],
    wrench: Float[Array, "6"] | None,
    markers: tactile.Markers | None = None,
) -> Resting:
    """Let an object sink and tilt until the gel balances the wrench. None keeps the object in the given pose.

    If `sound` is False (an invalid sensor or body), the object is placed below the pad, where it is not drawn.
    """
    finite, safe_pose, wrench = safe(sound, pose, wrench)
    points = _placed(finite, safe_pose, vertices, jnp.full_like(vertices, -1))
    present = _cpu_reductions.maximum(points[:, 2]) > 0
    heights, whole = underside(gel, faces, two_sided, points, present)
    if wrench is None:
        contact = tactile.indent(gel, heights)
        pressing = present
    else:
        contact = tactile.settle(gel, heights, jnp.where(present, wrench, 0))
        pressing = present & (wrench[2] > 0)
    balanced_pose = moved(safe_pose, contact)
    return Resting(
        points=_placed(pressing, balanced_pose, vertices, points),
        pose=balanced_pose,
        shown=jnp.where(finite, balanced_pose, pose),
        heights=whole,
        present=present,
        pressing=pressing,
        balanced=contact.balanced & finite,
        pressure=contact.pressure,
        shear=sheared(gel, markers, contact.pressure, wrench),
    )


balance = jax.jit(looped(_balance))


def safe(
    sound: Bool[Array, ""], pose: Float[Array, "7"], wrench: Float[Array, "6"] | None
) -> tuple[Bool[Array, ""], Float[Array, "7"], Float[Array, "6"] | None]:
    """True if all inputs are valid, with the pose and the wrench, or else with a pose below the pad and no load."""
    length = geometry.norm(jnp.where(jnp.isfinite(pose), pose, 0)[3:])
    finite = sound & jnp.all(jnp.isfinite(pose)) & (length > 0) & jnp.isfinite(length)
    if wrench is not None:
        finite &= jnp.all(jnp.isfinite(wrench))
        wrench = jnp.where(finite, wrench, 0)
    pose = jnp.where(finite, pose, jnp.array([0.0, 0, -1, 1, 0, 0, 0]))
    return finite, jnp.concatenate([pose[:3], geometry.normalize(pose[3:])]), wrench


def sheared(
    gel: tactile.Gel,
    markers: tactile.Markers | None,
    pressure: Float[Array, "r c"],
    wrench: Float[Array, "6"] | None,
) -> Float[Array, "r c 2"] | None:
    """Displacement of the skin under one object (m), 0 if no wrench is given."""
    if markers is None:
        return None
    return jnp.zeros((*gel.cells, 2)) if wrench is None else tactile.shear(gel, markers, pressure, wrench).displacement


def underside(
    gel: tactile.Gel,
    faces: Int[Array, "f 3"],
    two_sided: Bool[Array, "*f"],
    points: Float[Array, "v 3"],
    present: Bool[Array, "*v"],
) -> tuple[Float[Array, "r c"], Float[Array, "r c"]]:
    """Heights of an object's underside above the gel's face (m), on the gel's grid, `inf` at cells without a face.

    Args:
        gel: Constants of the gel.
        faces: Vertex indices of the object's faces.
        two_sided: True if faces, or each face, are also visible from behind.
        points: Vertices in the sensor frame (m).
        present: If False, the object is ignored. One flag for each vertex ignores the faces with such a corner.

    Returns:
        The map of only those faces that are low enough to press on the gel, and the map of all faces, because each of
        them hides a part of the sky.
    """
    rows, columns = gel.cells
    across, down, height = (points[:, k] for k in range(3))
    # A part never presses if it is higher above the lowest point, or above the gel's face where this is higher (parts
    # beside the pad can be lower), than the largest depth and tilt can lower it.
    extent = sum(_cpu_reductions.maximum(part) - _cpu_reductions.minimum(part) for part in (across, down))
    reach = jnp.maximum(_cpu_reductions.minimum(height), 0) + gel.max_depth + jnp.tan(gel.max_tilt) * extent
    across = (across / gel.size[0] + 0.5) * columns - 0.5
    down = (down / gel.size[1] + 0.5) * rows - 0.5
    keep = jnp.broadcast_to(present, height.shape)
    places = jnp.stack([across, down], axis=-1)
    near, winner = optics.rasterise(places, height, faces, keep, two_sided, gel.cells, within=reach)
    images = (winner, *lines(optics.pixel_centres(gel.cells)))
    corners = Corners(across, down, height, faces)
    whole = where_active(interpolated, winner >= 0, corners, images, jnp.full(gel.cells, jnp.inf))
    return jnp.where(winner == near, whole, jnp.inf), whole


def moved(pose: Float[Array, "7"], contact: tactile.Equilibrium) -> Float[Array, "7"]:
    """Pose after the motion to the equilibrium."""
    turn = geometry.quat_from_rotvec(jnp.concatenate([contact.turn, jnp.zeros(1)]))
    drop = jnp.stack([jnp.float32(0), jnp.float32(0), -contact.sink])
    position = geometry.transform(jnp.concatenate([drop, turn]), pose[:3])
    return jnp.concatenate([position, geometry.quat_canonical(geometry.quat_multiply(turn, pose[3:]))])


def _placed(
    condition: Bool[Array, ""], pose: Float[Array, "7"], vertices: Float[Array, "v 3"], otherwise: Float[Array, "v 3"]
) -> Float[Array, "v 3"]:
    """Vertices in the sensor frame if the condition is true, else `otherwise`."""
    # XLA stores the result of a conditional. It would recompute any other value at each use. x, y and z are returned as
    # separate arrays.
    planes = jax.lax.cond(condition, lambda: tuple(geometry.transform(pose, vertices).T), lambda: tuple(otherwise.T))
    return jnp.stack(planes, axis=-1)
