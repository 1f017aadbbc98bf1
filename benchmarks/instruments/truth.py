"""Public meshes, and reference depth images from the ray tracer Embree."""

import importlib.util
from pathlib import Path

import jax
import numpy as np
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

import sts_jax as sts
from sts_jax import objects


def public_meshes() -> Path:
    """Find the folder of the meshes of the package miniworld (Farama Foundation, Apache 2.0)."""
    found = importlib.util.find_spec("miniworld")
    if found is None or found.origin is None:
        raise ModuleNotFoundError(
            "the test meshes are in the package miniworld, which is missing: pip install -e '.[test]'"
        )
    return Path(found.origin).parent / "meshes"


def body_mesh(body: objects.Body, pose: jax.Array) -> trimesh.Trimesh:
    """Make the mesh of a body in the sensor frame, in float64."""
    faces = np.asarray(body.faces)
    faces = faces[np.any(faces != faces[:, :1], axis=1)]
    turn = trimesh.transformations.quaternion_matrix(np.asarray(pose[3:], float))[:3, :3]
    vertices = np.asarray(body.vertices, float) @ turn.T + np.asarray(pose[:3], float)
    return trimesh.Trimesh(vertices, faces, process=False)


def embree(
    mesh: trimesh.Trimesh, camera: sts.optics.Camera, shape: tuple[int, int], *, two_sided: bool = False
) -> np.ndarray:
    """Trace a depth image of the triangles that face the camera, with the ray tracer Embree."""
    towards = np.einsum("ij,ij->i", mesh.face_normals, mesh.triangles[:, 0] + [0, 0, camera.distance]) < 0
    scene = EmbreeScene()
    TriangleMesh(scene, np.ascontiguousarray(mesh.triangles[towards | two_sided], np.float32))
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
    """Find the pixels whose 3x3 neighbourhood has only finite depths, which differ by less than `span`."""
    around = neighbours(np.where(np.isfinite(depth), depth, 1e9), 1e9)
    return (around.max(0) < 1e8) & (around.max(0) - around.min(0) < span)


def neighbours(image: np.ndarray, beyond: float | None = None) -> np.ndarray:
    """Stack the 3x3 neighbourhood of every pixel."""
    height, width = image.shape
    fill = {"mode": "edge"} if beyond is None else {"constant_values": beyond}
    padded = np.pad(image, 1, **fill)
    return np.stack([padded[i : i + height, j : j + width] for i in range(3) for j in range(3)])
