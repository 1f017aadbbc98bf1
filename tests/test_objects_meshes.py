"""Meshes of many formats as bodies: colours, textures, damage and decimation."""

import json
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
import trimesh
from object_files import BAD_FILES, surface, volume
from PIL import Image

from sts_jax import objects
from sts_jax.objects.colors import linear


def looked_up(body: objects.Body) -> np.ndarray:
    """Albedo at each corner of each face, nearest texel."""
    number = len(surface(body).faces)
    texture = np.asarray(body.texture)
    place = np.asarray(body.uv)[:number] * len(texture)
    column, row = np.moveaxis(np.clip(place.astype(int), 0, len(texture) - 1), -1, 0)
    return texture[row, column] * np.asarray(body.colors)[:number]


@pytest.fixture
def box(tmp_path) -> Path:
    path = tmp_path / "box.stl"
    trimesh.creation.box((0.1, 0.06, 0.04)).export(path)
    return path


def flag(folder: Path, *, material: bool = True) -> Path:
    """A box as an OBJ whose front (y low) wears an image, red above blue, and whose Kd is dark."""
    mesh = trimesh.creation.box((0.1, 0.06, 0.04))
    lines = ["mtllib flag.mtl", "usemtl cloth"]
    lines += [f"v {x} {y} {z}" for x, y, z in mesh.vertices]
    lines += [f"vt {0.1 + 0.8 * (x > 0)} {0.1 + 0.8 * (z > 0)}" for x, _, z in mesh.vertices]
    lines += ["f " + " ".join(f"{i + 1}/{i + 1}" for i in face) for face in mesh.faces]
    (folder / "flag.obj").write_text("\n".join(lines) + "\n")
    if material:
        (folder / "flag.mtl").write_text("newmtl cloth\nKd 0.1 0.1 0.1\nmap_Kd flag.png\n")
    pixels = np.zeros((40, 60, 3), np.uint8)
    pixels[:20], pixels[20:] = (200, 0, 0), (0, 0, 200)
    Image.fromarray(pixels).save(folder / "flag.png")
    return folder / "flag.obj"


@pytest.mark.parametrize("inside_out", [False, True])
def test_a_closed_box_has_the_mass_and_volume_of_its_dimensions(tmp_path, inside_out):
    mesh = trimesh.creation.box((0.1, 0.06, 0.04))
    if inside_out:
        mesh.invert()
    mesh.export(tmp_path / "box.stl")
    body = objects.load(tmp_path / "box.stl")
    np.testing.assert_allclose(volume(body), 0.1 * 0.06 * 0.04, rtol=1e-5)
    assert body.contents_density == 1000
    assert not body.two_sided
    assert int(body.category) == -1
    assert body.hulls.shape == (1, 32, 3)
    assert len(np.unique(np.asarray(body.hulls)[0], axis=0)) == 8
    corners = surface(body).triangles
    np.testing.assert_allclose(corners.max((0, 1)), [0.05, 0.03, 0.02], rtol=1e-5)
    assert (np.einsum("fki,fki->fk", np.asarray(body.normals)[:12], corners) > 0).all()
    np.testing.assert_allclose(np.asarray(body.colors)[:12], linear(np.array(0.7)), rtol=1e-5)
    body = objects.load(tmp_path / "box.stl", longest_side=0.05, mass=0.3, up="x")
    np.testing.assert_allclose(np.ptp(surface(body).vertices, axis=0), [0.03, 0.02, 0.05], rtol=1e-5)
    np.testing.assert_allclose(objects.rigid(body, 1.0, 1.0)[0], 0.3, rtol=1e-6)


def test_parts_that_share_an_edge_are_closed(tmp_path):
    first, second = (trimesh.creation.box((0.03, 0.02, 0.04)) for _ in range(2))
    second.apply_translation((0.03, 0.02, 0.0))
    both = trimesh.util.concatenate([first, second])
    both.merge_vertices()
    assert len(both.vertices) == 14
    assert not both.is_watertight  # four faces at the common edge, whole: no diagonal
    both.export(tmp_path / "boxes.ply")
    body = objects.load(tmp_path / "boxes.ply", strict=True)
    assert not body.two_sided
    assert volume(body) == pytest.approx(2 * 0.03 * 0.02 * 0.04, rel=1e-5)

    trimesh.Trimesh(both.vertices, both.faces[1:], process=False).export(tmp_path / "open.ply")
    with pytest.raises(ValueError, match="is not closed"):
        objects.load(tmp_path / "open.ply", strict=True)
    with pytest.warns(UserWarning, match="is not closed"):
        assert objects.load(tmp_path / "open.ply").two_sided


