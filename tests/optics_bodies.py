"""Bodies from trimesh's primitives, and reference values from embree, for the tests of optics, tactile and frame."""

import jax.numpy as jnp
import numpy as np
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from benchmarks.instruments.truth import body_mesh, embree, interior, public_meshes
from sts_jax.objects.body import FACE_CLASSES, Body

__all__ = ["at", "body_mesh", "embree", "from_trimesh", "interior", "public_meshes", "rays_hidden", "weight"]


def at(x, y, z, turn=(1.0, 0, 0, 0)):
    """A pose at a position (m)."""
    return jnp.array([x, y, z, *turn], jnp.float32)


def weight(force, x, y):
    """The wrench of a load (N) with the centre of pressure (x, y) (m)."""
    return jnp.array([0.0, 0.0, force, y * force, -x * force, 0.0], jnp.float32)


def from_trimesh(mesh: trimesh.Trimesh, *, color=(0.6, 0.4, 0.3), colors=None) -> Body:
    """A body with flat normals, in the smallest size class that fits. `colors` has a colour for each face."""
    number = len(mesh.faces)
    padded = next(size for size in FACE_CLASSES if size >= number)
    normals = np.repeat(mesh.face_normals[:, None], 3, axis=1)
    colors = np.broadcast_to(np.asarray(color if colors is None else colors, float), (number, 3))
    hull = mesh.convex_hull.vertices[:64]

    def pad(values, size, filler=0):
        return np.concatenate([values, np.zeros((size - len(values), *values.shape[1:]), values.dtype) + filler])

    return Body(
        vertices=jnp.asarray(pad(mesh.vertices, padded, mesh.vertices[-1]), jnp.float32),
        faces=jnp.asarray(pad(np.asarray(mesh.faces), padded), jnp.int32),
        normals=jnp.asarray(pad(normals, padded), jnp.float32),
        colors=jnp.asarray(pad(np.repeat(colors[:, None], 3, axis=1), padded), jnp.float32),
        uv=jnp.zeros((padded, 3, 2)),
        texture=jnp.ones((1, 1, 3)),
        two_sided=jnp.bool_(False),
        hulls=jnp.asarray(pad(hull, 64, hull[-1]), jnp.float32)[None],
        shell_mass=jnp.float32(0.1),
        shell_com=jnp.zeros(3),
        shell_inertia=jnp.eye(3) * 1e-4,
        interior=jnp.zeros((padded, 3, 3)),
        contents_density=jnp.float32(0),
        category=jnp.int32(-1),
    )


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
