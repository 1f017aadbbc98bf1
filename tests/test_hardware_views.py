"""Views and images of recorded trajectories."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from recorded_session import LENS, SQUARE, drawn, raw, record

import sts_jax as sts
from sts_jax import hardware
from sts_jax.hardware import twin

CAMERA = sts.Sensor().camera


def test_a_raw_pair_becomes_the_views_that_it_was_made_from():
    visual, tactile = drawn((10, 20), (60, 60, 60)), drawn((30, 40), (220, 90, 40))
    found = hardware.sensor_view(LENS, CAMERA, raw(visual), raw(tactile))
    for image, truth in ((found.visual, visual), (found.tactile, tactile)):
        assert image.shape == (64, 64, 3)
        assert image.dtype == np.float32
        inside = np.s_[4:-4, 4:-4]  # the raw image is coarser than the view, which blurs edges
        assert np.median(np.abs(image - truth / 255)[inside]) < 1e-6
        assert np.abs(image - truth / 255)[inside].mean() < 0.01
    assert np.abs(found.visual - tactile / 255).mean() > 0.008


def test_recorded_images_are_rectified_in_the_order_of_the_trajectories(tmp_path):
    places = record(tmp_path / "work", 3)
    with hardware.Session(tmp_path / "work" / "dataset") as session:
        session.discard(1)
    recordings = hardware.load_recordings(tmp_path / "work" / "dataset")
    found = recordings.images(lambda image: hardware.rectified(LENS, CAMERA, image, (64, 64)))
    assert found.number.tolist() == [0, 2]
    assert found.visual.shape == found.tactile.shape == (2, 2, 64, 64, 3)
    for images, sign in ((found.visual, -1), (found.tactile, 1)):
        for ends, (row, column) in zip(images, places[[0, 2]], strict=True):
            for image, first in zip(ends, (row, row + 10), strict=True):
                change = sign * (image[..., 0].astype(float) - 170)
                centre = (first + (SQUARE - 1) / 2, column + (SQUARE - 1) / 2)
                np.testing.assert_allclose(np.argwhere(change > 25).mean(0), centre, atol=0.7)


def test_a_view_is_relit_by_the_ratio_of_the_empty_pads():
    random = np.random.default_rng(0)
    view, background, empty = (hardware.SensorView(*random.random((2, 8, 8, 3), np.float32)) for _ in range(3))
    found = hardware.relit(view, background, empty)
    for own, image, here, there in zip(found, view, background, empty, strict=True):
        for place in np.ndindex(image.shape):
            assert own[place] == pytest.approx(
                min(image[place] * there[place] / max(here[place], 1 / 255), 1), rel=1e-5
            )
    for own, there in zip(hardware.relit(background, background, empty), empty, strict=True):
        lit = (background.visual > 0.1) & (background.tactile > 0.1)
        np.testing.assert_allclose(own[lit], there[lit], rtol=1e-5)
    small = hardware.SensorView(*np.zeros((2, 4, 4, 3), np.float32))
    with pytest.raises(ValueError, match="broadcast"):
        hardware.relit(view, small, empty)


@pytest.mark.slow
def test_the_view_of_a_twin_is_the_rendering_of_the_pose_and_gives_the_same_prediction():
    height, width = 480, 640
    sensor, body = sts.Sensor(), sts.objects.make(jax.random.key(0), "camera")
    scene = twin.ObjectScene(body, sensor=sensor, resolution=(height, width), motion_rate=0.2)
    lens = hardware.Lens.ideal(width, height)
    with twin.Twin(scene, lens=lens) as device:

        def view():
            images = []
            for levels in ((0,) * 4, (255,) * 4):
                device.set(levels)
                device.step(0.2)
                exposure, image = device.capture()
                images.append(image)
            return exposure.pose, hardware.sensor_view(lens, sensor.camera, *images, (128, 128))

        empties = [view()[1] for _ in range(10)]
        device.command("hold")
        pose, found = view()
    background = hardware.SensorView(*(np.mean(images, axis=0) for images in zip(*empties, strict=True)))
    wrench = jnp.asarray(scene._motion(0).wrench[0])
    predict = sts.Predictor.load("freefall")
    frame = sts.sense(sensor, body, jnp.asarray(pose), wrench, resolution=(128, 128))
    lit = hardware.relit(found, background, hardware.SensorView(**predict.empty))
    for stream in ("visual", "tactile"):
        truth, image = np.asarray(getattr(frame, stream)), getattr(lit, stream)
        difference = 255 * np.abs(image - truth)
        wrong = 255 * np.abs(image[:, ::-1] - truth)
        print(f"{stream}: {difference.mean():.2f} of 255 on average, median {np.median(difference):.2f}")
        assert difference.mean() < 2
        assert np.median(difference) < 1.5  # noise of the frame and of the background
        assert wrong.mean() > 1.5 * difference.mean()
    plain, own, direct = (
        np.asarray(predict(visual=image).visual) for image in (found.visual, lit.visual, np.asarray(frame.visual))
    )
    apart, without = 255 * np.abs(own - direct).mean(), 255 * np.abs(plain - direct).mean()
    print(f"predictions: {apart:.2f} of 255 apart, {without:.2f} if the view is not relit")
    assert apart < without / 3