def test_obj_texture_the_right_way_up(tmp_path):
    body = objects.load(flag(tmp_path))
    assert body.texture.shape == (256, 256, 3)
    level = linear(np.array(200 / 255))
    expected = np.where(surface(body).triangles[..., 2:] > 0, [level, 0, 0], [0, 0, level])
    np.testing.assert_allclose(looked_up(body), expected, atol=1e-3)


def test_missing_materials_and_images_are_named_and_texture_replaces_them(tmp_path):
    path = flag(tmp_path, material=False)
    with pytest.warns(UserWarning, match=r"flag\.mtl.*argument texture") as caught:
        objects.load(path)
    assert len(caught) == 1
    with pytest.raises(FileNotFoundError, match=r"flag\.mtl"):
        objects.load(path, strict=True)
    body = objects.load(path, texture=tmp_path / "flag.png")
    assert looked_up(body)[surface(body).triangles[..., 2] > 0][:, 0].min() > 0.5
    path = flag(tmp_path)
    (tmp_path / "flag.png").write_bytes(b"\x89PNG\r\n\x1a\n torn")
    with pytest.raises(ValueError, match=r"flag\.png: the file cannot be read as an image"):
        objects.load(path)
    (tmp_path / "flag.png").unlink()
    with pytest.warns(UserWarning, match=r"flag\.png"):
        objects.load(path)


@pytest.mark.parametrize("kind", ["vertex", "face"])
def test_vertex_and_face_colours_are_srgb(tmp_path, kind):
    mesh = trimesh.creation.box((0.1, 0.06, 0.04))
    places = mesh.vertices if kind == "vertex" else mesh.triangles_center
    paint = np.where(places[:, 2:] > 0.01, [[255, 0, 0, 255]], [[0, 100, 0, 255]]).astype(np.uint8)
    setattr(mesh.visual, f"{kind}_colors", paint)
    mesh.export(tmp_path / "box.ply")
    body = objects.load(tmp_path / "box.ply")
    triangles = surface(body).triangles[..., 2]
    high = triangles > 0 if kind == "vertex" else np.tile(triangles.min(1)[:, None] > 0, 3)
    expected = np.where(high[..., None], [1, 0, 0], [0, float(linear(np.array(100 / 255))), 0])
    np.testing.assert_allclose(looked_up(body), expected, atol=1e-6)


def stack(path: Path, height: float, *looks: dict) -> objects.Body:
    """Cubes of 20 mm above each other, each with its own material."""
    scene = trimesh.Scene()
    for index, look in enumerate(looks):
        part, material = trimesh.creation.box((0.02, 0.02, 0.02)), trimesh.visual.material.PBRMaterial(**look)
        part.visual = trimesh.visual.TextureVisuals(uv=part.vertices[:, :2] * 40 + 0.5, material=material)
        scene.add_geometry(part, transform=trimesh.transformations.translation_matrix([0, 0, height * index]))
    scene.export(path)
    return objects.load(path)


def test_gltf_factor_is_linear_and_scenes_are_merged(tmp_path):
    factors = ([128, 0, 0, 255], [0, 64, 0, 255])
    body = stack(tmp_path / "two.glb", 0.05, *({"baseColorFactor": np.array(f, np.uint8)} for f in factors))
    high = surface(body).triangles[..., 2:] > 0
    np.testing.assert_allclose(looked_up(body), np.where(high, [0, 64 / 255, 0], [128 / 255, 0, 0]), atol=1e-3)
    np.testing.assert_allclose(np.ptp(np.asarray(body.vertices), axis=0), [0.02, 0.02, 0.07], rtol=1e-5)
    np.testing.assert_allclose(volume(body), 2 * 0.02**3, rtol=1e-4)


def test_a_dark_gltf_factor_is_not_rounded_to_8_bits(tmp_path):
    factor, name = [0.002, 0.0031, 0.5004], tmp_path / "dark.gltf"
    scene = trimesh.Scene(trimesh.creation.box((0.02, 0.02, 0.02)))
    files = trimesh.exchange.gltf.export_gltf(scene, embed_buffers=True)
    header = json.loads(files["model.gltf"])
    header["materials"] = [{"pbrMetallicRoughness": {"baseColorFactor": [*factor, 1]}}]
    primitive = header["meshes"][0]["primitives"][0]
    primitive["attributes"].pop("COLOR_0", None)
    primitive["material"] = 0
    name.write_text(json.dumps(header))
    np.testing.assert_allclose(looked_up(objects.load(name)), np.broadcast_to(factor, (12, 3, 3)), rtol=1e-5)


