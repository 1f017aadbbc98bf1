import re
from pathlib import Path

import numpy as np
import pytest
import shapenet_folder as shapenet
from object_files import BAD_FILES, box, mixed_folder, same_points, surface

from sts_jax import objects


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
    for arguments, size in (({"scale": 0.5}, 0.045), ({"longest_side": 0.03}, 0.03)):
        body = objects.bodies(objects.library(folder, **arguments), [1])[0][0]
        np.testing.assert_allclose(np.ptp(np.asarray(body.vertices), axis=0).max(), size, rtol=1e-5)


def test_a_missing_and_an_empty_folder_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere: no such folder"):
        objects.library(tmp_path / "nowhere")
    with pytest.raises(ValueError, match=f"{tmp_path.name}: the folder contains no usable mesh"):
        objects.library(tmp_path)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scale": 1.0, "longest_side": 0.1}, "not both"),
        ({"largest": 0.001}, r"largest is 0\.001 m, but it must be from 0\.005 to 0\.15 m"),
        ({"faces": 3}, "faces must be a whole number >= 4"),
    ],
)
def test_arguments_out_of_range_are_refused(folder, arguments, message):
    with pytest.raises(ValueError, match=message):
        objects.library(folder, **arguments)


def test_bad_objects_are_left_out_and_named(tmp_path):
    bad = {name: pair for name, pair in BAD_FILES.items() if name not in ("text.xyzzy", "millimetres.stl")}
    (tmp_path / "mixed").mkdir()
    for name, (content, _) in bad.items():
        (tmp_path / "mixed" / name).write_bytes(content)
    box((0.1, 0.1, 0.0001)).export(tmp_path / "mixed" / "thin.stl")
    reasons = {name: message for name, (_, message) in bad.items()} | {"thin.stl": r"the object is 0\.1 mm thick"}
    for name in ("good.stl", "zebra.stl"):
        box().export(tmp_path / "mixed" / name)
    listed = objects.library(tmp_path / "mixed")
    loaded, skipped = objects.bodies(listed)
    assert len(loaded) == 2
    assert [name for name, _ in skipped] == sorted(reasons)
    for name, reason in skipped:
        assert re.search(reasons[name], reason)
        assert str(tmp_path) not in reason

    lines: list[str] = []
    usable, text = objects.survey(listed, progress=lines.append)
    assert [item.name for item in usable.items] == ["good.stl", "zebra.stl"]
    assert list(usable.skipped) == skipped
    assert len(lines) == len(listed.items)
    assert text.startswith("2 objects: mixed 2\n")
    assert "mixed  good.stl: 60 x 40 x 30; 12 faces; 8 vertices; 0.00 / 0.00\n" in text
    assert all(f"{name}: " in text for name in reasons)
    assert objects.survey(listed) == (usable, text)


def test_a_deleted_file_is_left_out_and_named(folder):
    listed = objects.library(folder, cache=folder / "cache")
    (folder / "loose.obj").unlink()
    reason = "no such mesh file: restore it, or call objects.library() again to list the existing files"
    assert objects.bodies(listed, [3]) == ([], [("loose.obj", reason)])
