"""Hulls, scenes and mass properties that the tests of `physics` share."""

import copy
import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from sts_jax import objects, physics
from sts_jax.physics import contact, scene

PAD = (0.15, 0.15)


def box(*half: float) -> np.ndarray:
    """Corners of a box of half this size (m)."""
    return np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), -1).reshape(-1, 3) * half


def part(points: np.ndarray, count: int = 32) -> np.ndarray:
    """One convex part, padded by repetition."""
    return np.concatenate([points, np.repeat(points[-1:], count - len(points), axis=0)])[None]


def solid_block(half: np.ndarray, mass: float) -> objects.Body:
    """A solid block of half this size (m), without contents. The visible mesh is the block too."""
    body, mesh = objects.make(jax.random.key(0), "fork"), trimesh.creation.box(2 * half)
    return dataclasses.replace(
        body,
        vertices=jnp.asarray(np.resize(mesh.vertices, body.vertices.shape), jnp.float32),
        faces=jnp.asarray(np.resize(mesh.faces, body.faces.shape), body.faces.dtype),
        hulls=jnp.asarray(part(box(*half)), jnp.float32),
        shell_mass=jnp.float32(mass),
        shell_com=jnp.zeros(3),
        shell_inertia=jnp.asarray(mass / 3 * np.diag(np.sum(half**2) - half**2), jnp.float32),
    )


def hull(parts: np.ndarray) -> contact.Hull:
    return jax.tree.map(jnp.asarray, contact.hull(parts))


def mjx_model(
    constants: physics.Contact, mass: float, com: np.ndarray, inertia: np.ndarray, friction: float, wall: float = 0.0
) -> tuple[scene.mjx.Model, scene.mjx.Data]:
    """MJX's model of an object with these mass properties, and its data."""
    model, like, data = scene.template(PAD, constants, wall)
    model = copy.copy(model)
    scene.set_rigid(model, mujoco.MjData(model), mass, com, inertia, friction)
    return like.tree_replace(jax.tree.map(jnp.asarray, scene.drawn(model, like))), data


def rigid(bodies: list[objects.Body], trajectory: physics.Trajectory, row: int) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, centre of mass and inertia of a trajectory's object."""
    hidden = jax.tree.map(lambda x: jnp.asarray(x[row]), trajectory.hidden)
    mass, com, inertia = objects.rigid(bodies[trajectory.body[row]], hidden.fill, hidden.shell_scale, hidden.up)
    return float(mass), np.asarray(com, np.float64), np.asarray(inertia, np.float64)


def placed(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points of the mesh frame in the sensor frame."""
    return Rotation.from_quat(np.float64(pose[3:]), scalar_first=True).apply(points) + pose[:3]


def corners(bodies: list[objects.Body], trajectory: physics.Trajectory, row: int, frame: int = 0) -> np.ndarray:
    """Vertices of the hull in the sensor frame."""
    points = np.asarray(bodies[trajectory.body[row]].hulls, np.float64).reshape(-1, 3)
    return placed(trajectory.pose[row, frame], points)
