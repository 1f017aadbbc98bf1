"""`real collect --twin`, and the sensor file of a work directory."""

import math

import numpy as np
import pytest

import sts_jax as sts
from experiments import real
from experiments.shared import collecting
from experiments.shared.collecting import Collect, Hand, commissioned, started
from sts_jax import hardware
from sts_jax.hardware import twin

SMALL = {"size": (240, 180), "guide": hardware.GuideConfig(empty_s=0.3, hold_s=0.3, rest_s=0.5)}


def ends(workdir):
    """The images of both ends by the number of the trajectory, as numbers."""
    read = hardware.load_recordings(workdir / "dataset")
    return {t.number: np.array([t.initial.visual.image, t.final.visual.image], float) for t in read}


@pytest.mark.slow
def test_an_interrupted_collection_of_the_twin_equals_an_uninterrupted_one(tmp_path, monkeypatch, capsys):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    collecting.collect(Collect(whole, twin=True, count=5, **SMALL))
    show = Hand.show

    def interrupted(self, view):
        show(self, view)
        if view.confirmed == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(Hand, "show", interrupted)
    with pytest.raises(KeyboardInterrupt):
        collecting.collect(Collect(parts, twin=True, count=5, **SMALL))
    monkeypatch.undo()
    kept = {path: path.read_bytes() for path in parts.rglob("*.png")}
    real.main(Collect(parts, twin=True, count=5, **SMALL))
    assert all(path.read_bytes() == content for path, content in kept.items())

    one, two = ends(whole), ends(parts)
    assert list(one) == list(two) == [0, 1, 2, 3, 4]
    for number, images in two.items():
        assert np.abs(images - one[number]).mean() < 2  # the noise differs
        others = [np.abs(images - other).mean() for name, other in one.items() if name != number]
        assert min(others) > 2 * np.abs(images - one[number]).mean()

    capsys.readouterr()
    real.main(Collect(parts, twin=True, count=5, **SMALL))
    assert "has 5 trajectories already" in capsys.readouterr().err
    for options, message in (
        ({"seed": 1}, "give --seed 0"),
        ({"size": (320, 240)}, "is for images of 240 x 180 pixels"),
    ):
        with pytest.raises(SystemExit, match=message):
            real.main(Collect(parts, twin=True, count=6, **{**SMALL, **options}))


@pytest.mark.slow
def test_the_sensor_file_of_the_twin_rectifies_to_the_simulated_view(tmp_path):
    config = Collect(tmp_path, size=(320, 240))
    with started(config, 0) as device:
        sensor, empty = commissioned(config, device)
        pair = sensor.read()
        device.command("hold")
        held, pose = sensor.read(), device.state.pose
    made = hardware.Device.load(tmp_path)
    assert sts.Sensor.load(tmp_path / "sensor.json").constants() == sts.Sensor().constants()
    assert (made.lens.width, made.lens.height, made.leds, made.lens_from) == (320, 240, "TWIN0", "ideal")
    for shot in (pair.visual, pair.tactile):
        background = made.backgrounds(tmp_path)[shot.stream == "tactile"]
        assert np.abs(background - shot.image.astype(float)).mean() < 2
    assert np.abs(empty.mean.visual - sts.hardware.sts.thumbnail(pair.visual.image)).mean() < 1
    # The object's middle, seen through the lens of the file, lies at the place of its pose.
    dark = np.abs(made.backgrounds(tmp_path)[0] - held.visual.image.astype(float)).mean(-1)
    mask = np.repeat((255 * (dark > 30)).astype(np.uint8)[..., None], 3, -1)
    view = hardware.rectified(made.lens, sts.Sensor().camera, mask, (96, 96))
    rows, columns = np.nonzero(view[..., 0] > 127)
    side = 2 * float(sts.Sensor().camera.distance) * 0.75
    middle = (np.array([columns.mean(), rows.mean()]) + 0.5) / 96 * side - side / 2
    assert math.dist(middle, pose[:2]) < 0.035


@pytest.fixture
def file(tmp_path):
    """A sensor file of a real device, with backgrounds."""
    lens, levels = hardware.Lens.ideal(32, 24), (255, 255, 255, 255)
    device = hardware.Device("/dev/v4l/by-id/camera", 30.0, "0123", lens, 0.1, 0.1, levels, "2026-05-31")
    images = [np.full((24, 32, 3), level, np.uint8) for level in (40, 90)]
    device.save(tmp_path / "bench.json", sts.Sensor(), tuple(images))
    return tmp_path / "bench.json"


def test_a_work_directory_keeps_its_sensor_file(file, tmp_path):
    workdir = tmp_path / "run"
    workdir.mkdir()
    for _ in range(2):
        collecting.keep(file, workdir)
        file_content = file.read_bytes()
        assert (workdir / "sensor.json").read_bytes() == file_content
        assert hardware.Device.load(workdir).backgrounds(workdir)[1].mean() == 90
    device, image = hardware.Device.load(file), np.full((24, 32, 3), 91, np.uint8)
    other = sts.Sensor(camera=sts.optics.Camera(distance=0.12))
    for sensor, images in ((other, None), (sts.Sensor(), (image, image))):
        device.save(file, sensor, images)
        with pytest.raises(ValueError, match=r"sensor\.json differs from .*bench\.json.*choose another --workdir"):
            collecting.keep(file, workdir)
    assert hardware.Device.load(workdir).backgrounds(workdir)[1].mean() == 90


def test_a_work_directory_of_a_device_is_not_continued_by_the_twin(file, tmp_path):
    workdir = tmp_path / "run"
    workdir.mkdir()
    collecting.keep(file, workdir)
    with (
        twin.Twin(twin.Picture(np.zeros((24, 32, 3)), np.ones((24, 32, 3)))) as device,
        pytest.raises(ValueError, match="LED controller TWIN0"),
    ):
        commissioned(Collect(workdir, size=(32, 24)), device)
