"""The command `experiments.gap` on sessions and datasets."""

import dataclasses

import numpy as np
import pytest
from session_writer import pair

import sts_jax as sts
from experiments import gap as command
from sts_jax import dataset, hardware, physics

SIZE = (96, 128)


def write(folder, numbers, shift=0):
    """A session of random images, which follow from the number of the trajectory."""
    origin = hardware.Origin("camera", "0123", SIZE[1], SIZE[0], (255, 255, 255, 255))
    with hardware.Session(folder, origin) as session:
        while (number := session.begin()) <= max(numbers):
            if number not in numbers:
                continue
            for end in ("initial", "final"):
                made = pair(number + shift, end, SIZE)
                session.save(number, end, made)
            session.confirm(number)
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write(tmp_path_factory.mktemp("real") / "dataset", range(7))


def config(real, simulated, tmp_path, **options):
    return command.Config(real, simulated, out=tmp_path / "out", resolution=SIZE, **options)


def test_equal_sessions_have_no_gap(folder, tmp_path, capsys):
    command.main(config(folder, folder, tmp_path))
    printed = capsys.readouterr().out
    assert (tmp_path / "out" / "gap.txt").read_text() == printed
    assert (tmp_path / "out" / "gap.png").stat().st_size > 10_000
    rows = {line[:42].strip(): line[42:].split() for line in printed.splitlines()}
    assert rows["mean absolute error (of 255)"] == ["0.00", "[0.00,", "0.00]"] * 2
    assert rows["SSIM"][0] == "1.000"
    assert float(rows["same, for another trajectory: MAE"][0]) == pytest.approx(85, abs=2)  # of independent values
    assert rows["accuracy of a classifier (0.5: chance)"][0] == "0.500"


def test_trajectories_are_matched_by_their_number(folder, tmp_path):
    other = write(tmp_path / "other", (1, 2, 4, 5, 6, 9))
    real, simulated = command.load(config(folder, other, tmp_path))
    assert list(real.group) == [1, 1, 2, 2, 4, 4, 5, 5, 6, 6]
    for stream in ("visual", "tactile"):
        np.testing.assert_array_equal(getattr(real, stream), getattr(simulated, stream))
    np.testing.assert_array_equal(real.visual[2], pair(2, "initial", SIZE).visual.image)
    np.testing.assert_array_equal(real.tactile[3], pair(2, "final", SIZE).tactile.image)


def test_sides_without_a_match_share_no_group(folder, tmp_path, capsys):
    command.main(config(folder, write(tmp_path / "other", range(5), shift=50), tmp_path, match="none"))
    printed = capsys.readouterr().out
    assert "not matched" in printed
    assert "absolute" not in printed
    real, simulated = command.load(config(folder, tmp_path / "other", tmp_path, match="none"))
    assert not set(real.group) & set(simulated.group)


def test_raw_images_are_rectified_with_the_lens_of_the_sensor_file(folder, tmp_path):
    lens = hardware.Lens.ideal(SIZE[1], SIZE[0])
    device = hardware.Device("camera", 30.0, "0123", lens, 0.1, 0.1, (255, 255, 255, 255), "2026-05-31")
    device.save(tmp_path, sts.Sensor())
    real, simulated = command.load(config(folder, folder, tmp_path, sensor=tmp_path))
    raw = pair(3, "final", SIZE).tactile.image
    np.testing.assert_array_equal(real.tactile[7], hardware.rectified(lens, sts.Sensor().camera, raw, SIZE))
    np.testing.assert_array_equal(simulated.tactile[7], raw)
    dataclasses.replace(device, leds="4567").save(tmp_path / "other", sts.Sensor())
    with pytest.raises(ValueError, match=r"LED controller 4567, but the images are of .* LED controller 0123"):
        command.load(config(folder, folder, tmp_path, simulated_sensor=tmp_path / "other"))


def test_a_rectified_image_is_reduced_to_its_centre():
    image = np.zeros((96, 128, 3), np.uint8)
    image[:, 16:112] = 200  # the largest centred square
    np.testing.assert_array_equal(command.centred(image, (64, 64)), np.full((64, 64, 3), 200, np.uint8))


def test_missing_packages_are_named_before_any_work(folder, tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ImportError, match="pip install scikit-learn"):
        command.main(config(folder, folder, tmp_path))
    assert not (tmp_path / "out").exists()


def test_bad_options_are_refused(folder, tmp_path):
    with pytest.raises(FileNotFoundError, match="holds no session"):
        command.load(config(tmp_path / "nothing", folder, tmp_path))
    with pytest.raises(ValueError, match="give --match none"):
        command.load(config(folder, write(tmp_path / "later", (20, 21)), tmp_path))
    with pytest.raises(ValueError, match="resolution must be at least 64 x 64"):
        command.load(dataclasses.replace(config(folder, folder, tmp_path), resolution=(32, 64)))
    with pytest.raises(ValueError, match="rows must be >= 1, got 0"):
        command.main(config(folder, folder, tmp_path, rows=0))
    with pytest.raises(ValueError, match=r"few must have at least 5 trajectories in common, got 3"):
        command.main(config(folder, write(tmp_path / "few", range(3)), tmp_path))
    (tmp_path / "made").mkdir()
    (tmp_path / "made" / "collection.json").write_text("{}")
    with pytest.raises(ValueError, match="is a dataset"):
        command.load(config(folder, tmp_path / "made", tmp_path))
    (tmp_path / "sensor.json").write_text("{}")
    with pytest.raises(ValueError, match="that of a simulated sensor"):
        command.load(config(folder, folder, tmp_path, sensor=tmp_path))


@pytest.mark.slow
def test_a_dataset_is_compared_without_a_match_at_its_own_resolution(folder, tmp_path, capsys):
    collection = dataset.Collection(physics.Released(frames=6), categories=("camera",), num_objects=5, num_per_object=1)
    dataset.collect(collection, sts.Sensor(), tmp_path / "made")
    options = command.Config(folder, tmp_path / "made", match="none", out=tmp_path / "out")
    real, simulated = command.load(options)
    assert real.visual.shape == (14, 64, 64, 3)
    pairs = dataset.load(tmp_path / "made").pairs(np.array([2]))
    np.testing.assert_array_equal(simulated.visual[4:6], pairs.visual[0])
    np.testing.assert_array_equal(simulated.tactile[4:6], pairs.tactile[0])
    command.main(options)
    assert "not matched, compared at 64 x 64" in capsys.readouterr().out
    with pytest.raises(ValueError, match=r"resolution is \(96, 128\), but the images of .* have the size \(64, 64\)"):
        command.load(dataclasses.replace(options, resolution=SIZE))
