"""The file of a sensor, and the checks of its constants."""

import contextlib
import copy
import dataclasses
import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from damage import damaged
from optics_bodies import at, ball, weight, with_field

from sts_jax import Sensor, sense, storage, tactile


def test_the_defaults_equal_the_papers_values():
    sensor = Sensor()
    assert (sensor.gel.size, sensor.gel.thickness, sensor.camera.distance) == ((0.15, 0.15), 0.005, 0.1)
    phong = sensor.phong
    assert (phong.specular, phong.diffuse, phong.ambient, phong.shininess) == (0.5, 1.0, 0.8, 5.0)
    assert np.tan(sensor.camera.fov / 2) == pytest.approx(0.75)
    assert isinstance(sensor.lights, tactile.Lights)
    sensor.check()
    # LEDs may be in front of the gel, beside it and behind the pinhole.
    places = jnp.array([[0.0, 0, -0.0051], [0.0751, 0, -0.001], [0, 0, -0.15]])
    dataclasses.replace(sensor, lights=tactile.Leds(positions=places, colors=jnp.ones((3, 3)))).check()


LEDS = tactile.Leds(
    positions=jnp.array([[0.1, 0.0, -0.002], [0.0, 0.07, -0.0123]]),
    colors=jnp.array([[0.1, 0.2, 0.3], [1.0, 0.0, 0.7]]),
    falloff=1.5,
    reference=0.0987,
)


@pytest.mark.parametrize("lights", [tactile.Lights(), LEDS], ids=["Lights", "Leds"])
def test_a_loaded_sensor_equals_the_saved_one(tmp_path, lights):
    sensor = Sensor()
    gel = dataclasses.replace(sensor.gel, stiffness=5e5, cells=(100, 120))
    skin = tactile.Skin(coupling=0.0003, shadow_steps=12, shadow_reach=0.01, penumbra=0.3)
    markers = tactile.Markers(pitch=0.004) if lights is LEDS else None
    sensor = dataclasses.replace(sensor, gel=gel, fine_below=0, lights=lights, skin=skin, markers=markers)
    sensor.save(tmp_path / "sensor.json")
    loaded = Sensor.load(tmp_path / "sensor.json")
    assert jax.tree.structure(loaded) == jax.tree.structure(sensor)
    for wrote, read in zip(jax.tree.leaves(sensor), jax.tree.leaves(loaded), strict=True):
        assert np.array_equal(wrote, read)
    values = json.loads((tmp_path / "sensor.json").read_text())
    assert ("markers" in values) == (markers is not None)
    assert values["skin"] == {"coupling": 0.0003, "shadow_steps": 12, "shadow_reach": 0.01, "penumbra": 0.3}


LEDS_FILE = {"lights": {"kind": "Leds", "positions": [[0.1, 0, -0.002]], "colors": [[1, 1, 1]]}}
# A field of a file, and an invalid value for it.
INVALID = [
    ("gel.stiffness", "3"),
    ("gel.size", [0.15]),
    ("gel.max_depth", 0.006),
    ("camera.distance", 0.003),
    ("camera", None),
    ("housing", {}),
    ("lights.positions", [[0.1, 0, -0.02]]),  # unknown to Lights
    ("lights.directions", [[0, 0, 0]] * 4),
]
MARKERS_FILE = {"markers": {"pitch": 0.004, "radius": 0.002}}
INVALID_MARKERS = [
    ("markers.radius", 0.0021),  # dots that overlap
    ("markers.pitch", [0.004]),
    ("markers.size", 0.1),
    ("markers", 3),
]
INVALID_LEDS = [
    ("lights.positions", [[0.0, 0, -0.004]]),  # in the gel, over the pad
    ("lights.positions", [[0.075, 0.075, 0.0]]),  # at its corner
    ("lights.positions", [[0.1, 0, 0.001]]),  # beside the pad, above the gel's face
]


@pytest.mark.parametrize(
    ("start", "field", "value"),
    [
        *((Sensor().constants(), *row) for row in INVALID),
        *((LEDS_FILE, *row) for row in INVALID_LEDS),
        *((MARKERS_FILE, *row) for row in INVALID_MARKERS),
    ],
)
def test_an_invalid_or_unknown_field_in_a_file_raises_an_error_that_names_it(tmp_path, start, field, value):
    path, values = tmp_path / "sensor.json", copy.deepcopy(start)
    path.write_text(json.dumps(values))
    Sensor.load(path)
    *above, last = field.split(".")
    functools.reduce(dict.__getitem__, above, values)[last] = value
    path.write_text(json.dumps(values))
    with pytest.raises(ValueError, match=f"sensor.json: .*{field}"):
        Sensor.load(path)


@pytest.mark.parametrize("field", ["gel.thickness", "skin", "lights", "lights.kind", "fine_below"])
def test_a_missing_field_in_a_file_takes_its_default(tmp_path, field):
    sensor = Sensor(gel=tactile.Gel(stiffness=5e5))
    path, values = tmp_path / "sensor.json", sensor.constants()
    *above, last = field.split(".")
    del functools.reduce(dict.__getitem__, above, values)[last]
    path.write_text(json.dumps(values))
    assert Sensor.load(path).constants() == sensor.constants()


def limited_fields():
    sensor = Sensor(lights=tactile.Leds(), markers=tactile.Markers())
    parts = [part.name for part in dataclasses.fields(sensor) if part.name != "fine_below"]
    beyond = {"above": (">", 0), "at_least": (">=", -1), "below": ("<", 1), "at_most": ("<=", 1)}
    for part in parts:
        for field in dataclasses.fields(getattr(sensor, part)):
            for limit in beyond.keys() & field.metadata.keys():
                sign, step = beyond[limit]
                yield part, field.name, field.metadata[limit] + step, sign


