import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest
import shapenet_folder as shapenet
import trimesh
from PIL import Image

from sts_jax import objects
from sts_jax.objects import libraries
from sts_jax.objects.colors import linear

INCH = 0.0254


def surface(body: objects.Body) -> trimesh.Trimesh:
    faces = np.asarray(body.faces)
    faces = faces[faces.any(axis=1)]
    return trimesh.Trimesh(np.asarray(body.vertices, float)[: faces.max() + 1], faces, process=False)


def volume(body: objects.Body) -> float:
    return float(objects.fill_moments(body.interior, 1.0)[0])


def same_points(found: np.ndarray, truth: np.ndarray) -> None:
    """Each found vertex is one of the truth's, and the other way round."""
    distance = np.linalg.norm(found[:, None] - truth[None], axis=2)
    assert distance.min(axis=0).max() < 1e-6
    assert distance.min(axis=1).max() < 1e-6


def leaves(body: objects.Body) -> list[bytes]:
    return [np.asarray(getattr(body, field.name)).tobytes() for field in dataclasses.fields(body)]


def box(size=(0.06, 0.04, 0.03)) -> trimesh.Trimesh:
    return trimesh.creation.box(size)


def only(root: Path, mesh: trimesh.Trimesh, **values: str) -> objects.Library:
    category = values.pop("category", "Bottle")
    return objects.library(shapenet.build(root, [shapenet.row("a", category, **values)], {"a": mesh}))


# ShapeNetSem.

ATTITUDES = {
    "z_up": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "y_up": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "front_is_x": ((0, 1, 0), (-1, 0, 0), (0, 0, 1)),
    "upside_down": ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
    "slanted": ((0.8, 0.6, 0), (-0.6, 0.8, 0), (0, 0, 1)),
}


@pytest.mark.parametrize(("attitude", "unit"), [*zip(ATTITUDES, [INCH, 0.001, 1.0, INCH, 0.01], strict=True)])
def test_unit_up_and_front(tmp_path, attitude, unit):
    right, back, up = ATTITUDES[attitude]
    truth = shapenet.wedge()
    vector = r"\,".join(str(float(x)) for x in up)
    front = r"\,".join(str(-float(x)) for x in back)
    listed = only(tmp_path, shapenet.in_file(truth, right, back, up, unit), up=vector, front=front, unit=str(unit))
    entry = objects.read(listed, 0)
    assert entry.notes == ()
    same_points(surface(entry.body).vertices, truth.vertices - truth.center_mass)
    np.testing.assert_allclose(volume(entry.body), truth.volume, rtol=1e-4)
    assert objects.CATEGORIES[int(entry.body.category)] == "bottle"


def test_a_front_that_is_not_square_to_up_is_made_so(tmp_path):
    truth = shapenet.wedge()
    listed = only(tmp_path, truth, unit="1", front=r"0.0\,-1.0\,0.7")
    same_points(surface(objects.read(listed, 0).body).vertices, truth.vertices - truth.center_mass)


def test_categories_and_what_is_left_out(tmp_path):
    rows = [
        shapenet.row("g", "WineBottle,Bottle,_StanfordSceneDBModels"),
        shapenet.row("b", "Camera,DSLRCamera"),
        shapenet.row("c", "Camera,WebCam"),
        shapenet.row("d", "ComputerMouse"),
        shapenet.row("e", "Mouse"),
        shapenet.row("f", "Chair"),
        shapenet.row("h", "Fork,Spoon"),
        shapenet.row("i", "Watch", unit=""),
        shapenet.row("j", "Watch", unit="inch"),
        shapenet.row("k", "Watch", up=r"0\,0\,1", front=r"0\,0\,-1"),
        shapenet.row("l", "Watch", up=r"0\,0"),
        shapenet.row("m", "Watch"),
        shapenet.row("n", "Scissors", front=""),
        shapenet.row("d", "ComputerMouse"),
        shapenet.row("o", "Bottle,_BAD"),
    ]
    shapenet.build(tmp_path, rows, dict.fromkeys("abcdefghijklno", box((2, 2, 2))))
    listed = objects.library(tmp_path)
    assert [(item.label, item.name) for item in listed.items] == [
        ("bottle", "g"),
        ("camera", "b"),
        ("mouse", "d"),
        ("scissors", "n"),
        ("webcam", "c"),
    ]
    assert listed.classes == ("bottle", "camera", "mouse", "scissors", "webcam")
    assert listed.items[3].notes == ("no front in the table: ShapeNet's default",)
    reasons = dict(listed.skipped)
    for name, reason in (
        ("h", "it has several classes (fork, spoon)"),
        ("i", "unit is missing"),
        ("j", "unit is 'inch'"),
        ("k", "must not be parallel"),
        ("l", "its up is"),
        ("m", "models-OBJ/models/m.obj does not exist"),
        ("d", "twice"),
        ("o", "_BAD"),
        ("metadata.csv", "2 of 15 models are of none"),
    ):
        assert reason in reasons.pop(name)
    assert not reasons
    assert objects.library(tmp_path) == listed  # and again the same, in the same order


