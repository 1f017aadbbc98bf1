"""The file of a commissioned sensor: contents, identity, damage, and loading it as a simulated sensor."""

import dataclasses
import json
import re

import jax
import numpy as np
import pytest
from PIL import Image

import sts_jax as sts
from sts_jax import hardware
from sts_jax.hardware import Device, Lens, SensorFileError, WrongDeviceError

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


def background(seed):
    return np.random.default_rng(seed).integers(0, 256, (48, 64, 3), dtype=np.uint8)


def saved(folder, device=DEVICE):
    sensor = sts.Sensor(camera=sts.optics.Camera(distance=0.12, fov=1.1))
    return device.save(folder, sensor.constants(), visual=background(0), tactile=background(1))


def change(path, edit):
    values = json.loads(path.read_text())
    edit(values)
    path.write_text(json.dumps(values))


def test_a_loaded_device_equals_the_saved_one(tmp_path):
    written = saved(tmp_path / "bench")
    folder = tmp_path / "bench"
    assert sorted(path.name for path in folder.iterdir()) == [
        "background_tactile.png",
        "background_visual.png",
        "sensor.json",
    ]
    assert Device.load(folder) == Device.load(folder / "sensor.json") == written
    names = dataclasses.replace(written, background_visual=None, background_tactile=None)
    assert names == DEVICE
    assert (written.width, written.height) == (64, 48)
    np.testing.assert_array_equal(written.background(folder, "visual"), background(0))
    np.testing.assert_array_equal(written.background(folder / "sensor.json", "tactile"), background(1))
    with Image.open(folder / "background_visual.png") as image:  # red is first
        assert image.getpixel((0, 0)) == tuple(background(0)[0, 0].tolist())


