"""Bodies from MuJoCo geoms against MuJoCo's own rays, its renderer, and closed forms."""

import os
import subprocess
import sys

import mujoco
import numpy as np
import pytest
import trimesh

from sts_jax.scene import geometry

TILTED = 'pos=".02 .03 .01" euler="10 50 70"'
GEOMS = {
    "sphere": 'type="sphere" size=".04"',
    "capsule": 'type="capsule" size=".02 .05"',
    "ellipsoid": 'type="ellipsoid" size=".02 .05 .03"',
    "cylinder": 'type="cylinder" size=".03 .04"',
    "box": 'type="box" size=".02 .04 .06"',
    "plane": 'type="plane" size=".1 .2 1"',
    "mesh": 'type="mesh" mesh="mesh"',
    "hfield": 'type="hfield" hfield="hills"',
}
FLAT = ("plane", "box", "mesh", "hfield")  # drawn exactly
ASSET = """
<asset>
  <mesh name="mesh" vertex="0 0 0 .1 0 0 0 .08 0 0 0 .06 .1 .08 .01"/>
  <hfield name="hills" nrow="9" ncol="7" size=".1 .07 .04 .02"/>
</asset>"""


def compiled(geoms: str, joint: bool = True) -> tuple[mujoco.MjModel, mujoco.MjData]:
    moving = "<freejoint/>" if joint else ""
    spec = mujoco.MjSpec.from_string(
        f'<mujoco>{ASSET}<worldbody><body name="body" pos=".3 .1 .2" euler="20 30 40">{moving}{geoms}</body>'
        "</worldbody></mujoco>"
    )
    spec.hfields[0].userdata = np.random.default_rng(0).random(63)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def in_world(model: mujoco.MjModel, data: mujoco.MjData, body: int = 1) -> tuple[trimesh.Trimesh, geometry.Body]:
    drawn = geometry.body_of(model, np.flatnonzero(model.geom_bodyid == body))
    faces = np.asarray(drawn.faces)
    faces = faces[(faces != faces[:, :1]).any(axis=1)]
    vertices = np.asarray(drawn.vertices, np.float64) @ data.xmat[body].reshape(3, 3).T + data.xpos[body]
    return trimesh.Trimesh(vertices, faces, process=False), drawn


@pytest.mark.parametrize("kind", GEOMS)
def test_rays_hit_a_geom_where_mujocos_do(kind):
    model, data = compiled(f"<geom {GEOMS[kind]} {TILTED}/>", joint=kind not in ("plane", "hfield"))
    mesh, body = in_world(model, data)
    random, centre = np.random.default_rng(1), data.geom_xpos[0]
    away = random.normal(size=(400, 3))
    start = centre + 0.4 * away / np.linalg.norm(away, axis=1, keepdims=True)
    if kind == "plane":  # has no underside
        start = start[(start - centre) @ data.geom_xmat[0].reshape(3, 3)[:, 2] > 0.01]
    ray = centre + random.uniform(-0.06, 0.06, start.shape) - start
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    none = np.zeros(1, np.int32)
    truth = np.array([mujoco.mj_ray(model, data, *pair, None, 1, -1, none) for pair in zip(start, ray, strict=True)])
    place, number, face = mesh.ray.intersects_location(start, ray, multiple_hits=False)
    found = np.full(len(start), -1.0)
    found[number] = np.linalg.norm(place - start[number], axis=1)
    hit = (found > 0) & (truth > 0)
    assert hit.sum() > 40
    assert ((found > 0) != (truth > 0)).sum() <= (0 if kind in FLAT else 2)
    slope = np.zeros(len(start))
    slope[number] = -np.sum(mesh.face_normals[face] * ray[number], axis=1)
    assert slope[number].min() > 0  # seen from outside
    largest = 1e-6 if kind in FLAT else 8e-5
    assert np.abs((found - truth)[hit] * slope[hit]).max() < largest
    # Normals at the corners are those of the faces, or smooth.
    own = np.asarray(body.normals)[: len(mesh.faces)] @ data.xmat[1].reshape(3, 3).T
    np.testing.assert_allclose(np.linalg.norm(own, axis=-1), 1, atol=1e-5)
    assert np.einsum("fki,fi->fk", own, mesh.face_normals).min() > 0.75


