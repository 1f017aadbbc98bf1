"""The file of a commissioned sensor: contents, identity, damage, and loading it as a simulated sensor."""

import dataclasses
import json
import re
import shutil
from pathlib import Path

import jax
import numpy as np
import pytest
from damage import damaged
from PIL import Image

import sts_jax as sts
from sts_jax import hardware, storage
from sts_jax.hardware import Device, Lens

LENS = dataclasses.replace(Lens.ideal(64, 48), k=(-0.04, 0.012, -0.007, 0.0012), rotation=(0.01, -0.02, 0.0301))
DEVICE = Device(
    camera="/dev/v4l/by-id/usb-Maker_Camera_0123-video-index0",
    fps=30.0,
    leds="1A2B3C4D",
    lens=LENS,
    settle_on_s=0.043,
    settle_off_s=0.051,
    levels=(255, 255, 0, 128),
    commissioned="2026-05-31",
    exposure_visual=312.0,
    exposure_tactile=None,
)
SENSOR = sts.Sensor(camera=sts.optics.Camera(distance=0.12, fov=1.1))
DARK, LIT, NEW = (np.random.default_rng(seed).integers(0, 256, (48, 64, 3), dtype=np.uint8) for seed in range(3))


@pytest.fixture
def folder(tmp_path):
    DEVICE.save(tmp_path / "bench", SENSOR, (DARK, LIT))
    return tmp_path / "bench"


def test_a_loaded_device_equals_the_saved_one(folder):
    assert Device.load(folder) == Device.load(folder / "sensor.json") == DEVICE
    np.testing.assert_array_equal(DEVICE.backgrounds(folder), [DARK, LIT])
    with Image.open(folder / "background_visual.png") as image:  # red is first
        assert image.getpixel((0, 0)) == tuple(DARK[0, 0].tolist())


def test_the_file_is_also_that_of_a_simulated_sensor(tmp_path):
    DEVICE.save(tmp_path / "left.json", SENSOR)
    sensor = sts.Sensor.load(tmp_path / "left.json")
    for read, wrote in zip(jax.tree.leaves(sensor), jax.tree.leaves(SENSOR), strict=True):
        np.testing.assert_array_equal(read, wrote)
    assert DEVICE.backgrounds(tmp_path / "left.json") is None
    sensor.save(tmp_path / "other" / "sensor.json")
    with pytest.raises(ValueError, match=r"sensor\.json is incomplete or that of a simulated sensor"):
        Device.load(tmp_path / "other")


def test_on_a_full_disk_the_earlier_sensor_stays(small_disk):
    folder, ballast, plain = small_disk / "bench", small_disk / "ballast", np.zeros_like(DARK)  # small files
    DEVICE.save(folder, SENSOR, (plain, plain))
    ballast.write_bytes(bytes(shutil.disk_usage(small_disk).free - 16384))  # room for one of the new images
    with pytest.raises(OSError, match=r"cannot write .*bench: .*Free some disk space"):
        dataclasses.replace(DEVICE, settle_on_s=0.06).save(folder, SENSOR, (DARK, LIT))
    ballast.unlink()
    assert Device.load(folder) == DEVICE
    np.testing.assert_array_equal(DEVICE.backgrounds(folder), [plain, plain])
    assert not list(folder.glob(".*partial"))


def test_a_device_can_be_copied_and_saved_again_with_and_without_its_backgrounds(folder, tmp_path):
    assert hardware.copy_sensor(folder, tmp_path / "copy") == hardware.sensor_file.checksums(folder)
    slower = dataclasses.replace(DEVICE, settle_on_s=0.06)
    slower.save(folder, SENSOR)
    for path, device in ((folder, slower), (tmp_path / "copy", DEVICE)):
        assert Device.load(path) == device
        np.testing.assert_array_equal(device.backgrounds(path), [DARK, LIT])
    slower.save(folder, SENSOR, (DARK, NEW))
    np.testing.assert_array_equal(slower.backgrounds(folder), [DARK, NEW])


@pytest.mark.parametrize("name", ["sensor.json", "background_visual.png", "background_tactile.png", "manifest.json"])
def test_flipped_bits_and_truncated_missing_and_exchanged_files_are_named(folder, tmp_path, name):
    dataclasses.replace(DEVICE, fps=15.0).save(tmp_path / "other", SENSOR, (NEW, NEW))
    for kind in damaged(folder / name, tmp_path / "other" / name):
        named = "background_visual.png|sensor.json" if (name, kind) == ("manifest.json", "exchanged") else name
        for read in (Device.load, DEVICE.backgrounds):
            with pytest.raises((OSError, ValueError), match=rf"({named}).*experiments\.commission` again"):
                read(folder)
    assert Device.load(folder) == DEVICE


