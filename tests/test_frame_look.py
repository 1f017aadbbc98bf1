"""The view through the skin: shadow, housing, texture."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from optics_bodies import at, body_mesh, from_trimesh, public_meshes
from PIL import Image

import sts_jax as sts
from sts_jax import objects, sense

SENSOR = sts.Sensor()


def test_an_object_on_the_pad_darkens_the_skin_around_it():
    body = from_trimesh(trimesh.creation.cylinder(radius=0.015, height=0.06))
    empty = np.asarray(sense(SENSOR, body, at(0, 0, -1.0)).visual)
    there = sense(SENSOR, body, at(0, 0, 0.03))
    share = np.asarray(there.visual).mean(-1) / empty.mean(-1)
    x = 0.15 * ((np.arange(64) + 0.5) / 64 - 0.5)
    away = np.where(there.segmentation, 0, np.hypot(x[None, :], x[:, None]))
    # The wall of the cylinder hides nearly half of the sky beside it. 3 % in sRGB is about 7 % of the light.
    assert 0.9 < share[(away > 0.016) & (away < 0.02)].mean() < 0.97
    assert np.all(share[away > 0.06] > 0.985)
    in_air = np.asarray(sense(SENSOR, body, at(0, 0, 0.13)).visual).mean(-1) / empty.mean(-1)
    assert in_air[(away > 0.03) & (away < 0.035)].min() > 0.96


@pytest.mark.slow
def test_the_texture_of_a_public_mesh_agrees_with_traced_rays():
    meshes = public_meshes()
    body = objects.load(meshes / "potion.obj", longest_side=0.08, up="y", texture=meshes / "potion.png")
    raw = trimesh.load_scene(meshes / "potion.obj", process=False).to_geometry()
    sheet = np.asarray(Image.open(meshes / "potion.png").convert("RGB")) / 255
    # Albedo alone.
    flat = {"milk": 0.0, "crease": 0.0, "haze": 1e6, "tint": jnp.ones(3)}
    room = dataclasses.replace(SENSOR.room, ambient=jnp.ones(3), colors=jnp.zeros((3, 3)), **flat)
    bare = dataclasses.replace(SENSOR, room=room)
    turn = np.array([np.cos(0.6), np.sin(0.6), 0.0, 0.0])
    pose = jnp.asarray([0.0, 0.0, 0.05, *turn], jnp.float32)
    size = (240, 240)
    frame = sense(bare, body, pose, jnp.zeros(6), resolution=size, crop=True)

    mesh = body_mesh(body, frame.pose)
    assert len(mesh.faces) == len(raw.faces)
    scene = EmbreeScene()
    towards = np.einsum("ij,ij->i", mesh.face_normals, mesh.triangles[:, 0] + [0, 0, SENSOR.camera.distance]) < 0
    TriangleMesh(scene, np.ascontiguousarray(mesh.triangles[towards], np.float32))
    left, top, width, height = np.asarray(frame.window)
    x = left + (np.arange(size[1]) + 0.5) / size[1] * width
    y = top + (np.arange(size[0]) + 0.5) / size[0] * height
    slopes = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2) / SENSOR.camera.distance
    rays = np.concatenate([slopes, np.ones((len(slopes), 1))], -1).astype(np.float32)
    origins = np.tile(np.float32([[0, 0, -SENSOR.camera.distance]]), (len(rays), 1))
    hit = scene.run(origins, rays, output=1)
    seen = hit["primID"] >= 0
    face = np.flatnonzero(towards)[hit["primID"][seen]]
    u, v = hit["u"][seen], hit["v"][seen]
    corners = np.asarray(raw.visual.uv)[np.asarray(raw.faces)[face]]
    place = np.einsum("nk,nkc->nc", np.stack([1 - u - v, u, v], -1), corners)
    column = np.clip((place[:, 0] % 1 * sheet.shape[1]).astype(int), 0, sheet.shape[1] - 1)
    row = np.clip(((1 - place[:, 1] % 1) * sheet.shape[0]).astype(int), 0, sheet.shape[0] - 1)
    shown = np.asarray(frame.visual).reshape(-1, 3)[seen]
    assert seen.mean() > 0.2
    error = np.abs(shown - sheet[row, column]).max(-1)
    assert np.median(error) < 0.02  # they differ between texels and at seams
    assert np.quantile(error, 0.9) < 0.15