def test_commas_escaped_without_quotes(tmp_path):
    shapenet.build(tmp_path, [], {"a": box((2, 2, 2))})
    header, line = ",".join(shapenet.COLUMNS), r"wss.a,Bottle\,WineBottle,,,0\,0\,1,0\,-1\,0,0.0254,,,,,,,,a,*"
    (tmp_path / "metadata.csv").write_text(f"{header}\n{line}\n")
    (item,) = objects.library(tmp_path).items
    assert (item.name, item.label, item.scale, item.up, item.front) == ("a", "bottle", INCH, (0, 0, 1), (0, -1, 0))


def test_table_in_a_folder_below(tmp_path):
    shapenet.build(tmp_path / "ShapeNetSem.v0", [shapenet.row("a", "Spoon")], {"a": box((2, 2, 2))})
    assert [item.label for item in objects.library(tmp_path).items] == ["spoon"]


def test_image_of_the_texture_folder(tmp_path):
    paint = (200, 40, 0)
    shapenet.build(tmp_path, [shapenet.row("a", "Watch")], {"a": box((2, 1, 1))}, {"a": paint})
    entry = objects.read(objects.library(tmp_path), 0)
    assert entry.notes == ()
    assert entry.body.texture.shape == (256, 256, 3)
    np.testing.assert_allclose(entry.body.texture[128, 128], linear(np.array(paint) / 255), atol=1e-5)
    np.testing.assert_allclose(entry.body.colors[0], 1)  # and not the Kd
    (tmp_path / "models-textures" / "textures" / "a.png").unlink()
    assert "a.png, not found" in objects.read(objects.library(tmp_path), 0).notes[0]


def test_what_is_larger_is_scaled_down_and_said(tmp_path):
    listed = only(tmp_path, box((3, 2, 20)))
    entry = objects.read(listed, 0)
    np.testing.assert_allclose(np.ptp(np.asarray(entry.body.vertices), axis=0), [0.018, 0.012, 0.12], rtol=1e-5)
    assert entry.notes == ("its longest side is 0.508 m, scaled down to 0.12 m",)
    (note,) = objects.read(dataclasses.replace(listed, largest=0.05), 0).notes
    assert note.endswith("scaled down to 0.05 m")


def test_aligned_dims_that_disagree_are_said(tmp_path):
    dims = r"5.08\,5.08\,10.16"  # cm
    assert objects.read(only(tmp_path / "a", box((2, 2, 4)), **{"aligned.dims": dims}), 0).notes == ()
    (note,) = objects.read(only(tmp_path / "b", box((2, 2, 3)), **{"aligned.dims": dims}), 0).notes
    assert note == "the table's aligned.dims give a longest side of 102 mm"


def test_solid_things_hold_nothing_and_are_of_steel(tmp_path):
    fork = objects.read(only(tmp_path, box((1, 4, 0.2)), category="Fork"), 0).body
    area = 2 * (4 + 0.2 + 0.8) * INCH**2
    for fill in (0.0, 1.0):
        np.testing.assert_allclose(objects.rigid(fork, fill, 1.0)[0], 5.9 * area, rtol=1e-5)


