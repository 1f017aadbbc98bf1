"""A sensor's file: whole, readable, refused with a named field."""

import dataclasses
import json

import jax
import numpy as np
import pytest

from sts_jax import Sensor


def test_the_defaults_are_the_papers():
    sensor = Sensor()
    assert sensor.gel.size == (0.15, 0.15)
    assert sensor.gel.thickness == 0.005
    phong = sensor.phong
    assert (phong.specular, phong.diffuse, phong.ambient, phong.shininess) == (0.5, 1.0, 0.8, 5.0)
    assert np.tan(sensor.camera.fov / 2) == pytest.approx(0.75)
    assert sensor.camera.distance == 0.1


def test_saved_and_loaded_are_equal(tmp_path):
    sensor = Sensor()
    gel = dataclasses.replace(sensor.gel, stiffness=5e5, cells=(100, 120))
    sensor = dataclasses.replace(sensor, gel=gel, fine_below=0)
    sensor.save(tmp_path / "sensor.json")
    loaded = Sensor.load(tmp_path / "sensor.json")
    assert jax.tree.structure(loaded) == jax.tree.structure(sensor)
    for wrote, read in zip(jax.tree.leaves(sensor), jax.tree.leaves(loaded), strict=True):
        assert np.array_equal(wrote, read)
    assert [p.name for p in tmp_path.iterdir()] == ["sensor.json"]


def change(values, path, value):
    *above, last = path.split(".")
    for key in above:
        values = values[key]
    if value is None:
        del values[last]
    else:
        values[last] = value


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("gel.stiffness", 0),
        ("gel.stiffness", "soft"),
        ("gel.thickness", None),
        ("gel.size", [0.15]),
        ("gel.cells", [0, 150]),
        ("gel.colour", 1),
        ("camera.distance", -0.1),
        ("camera.fov", 3.5),
        ("camera", 3),
        ("lights.directions", [[0, 1]]),
        ("lights.directions", [[0, 0, float("nan")]]),
        ("lights.directions", [[0, 0, 1.0]] * 3),
        ("gel.cells", [0.5, 150]),
        ("phong.ambient_color", [1, 1, 1, 1]),
    ],
)
def test_a_bad_field_is_named(tmp_path, field, value):
    path = tmp_path / "sensor.json"
    Sensor().save(path)
    values = json.loads(path.read_text())
    change(values, field, value)
    path.write_text(json.dumps(values))
    with pytest.raises(ValueError, match=field) as error:
        Sensor.load(path)
    assert str(path) in str(error.value)


def test_a_torn_or_missing_file_is_named(tmp_path):
    path = tmp_path / "sensor.json"
    with pytest.raises(FileNotFoundError, match=r"sensor\.json"):
        Sensor.load(path)
    Sensor().save(path)
    path.write_text(path.read_text()[:200])
    with pytest.raises(ValueError, match=r"sensor\.json is torn"):
        Sensor.load(path)
