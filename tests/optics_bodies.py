"""Bodies from trimesh's primitives, and reference values from embree, for the tests of optics, tactile and frame."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from sts_jax import Frame
from sts_jax.objects.assembly import assemble
from sts_jax.objects.body import Body, pad

pytest.importorskip("embreex")  # which has no wheel for Linux on arm64
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene


def at(x, y, z, turn=(1.0, 0, 0, 0)):
    """A pose at a position (m)."""
    return jnp.array([x, y, z, *turn], jnp.float32)


def weight(force, x, y):
    """The wrench of a load (N) with the centre of pressure (x, y) (m)."""
    return jnp.array([0.0, 0.0, force, y * force, -x * force, 0.0], jnp.float32)


def with_field(sensor, field, value):
    """The sensor with another value of a field such as `gel.stiffness`."""
    part, name = field.split(".")
    return dataclasses.replace(sensor, **{part: dataclasses.replace(getattr(sensor, part), **{name: value})})


def noise(shape, seed=0):
    """A frame of random images with black and white pixels, with an object in its first quarter."""
    rng = np.random.default_rng(seed)
    images = rng.uniform(size=(2, *shape, 3)).astype(np.float32)
    images[rng.uniform(size=images.shape) < 0.05] = 0
    images[rng.uniform(size=images.shape) < 0.05] = 1
    lead, seen = shape[:-2], np.arange(np.prod(shape)).reshape(shape) < np.prod(shape) / 4
    return Frame(
        visual=jnp.asarray(images[0]),
        tactile=jnp.asarray(images[1]),
        depth=jnp.where(seen, 0.1, jnp.inf),
        segmentation=jnp.asarray(seen),
        pose=jnp.broadcast_to(at(0, 0, 0.01), (*lead, 7)),
        balanced=jnp.ones(lead, bool),
        pressure=jnp.asarray(rng.uniform(0, 2000, (*lead, 5, 5)), jnp.float32),
        window=jnp.broadcast_to(jnp.array([-0.1, -0.1, 0.2, 0.2]), (*lead, 4)),
        body=jnp.where(seen, 0, -1),
    )


def ball(radius=0.03):
    """A ball of rings that are fine where it touches the gel, with few faces."""
    angle = np.radians([*range(0, 27, 2), 60, 120, 180])
    return from_trimesh(trimesh.creation.revolve(radius * np.stack([np.sin(angle), -np.cos(angle)], -1), sections=32))


def from_trimesh(mesh: trimesh.Trimesh, *, color=(0.6, 0.4, 0.3), colors=None) -> Body:
    """A body in the frame of its mesh. `colors` has a colour for each face."""
    number = len(mesh.faces)
    colors = np.broadcast_to(np.asarray(color if colors is None else colors, float)[..., None, :], (number, 3, 3))
    body = assemble(mesh.vertices, mesh.faces, colors, density=np.ones(number), interior=None, mass=0.1)
    vertices = pad(mesh.vertices, len(body.vertices), mesh.vertices[-1])  # not about the centroid
    return dataclasses.replace(body, vertices=jnp.asarray(vertices, jnp.float32))


def rays_hidden(mesh, places, num=3000):
    """Share of the cosine-distributed rays from each place of the skin that hit a mesh."""
    scene = EmbreeScene()
    TriangleMesh(scene, np.ascontiguousarray(mesh.triangles, np.float32))
    index = np.arange(num)
    radius, angle = np.sqrt((index + 0.5) / num), index * np.pi * (3 - np.sqrt(5))
    directions = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - radius**2)], -1)
    shares = []
    for x, y in places:
        origins = np.tile([x, y, 1e-5], (num, 1)).astype(np.float32)
        shares.append(np.mean(scene.run(origins, directions.astype(np.float32), query="DISTANCE") < 1e3))
    return np.array(shares)
