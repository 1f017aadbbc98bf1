"""Geometry of the pinhole against values computed by hand."""

import jax.numpy as jnp
import numpy as np
import pytest

from sts_jax import optics

pytestmark = pytest.mark.usefixtures("strict_ranks")

CAMERA = optics.Camera()


@pytest.mark.parametrize(
    ("resolution", "window"),
    [
        ((480, 640), (-0.1, -0.075, 0.2, 0.15)),  # the native aspect ratio shows the whole view
        ((64, 64), (-0.075, -0.075, 0.15, 0.15)),  # a square image shows the pad from edge to edge
        ((50, 200), (-0.1, -0.025, 0.2, 0.05)),
    ],
)
def test_an_image_shows_the_largest_centred_part(resolution, window):
    np.testing.assert_allclose(optics.full_window(CAMERA, resolution), window, atol=1e-6)


def test_projection_equals_that_of_a_pinhole():
    window = optics.full_window(CAMERA, (64, 64))
    points = jnp.array([[0.0, 0, 0], [-0.075, -0.075, 0], [0.03, 0.0, 0.0], [0.03, 0.06, 0.1]])
    pixels, depth = optics.to_pixels(CAMERA, window, (64, 64), points)
    np.testing.assert_allclose(pixels, [[31.5, 31.5], [-0.5, -0.5], [44.3, 31.5], [37.9, 44.3]], atol=1e-4)
    np.testing.assert_allclose(depth, [0.1, 0.1, 0.1, 0.2], rtol=1e-6)


@pytest.mark.parametrize("shape", [(64, 64), (97, 53)])
def test_rays_are_the_inverse_of_projection(shape):
    window = jnp.array([-0.02, 0.01, 0.03, 0.04])
    slopes = np.stack(optics.rays(CAMERA, window, shape), -1)
    points = jnp.concatenate([0.17 * slopes, jnp.full((*shape, 1), 0.07)], -1).reshape(-1, 3)
    pixels, _ = optics.to_pixels(CAMERA, window, shape, points)
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    np.testing.assert_allclose(pixels[:, 0], columns.ravel(), atol=1e-3)
    np.testing.assert_allclose(pixels[:, 1], rows.ravel(), atol=1e-3)


def window_of(points, resolution=(64, 64)):
    return np.asarray(optics.object_window(CAMERA, jnp.asarray(points, jnp.float32), resolution))


def test_a_crop_is_the_square_around_the_projected_points():
    points = [[0.01, 0.0, 0.0], [0.03, 0.0, 0.0], [0.02, 0.01, 0.0], [0.02, -0.02, 0.1]]
    left, top, width, height = window_of(points)
    assert (left, left + width) == pytest.approx((0.01, 0.03), abs=1e-6)
    assert (top, top + height) == pytest.approx((-0.01, 0.01), abs=1e-6)


def test_a_crop_stays_in_the_view_and_has_the_images_aspect():
    left, _, width, height = window_of([[0.06, 0.05, 0.0], [0.2, 0.06, 0.0]])
    assert left + width == pytest.approx(0.075, abs=1e-6)
    assert width == pytest.approx(height) == pytest.approx(0.015, abs=1e-6)
    _, _, width, height = window_of([[0.0, 0.0, 0.0], [0.02, 0.02, 0.0]], (50, 100))
    assert width == pytest.approx(2 * height)
    assert height == pytest.approx(0.02, abs=1e-6)


def test_a_crop_of_points_out_of_view_is_the_full_view_and_that_of_a_point_is_not_empty():
    for points in ([[0.0, 0.0, -0.2]], [[0.3, 0.0, 0.0]], [[0.0, -0.5, 0.1], [0.1, -0.6, 0.1]]):
        np.testing.assert_allclose(window_of(points), [-0.075, -0.075, 0.15, 0.15], atol=1e-6)
    assert window_of([[0.0, 0.0, 0.0]])[2] == pytest.approx(0.005)