def test_missing_columns_are_named(tmp_path):
    shapenet.build(tmp_path, [], {})
    shapenet.table(tmp_path, [], [name for name in shapenet.COLUMNS if name not in ("unit", "front")])
    with pytest.raises(ValueError, match=r"metadata\.csv: lacks the columns front, unit "):
        objects.library(tmp_path)
    shapenet.table(tmp_path, [], [name for name in shapenet.COLUMNS if name != "fullId"])
    (tmp_path / "models-OBJ").rename(tmp_path / "models")  # known by its columns alone
    with pytest.raises(ValueError, match=r"metadata\.csv: lacks the columns fullId "):
        objects.library(tmp_path)
    (tmp_path / "models").rename(tmp_path / "models-OBJ")
    shapenet.table(tmp_path, [], ["id", "class"])
    with pytest.raises(ValueError, match="lacks the columns fullId, category, up, front, unit"):
        objects.library(tmp_path)


def test_table_without_a_usable_object(tmp_path):
    shapenet.build(tmp_path, [shapenet.row("a", "Watch", unit="")], {"a": box()})
    with pytest.raises(ValueError, match=r"holds no mesh that can be used.*\n  a: its unit is missing"):
        objects.library(tmp_path)


# Any folder.


@pytest.fixture
def folder(tmp_path) -> Path:
    root = tmp_path / "things"
    for place in ("cups/small/x.stl", "cups/y.ply", "boxes/z.glb", "loose.obj"):
        (root / place).parent.mkdir(parents=True, exist_ok=True)
        shapenet.wedge().export(root / place)
    (root / "notes.txt").write_text("no mesh")
    (root / "boxes" / "w.fbx").write_bytes(b"Kaydara")
    return root


def test_a_class_is_the_first_folder(folder):
    listed = objects.library(folder)
    names = [("boxes", "boxes/z.glb"), ("cups", "cups/small/x.stl"), ("cups", "cups/y.ply"), ("things", "loose.obj")]
    assert [(item.label, item.name) for item in listed.items] == names
    assert listed.classes == ("boxes", "cups", "things")
    assert listed.skipped == (("boxes/w.fbx", "trimesh cannot read it here: export it as glb, ply, obj or stl"),)


def test_axes_and_size_of_any_folder(folder):
    truth = shapenet.wedge()
    made, skipped = objects.bodies(objects.library(folder), [1, 2, 3])
    assert not skipped
    for body in made:
        same_points(surface(body).vertices, truth.vertices - truth.center_mass)
        assert int(body.category) == -1
    # A glTF's +y is up and its +z is the front.
    turned = (truth.vertices - truth.center_mass) @ np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]).T
    same_points(surface(objects.bodies(objects.library(folder), [0])[0][0]).vertices, turned)
    upright = objects.bodies(objects.library(folder, up="y"), [1])[0][0]  # the STL, read as the glTF is
    same_points(surface(upright).vertices, turned)
    for arguments, size in (({"scale": 0.5}, 0.045), ({"longest_side": 0.03}, 0.03)):
        body = objects.bodies(objects.library(folder, **arguments), [1])[0][0]
        np.testing.assert_allclose(np.ptp(np.asarray(body.vertices), axis=0).max(), size, rtol=1e-5)


def test_folders_that_are_none(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere: no such folder"):
        objects.library(tmp_path / "nowhere")
    with pytest.raises(ValueError, match=f"{tmp_path.name}: holds no mesh"):
        objects.library(tmp_path)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scale": 1.0, "longest_side": 0.1}, "not both"),
        ({"scale": -1.0}, "scale must be positive"),
        ({"longest_side": 0.3}, r"longest_side must be .* at most 0\.15 m"),
        ({"largest": float("nan")}, "largest must be positive"),
        ({"faces": 3}, "faces must be at least 4"),
    ],
)
def test_bad_arguments(folder, arguments, message):
    with pytest.raises(ValueError, match=message):
        objects.library(folder, **arguments)


# Bad objects.


