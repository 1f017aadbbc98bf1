import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

import sts_jax as sts
from experiments import sense
from experiments.shared import laying

pytestmark = pytest.mark.slow

TINY = (24, 32)


@pytest.fixture
def box(tmp_path):
    path = tmp_path / "box.stl"
    trimesh.creation.box((0.04, 0.03, 0.02)).export(path)
    return path


def test_all_streams_of_a_class_in_one_picture(tmp_path, capsys):
    out = tmp_path / "bottle.png"
    config = sense.Config("bottle", out=out, resolution=TINY)
    sense.main(config)
    lines = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"bottle: \d+ x \d+ x \d+ mm, \d+ faces", lines[0])
    assert re.match(
        r"on face 0 of the \d+ that it can rest on \(share [\d.]+\); [\d.]+ kg, pressed by [\d.]+ N", lines[1]
    )
    imprint = re.fullmatch(r"deepest imprint ([\d.]+) mm, contact area (\d+) mm2, balanced", lines[2])
    assert imprint is not None
    assert 0 < float(imprint[1]) < 3
    assert int(imprint[2]) > 0
    assert lines[3] == str(out)

    with Image.open(out) as picture:
        assert picture.size == (1020, 560)
        assert len(picture.convert("RGB").getcolors(picture.size[0] * picture.size[1])) > 100


def test_a_file_is_pressed_by_its_weight(box, tmp_path, capsys):
    config = sense.Config(str(box), out=tmp_path / "box.png", resolution=TINY, mass=0.2, crop=True)
    body, sensor = laying.read(config, sts.Sensor(), str(box)), sts.Sensor()
    frame, _, words = sense.look(config, sensor, body)
    assert "0.2 kg, pressed by 1.96 N" in words
    assert float(frame.pressure.sum()) * 1e-6 == pytest.approx(0.2 * laying.G, rel=0.005)
    # its largest face, 40 x 30 mm, by p = k d
    assert "deepest imprint 0.82 mm, contact area 1200 mm2, balanced" in words
    assert bool(frame.balanced)
    harder = dataclasses.replace(config, force=3.0)
    assert float(sense.look(harder, sensor, body)[0].pressure.sum()) * 1e-6 == pytest.approx(3.0, rel=0.005)


def test_the_object_lies_at_the_configured_place(box):
    config = sense.Config(str(box), mass=0.1, position=(0.02, -0.01), turn=90.0)
    body = laying.read(config, sts.Sensor(), str(box))

    def corners(config):
        pose, wrench, words = laying.lay(config, sts.Sensor(), body)
        w, x, y, z = pose[3:]
        return Rotation.from_quat([x, y, z, w]).apply(np.asarray(body.vertices, float)) + pose[:3], wrench, words

    points, wrench, _ = corners(config)
    np.testing.assert_allclose(np.ptp(points, axis=0), [0.03, 0.04, 0.02], atol=1e-6)
    np.testing.assert_allclose((points.min(0) + points.max(0)) / 2, [0.02, -0.01, 0.01], atol=1e-6)
    np.testing.assert_allclose(wrench, [0, 0, 0.981, -0.01 * 0.981, -0.02 * 0.981, 0], atol=1e-5)

    points, _, _ = corners(dataclasses.replace(config, rest=2, turn=0.0))
    assert np.ptp(points[:, 2]) == pytest.approx(0.03, abs=1e-6)  # on one of the second largest pair of faces

    points, wrench, words = corners(dataclasses.replace(config, tilt=(10.0, 0.0), height=0.03))
    assert points[:, 2].min() == pytest.approx(0.03, abs=1e-6)
    assert not np.any(wrench)
    assert "tilted by 10 and 0 degrees" in words
    assert "30.0 mm over the gel" in words
    # about x, whatever the turn about the vertical
    height = 0.02 * np.cos(np.deg2rad(10)) + 0.03 * np.sin(np.deg2rad(10))
    assert np.ptp(corners(dataclasses.replace(config, tilt=(10.0, 0.0), turn=0.0))[0][:, 2]) == pytest.approx(height)


def test_a_sheet_shows_all_classes(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sts.objects, "CATEGORIES", ("fork", "watch"))
    sense.main(sense.Config("classes", out=tmp_path / "classes.png", resolution=TINY))
    with Image.open(tmp_path / "classes.png") as picture:
        assert picture.size == (2040, 280)
    assert capsys.readouterr().out.count("deepest imprint") == 2


def test_markers_move_under_a_force_and_a_moment_that_friction_carries(box, tmp_path, capsys):
    config = sense.Config(str(box), out=tmp_path / "box.png", resolution=TINY, mass=0.1, markers=0.01)
    sense.main(config)
    loads = re.search(
        r"0.981 N down, and ([\d.]+) N to the right, and ([\d.]+) N m about the vertical: the skin moves by up to "
        r"([\d.]+) mm, balanced",
        capsys.readouterr().out,
    )
    assert loads is not None
    assert float(loads[1]) == pytest.approx(0.8 * 0.8 * 0.981, rel=0.01)  # share, friction, weight
    # The mean distance of the points of a 40 x 30 mm rectangle from its centre is 13.5 mm.
    assert float(loads[2]) == pytest.approx(float(loads[1]) * 0.0135, rel=0.02)
    assert 0 < float(loads[3]) < 2
    with Image.open(tmp_path / "box.png") as picture:
        assert picture.size == (1020, 840)
    with pytest.raises(ValueError, match="--markers needs a contact, but the force is 0 N: give a larger --force"):
        sense.main(dataclasses.replace(config, force=0.0))


def test_a_sensor_of_a_file_is_used(box, tmp_path, capsys):
    sensor, path = sts.Sensor(), tmp_path / "soft.json"
    dataclasses.replace(sensor, gel=dataclasses.replace(sensor.gel, stiffness=1e6)).save(path)
    sense.main(sense.Config(str(box), out=tmp_path / "a.png", resolution=TINY, mass=0.1, sensor=path))
    assert "deepest imprint 0.82 mm" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mesh": "teapot"}, r"teapot is neither a file nor an object class \(bottle, camera"),
        ({"resolution": (0, 64)}, r"--resolution is \(0, 64\), but it must be from 1 to 8,192"),
        ({"mass": 0.0}, "mass is 0.0, but it must be > 0"),
        ({"force": -1.0}, "--force is -1.0, but it must be from 0 to "),
        ({"light": 1.5}, "light is 1.5"),
        ({"rest": 99}, r"--rest is 99, but it must be the index of a face, from 0 to \d+"),
        ({"mesh": "bottle", "longest_side": 0.1}, "--longest-side is for mesh files, but bottle is an object class"),
        ({"sensor": "none.json"}, r"none\.json"),
    ],
)
def test_an_invalid_option_is_refused_before_a_picture_is_written(box, tmp_path, monkeypatch, changes, message):
    monkeypatch.chdir(tmp_path)
    changes = {"mesh": str(box), "out": tmp_path / "a.png", "resolution": TINY} | changes
    config = sense.Config(**{**changes, "out": Path(changes["out"])})
    with pytest.raises((ValueError, OSError), match=message):
        sense.main(config)
    assert not (tmp_path / "a.png").exists()
