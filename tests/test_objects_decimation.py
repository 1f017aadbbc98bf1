import sys

import numpy as np
import pytest
import trimesh
from object_files import surface, volume
from PIL import Image

from sts_jax import objects


@pytest.mark.parametrize("textured", [False, True])
def test_decimation_keeps_volume_and_colours(tmp_path, textured):
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=0.04)  # 20,480 faces
    if textured:
        pixels = np.zeros((64, 64, 3), np.uint8)
        pixels[:, :32], pixels[:, 32:] = (255, 0, 0), (0, 0, 255)
        material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(pixels))
        uv = np.stack([0.5 - mesh.vertices[:, 2] * 12, np.full(len(mesh.vertices), 0.5)], axis=1)
        mesh.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    else:
        mesh.visual.vertex_colors = np.where(mesh.vertices[:, 2:] > 0, [[255, 0, 0, 255]], [[0, 0, 255, 255]])
    mesh.export(tmp_path / f"ball.{'glb' if textured else 'ply'}")
    note = "decimated from 20,480 to .* faces" + ", and its texture replaced by one colour" * textured
    with pytest.warns(UserWarning, match=note):
        body = objects.load(tmp_path / f"ball.{'glb' if textured else 'ply'}", faces=4096)
    drawn = surface(body)
    assert len(drawn.faces) <= 4096
    assert drawn.is_watertight
    assert body.texture.shape == (1, 1, 3)
    for measured in (drawn.volume, volume(body)):
        np.testing.assert_allclose(measured, mesh.volume, rtol=5e-3)
    height = drawn.triangles[..., 2]
    colors = np.asarray(body.colors)[: len(drawn.faces)]
    np.testing.assert_allclose(colors[height > 0.005], [[1, 0, 0]] * (height > 0.005).sum(), atol=1e-3)
    np.testing.assert_allclose(colors[height < -0.005], [[0, 0, 1]] * (height < -0.005).sum(), atol=1e-3)


def test_decimation_of_loose_parts(tmp_path):
    scale = trimesh.creation.icosphere(subdivisions=4, radius=0.04)
    loose = scale.triangles * 0.98 + 0.02 * scale.triangles.mean(axis=1, keepdims=True)
    trimesh.Trimesh(loose.reshape(-1, 3), np.arange(3 * len(loose)).reshape(-1, 3), process=False).export(
        tmp_path / "scales.ply"
    )
    with pytest.warns(UserWarning, match="decimated from 5,120"), pytest.warns(UserWarning, match="not closed"):
        body = objects.load(tmp_path / "scales.ply", faces=1024)
    assert body.vertices.shape == (1024, 3)
    np.testing.assert_allclose(np.ptp(surface(body).vertices, axis=0), 0.08, rtol=0.03)


def test_the_error_names_the_missing_package(tmp_path, monkeypatch):
    trimesh.creation.icosphere(subdivisions=5, radius=0.04).export(tmp_path / "ball.ply")
    monkeypatch.setitem(sys.modules, "fast_simplification", None)
    listed = objects.library(tmp_path)
    with pytest.raises(ImportError, match=r"ball\.ply.*fast-simplification.*install -e '\.\[meshes\]'"):
        objects.bodies(listed)
