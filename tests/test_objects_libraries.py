"""Folders of meshes as libraries, and ShapeNetSem."""

import re
from pathlib import Path

import numpy as np
import pytest
import shapenet_folder as shapenet
import trimesh
from object_files import BAD_FILES, box, leaves, mixed_folder, same_points, surface, volume

from sts_jax import objects
from sts_jax.objects import libraries
from sts_jax.objects.colors import linear


@pytest.fixture
def folder(tmp_path) -> Path:
    return mixed_folder(tmp_path / "things")


def test_the_first_folder_of_a_path_is_the_class(folder):
    listed = objects.library(folder)
    names = [("boxes", "boxes/z.glb"), ("cups", "cups/small/x.stl"), ("cups", "cups/y.ply"), ("things", "loose.obj")]
    assert [(item.label, item.name) for item in listed.items] == names
    assert listed.classes == ("boxes", "cups", "things")
    assert listed.skipped == (("boxes/w.fbx", "trimesh cannot read it here: export it as glb, ply, obj or stl"),)


def test_files_of_any_folder_take_the_axes_of_their_format_and_the_given_size(folder):
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
    body = objects.read(objects.library(folder, scale=0.5), 1).body
    np.testing.assert_allclose(np.ptp(np.asarray(body.vertices), axis=0).max(), 0.045, rtol=1e-5)


def test_a_missing_and_an_empty_folder_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere: no such folder"):
        objects.library(tmp_path / "nowhere")
    with pytest.raises(ValueError, match=f"{tmp_path.name}: the folder contains no usable mesh"):
        objects.library(tmp_path)


def test_bad_objects_are_left_out_and_named(tmp_path):
    reasons = {"thin.stl": r"the object is 0\.1 mm thick"}
    (tmp_path / "mixed").mkdir()
    for name in ("torn.glb", "points.obj", "sheet.stl", "nan.obj"):
        content, reasons[name] = BAD_FILES[name]
        (tmp_path / "mixed" / name).write_bytes(content)
    box((0.1, 0.1, 0.0001)).export(tmp_path / "mixed" / "thin.stl")
    box().export(tmp_path / "mixed" / "good.stl")
    listed = objects.library(tmp_path / "mixed")
    _, skipped = objects.bodies(listed)
    assert [name for name, _ in skipped] == sorted(reasons)
    for name, reason in skipped:
        assert re.search(reasons[name], reason)
        assert str(tmp_path) not in reason

    lines: list[str] = []
    usable, text = objects.survey(listed, progress=lines.append)
    assert [item.name for item in usable.items] == ["good.stl"]
    assert list(usable.skipped) == skipped
    assert len(lines) == len(listed.items)
    assert "1 objects: mixed 1\n" in text
    assert "mixed  good.stl: 60 x 40 x 30; 12 faces; 8 vertices; 0.00 / 0.00\n" in text
    assert all(f"{name}: " in text for name in reasons)


def test_the_cache_returns_the_same_bytes_without_loading_again(folder, tmp_path, monkeypatch):
    plain = [leaves(body) for body in objects.bodies(objects.library(folder))[0]]
    listed = objects.library(folder, cache=tmp_path / "kept")
    usable, text = objects.survey(listed)
    assert len(list((tmp_path / "kept").iterdir())) == len(listed.items)
    monkeypatch.setattr(libraries, "load", None)  # nothing is made twice
    assert [leaves(body) for body in objects.bodies(usable)[0]] == plain
    assert objects.survey(listed) == (usable, text)
    (folder / "loose.obj").unlink()
    reason = "no such mesh file: restore it, or call objects.library() again to list the existing files"
    assert objects.bodies(listed, [3]) == ([], [("loose.obj", reason)])


