"""Views and moments of recorded trajectories."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from recorded_session import LENS, SQUARE, drawn, pair, raw, record

import sts_jax as sts
from sts_jax import hardware
from sts_jax.hardware import twin

CAMERA = sts.Sensor().camera


def test_a_raw_pair_becomes_the_views_that_it_was_made_from():
    visual, tactile = drawn((10, 20), (60, 60, 60)), drawn((30, 40), (220, 90, 40))
    found = hardware.sensor_view(LENS, CAMERA, pair(raw(visual), raw(tactile)))
    for image, truth in ((found.visual, visual), (found.tactile, tactile)):
        assert image.shape == (64, 64, 3)
        assert image.dtype == np.float32
        inside = np.s_[4:-4, 4:-4]  # the raw image is coarser than the view, which blurs edges
        assert np.median(np.abs(image - truth / 255)[inside]) < 1e-6
        assert np.abs(image - truth / 255)[inside].mean() < 0.01
    assert np.abs(found.visual - tactile / 255).mean() > 0.008


def test_moments_are_in_the_order_of_the_trajectories(tmp_path):
    places = record(tmp_path / "work", 3)
    hardware.discard_recording(tmp_path / "work" / "dataset", 1)
    seen = []
    found = hardware.moments(
        hardware.load_recordings(tmp_path / "work" / "dataset"),
        LENS,
        CAMERA,
        progress=lambda done, total: seen.append((done, total)),
    )
    assert found.number.tolist() == [0, 2]
    assert found.visual.shape == found.tactile.shape == (2, 2, 64, 64, 3)
    assert seen == [(1, 2), (2, 2)]
    for images, sign in ((found.visual, -1), (found.tactile, 1)):
        for own, (row, column) in zip(images, places[[0, 2]], strict=True):
            for moment, first in zip(own, (row, row + 10), strict=True):
                change = sign * (moment[..., 0].astype(float) - 170)
                there = np.argwhere(change > 25)
                centre = (first + (SQUARE - 1) / 2, column + (SQUARE - 1) / 2)
                np.testing.assert_allclose(there.mean(0), centre, atol=0.7)


def test_the_identity_changes_with_the_confirmed_trajectories(tmp_path):
    record(tmp_path / "work", 2)
    folder = tmp_path / "work" / "dataset"
    before = hardware.load_recordings(folder).identity
    assert hardware.load_recordings(folder).identity == before
    hardware.discard_recording(folder, 1)
    without = hardware.load_recordings(folder).identity
    hardware.restore_recording(folder, 1)
    assert hardware.load_recordings(folder).identity == before != without


def test_images_of_another_size_than_the_lens_are_refused(tmp_path):
    record(tmp_path / "work", 1)
    lens = dataclasses.replace(LENS, width=640, height=480)
    with pytest.raises(ValueError, match="images of 128x96 pixels, but the lens belongs to images of 640x480"):
        hardware.moments(hardware.load_recordings(tmp_path / "work" / "dataset"), lens, CAMERA)


@pytest.mark.slow
def test_the_view_of_a_twin_is_the_rendering_of_the_pose_and_gives_the_same_prediction():
    height, width = 480, 640
    sensor, body = sts.Sensor(), sts.objects.make(jax.random.key(0), "camera")
    scene = twin.ObjectScene(body, sensor=sensor, resolution=(height, width), motion_rate=0.2)
    lens = hardware.Lens.ideal(width, height)
    # The simulated sensor has no vignetting and no leakage.
    flaws = twin.Imperfections(vignetting=0.0, leakage=0.0)
    shots = []
    with twin.Twin(scene, imperfections=flaws, warp=twin.lens_warp(lens, sensor.camera, (height, width))) as device:
        device.command("hold")
        for levels in ((0,) * 4, (255,) * 4):
            device.set(levels)
            device.step(0.2)
            shots.append(device.capture())
    pose = jnp.asarray(shots[0][0].pose)
    frame = sts.sense(sensor, body, pose, resolution=(128, 128))
    found = hardware.sensor_view(lens, sensor.camera, pair(*(image for _, image in shots)), (128, 128))
    inside = np.s_[3:-3, 3:-3]  # beyond the view, a raw pixel is dark
    difference = np.abs(found.visual - np.asarray(frame.visual))[inside]
    print(f"visual: mean {255 * difference.mean():.2f}, 99 % below {255 * np.quantile(difference, 0.99):.1f} of 255")
    assert difference.mean() < 1.5 / 255
    assert np.quantile(difference, 0.99) < 20 / 255  # outlines
    wrong = np.abs(found.visual[:, ::-1] - np.asarray(frame.visual))[inside]
    assert wrong.mean() > 4 * difference.mean()
    predict = sts.Predictor.load("freefall", resolution=(128, 128))
    own, direct, empty = (
        np.asarray(predict(visual=image).visual)
        for image in (found.visual, np.asarray(frame.visual), np.full((128, 128, 3), 0.7, np.float32))
    )
    apart, scale = np.abs(own - direct).mean(), np.abs(empty - direct).mean()
    print(f"predictions: {255 * apart:.2f} of 255 apart, {255 * scale:.2f} from that of a grey image")
    assert apart < scale / 3
