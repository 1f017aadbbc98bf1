from pathlib import Path

import numpy as np
import pytest
import shapenet_folder as shapenet
import trimesh
from object_files import box, same_points, surface, volume

from sts_jax import objects
from sts_jax.objects.colors import linear

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
    (folder / "metadata.csv").write_text(f"{header}\n{line.replace('0.0254', '')}\n")
    with pytest.raises(ValueError, match=r"contains no usable mesh.*\n  a: the row of the model .* has no unit"):
        objects.library(tmp_path)


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


def test_a_larger_object_is_scaled_down_with_a_note(tmp_path):
    listed = only(tmp_path, box((3, 2, 20)))
    entry = objects.read(listed, 0)
    np.testing.assert_allclose(np.ptp(np.asarray(entry.body.vertices), axis=0), [0.018, 0.012, 0.12], rtol=1e-5)
    assert entry.notes == ("the longest side of 0.508 m is scaled down to 0.12 m",)


def test_cutlery_is_solid_and_of_steel(tmp_path):
    fork = objects.read(only(tmp_path, box((1, 4, 0.2)), category="Fork"), 0).body
    area = 2 * (4 + 0.2 + 0.8) * INCH**2
    for fill in (0.0, 1.0):
        np.testing.assert_allclose(objects.rigid(fork, fill, 1.0)[0], 5.9 * area, rtol=1e-5)


def test_missing_columns_are_named(tmp_path):
    shapenet.build(tmp_path, [], {})
    shapenet.table(tmp_path, [], [name for name in shapenet.COLUMNS if name not in ("unit", "front")])
    with pytest.raises(ValueError, match=r"metadata\.csv: the table lacks columns of ShapeNetSem \(front, unit\)"):
        objects.library(tmp_path)
    shapenet.table(tmp_path, [], [name for name in shapenet.COLUMNS if name != "fullId"])
    (tmp_path / "models-OBJ").rename(tmp_path / "models")  # known by its columns alone
    with pytest.raises(ValueError, match=r"metadata\.csv: the table lacks columns of ShapeNetSem \(fullId\)"):
        objects.library(tmp_path)