def test_parts_that_overlap_are_reported_with_their_common_volume(tmp_path):
    first, second = (trimesh.creation.box((0.03, 0.03, 0.03)) for _ in range(2))
    for offset, warned in (([0.015, 0.002, 0.003], True), ([0.0299, 0, 0], False), ([0.03, 0, 0], False)):
        both = trimesh.util.concatenate([first, second.copy().apply_translation(offset)])
        both.export(tmp_path / "boxes.stl")
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            objects.load(tmp_path / "boxes.stl")
        assert [str(one.message) for one in caught if "overlap" in str(one.message)] == (
            [
                f"{tmp_path / 'boxes.stl'}: parts of the mesh overlap, so that 11 of 54 ml of the contents count "
                "twice: unite the parts, or give the mass"
            ]
            if warned
            else []
        )
    inner = trimesh.creation.box((0.02, 0.02, 0.02))
    trimesh.util.concatenate([first, inner, trimesh.creation.box((0.01, 0.01, 0.01))]).export(tmp_path / "nest.stl")
    objects.load(tmp_path / "nest.stl")  # no warning: a solid within a cavity


def test_several_textures_become_one(tmp_path):
    red, green = (Image.new("RGB", (300, 20), paint) for paint in ((255, 0, 0), (0, 255, 0)))
    body = stack(tmp_path / "three.glb", 0.04, {"baseColorTexture": red}, {"baseColorTexture": green}, {})
    assert body.texture.shape == (1024, 1024, 3)
    color, z = looked_up(body), surface(body).triangles[..., 2]
    for rows, truth in ((z < -0.02, [1, 0, 0]), (abs(z) < 0.02, [0, 1, 0]), (z > 0.02, [1, 1, 1])):
        np.testing.assert_allclose(color[rows], np.broadcast_to(truth, color[rows].shape), atol=2e-2)


def test_an_open_bowl_takes_the_volume_of_its_hull_with_one_warning(tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.04)
    keep = ball.triangles_center[:, 2] < 0
    bowl = trimesh.Trimesh(ball.vertices, ball.faces[keep])
    path = tmp_path / "bowl.stl"
    bowl.export(path)
    with pytest.warns(UserWarning, match=r"bowl\.stl.*not closed.*convex hull") as caught:
        body = objects.load(path)
    assert len(caught) == 1
    np.testing.assert_allclose(volume(body), bowl.convex_hull.volume, rtol=1e-4)
    assert body.two_sided
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert objects.load(path, mass=0.1).two_sided  # needs no volume


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"mass": -0.1}, "mass must be a positive number of kilograms"),
        ({"longest_side": 0.004}, r"longest_side is 0\.004 m, but it must be from 0\.005 to 0\.15 m"),
        ({"scale": 1.0, "longest_side": 0.1}, "not both"),
        ({"scale": 0.001}, r"longest side is 0\.1 mm, but it must be at least 5 mm: .*longest_side \(in metres\)"),
        ({"up": (0.0, 1.0, 0.0)}, "must not be parallel"),
        ({"up": "z", "front": (0.0, -1.0, 0.0)}, "give an axis x, y or z without front, or two directions"),
    ],
)
def test_an_argument_out_of_range_is_refused(box, arguments, message):
    with pytest.raises(ValueError, match=message):
        objects.load(box, **arguments)


@pytest.mark.parametrize("name", BAD_FILES)
def test_a_damaged_file_is_named(tmp_path, name):
    content, message = BAD_FILES[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=rf"{name}: .*{message}"):
        objects.load(tmp_path / name)


def test_a_missing_file_a_folder_and_an_unusable_texture_are_named(tmp_path, box):
    with pytest.raises(FileNotFoundError, match=r"nothing\.obj: no such mesh file"):
        objects.load(tmp_path / "nothing.obj")
    with pytest.raises(IsADirectoryError, match=r"is a folder: give a mesh file in it.*objects\.library"):
        objects.load(tmp_path)
    with pytest.raises(ValueError, match="no texture coordinates"):
        objects.load(box, texture=flag(tmp_path).with_name("flag.png"))


@pytest.mark.parametrize("kind", ["stl", "stl_ascii"])
def test_a_truncated_stl_is_refused_as_truncated(tmp_path, kind):
    whole = trimesh.creation.icosphere(subdivisions=2, radius=0.04).export(file_type=kind)
    whole = whole.encode() if isinstance(whole, str) else whole
    torn = tmp_path / "torn.stl"
    torn.write_bytes(whole)
    assert int(np.asarray(objects.load(torn).faces).any(axis=1).sum()) == 320
    for part in (0.01, 0.3, 0.98):
        torn.write_bytes(whole[: int(part * len(whole))])
        with pytest.raises(ValueError, match=r"torn\.stl: the file is truncated.*eplace the file"):
            objects.load(torn)


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
    trimesh.creation.annulus(0.03, 0.04, 0.02).export(tmp_path / "ring.ply")
    monkeypatch.setitem(sys.modules, "coacd", None)
    listed = objects.library(tmp_path, parts=True)
    with pytest.raises(ImportError, match="coacd, which is not installed: pip install coacd"):
        objects.bodies(listed)