def bad_objects(root: Path) -> dict[str, str]:
    """Files that no body can be made of, and what is said of each."""
    root.mkdir(parents=True, exist_ok=True)
    sheets = [
        trimesh.Trimesh([[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0]], [[0, 1, 2]]).apply_translation([0.01 * i, 0, 0])
        for i in range(3)
    ]
    trimesh.util.concatenate(sheets).export(root / "stack_of_sheets.stl")
    box((0.1, 0.1, 0.0001)).export(root / "thin.stl")
    box((0.001, 0.001, 0.001)).export(root / "tiny.stl")
    whole = trimesh.creation.icosphere(subdivisions=2, radius=0.04)
    whole.export(root / "torn.glb")
    (root / "torn.glb").write_bytes((root / "torn.glb").read_bytes()[:3000])
    (root / "empty.stl").write_bytes(b"")
    (root / "points.obj").write_text("v 0 0 0\nv 0 0 1\nv 0 1 0\n")
    (root / "nan.obj").write_text("v nan 0 0\nv 0 0 1\nv 0 1 0\nv 1 0 0\nf 1 2 3\nf 2 3 4\n")
    (root / "beyond.off").write_text("OFF\n4 4 0\n0 0 0\n0 0 1\n0 1 0\n1 0 0\n3 0 1 2\n3 0 1 9\n3 1 2 3\n3 0 2 3\n")
    return {
        "stack_of_sheets.stl": "flat",
        "thin.stl": "sheet 0.1 mm thick",
        "tiny.stl": "longest side is 1 mm",
        "torn.glb": "cannot be read as a mesh",
        "empty.stl": "is empty",
        "points.obj": "no faces",
        "nan.obj": "NaN",
        "beyond.off": "",
    }


def test_bad_objects_are_left_out_and_named(tmp_path):
    bad = bad_objects(tmp_path / "mixed")
    for name in ("good.stl", "zebra.stl"):
        box().export(tmp_path / "mixed" / name)
    listed = objects.library(tmp_path / "mixed")
    assert len(listed.items) == len(bad) + 2
    made, skipped = objects.bodies(listed)
    assert len(made) == 2
    assert [name for name, _ in skipped] == sorted(bad)
    for name, reason in skipped:
        assert bad[name] in reason
        assert str(tmp_path) not in reason

    said: list[str] = []
    usable, text = objects.survey(listed, progress=said.append)
    assert [item.name for item in usable.items] == ["good.stl", "zebra.stl"]
    assert list(usable.skipped) == skipped
    assert len(said) == len(listed.items)
    assert text.startswith("2 objects: mixed 2\n")
    assert "mixed  good.stl: 60 x 40 x 30; 12 faces; 8 vertices; 0.00 / 0.00\n" in text
    assert all(f"{name}: " in text for name in bad)
    assert objects.survey(listed) == (usable, text)


def test_a_file_that_went_away(folder):
    listed = objects.library(folder, cache=folder / "cache")
    (folder / "loose.obj").unlink()
    assert objects.bodies(listed, [3]) == ([], [("loose.obj", "no such mesh file")])


# The cache.


def test_cache_gives_the_same_bytes(folder, tmp_path, monkeypatch):
    plain = [leaves(body) for body in objects.bodies(objects.library(folder))[0]]
    listed = objects.library(folder, cache=tmp_path / "kept")
    usable, text = objects.survey(listed)
    assert len(list((tmp_path / "kept").iterdir())) == len(listed.items)
    monkeypatch.setattr(libraries, "load", None)  # nothing is made twice
    assert [leaves(body) for body in objects.bodies(usable)[0]] == plain
    assert objects.survey(listed) == (usable, text)


