"""Bodies for the tests of optics, tactile and frame, straight from trimesh's primitives."""

import importlib.util
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from sts_jax.objects.body import FACE_CLASSES, Body


def from_trimesh(mesh: trimesh.Trimesh, *, color=(0.6, 0.4, 0.3), colors=None) -> Body:
    """A body with flat normals, of the smallest size class where it fits; `colors` are per face."""
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


def body_mesh(body: Body, pose) -> trimesh.Trimesh:
    """The body's triangles in the sensor frame, in float64."""
    faces = np.asarray(body.faces)
    faces = faces[np.any(faces != faces[:, :1], axis=1)]
    turn = trimesh.transformations.quaternion_matrix(np.asarray(pose[3:], float))[:3, :3]
    vertices = np.asarray(body.vertices, float) @ turn.T + np.asarray(pose[:3], float)
    return trimesh.Trimesh(vertices, faces, process=False)


def embree(mesh: trimesh.Trimesh, camera, shape: tuple[int, int]) -> np.ndarray:
    """Depth along the optical axis of the nearest triangle that faces the camera, `inf` where there is none."""
    towards = np.einsum("ij,ij->i", mesh.face_normals, mesh.triangles[:, 0] + [0, 0, camera.distance]) < 0
    scene = EmbreeScene()
    TriangleMesh(scene, np.ascontiguousarray(mesh.triangles[towards], np.float32))
    height = 2 * camera.distance * np.tan(camera.fov / 2)
    width = min(height * camera.aspect, height * shape[1] / shape[0])
    height = width * shape[0] / shape[1]
    x = (-width / 2 + (np.arange(shape[1]) + 0.5) / shape[1] * width) / camera.distance
    y = (-height / 2 + (np.arange(shape[0]) + 0.5) / shape[0] * height) / camera.distance
    slopes = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    directions = np.concatenate([slopes, np.ones((len(slopes), 1))], -1).astype(np.float32)
    origins = np.tile(np.array([[0, 0, -camera.distance]], np.float32), (len(slopes), 1))
    hit = scene.run(origins, directions, query="DISTANCE")
    return np.where(hit < 1e3, hit, np.inf).astype(float).reshape(shape)


def interior(depth: np.ndarray, *, span: float = 1e-3) -> np.ndarray:
    """Pixels whose 3x3 neighbourhood is all hit and spans less than `span` of depth (m)."""
    height, width = depth.shape
    padded = np.pad(np.where(np.isfinite(depth), depth, 1e9), 1, constant_values=1e9)
    around = np.stack([padded[i : i + height, j : j + width] for i in range(3) for j in range(3)])
    return (around.max(0) < 1e8) & (around.max(0) - around.min(0) < span)


def public_meshes() -> Path:
    """miniworld's folder of meshes (Farama Foundation, Apache 2.0); its code wants a display and is not run."""
    found = importlib.util.find_spec("miniworld")
    assert found is not None, "the test extra is not installed: pip install -e .[test]"
    assert found.origin is not None
    return Path(found.origin).parent / "meshes"
