"""Calibration of lens and pad from images of a board that a known lens sees."""

import dataclasses
import math
import re

import calibration_images
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

import sts_jax as sts
from sts_jax import hardware
from sts_jax.hardware import Board, Lens

PINHOLE = sts.Sensor().camera
BOARD = Board()
TRUE = calibration_images.LENS
# Board to camera: rotation vector (rad), position of the board's centre (m). In the first pose it lies on the pad.
POSES = [
    (TRUE.rotation, TRUE.translation),
    ((0.5, 0.0, 0.0), (0.0, 0.0, 0.15)),
    ((-0.5, 0.1, 0.0), (0.03, 0.01, 0.15)),
    ((0.0, 0.5, 0.2), (-0.03, 0.0, 0.14)),
    ((0.1, -0.5, 0.1), (0.04, 0.0, 0.14)),
    ((0.3, 0.3, 1.5), (0.0, -0.03, 0.13)),
    ((-0.3, 0.4, 0.0), (-0.05, 0.05, 0.13)),
    ((0.4, -0.3, 0.0), (0.05, 0.05, 0.14)),
    ((0.1, -0.1, 3.1), (0.07, -0.05, 0.13)),
    ((-0.2, 0.5, 0.3), (-0.08, -0.04, 0.14)),
    ((0.2, -0.5, 0.3), (0.09, 0.0, 0.13)),
]


@pytest.fixture(scope="module")
def rays():
    return calibration_images.camera_rays(TRUE)


@pytest.fixture(scope="module")
def printed():
    return calibration_images.printed(BOARD)


@pytest.fixture(scope="module")
def images(rays, printed):
    return [calibration_images.board_view(rays, *printed, *pose) for pose in POSES]


@pytest.fixture(scope="module")
def noisy(images):
    rng = np.random.default_rng(0)
    return [calibration_images.degraded(image, rng) for image in images]


def board_pixels(pose):
    """Exact raw pixels of the board's corners."""
    rotation, translation = pose
    matrix = Rotation.from_rotvec(rotation).as_matrix()
    return hardware.lens.project_camera(TRUE, BOARD.corners @ matrix.T + translation)


# ---- The board


def test_the_page_shows_the_board_at_the_stated_dimensions():
    page = hardware.board_image(BOARD)
    assert page.shape == (2970, 2100)
    board = page[100 + 30 : 100 + 30 + 1440, 300 + 30 : 300 + 30 + 1440]  # 10 pixels per mm, in the middle of the frame
    np.testing.assert_array_equal(board, calibration_images.printed(BOARD)[0])
    assert (page[99, 299:1801] == 160).all()  # the frame of 150 mm
    assert (page[100:1600, [299, 1800]] == 160).all()
    ruler = (page[1610:] == 0).sum(axis=1) == 1000  # 100 mm
    assert ruler.sum() == 5
    found = hardware.find_board(page, BOARD)
    corners = BOARD.corners[found.numbers][:, :2] * 10_000 + [1049.5, 849.5]
    assert len(found.numbers) == 64
    np.testing.assert_allclose(found.pixels, corners, atol=0.1)