def test_torn_cache_is_made_anew(folder, tmp_path):
    listed = objects.library(folder, cache=tmp_path / "kept")
    whole = leaves(objects.read(listed, 1).body)
    (place,) = (tmp_path / "kept").iterdir()
    content = place.read_bytes()
    for torn in (content[: len(content) // 2], b"", b"\x80 no archive", content[:-200] + bytes(200)):
        place.write_bytes(torn)
        assert leaves(objects.read(listed, 1).body) == whole
        assert place.read_bytes() == content
    assert list((tmp_path / "kept").iterdir()) == [place]


def test_cache_follows_file_image_and_settings(tmp_path):
    shapenet.build(tmp_path, [shapenet.row("a", "Watch")], {"a": box((2, 1, 1))}, {"a": (9, 9, 9)})
    cache = tmp_path / "kept"

    def count(**settings) -> int:
        objects.read(objects.library(tmp_path, cache=cache, **settings), 0)
        return len(list(cache.iterdir()))

    assert [count(), count()] == [1, 1]
    image = tmp_path / "models-textures" / "textures" / "a.png"
    image.write_bytes(image.read_bytes() + b"\0")
    assert count() == 2
    mesh = tmp_path / "models-OBJ" / "models" / "a.obj"
    mesh.write_text(mesh.read_text() + "# end\n")
    assert count() == 3
    assert [count(longest_side=0.05), count(faces=64), count(largest=0.06)] == [4, 5, 6]


# Decimation.


def painted_ball(path: Path) -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=0.04)  # 20,480 faces
    paint = np.where(mesh.vertices[:, 2:] > 0, [[255, 0, 0, 255]], [[0, 0, 255, 255]]).astype(np.uint8)
    mesh.visual.vertex_colors = paint
    mesh.export(path)
    return mesh


@pytest.mark.slow
def test_decimation_keeps_volume_and_colours(tmp_path):
    mesh = painted_ball(tmp_path / "ball.ply")
    entry = objects.read(objects.library(tmp_path), 0)
    drawn = surface(entry.body)
    assert len(drawn.faces) <= 4096
    assert drawn.is_watertight
    np.testing.assert_allclose(drawn.volume, mesh.volume, rtol=5e-3)
    np.testing.assert_allclose(volume(entry.body), mesh.volume, rtol=5e-3)
    np.testing.assert_allclose(np.ptp(drawn.vertices, axis=0), 0.08, rtol=5e-3)
    assert entry.notes == (f"decimated from 20,480 to {len(drawn.faces):,} faces",)
    height = drawn.vertices[drawn.faces][..., 2]
    colors = np.asarray(entry.body.colors)[: len(drawn.faces)]
    np.testing.assert_allclose(colors[height > 0.003], [[1, 0, 0]] * (height > 0.003).sum(), atol=1e-6)
    np.testing.assert_allclose(colors[height < -0.003], [[0, 0, 1]] * (height < -0.003).sum(), atol=1e-6)


def test_decimation_samples_the_texture(tmp_path):
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=0.04)
    pixels = np.zeros((64, 64, 3), np.uint8)
    pixels[:, :32], pixels[:, 32:] = (255, 0, 0), (0, 255, 0)
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(pixels))
    uv = np.stack([0.5 + mesh.vertices[:, 0] * 12, np.full(len(mesh.vertices), 0.5)], axis=1)
    mesh.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    mesh.export(tmp_path / "ball.glb")
    with pytest.warns(UserWarning, match="decimated from 20,480 to .* faces, and its texture to one colour"):
        body = objects.load(tmp_path / "ball.glb", faces=2000)
    assert body.texture.shape == (1, 1, 3)
    drawn = surface(body)
    x = drawn.vertices[drawn.faces][..., 0]
    colors = np.asarray(body.colors)[: len(drawn.faces)]
    np.testing.assert_allclose(colors[x < -0.005], [[1, 0, 0]] * (x < -0.005).sum(), atol=1e-3)
    np.testing.assert_allclose(colors[x > 0.005], [[0, 1, 0]] * (x > 0.005).sum(), atol=1e-3)


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


def test_decimation_names_its_package(tmp_path, monkeypatch):
    painted_ball(tmp_path / "ball.ply")
    monkeypatch.setitem(sys.modules, "fast_simplification", None)
    listed = objects.library(tmp_path)
    with pytest.raises(ImportError, match=r"ball\.ply.*fast-simplification.*sts_jax\[meshes\]"):
        objects.bodies(listed)
    with pytest.raises(ImportError, match="fast-simplification"):
        objects.survey(listed)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scale": 0.0}, "scale must be a positive"),
        ({"largest": -1.0}, "largest must be a positive"),
        ({"largest": 0.2}, r"the pad is 0\.15 m"),
        ({"density": 0.0}, "density must be a positive"),
        ({"scale": 1.0, "longest_side": 0.1}, "not both"),
        ({"faces": 2}, "faces must be a whole number, at least 4"),
        ({"up": (0.0, 0.0, 0.0)}, "not all zero"),
        ({"up": (0.0, 1.0, 0.0)}, "must not be parallel"),
        ({"up": "z", "front": (0.0, -1.0, 0.0)}, "three numbers if front is given"),
    ],
)
def test_bad_arguments_of_load(tmp_path, arguments, message):
    box().export(tmp_path / "box.stl")
    with pytest.raises(ValueError, match=message):
        objects.load(tmp_path / "box.stl", **arguments)
