import re
from pathlib import Path

import numpy as np
import pytest
import shapenet_folder as shapenet
from object_files import BAD_FILES, box, leaves, mixed_folder, same_points, surface

from sts_jax import objects
from sts_jax.objects import libraries


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


def test_a_missing_and_an_empty_folder_and_a_bad_argument_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere: no such folder"):
        objects.library(tmp_path / "nowhere")
    with pytest.raises(ValueError, match=f"{tmp_path.name}: the folder contains no usable mesh"):
        objects.library(tmp_path)
    with pytest.raises(ValueError, match="scale must be a positive number of metres per unit"):
        objects.library(tmp_path, scale=0.0)


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