def test_the_board_is_written_at_its_true_size(tmp_path):
    hardware.save_board(tmp_path / "board.png", BOARD)
    with Image.open(tmp_path / "board.png") as picture:
        assert picture.size == (2100, 2970)
        assert picture.info["dpi"] == pytest.approx((254, 254), abs=0.01)
    hardware.save_board(tmp_path / "board.pdf", BOARD)
    box = re.search(rb"/MediaBox \[ ?0 0 ([0-9.]+) ([0-9.]+)", (tmp_path / "board.pdf").read_bytes())
    assert box is not None
    size_mm = [float(side) / 72 * 25.4 for side in box.groups()]
    assert size_mm == pytest.approx([210, 297], abs=0.01)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["board.pdf", "board.png"]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: hardware.board_image(Board(square=0.025)), "225 mm x 225 mm, but must fit in the frame of 150 mm"),
        (lambda: hardware.save_board("board.tiff"), r"path must end in \.pdf or \.png, got board\.tiff"),
        (lambda: Board(marker=0.02), "marker < square"),
        (lambda: Board(12, 12, 0.012, 0.009), "needs 72 markers, but the dictionary DICT_4X4_50 has 50"),
        (lambda: Board(rows=2), "rows must be >= 4, got 9 and 2"),
    ],
)
def test_boards_that_do_not_exist_or_fit_raise_errors(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("index", [0, 6])
def test_corners_are_found_where_the_lens_shows_them(images, noisy, index):
    for image, mean_limit in ((images[index], 0.25), (noisy[index], 0.3)):
        found = hardware.find_board(image, BOARD)
        errors = np.linalg.norm(found.pixels - board_pixels(POSES[index])[found.numbers], axis=-1)
        assert len(found.numbers) > 40
        assert errors.mean() < mean_limit
    assert len(hardware.find_board(np.full((480, 640, 3), 90, np.uint8)).numbers) == 0


# ---- The fit


def calibrate(images, **options):
    return hardware.fit_lens([hardware.find_board(image, BOARD) for image in images], (640, 480), BOARD, **options)


def assert_recovered(calibration, *, view_error, position_error):
    """Compare raw pixels over the sensor's view (pixels) and the places of camera and pad (m)."""
    lens = calibration.lens
    np.testing.assert_allclose([lens.fx, lens.fy], [TRUE.fx, TRUE.fy], rtol=0.003)
    np.testing.assert_allclose([lens.cx, lens.cy], [TRUE.cx, TRUE.cy], atol=0.8)
    np.testing.assert_allclose(lens.translation, TRUE.translation, atol=position_error)
    np.testing.assert_allclose(lens.center, TRUE.center, atol=position_error)
    np.testing.assert_allclose(lens.rotation, TRUE.rotation, atol=math.radians(0.15))
    maps = [hardware.rectification(which, PINHOLE, (48, 64)) for which in (lens, TRUE)]
    assert np.linalg.norm(maps[0] - maps[1], axis=-1).max() < view_error


def test_blur_and_noise_give_back_the_lens_and_a_marker_on_the_pad(noisy, rays, printed):
    calibration = calibrate(noisy)
    assert max(calibration.errors) < 0.35
    assert np.sqrt(np.mean(np.square(calibration.errors))) < 0.3
    assert math.degrees(calibration.largest_angle) > 50
    assert_recovered(calibration, view_error=0.3, position_error=5e-4)
    raw = calibration_images.board_view(rays, *printed, *POSES[0])
    corners = hardware.find_board(hardware.rectified(calibration.lens, PINHOLE, raw, (480, 640)), BOARD)
    expected = BOARD.corners[corners.numbers][:, :2] / 0.15 * 480 + [319.5, 239.5]  # 0.15 m is the height of the view
    assert len(corners.numbers) == 64
    assert np.linalg.norm(corners.pixels - expected, axis=-1).max() < 1.0


def test_a_board_that_lies_on_the_pad_in_another_orientation_gives_the_same_pad(images, rays, printed):
    turn = Rotation.from_euler("z", math.pi / 2)
    rotation = (Rotation.from_rotvec(TRUE.rotation) * turn).as_rotvec()
    turned = calibration_images.board_view(rays, *printed, rotation, TRUE.translation)
    empty = np.full((480, 640), 90, np.uint8)
    colour = [np.repeat(image[..., None], 3, axis=-1) for image in [*images[1:], turned, empty]]
    calibration = calibrate(colour, on_pad=10)
    assert (calibration.errors[-1], calibration.corners[-1]) == (None, 0)
    assert_recovered(calibration, view_error=0.2, position_error=2e-4)


def corners_of(lens, poses, noise, rng, project=None):
    """The corners of boards in given poses (board to camera) that lie in the image, with noise in pixels."""
    found = []
    for rotation, translation in poses:
        points = BOARD.corners @ Rotation.from_rotvec(rotation).as_matrix().T + translation
        pixels = (project or hardware.lens.project_camera)(lens, points)
        pixels = pixels + noise * rng.standard_normal(pixels.shape)
        inside = ((pixels > 2) & (pixels < [lens.width - 3, lens.height - 3])).all(axis=-1)
        found.append(hardware.FoundCorners(np.flatnonzero(inside), pixels[inside]))
    return found


def pad_points():
    """Points all over the pad (m), shape (64, 3)."""
    x, y = np.meshgrid(np.linspace(-0.075, 0.075, 8), np.linspace(-0.075, 0.075, 8))
    return np.stack([x.ravel(), y.ravel(), np.zeros(64)], axis=-1)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 4))])
def test_lenses_of_all_fields_of_view_are_recovered(seed):
    rng = np.random.default_rng(seed)
    width, height = [(640, 480), (1640, 1232)][seed % 2]
    ideal = Lens.ideal(width, height, field_of_view=math.radians(rng.uniform(115, 200)))
    lens = dataclasses.replace(
        ideal,
        cx=ideal.cx + 0.02 * width * rng.uniform(-1, 1),
        cy=ideal.cy + 0.02 * width * rng.uniform(-1, 1),
        fy=ideal.fy * rng.uniform(0.98, 1.02),
        k=tuple(np.array([0.08, 0.03, 0.01, 0.002]) * rng.uniform(-1, 1, 4)),
        rotation=tuple(rng.uniform(-0.15, 0.15, 3)),
        translation=(*rng.uniform(-0.01, 0.01, 2), rng.uniform(0.09, 0.12)),
    )
    poses = [(lens.rotation, lens.translation)]
    for x, y in [(x, y) for x in (-0.05, 0, 0.05) for y in (-0.04, 0, 0.04)]:
        poses.append((rng.uniform(-0.5, 0.5, 3), (x, y, rng.uniform(0.12, 0.16))))
    calibration = hardware.fit_lens(corners_of(lens, poses, 0.1, rng), (width, height), BOARD)
    np.testing.assert_allclose(max(calibration.errors), 0.14, atol=0.04)  # 0.1 pixels in both directions
    errors = hardware.project(calibration.lens, pad_points()) - hardware.project(lens, pad_points())
    assert np.linalg.norm(errors, axis=-1).max() < 0.3
    np.testing.assert_allclose(calibration.lens.center, lens.center, atol=4e-4)


