"""Bodies for the tests of optics, tactile and frame, straight from trimesh's primitives."""

import jax.numpy as jnp
import numpy as np
import trimesh

from sts_jax.objects.body import NUM_FILLS, Body


def from_trimesh(mesh: trimesh.Trimesh, *, color=(0.6, 0.4, 0.3), colors=None, faces: int | None = None) -> Body:
    """A body with flat normals; `colors` per face, `faces` a number to pad to."""
    number = len(mesh.faces)
    padded = max(faces or number, number)
    normals = np.repeat(mesh.face_normals[:, None], 3, axis=1)
    colors = np.broadcast_to(np.asarray(color if colors is None else colors, float), (number, 3))
    pad = lambda a: np.concatenate([a, np.zeros((padded - number, *a.shape[1:]), a.dtype)])  # noqa: E731
    hull = mesh.convex_hull.vertices[:32]
    return Body(
        vertices=jnp.asarray(mesh.vertices, jnp.float32),
        faces=jnp.asarray(pad(np.asarray(mesh.faces)), jnp.int32),
        normals=jnp.asarray(pad(normals), jnp.float32),
        colors=jnp.asarray(pad(np.repeat(colors[:, None], 3, axis=1)), jnp.float32),
        uv=jnp.zeros((padded, 3, 2)),
        texture=jnp.ones((1, 1, 3)),
        two_sided=jnp.bool_(False),
        hull=jnp.asarray(hull, jnp.float32),
        shell_mass=jnp.float32(0.1),
        shell_com=jnp.zeros(3),
        shell_inertia=jnp.eye(3) * 1e-4,
        contents=jnp.zeros((NUM_FILLS, 10)),
        contents_density=jnp.float32(0),
        category=jnp.int32(-1),
    )