def test_an_interrupted_first_write_is_noticed_and_repeated(tmp_path, monkeypatch):
    rename = Path.replace

    def interrupted(path, target):
        if target.name == "manifest.json":
            raise KeyboardInterrupt
        rename(path, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", interrupted)
        with pytest.raises(KeyboardInterrupt):
            DEVICE.save(tmp_path, SENSOR, (DARK, LIT))
    with pytest.raises(ValueError, match="incomplete"):
        Device.load(tmp_path)
    DEVICE.save(tmp_path, SENSOR, (DARK, LIT))
    assert Device.load(tmp_path) == DEVICE


def test_another_camera_or_controller_is_refused_by_name():
    DEVICE.check_identity()
    DEVICE.check_identity(camera=DEVICE.camera, leds=DEVICE.leds)
    both = rf"camera {re.escape(DEVICE.camera)} and LED controller 1A2B3C4D, but the images are of "
    with pytest.raises(ValueError, match=both + r"camera /dev/video3 and LED controller 1A2B3C4D: load"):
        DEVICE.check_identity(camera="/dev/video3")
    with pytest.raises(ValueError, match=both + "camera /dev/video3 and LED controller FFFF"):
        DEVICE.check_identity(camera="/dev/video3", leds="FFFF")


def test_passwords_of_urls_are_not_kept(tmp_path):
    dataclasses.replace(DEVICE, camera="rtsp://user:secret@camera/live").save(tmp_path, SENSOR)
    assert "secret" not in (tmp_path / "sensor.json").read_text()
    loaded = Device.load(tmp_path)
    loaded.check_identity(camera="rtsp://other:word@camera/live")
    with pytest.raises(ValueError, match=r"camera rtsp://camera/live .* of camera rtsp://elsewhere/live"):
        loaded.check_identity(camera="rtsp://user:secret@elsewhere/live")


def test_a_password_with_an_at_sign_is_not_kept_either():
    kept = ("http://camera:80/a@b", "rtsp://camera/live?user=me@home")
    assert hardware.camera.public("http://user:p@ss@camera:80/a@b") == kept[0]
    assert [hardware.camera.public(url) for url in kept] == list(kept)


def load_edited(folder, **fields):
    """Load a sensor file whose fields a program has set, or deleted (...), and written with a new manifest."""
    path = folder / "sensor.json"
    values = json.loads(path.read_text())
    for name, value in fields.items():
        *above, last = name.split("__")
        inner = values["device"][above[0]] if above else values["device"]
        inner[last] = value
        if value is ...:
            del inner[last]
    path.write_text(json.dumps(values))
    storage.write_manifest(folder, storage.read_manifest(folder, "").files | storage.checksums(folder, [path.name]))
    return Device.load(folder)


def test_a_missing_field_takes_its_default(folder):
    loaded = load_edited(folder, focus=..., exposure_visual=..., lens_from=...)
    assert loaded == dataclasses.replace(DEVICE, exposure_visual=None)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"leds": ""}, r"device\.leds is ''"),
        ({"fps": 0}, r"device\.fps is 0: Input should be greater than 0"),
        ({"settle_off_s": float("nan")}, r"device\.settle_off_s"),
        ({"settle_on_s": 60.5}, r"device\.settle_on_s is 60\.5: Input should be less than 60"),
        ({"levels": [256, 0, 0, 0.5]}, r"device\.levels\[0\] is 256"),
        ({"commissioned": "yesterday"}, r"device\.commissioned is 'yesterday'"),
        ({"lens__fx": 10**400}, "must be finite"),
        ({"lens__cx": ...}, r"device\.lens\.cx is missing"),
        ({"colour": 1}, r"device\.colour is unknown"),
    ],
)
def test_a_wrong_field_is_named(folder, fields, message):
    with pytest.raises(ValueError, match=rf"sensor\.json: .*({message}).*experiments\.commission` again"):
        load_edited(folder, **fields)


def test_wrong_values_are_not_saved(tmp_path):
    with pytest.raises(ValueError, match=r"background has shape \(47, 64, 3\)"):
        DEVICE.save(tmp_path, SENSOR, (DARK[:-1], LIT[:-1]))
    with pytest.raises(ValueError, match=r"device\.fps is -1\.0"):
        dataclasses.replace(DEVICE, fps=-1.0).save(tmp_path, SENSOR)
    assert not (tmp_path / "sensor.json").exists()