def test_visual_geoms_are_drawn_where_a_body_has_them_and_groups_can_be_chosen():
    visual = 'type="sphere" size=".01" contype="0" conaffinity="0" group="2"'
    model, _ = compiled(
        f'<geom {GEOMS["box"]} group="3"/><geom {visual}/><geom {visual} rgba="1 1 1 0"/>'
        f'<body><geom {GEOMS["box"]} group="3"/></body>'
        # A sticker on a box does not hide the box, which MuJoCo's viewer shows as well.
        f'<body><geom {GEOMS["box"]} group="2"/><geom {GEOMS["box"]} group="3"/><geom {visual}/></body>'
    )
    np.testing.assert_array_equal(geometry.visible(model, None), [1, 3, 4, 6])
    np.testing.assert_array_equal(geometry.visible(model, [3]), [0, 3, 5])
    np.testing.assert_array_equal(geometry.visible(model, [2]), [1, 4, 6])


def test_the_default_colour_gives_way_to_that_of_the_material():
    spec = mujoco.MjSpec.from_string("""
    <mujoco><asset><material name="green" rgba="0 1 0 1"/></asset><worldbody>
    <geom size="1" material="green"/><geom size="1" material="green" rgba="1 0 0 1"/><geom size="1"/>
    </worldbody></mujoco>""")
    model = spec.compile()
    colors = np.asarray(geometry.body_of(model, [0, 1, 2]).colors)
    faces = len(geometry.surface(model, 0).faces)
    expected = [[0, 1, 0], [1, 0, 0], [0.214, 0.214, 0.214]]
    np.testing.assert_allclose(colors[[0, faces, 2 * faces], 0], expected, atol=1e-3)


TEXTURES = """
<mujoco>
  <visual><headlight ambient="1 1 1" diffuse="0 0 0" specular="0 0 0"/><map znear=".01"/></visual>
  <asset>
    <texture name="flat" type="2d" builtin="flat" width="240" height="240"/>
    <texture name="cube" type="cube" builtin="flat" width="80" height="80"/>
    <material name="flat" texture="flat"/>
    <material name="twice" texture="flat" texrepeat="1 2" rgba="1 .8 .6 1"/>
    <material name="metres" texture="flat" texrepeat="4 4" texuniform="true"/>
    <material name="cube" texture="cube"/>
    <mesh name="bare" vertex="-1 -1 -1  1 -1 -1  1 1 -1  -1 1 -1  -1 -1 1  1 -1 1  1 1 1  -1 1 1" scale=".3 .3 .3"/>
    <mesh name="mapped" vertex="-1 0 -1  1 0 -1  1 0 1  -1 0 1  0 1 0" texcoord="0 0  1 0  1 1  0 1  .5 .5"
          face="0 1 2 0 2 3 1 0 4 2 1 4 3 2 4 0 3 4" scale=".4 .4 .4"/>
    <hfield name="hill" nrow="3" ncol="3" size=".4 .3 .2 .05"/>
  </asset>
  <worldbody>
    <camera name="camera" pos="0 -3.5 3.5" xyaxes="1 0 0 0 1 1" fovy="45"/>
    <geom type="plane" size="1.9 1.5 .1" pos="0 0 -.5" material="metres"/>
    <body pos="-1.4 -.8 0" euler="20 10 30"><geom type="box" size=".3 .2 .3" material="flat"/></body>
    <body pos="-.5 -.8 0" euler="20 0 0"><geom type="sphere" size=".35" material="flat"/></body>
    <body pos=".5 -.8 0" euler="0 20 50"><geom type="box" size=".3 .2 .3" material="cube"/></body>
    <body pos="1.4 -.8 0" euler="0 20 50"><geom type="ellipsoid" size=".2 .3 .4" material="cube"/></body>
    <body pos="-1.4 .5 0" euler="20 -10 30"><geom type="mesh" mesh="bare" material="twice"/></body>
    <body pos="-.5 .5 0" euler="20 0 20"><geom type="mesh" mesh="mapped" material="flat"/></body>
    <body pos=".5 .5 0" euler="10 0 30"><geom type="hfield" hfield="hill" material="twice"/></body>
    <body pos="1.4 .5 0" euler="10 0 30">
      <geom type="cylinder" size=".3 .2" material="twice"/>
      <geom type="box" size=".1 .1 .1" pos="0 0 .3" material="cube"/>
      <geom type="box" size=".15 .1 .1" pos="0 -.35 0" rgba="0 .5 1 1"/>
    </body>
  </worldbody>
</mujoco>"""
RENDER = """
import pickle, sys
import mujoco, numpy as np
import test_scene_geometry as scene
model, data = scene.textured()
with mujoco.Renderer(model, 180, 240) as renderer:
    renderer.update_scene(data, "camera")
    np.save(sys.argv[1], renderer.render())
"""