def test_the_file_is_also_that_of_a_simulated_sensor(tmp_path):
    path = tmp_path / "left.json"
    saved(path)
    sensor = sts.Sensor.load(path)
    expected = sts.Sensor(camera=sts.optics.Camera(distance=0.12, fov=1.1))
    for read, wrote in zip(jax.tree.leaves(sensor), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(read, wrote)
    sensor.save(tmp_path / "plain.json")
    assert "device" not in json.loads((tmp_path / "plain.json").read_text())
    with pytest.raises(SensorFileError, match=r"plain\.json describes no device.*experiments\.commission"):
        Device.load(tmp_path / "plain.json")


def test_a_device_can_be_saved_again_with_its_backgrounds(tmp_path):
    written = saved(tmp_path)
    constants = sts.Sensor.load(tmp_path / "sensor.json").constants()
    again = dataclasses.replace(written, settle_on_s=0.06).save(tmp_path, constants)
    assert again == Device.load(tmp_path)
    assert again.settle_on_s == 0.06
    assert again.background_visual == written.background_visual
    replaced = again.save(tmp_path, constants, tactile=background(2))
    np.testing.assert_array_equal(replaced.background(tmp_path, "tactile"), background(2))
    assert replaced.background_visual == written.background_visual
    with pytest.raises(SensorFileError, match=r"background_visual\.png cannot be read"):
        again.save(tmp_path / "elsewhere", constants)
    assert not (tmp_path / "elsewhere").exists()


def test_an_interrupted_write_leaves_the_earlier_file(tmp_path, monkeypatch):
    written = saved(tmp_path)

    def full(path, content):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("sts_jax.storage.write_json", full)
    with pytest.raises(OSError, match="No space left"):
        dataclasses.replace(written, fps=60.0).save(tmp_path, sts.Sensor().constants())
    assert Device.load(tmp_path) == written


def test_another_camera_or_controller_is_refused_by_name():
    camera, leds = DEVICE.camera, DEVICE.leds
    DEVICE.check_identity()
    DEVICE.check_identity(camera=camera, leds=leds)
    both = rf"describes camera {re.escape(camera)} and LED controller {leds}, but the connected sensor has "
    with pytest.raises(WrongDeviceError, match=both + r"camera /dev/video3\. Load the .*experiments\.commission"):
        DEVICE.check_identity(camera="/dev/video3", leds=leds)
    with pytest.raises(WrongDeviceError, match=both + "LED controller FFFF"):
        DEVICE.check_identity(camera=camera, leds="FFFF")
    with pytest.raises(WrongDeviceError, match=both + "camera /dev/video3 and LED controller FFFF"):
        DEVICE.check_identity(camera="/dev/video3", leds="FFFF")


def test_passwords_of_urls_are_not_kept(tmp_path):
    device = dataclasses.replace(DEVICE, camera="rtsp://user:secret@camera/live")
    saved(tmp_path, device)
    assert "secret" not in (tmp_path / "sensor.json").read_text()
    loaded = Device.load(tmp_path)
    assert loaded.camera == "rtsp://camera/live"
    loaded.check_identity(camera="rtsp://other:word@camera/live")
    with pytest.raises(WrongDeviceError) as error:
        loaded.check_identity(camera="rtsp://user:secret@elsewhere/live")
    assert "secret" not in str(error.value)


def test_another_version_is_refused(tmp_path):
    saved(tmp_path)
    change(tmp_path / "sensor.json", lambda values: values["device"].update(version=2))
    with pytest.raises(SensorFileError, match=r"sensor\.json has format 2 .* reads format 1\. Use the version"):
        Device.load(tmp_path)
    sts.Sensor.load(tmp_path / "sensor.json")


@pytest.mark.parametrize("size", [0, 10, 700, -2])
def test_a_truncated_file_is_refused(tmp_path, size):
    saved(tmp_path)
    path = tmp_path / "sensor.json"
    path.write_bytes(path.read_bytes()[:size].rstrip(b"\n}"))
    with pytest.raises(SensorFileError, match=r"sensor\.json cannot be read as JSON .*experiments\.commission` again"):
        Device.load(path)
    with pytest.raises(FileNotFoundError):
        Device.load(tmp_path / "missing.json")


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("leds", None, r"device\.leds is None: Input should be a valid string"),
        ("leds", "", "leds must not be empty"),
        ("fps", 0, "fps must be > 0"),
        ("fps", "30", "device.fps is '30': Input should be a valid number"),
        ("settle_on_s", -0.1, r"settle_on_s must be in \(0, 60\) s"),
        ("settle_off_s", float("nan"), "settle_off_s must be finite, got nan"),
        ("levels", [255, 255, 0], r"device\.levels\[3\] is missing"),
        ("levels", [255, 255, 0, 0.5], r"device\.levels\[3\] is 0\.5: Input should be a valid integer"),
        ("levels", [0, 0, 0, 0], "not all 0"),
        ("levels", [256, 0, 0, 0], r"in 0\.\.255"),
        ("commissioned", "yesterday", "commissioned must be a date"),
        ("exposure_visual", True, "exposure_visual is True"),
        ("lens", 3, r"device\.lens is 3: Input should be an object"),
        ("lens.k", [0, 0], r"device\.lens\.k\[2\] is missing"),
        ("lens.fx", -1, r"fx must be > 0"),
        ("lens.fx", 10**400, "fx must be a finite int or float, got inf"),
        ("lens.width", 64.0, r"device\.lens\.width is 64\.0: Input should be a valid integer"),
        ("background_visual.sha256", "0" * 63, "64 hexadecimal digits"),
        ("background_visual.name", "../a.png", "file name without a folder"),
        ("colour", 1, r"device\.colour is unknown"),
        ("lens.cx", ..., r"device\.lens\.cx is missing"),
        ("camera", ..., r"device\.camera is missing"),
    ],
)
def test_a_damaged_field_is_named(tmp_path, path, value, message):
    saved(tmp_path)

    def edit(values):
        *above, last = path.split(".")
        inner = values["device"]
        for key in above:
            inner = inner[key]
        if value is ...:
            del inner[last]
        else:
            inner[last] = value

    change(tmp_path / "sensor.json", edit)
    with pytest.raises(SensorFileError, match=rf"sensor\.json: .*({message}).*experiments\.commission` again"):
        Device.load(tmp_path)


def test_a_damaged_or_missing_background_is_named(tmp_path):
    device = saved(tmp_path)
    path = tmp_path / "background_tactile.png"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    for read in (Device.load, lambda folder: device.background(folder, "tactile")):
        with pytest.raises(SensorFileError, match=r"background_tactile\.png differs.* damaged or belongs to another"):
            read(tmp_path)
    path.unlink()
    with pytest.raises(SensorFileError, match=r"background_tactile\.png cannot be read .*Copy the image"):
        Device.load(tmp_path)
    with pytest.raises(SensorFileError, match="has no visual background"):
        DEVICE.background(tmp_path, "visual")


def test_wrong_arguments_raise_errors(tmp_path):
    constants = sts.Sensor().constants()
    with pytest.raises(ValueError, match=r"visual background must be a raw image, uint8 of shape \(48, 64, 3\)"):
        DEVICE.save(tmp_path, constants, visual=background(0)[:-1])
    with pytest.raises(ValueError, match="constants must be the constants of a simulated sensor"):
        DEVICE.save(tmp_path, {})
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(ValueError, match="fps must be > 0 and finite, got -1"):
        dataclasses.replace(DEVICE, fps=-1.0)


def test_all_public_names_exist():
    assert all(hasattr(hardware, name) for name in hardware.__all__)