def refracted(lens, points, thickness=0.005, index=1.41):
    """Project points of the camera frame through a gel in front of an untilted camera: a slab with parallel faces."""
    radius = np.hypot(points[:, 0], points[:, 1])
    low, high = np.zeros_like(radius), np.full_like(radius, 1.55)
    for _ in range(60):
        middle = (low + high) / 2
        within = np.tan(np.arcsin(np.sin(middle) / index))
        near = (points[:, 2] - thickness) * np.tan(middle) + thickness * within < radius
        low, high = np.where(near, middle, low), np.where(near, high, middle)
    rays = np.stack([np.sin(low) * points[:, 0] / radius, np.sin(low) * points[:, 1] / radius, np.cos(low)], axis=-1)
    return hardware.lens.project_camera(lens, rays)


def test_the_refraction_of_the_gel_becomes_a_part_of_the_lens():
    rng, lens = np.random.default_rng(0), Lens.ideal(640, 480)
    poses = [(lens.rotation, lens.translation)] + [
        (rng.uniform(-0.4, 0.4, 3), (x, y, rng.uniform(0.14, 0.17))) for x in (-0.05, 0, 0.05) for y in (-0.04, 0, 0.04)
    ]
    found = corners_of(lens, poses, 0.05, rng, refracted)
    calibration = hardware.fit_lens(found, (640, 480), BOARD)
    points = pad_points()
    seen = refracted(lens, points + lens.translation)
    ignored, remaining = (
        np.linalg.norm(hardware.project(used, points) - seen, axis=-1).max() for used in (lens, calibration.lens)
    )
    assert ignored > 2
    assert remaining < 0.3
    assert 0.001 < lens.translation[2] - calibration.lens.translation[2] < 0.0025  # the pad appears nearer


# ---- Errors


def exact(poses):
    return corners_of(TRUE, poses, 0.0, np.random.default_rng(0))


SHIFTS = [(0, 0, 0.103), (0.02, 0, 0.13), (-0.03, 0, 0.14), (0, 0.03, 0.15), (0, -0.03, 0.12), (0, 0, 0.2)]
LOST = hardware.FoundCorners(np.arange(5), np.zeros((5, 2)))  # too few corners


def torn(corners):
    """The third board is torn: half of its corners are displaced by 6 pixels."""
    pixels = corners[3].pixels.copy()
    pixels[::2] += 6
    return [*corners[:3], dataclasses.replace(corners[3], pixels=pixels), *corners[4:]]


@pytest.mark.parametrize(
    ("corners", "on_pad", "message"),
    [
        (exact(POSES[:2]), 0, "2 of 2 images show at least 12 corners of the board, but 6 must"),
        ([*exact(POSES[:3]), LOST, *exact(POSES[4:6])], 0, r"5 of 6 .*: 3 \(5 corners\)\. Check that `board`"),
        ([*exact(POSES), LOST], 11, r"with image 11 of the board on the pad\. Too few corners: 11 \(5 corners\)"),
        (exact(POSES[:6]), 6, r"on_pad must be the index of an image, got 6 .*images: 6"),
        (torn(exact(POSES)), 0, r"exceeds 1 pixels in images 3 \(.* pixels\): leave"),
        (exact([((0.0, 0.0, 0.0), shift) for shift in SHIFTS]), 0, r"by only \d+ degrees.*tilt the board by 20 to 40"),
        (exact([POSES[0], ((0.7, 0.0, 0.0), (0.0, 0.0, 0.15)), *POSES[2:8]]), 1, "image 1 is tilted by 40 and"),
        (exact([POSES[0], ((0.0, 0.0, 0.7), (0.0, 0.0, 0.15)), *POSES[2:8]]), 1, "and turned by -?40 degrees"),
    ],
)
def test_images_that_do_not_determine_the_lens_are_named(corners, on_pad, message):
    with pytest.raises(ValueError, match=message):
        hardware.fit_lens(corners, (640, 480), BOARD, on_pad=on_pad)