def textured() -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Geoms of many types with coarse random textures."""
    spec = mujoco.MjSpec.from_string(TEXTURES)
    spec.hfields[0].userdata = [0, 0.2, 0, 0.5, 1, 0.3, 0, 0.1, 0]
    model = spec.compile()
    for texture, side in enumerate((80, 40)):  # pixels of a square
        height, width = model.tex_height[texture], model.tex_width[texture]
        colors = np.random.default_rng(texture).integers(40, 256, (height // side, width // side, 3), np.uint8)
        image, start = np.kron(colors, np.ones((side, side, 1), np.uint8)).ravel(), model.tex_adr[texture]
        model.tex_data[start : start + len(image)] = image
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def test_textures_and_colours_equal_those_of_mujocos_renderer(tmp_path):
    environment = os.environ | {"MUJOCO_GL": "osmesa", "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", RENDER, str(tmp_path / "image.npy")]
    if subprocess.run(command, env=environment, capture_output=True, check=False).returncode:
        pytest.skip("OSMesa is not installed")
    truth = np.load(tmp_path / "image.npy") / 255
    model, data = textured()
    bodies = [in_world(model, data, body) for body in range(model.nbody)]
    meshes = [mesh for mesh, _ in bodies]
    first = np.cumsum([0, *(len(mesh.faces) for mesh in meshes)])
    camera, (height, width) = data.camera("camera"), truth.shape[:2]
    y, x = np.mgrid[:height, :width] + 0.5
    scale = 2 * np.tan(np.deg2rad(45) / 2) / height
    ray = np.stack([(x - width / 2) * scale, (height / 2 - y) * scale, -np.ones_like(x)], axis=-1).reshape(-1, 3)
    ray = ray @ camera.xmat.reshape(3, 3).T
    start = np.broadcast_to(camera.xpos, ray.shape)
    place, number, face = trimesh.util.concatenate(meshes).ray.intersects_location(start, ray, multiple_hits=False)
    owner = np.searchsorted(first, face, side="right") - 1
    color = np.ones((len(ray), 3))
    for index, (mesh, body) in enumerate(bodies):
        mine = owner == index
        own = face[mine] - first[index]
        shares = trimesh.triangles.points_to_barycentric(mesh.triangles[own], place[mine])
        uv, albedo = (np.einsum("nk,nki->ni", shares, np.asarray(x)[own]) for x in (body.uv, body.colors))
        size = len(body.texture)
        column, row = np.floor(uv * size).astype(int).T % size
        linear = albedo * np.asarray(body.texture)[row, column]
        color[number[mine]] = np.where(linear < 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    error = np.abs(color.reshape(truth.shape) - truth).max(axis=2).ravel()[number]
    assert len(error) > 10_000
    for index in range(model.nbody):
        own = error[owner == index]
        assert np.median(own) < 0.12, index