@pytest.mark.parametrize(("part", "name", "number", "sign"), sorted(limited_fields()))
def test_every_range_is_checked(tmp_path, part, name, number, sign):
    sensor = Sensor(lights=tactile.Leds(), markers=tactile.Markers())
    field = getattr(getattr(sensor, part), name)
    wrong = jax.tree.map(lambda x: jnp.full_like(x, number) if isinstance(x, jax.Array) else type(x)(number), field)
    with pytest.raises(ValueError, match=rf"(?s)field {part}\.{name} is .*, but it must be {sign} "):
        with_field(sensor, f"{part}.{name}", wrong).save(tmp_path / "sensor.json")
    assert list(tmp_path.iterdir()) == []


def test_a_damaged_or_missing_file_and_an_unusable_path_are_named(tmp_path):
    path = tmp_path / "sensor.json"
    with pytest.raises(FileNotFoundError, match=r"sensor\.json"):
        Sensor.load(path)
    Sensor().save(path)
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(OSError, match=r"sensor\.json cannot be read as JSON .* write it again with Sensor\.save"):
        Sensor.load(path)
    with pytest.raises(OSError, match=r"cannot write .*sensor\.json/below"):
        Sensor().save(path / "below")


def test_flipped_bits_of_a_saved_sensor_are_found_and_edited_files_are_accepted_on_request(tmp_path):
    path = tmp_path / "sensor.json"
    Sensor().save(path)
    for _ in damaged(path):
        with contextlib.suppress(OSError, ValueError):
            assert Sensor.load(path).constants() == Sensor().constants()  # a flip in white space
    values = json.loads(path.read_text())
    values["gel"]["stiffness"] = 5e5
    path.write_text(json.dumps(values))
    with pytest.raises(OSError, match=r"sensor\.json is damaged or was edited .*delete the field `checksum` to accept"):
        Sensor.load(path)
    del values["checksum"]
    path.write_text(json.dumps(values))
    assert float(Sensor.load(path).gel.stiffness) == 5e5
    storage.write_manifest(tmp_path, storage.checksums(tmp_path, ["sensor.json"]))
    path.write_text(json.dumps(values) + " ")
    with pytest.raises(OSError, match=r"sensor\.json is not the file that manifest\.json lists"):
        Sensor.load(path)
    (tmp_path / "manifest.json").write_text("of another program")
    Sensor.load(path)


@pytest.mark.slow
@pytest.mark.parametrize("width", [0.0375, 0.04, 0.6])
def test_a_similar_body_under_the_same_force_gives_the_same_images_on_a_similar_sensor(width):
    like = Sensor(lights=tactile.Leds(), skin=tactile.Skin(coupling=0.0007, shadow_steps=4), markers=tactile.Markers())

    def frame(sensor, scale):
        body = ball()
        body = dataclasses.replace(body, vertices=body.vertices * scale, hulls=body.hulls * scale)
        placement = at(0.012 * scale, -0.02 * scale, 0.0305 * scale, (0.9, 0, 0, 0.4))
        wrench = weight(1, 0.012 * scale, -0.02 * scale) + jnp.array([-0.5, 0.3, 0, 0, 0, -0.006 * scale])
        return sense(sensor, body, placement, wrench, resolution=(32, 32))

    scale, first = width / 0.15, frame(like, 1)
    second = frame(Sensor.sized(width, like=like), scale)
    assert first.balanced
    assert second.balanced
    assert float(first.pressure.max()) > 1000
    assert float(first.shear.max()) > 0.0005
    assert np.array_equal(first.segmentation, second.segmentation)
    pairs = {
        "visual": (first.visual, second.visual),
        "tactile": (first.tactile, second.tactile),
        "depth": (first.depth, second.depth / scale),
        "pressure": (first.pressure / 1e4, second.pressure / 1e4 * scale**2),
        "position": (first.pose[:3], second.pose[:3] / scale),
        "shear": (first.shear, second.shear / scale),
        "window": (first.window, second.window / scale),
    }
    exact = width == 0.0375  # a power of two
    for name, (one, other) in pairs.items():
        np.testing.assert_allclose(one, other, atol=1e-6 if exact else 1e-4, err_msg=name)


def test_a_sensor_of_the_default_size_is_the_default_and_a_stretched_one_shows_its_whole_pad():
    for one, other in zip(jax.tree.leaves(Sensor()), jax.tree.leaves(Sensor.sized(0.15)), strict=True):
        assert np.array_equal(one, other)
    tall = Sensor.sized(0.02, 0.04, like=Sensor(lights=tactile.Leds()))
    tall.check()
    assert tall.gel.size == (pytest.approx(0.02), 0.04)
    assert tall.camera.distance * np.tan(tall.camera.fov / 2) == pytest.approx(0.02)
    assert tall.camera.aspect == pytest.approx(4 / 3 / 2)
    assert tall.gel.cells == (212, 106)
    assert np.allclose(tall.lights.positions[:, :2], [[-0.014, 0], [0.014, 0], [0, -0.028], [0, 0.028]])


@pytest.mark.parametrize(
    ("size", "name"), [((40,), "width"), ((0,), "width"), ((-0.04,), "width"), ((0.04, 30), "height")]
)
def test_a_size_that_is_not_positive_or_in_millimetres_raises_an_error(size, name):
    with pytest.raises(ValueError, match=rf"{name} must be from 0.001 to 1 m, got {size[-1]}: .* in metres, not"):
        Sensor.sized(*size)