def test_a_torn_file_of_the_cache_is_replaced(folder, tmp_path):
    listed = objects.library(folder, cache=tmp_path / "kept")
    whole = leaves(objects.read(listed, 1).body)
    (place,) = (tmp_path / "kept").iterdir()
    content = place.read_bytes()
    for torn in (content[: len(content) // 2], b"", b"\x80 no archive", content[:-200] + bytes(200)):
        place.write_bytes(torn)
        assert leaves(objects.read(listed, 1).body) == whole
        assert place.read_bytes() == content
    assert list((tmp_path / "kept").iterdir()) == [place]


def test_a_changed_file_image_or_setting_is_another_entry_of_the_cache(tmp_path):
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
    assert [count(scale=0.01), count(up="y")] == [4, 5]


INCH = 0.0254  # m


def only(root: Path, mesh: trimesh.Trimesh, **values: str) -> objects.Library:
    category = values.pop("category", "Bottle")
    return objects.library(shapenet.build(root, [shapenet.row("a", category, **values)], {"a": mesh}))


@pytest.mark.parametrize(
    ("right", "back", "up", "unit"),
    [
        ((1, 0, 0), (0, 1, 0), (0, 0, 1), INCH),
        ((1, 0, 0), (0, 0, -1), (0, 1, 0), 0.001),
        ((0.8, 0.6, 0), (-0.6, 0.8, 0), (0, 0, 1), 0.01),
    ],
)
def test_unit_up_and_front_give_size_and_attitude(tmp_path, right, back, up, unit):
    truth = shapenet.wedge()
    vector = r"\,".join(str(float(x)) for x in up)
    front = r"\,".join(str(-float(x)) for x in back)
    listed = only(tmp_path, shapenet.in_file(truth, right, back, up, unit), up=vector, front=front, unit=str(unit))
    entry = objects.read(listed, 0)
    assert entry.notes == ()
    same_points(surface(entry.body).vertices, truth.vertices - truth.center_mass)
    np.testing.assert_allclose(volume(entry.body), truth.volume, rtol=1e-4)
    assert objects.CATEGORIES[int(entry.body.category)] == "bottle"


def test_models_of_other_categories_and_defective_rows_are_skipped_with_a_reason(tmp_path):
    good = [
        shapenet.row("g", "WineBottle,Bottle,_StanfordSceneDBModels"),
        shapenet.row("c", "Camera,WebCam"),
        shapenet.row("d", "ComputerMouse"),
        shapenet.row("n", "Scissors", front=""),
    ]
    reasons = {
        "h": (shapenet.row("h", "Fork,Spoon"), "belong to several classes (fork, spoon)"),
        "i": (shapenet.row("i", "Watch", unit=""), "has no unit"),
        "j": (shapenet.row("j", "Watch", unit="inch"), "unit is 'inch'"),
        "k": (shapenet.row("k", "Watch", up=r"0\,0\,1", front=r"0\,0\,-1"), "must not be parallel"),
        "l": (shapenet.row("l", "Watch", up=r"0\,0"), "in the column 'up', but"),
        "m": (shapenet.row("m", "Watch"), "models-OBJ/models/m.obj does not exist"),
        "d": (shapenet.row("d", "ComputerMouse"), "an earlier row"),
        "o": (shapenet.row("o", "Bottle,_BAD"), "_BAD"),
        "metadata.csv": (shapenet.row("f", "Chair"), "1 of 13 models are of none"),
    }
    rows = [*good, *(row for row, _ in reasons.values())]
    shapenet.build(tmp_path, rows, dict.fromkeys("cdfghijklno", box((2, 2, 2))))
    listed = objects.library(tmp_path)
    names = [("bottle", "g"), ("mouse", "d"), ("scissors", "n"), ("webcam", "c")]
    assert [(item.label, item.name) for item in listed.items] == names
    assert listed.items[2].notes == ("metadata.csv has no front: ShapeNet's default is used",)
    assert dict(listed.skipped).keys() == reasons.keys()
    assert all(reasons[name][1] in reason for name, reason in listed.skipped)


def test_the_table_may_be_in_a_sub_folder_and_commas_may_be_escaped_without_quotes(tmp_path):
    folder = shapenet.build(tmp_path / "ShapeNetSem.v0", [], {"a": box((2, 2, 2))})
    header, line = ",".join(shapenet.COLUMNS), r"wss.a,Bottle\,WineBottle,,,0\,0\,1,0\,-1\,0.7,0.0254,,,,,,,,a,*"
    (folder / "metadata.csv").write_text(f"{header}\n{line}\n")
    (item,) = objects.library(tmp_path).items
    assert (item.name, item.label, item.scale, item.up, item.front) == ("a", "bottle", INCH, (0, 0, 1), (0, -1, 0.7))


def test_images_are_found_in_the_folder_of_textures(tmp_path):
    paint = (200, 40, 0)
    shapenet.build(tmp_path, [shapenet.row("a", "Watch")], {"a": box((2, 1, 1))}, {"a": paint})
    entry = objects.read(objects.library(tmp_path), 0)
    assert entry.notes == ()
    assert entry.body.texture.shape == (256, 256, 3)
    np.testing.assert_allclose(entry.body.texture[128, 128], linear(np.array(paint) / 255), atol=1e-5)
    np.testing.assert_allclose(entry.body.colors[0], 1)  # and not the Kd
    (tmp_path / "models-textures" / "textures" / "a.png").unlink()
    assert "a.png. Add them" in objects.read(objects.library(tmp_path), 0).notes[0]


def test_a_larger_object_is_scaled_down_with_a_note_and_cutlery_is_solid_and_of_steel(tmp_path):
    entry = objects.read(only(tmp_path / "large", box((3, 2, 20))), 0)
    np.testing.assert_allclose(np.ptp(np.asarray(entry.body.vertices), axis=0), [0.018, 0.012, 0.12], rtol=1e-5)
    assert entry.notes == ("the longest side of 0.508 m is scaled down to 0.12 m",)
    fork = objects.read(only(tmp_path / "fork", box((1, 4, 0.2)), category="Fork"), 0).body
    for fill in (0.0, 1.0):
        np.testing.assert_allclose(objects.rigid(fork, fill, 1.0)[0], 5.9 * 2 * (4 + 0.2 + 0.8) * INCH**2, rtol=1e-5)


@pytest.mark.parametrize("sizes", [(50.5, 0.093), (0.05, 25.0), (2.0, 0.04), (60.0, 40.0), (5.0,)])
def test_a_folder_that_cannot_be_in_metres_needs_a_scale(tmp_path, sizes):
    for number, side in enumerate(sizes):
        box((side, 0.8 * side, 0.5 * side)).export(tmp_path / f"{number}.stl")
    longest = f"{np.argmax(sizes)}.stl"
    for cache in (None, tmp_path / "kept", tmp_path / "kept"):
        listed = objects.library(tmp_path, cache=cache)
        for load in (objects.survey, objects.bodies):
            with pytest.raises(
                ValueError, match=rf"in metres, {longest} would be .* m long.* --scale '{longest}' 0\.001"
            ):
                load(listed)
    assert len(objects.bodies(objects.library(tmp_path, scale=1.0))[0]) == len(sizes)


def test_large_things_in_metres_and_meshes_without_a_unit_are_scaled_down(tmp_path):
    for number, side in enumerate((0.5, 2.0, 2.0)):
        box((side, 0.8 * side, 0.5 * side)).export(tmp_path / f"{number}.stl")
    made, _ = objects.bodies(objects.library(tmp_path))
    np.testing.assert_allclose([np.ptp(np.asarray(body.vertices), axis=0).max() for body in made], 0.12, rtol=1e-5)


def test_files_and_sub_folders_have_their_own_scale(tmp_path):
    (tmp_path / "gripper").mkdir()
    box((50.5, 20, 10)).export(tmp_path / "gripper" / "finger.stl")
    box((3, 2, 1)).export(tmp_path / "gripper" / "tip.obj")
    box((0.093, 0.05, 0.04)).export(tmp_path / "base.stl")
    listed = objects.library(tmp_path, scale={"*.obj": 0.01, "gripper": 0.001})
    made, _ = objects.bodies(listed)
    sides = {
        item.name: np.ptp(np.asarray(x.vertices), axis=0).max() for item, x in zip(listed.items, made, strict=True)
    }
    assert sides == pytest.approx({"gripper/finger.stl": 0.0505, "gripper/tip.obj": 0.03, "base.stl": 0.093}, rel=1e-5)
    for scale, message in (({"robot": 1.0}, "scale has 'robot', but"), ({"gripper": 0.0}, "scale must be a positive")):
        with pytest.raises(ValueError, match=message):
            objects.library(tmp_path, scale=scale)


def test_missing_columns_are_named(tmp_path):
    shapenet.build(tmp_path, [], {})
    for missing in (["front", "unit"], ["fullId"]):
        shapenet.table(tmp_path, [], [name for name in shapenet.COLUMNS if name not in missing])
        with pytest.raises(ValueError, match=rf"lacks columns of ShapeNetSem \({', '.join(missing)}\)"):
            objects.library(tmp_path)
