"""The lens: its model against closed forms and OpenCV, and images from raw to rectified and back."""

import dataclasses
import math

import calibration_images
import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import TypeCheckError
from recorded_session import LENS as SMALL
from recorded_session import drawn, raw
from scipy import ndimage

import sts_jax as sts
from sts_jax import hardware
from sts_jax.hardware import Lens, twin
from sts_jax.hardware import lens as lens_module

PINHOLE = sts.Sensor().camera
IDEAL = Lens.ideal(640, 480)
REAL = calibration_images.LENS
LENSES = pytest.mark.parametrize("lens", [IDEAL, REAL], ids=["ideal", "tilted and shifted"])


def pixel_of_point(lens, point):
    """The Kannala-Brandt model for one point, with the rotation by Rodrigues' formula applied to the vector."""
    v, p = np.array(lens.rotation), np.array(point)
    angle = math.sqrt(v @ v)
    axis = v / angle if angle else np.array([0.0, 0.0, 1.0])
    turned = p * math.cos(angle) + np.cross(axis, p) * math.sin(angle) + axis * (axis @ p) * (1 - math.cos(angle))
    x, y, z = turned + np.array(lens.translation)
    theta = math.acos(z / math.sqrt(x * x + y * y + z * z))
    phi = math.atan2(y, x)
    d = theta + sum(k * theta ** (3 + 2 * i) for i, k in enumerate(lens.k))
    return lens.fx * d * math.cos(phi) + lens.cx, lens.fy * d * math.sin(phi) + lens.cy


# ---- Model


@LENSES
def test_projection_equals_the_closed_form_and_opencv(lens):
    points = np.random.default_rng(0).uniform([-0.1, -0.1, -0.02], [0.1, 0.1, 0.1], (200, 3))
    expected = np.array([pixel_of_point(lens, point) for point in points])
    np.testing.assert_allclose(hardware.project(lens, points), expected, atol=1e-9)
    matrix = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])
    vectors = np.array(lens.rotation), np.array(lens.translation)
    expected, _ = cv2.fisheye.projectPoints(points[None], *vectors, matrix, np.array(lens.k))
    np.testing.assert_allclose(hardware.project(lens, points), expected[0], atol=1e-8)


def test_projection_of_a_point_beside_and_behind_the_camera():
    lens = Lens.ideal(100, 100, field_of_view=2 * math.pi)
    pixels = hardware.project(lens, np.array([[0.2, 0.0, -0.1], [0.2, 0.0, -0.3], [0.0, 0.0, -0.05]]))
    focal = math.hypot(100, 100) / (2 * math.pi)
    expected = [[49.5 + focal * math.pi / 2, 49.5], [49.5 + focal * 0.75 * math.pi, 49.5], [49.5, 49.5]]
    np.testing.assert_allclose(pixels, expected, atol=1e-9)


@LENSES
def test_directions_invert_the_projection_over_the_whole_image(lens):
    rows, columns = np.meshgrid(np.arange(0, 480, 7.0), np.arange(0, 640, 7.0), indexing="ij")
    pixels = np.stack([columns, rows], axis=-1)
    rays = lens_module.directions(lens, pixels)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1, atol=1e-12)
    np.testing.assert_allclose(lens_module.project_camera(lens, rays), pixels, atol=1e-4)


def test_a_polynomial_that_bends_back_is_used_up_to_its_largest_value():
    lens = dataclasses.replace(IDEAL, k=(-0.25, 0.0, 0.0, 0.0))
    largest = math.sqrt(1 / 0.75)
    assert lens.largest_angle == pytest.approx(largest)
    beyond = [0.1 * math.tan(largest + 0.01), 0, 0]
    within = [0.1 * math.tan(largest - 0.01), 0, 0]
    pixels = hardware.project(lens, np.array([beyond, within]))
    assert np.isnan(pixels[0]).all()
    assert np.isfinite(pixels[1]).all()
    assert np.isnan(hardware.distortion(lens, PINHOLE, (48, 64))[0, 0]).all()
    tilted = dataclasses.replace(IDEAL, rotation=(0.6, 0.0, 0.0))
    assert np.isnan(hardware.distortion(tilted, PINHOLE, (48, 64))).any()  # rays that do not meet the pad
    bent = dataclasses.replace(lens, k=(-0.6, 0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match=r"valid up to 42\.7 degrees .* calibrate the lens again"):
        hardware.rectification(bent, PINHOLE, (48, 64))


# ---- Maps


@LENSES
@pytest.mark.parametrize("resolution", [(60, 80), (64, 64)])
def test_rectification_passes_through_the_points_that_the_simulated_camera_sees(lens, resolution):
    window = sts.optics.full_window(PINHOLE, resolution)
    slopes = sts.optics.rays(PINHOLE, window, resolution)
    x, y = (PINHOLE.distance * np.asarray(slope, np.float64) for slope in slopes)
    points = np.stack([x, y, np.zeros_like(x)], axis=-1)
    pixels = hardware.rectification(lens, PINHOLE, resolution)
    for row, column in [(0, 0), (10, 50), (resolution[0] - 1, resolution[1] - 1)]:
        np.testing.assert_allclose(pixels[row, column], pixel_of_point(lens, points[row, column]), atol=2e-4)


@LENSES
def test_distortion_inverts_the_rectification(lens):
    resolution = (480, 640)
    raw = hardware.rectification(lens, PINHOLE, resolution)
    back = hardware.distortion(lens, PINHOLE, resolution)
    planes = [ndimage.map_coordinates(np.nan_to_num(back[..., i]), raw[..., ::-1].T, order=1).T for i in (0, 1)]
    mapped = np.stack(planes, axis=-1)[3:-3, 3:-3]
    inside = (np.abs(raw[3:-3, 3:-3] - [319.5, 239.5]) < [316, 236]).all(axis=-1)
    rows, columns = np.mgrid[3:477, 3:637]
    errors = np.abs(mapped - np.stack([columns, rows], axis=-1))[inside]
    assert inside.mean() > 0.95
    assert errors.max() < 0.01  # pixels: linear interpolation of the map


# ---- Images

IMAGE = np.zeros((480, 640, 3), np.uint8)


def smooth_image(resolution):
    y, x = np.mgrid[: resolution[0], : resolution[1]] / resolution[0]
    waves = [np.sin(9 * x + 2 * y), np.cos(7 * y - 3 * x), np.sin(5 * x) * np.cos(6 * y)]
    return (127.5 + 100 * np.stack(waves, axis=-1)).round().astype(np.uint8)


@LENSES
@pytest.mark.parametrize("resolution", [(480, 640), (256, 256)])
def test_a_smooth_image_survives_the_round_trip(lens, resolution):
    image = smooth_image(resolution)
    raw = hardware.distorted(lens, PINHOLE, image, outside=0)
    assert raw.dtype == np.uint8
    back = hardware.rectified(lens, PINHOLE, raw, resolution)
    difference = np.abs(back.astype(int) - image)[3:-3, 3:-3]  # without pixels that blend with the outside
    assert difference.max() <= 4
    assert difference.mean() < 0.7


@LENSES
def test_markers_on_the_pad_are_rectified_to_their_pixels(lens):
    y, x = np.mgrid[:480, :640].astype(float)
    window = sts.optics.full_window(PINHOLE, (480, 640))
    for point in ((0.0, 0.0), (-0.06, 0.055), (0.074, 0.01)):
        column, row = pixel_of_point(lens, (*point, 0.0))
        raw = (255 * np.exp(-((x - column) ** 2 + (y - row) ** 2) / (2 * 1.2**2))).round().astype(np.uint8)
        expected, _ = sts.optics.to_pixels(PINHOLE, window, (480, 640), jnp.array([[*point, 0.0]]))
        image = hardware.rectified(lens, PINHOLE, raw, (480, 640)).astype(float)
        centre = np.array([(image * x).sum(), (image * y).sum()]) / image.sum()
        np.testing.assert_allclose(centre, np.asarray(expected)[0], atol=0.1)


def test_small_images_are_means_and_show_no_aliasing():
    rows, columns = np.mgrid[:480, :640]
    stripes = np.where((rows + columns) % 2 == 0, 255, 0).astype(np.uint8)
    image = hardware.rectified(IDEAL, PINHOLE, stripes, (16, 16))
    assert np.abs(image.astype(int) - 127).max() < 12
    full = hardware.rectified(IDEAL, PINHOLE, smooth_image((480, 640)), (480, 480))
    small = hardware.rectified(IDEAL, PINHOLE, smooth_image((480, 640)), (48, 48))
    means = full.reshape(48, 10, 48, 10, 3).mean(axis=(1, 3))
    assert np.abs(means - small).max() < 1.5


def test_parts_that_the_camera_does_not_see_are_black_and_raw_pixels_beyond_the_view_have_the_outside_colour():
    image = np.full((480, 640, 3), 200, np.uint8)
    narrow = Lens.ideal(640, 480, field_of_view=math.radians(60))
    assert hardware.rectified(narrow, PINHOLE, image, (48, 64))[[0, 24], [0, 32], 0].tolist() == [0, 200]
    raw = hardware.distorted(IDEAL, PINHOLE, image, outside=(10, 20, 30))
    assert raw[0, 0].tolist() == [10, 20, 30]
    assert raw[240, 320].tolist() == [200, 200, 200]


# ---- Views of a predictor


def test_a_raw_pair_becomes_the_views_that_it_was_made_from():
    visual, tactile = drawn((10, 20), (60, 60, 60)), drawn((30, 40), (220, 90, 40))
    found = hardware.sensor_view(SMALL, PINHOLE, raw(visual), raw(tactile))
    for image, truth in ((found.visual, visual), (found.tactile, tactile)):
        assert image.dtype == np.float32
        inside = np.s_[4:-4, 4:-4]  # the raw image is coarser than the view, which blurs edges
        assert np.median(np.abs(image - truth / 255)[inside]) < 1e-6
        assert np.abs(image - truth / 255)[inside].mean() < 0.01
    assert np.abs(found.visual - tactile / 255).mean() > 0.008


def test_a_view_is_relit_by_the_ratio_of_the_empty_pads():
    random = np.random.default_rng(0)
    view, background, empty = (hardware.SensorView(*random.random((2, 8, 8, 3), np.float32)) for _ in range(3))
    found = hardware.relit(view, background, empty)
    for own, image, here, there in zip(found, view, background, empty, strict=True):
        for place in np.ndindex(image.shape):
            expected = min(image[place] * there[place] / max(here[place], 1 / 255), 1)
            assert own[place] == pytest.approx(expected, rel=1e-5)


@pytest.mark.slow
def test_the_view_of_a_twin_is_the_rendering_of_the_pose_and_gives_the_same_prediction():
    height, width = 480, 640
    sensor, predict, lens = sts.Sensor(), sts.Predictor.load("freefall"), hardware.Lens.ideal(width, height)
    ratios = []
    for seed in range(3):  # the prediction of one object may jump with the noise of its view
        body = sts.objects.make(jax.random.key(seed), "bottle")
        scene = twin.ObjectScene(body, sensor=sensor, resolution=(height, width), motion_rate=0.2)
        with twin.Twin(scene, lens=lens) as device:

            def view(device=device):
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
        frame = sts.sense(sensor, body, jnp.asarray(pose), wrench, resolution=(128, 128))
        lit = hardware.relit(found, background, hardware.SensorView(**predict.empty))
        for stream in ("visual", "tactile"):
            truth, image = np.asarray(getattr(frame, stream)), getattr(lit, stream)
            difference, wrong = 255 * np.abs(image - truth), 255 * np.abs(image[:, ::-1] - truth)
            print(f"{stream}: {difference.mean():.2f} of 255 on average, median {np.median(difference):.2f}")
            assert difference.mean() < 2
            assert np.median(difference) < 1.5  # noise of the frame and of the background
            assert wrong.mean() > 1.5 * difference.mean()
        plain, own, direct = (
            np.asarray(predict(visual=image).visual) for image in (found.visual, lit.visual, np.asarray(frame.visual))
        )
        apart, without = 255 * np.abs(own - direct).mean(), 255 * np.abs(plain - direct).mean()
        print(f"predictions: {apart:.2f} of 255 apart, {without:.2f} if the view is not relit")
        ratios.append(apart / without)
    assert np.median(ratios) < 1 / 3


# ---- Errors


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: dataclasses.replace(IDEAL, fx=-1.0), r"must be > 0, got Lens.*fx=-1\.0"),
        (lambda: dataclasses.replace(IDEAL, k=(0.0, math.nan, 0.0, 0.0)), "must be finite, got Lens.*nan"),
        (lambda: dataclasses.replace(IDEAL, translation=(0.0, 0.0, -0.1)), "from the sensor frame to the camera frame"),
        (lambda: dataclasses.replace(IDEAL, rotation=(math.pi, 0.0, 0.0)), "from the sensor frame to the camera frame"),
        (lambda: Lens.ideal(640, 480, field_of_view=160.0), r"field_of_view must be in \(0, 2 pi\] rad, got 160"),
        (lambda: hardware.rectified(IDEAL, PINHOLE, IMAGE[:50], (48, 64)), "640x50 pixels, but the lens .* 640x480"),
        (lambda: hardware.rectified(IDEAL, PINHOLE, IMAGE / 255, (48, 64)), "image"),
        (lambda: hardware.project(IDEAL, np.zeros((3, 2))), "points"),
    ],
)
def test_a_wrong_lens_or_image_is_named(make, message):
    with pytest.raises((ValueError, TypeCheckError), match=f"(?s){message}"):
        make()
