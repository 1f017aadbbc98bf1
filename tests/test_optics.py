"""The pinhole by hand, shading against loops in float64 and traced rays, the rasteriser against a loop over faces."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from optics_bodies import rays_hidden

from sts_jax import optics
from sts_jax.sensor import Sensor

pytestmark = pytest.mark.usefixtures("strict_ranks")

CAMERA = optics.Camera()
FULL = (-0.075, -0.075, 0.15, 0.15)


@pytest.mark.parametrize(
    ("resolution", "window"),
    [
        ((480, 640), (-0.1, -0.075, 0.2, 0.15)),  # the native aspect ratio shows the whole view
        ((64, 64), FULL),  # a square image shows the pad from edge to edge
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


@pytest.mark.parametrize(
    ("points", "resolution", "window"),
    [
        ([[0.01, 0, 0], [0.03, 0, 0], [0.02, 0.01, 0], [0.02, -0.02, 0.1]], (64, 64), (0.01, -0.01, 0.02, 0.02)),
        ([[0.06, 0.05, 0.0], [0.2, 0.06, 0.0]], (64, 64), (0.06, 0.0475, 0.015, 0.015)),  # stays in the view
        ([[0, 0, 0], [0.02, 0.02, 0]], (50, 100), (-0.01, 0, 0.04, 0.02)),  # has the aspect of the image
        ([[0.0, 0.0, 0.0]], (64, 64), (-0.0025, -0.0025, 0.005, 0.005)),  # of a point
        *(([[x, y, z]], (64, 64), FULL) for x, y, z in ((0, 0, -0.2), (0.3, 0, 0), (0, -0.5, 0.1))),  # out of view
    ],
)
def test_a_crop_is_the_square_around_the_projected_points(points, resolution, window):
    got = optics.object_window(CAMERA, jnp.asarray(points, jnp.float32), resolution)
    np.testing.assert_allclose(got, window, atol=1e-6)


def test_a_crop_scales_with_the_sensor():
    small, points = Sensor().sized(0.02), np.random.default_rng(0).uniform(-0.008, 0.008, (20, 3)).astype(np.float32)
    points[:, 2] = np.abs(points[:, 2])
    scale = 0.02 / 0.15
    got = optics.object_window(small.camera, jnp.asarray(points * scale), (64, 64))
    expected = optics.object_window(Sensor().camera, jnp.asarray(points), (64, 64))
    np.testing.assert_allclose(got, scale * expected, rtol=1e-4, atol=1e-7)
    dot = optics.object_window(small.camera, jnp.asarray(points * 1e-3), (64, 64))
    np.testing.assert_allclose(dot[2:], 0.005 * scale, rtol=1e-5)


PAD = (0.15, 0.15)  # m


def test_srgb_conversion_equals_the_standard():
    values = np.linspace(0, 1, 257)
    linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(optics.to_linear(jnp.asarray(values)), linear, atol=1e-6)
    np.testing.assert_allclose(optics.to_srgb(jnp.asarray(linear)), values, atol=1e-6)
    assert np.all(np.isfinite(jax.vmap(jax.grad(optics.to_srgb))(jnp.zeros(3))))


def test_texture_is_bilinear_with_its_first_row_at_v_zero():
    texture = np.random.default_rng(0).uniform(size=(8, 8, 3))
    texels = (np.stack(np.meshgrid(np.arange(8), np.arange(8)), -1) + 0.5) / 8
    sample = jax.jit(optics.sample_texture)
    table = jnp.asarray(texture, jnp.float32)
    np.testing.assert_allclose(sample(table, jnp.asarray(texels, jnp.float32)), texture, atol=1e-6)
    between = jnp.full((1, 1, 2), 3 / 8)  # the corner of four texels
    np.testing.assert_allclose(sample(table, between)[0, 0], texture[2:4, 2:4].mean((0, 1)), atol=1e-5)
    np.testing.assert_allclose(sample(table, between + 1), sample(table, between), atol=1e-5)
    plain = sample(jnp.full((1, 1, 3), 0.5), jnp.zeros((7, 2)))
    np.testing.assert_array_equal(plain, np.full((7, 3), 0.5))


def test_shading_equals_lamberts_law_behind_a_milky_skin():
    room, shape = optics.Room(), (97, 53)
    rng = np.random.default_rng(0)
    albedo, empty = rng.uniform(size=(2, *shape, 3))
    normals = rng.normal(size=(*shape, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    heights, hidden = rng.uniform(-0.002, 0.2, shape), rng.uniform(size=shape)
    arrays = [jnp.asarray(a, jnp.float32) for a in (albedo, normals, heights, empty, hidden)]
    got = np.asarray(jax.jit(optics.shade)(room, *arrays))
    for i, j in zip(rng.integers(shape[0], size=100), rng.integers(shape[1], size=100), strict=True):
        light = np.array(room.ambient, float)
        for direction, color in zip(np.asarray(room.directions, float), np.asarray(room.colors), strict=True):
            light = light + max(direction @ normals[i, j] / np.linalg.norm(direction), 0) * color
        height = max(heights[i, j], 0)
        light *= 1 - room.crease * hidden[i, j] * np.exp(-height / room.crease_height)
        through = np.exp(-height / room.haze)
        behind = through * np.asarray(room.tint) * albedo[i, j] * light + (1 - through) * empty[i, j]
        sky = empty[i, j] / (1 - room.milk * hidden[i, j])
        expected = (1 - room.milk) * behind + room.milk * (1 - hidden[i, j]) * sky
        np.testing.assert_allclose(got[i, j], expected, atol=1e-5)


def test_the_empty_view_has_the_papers_colour_with_vignette_walls_and_shadow():
    room, shape = optics.Room(), (97, 53)
    rng = np.random.default_rng(0)
    radius, walls, hidden = rng.uniform(0, 2.8, shape), rng.uniform(size=shape), rng.uniform(size=shape)
    image = np.asarray(jax.jit(optics.empty_view)(room, *map(jnp.float32, (radius, walls, hidden))))
    colour = ((np.array([178, 178, 204]) / 255 + 0.055) / 1.055) ** 2.4
    light = (1 - room.vignette * radius) * walls**2 * (1 - room.milk * hidden)
    np.testing.assert_allclose(image, light[..., None] * colour, atol=1e-5)


def test_walls_get_darker_with_depth():
    room, distance = optics.Room(), 0.1
    places = np.array([[0.0, 0.0], [0.074, -0.074], [0.076, 0.0], [0.0, -0.09], [-0.1, 0.02], [0.09, 0.1]])
    on_pad = jnp.array([True, True, False, False, False, False])
    got = optics.housing(room, on_pad, jnp.asarray(places, jnp.float32), PAD, distance)
    expected = []
    for x, y in places:
        # The ray (0, 0, -distance) + s (x, y, distance) meets the nearest of the walls |x| = 75 mm, |y| = 75 mm.
        s = min(0.075 / abs(x) if x else np.inf, 0.075 / abs(y) if y else np.inf)
        expected.append(1.0 if s > 1 else room.rim * np.exp(-distance * (1 - s) / room.rim_depth))
    np.testing.assert_allclose(got, expected, atol=1e-6)


def centres(cells):
    return ((np.arange(cells) + 0.5) / cells - 0.5) * 0.15


def hidden_by(heights, top, x, y):
    return np.asarray(jax.jit(optics.hidden_sky)(*map(jnp.float32, (heights,)), PAD, *map(jnp.float32, (top, x, y))))


def test_hidden_sky_under_a_ball_agrees_with_traced_rays():
    x, y = np.meshgrid(centres(150) - 0.02, centres(150) + 0.01)
    square = x**2 + y**2
    heights = np.where(square < 0.02**2, 0.02 - np.sqrt(np.maximum(0.02**2 - square, 0)), np.inf)
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.02)
    ball.apply_translation((0.02, -0.01, 0.02))
    x, y = np.linspace(-0.07, 0.07, 29), np.linspace(-0.07, 0.07, 15)
    truth = rays_hidden(ball, [(a, b) for b in y for a in x]).reshape(15, 29)
    got = hidden_by(heights, 0.04, x, y)
    assert np.abs(got - truth).mean() < 0.02
    assert np.abs(got - truth).max() < 0.1


def test_absent_and_distant_objects_hide_no_sky():
    x, y = np.meshgrid(centres(150), centres(150))
    for low, most in ((np.inf, 0), (-0.1, 0), (0.5, 0.01)):  # no object, below the skin, and far above it
        heights = np.where((abs(x) < 0.03) & (abs(y) < 0.03), low, np.inf)
        assert hidden_by(heights, low + 0.05, centres(30), centres(40)).max() <= most


@pytest.mark.parametrize("chunk", [64, 2048])
def test_faces_of_any_size_equal_a_loop_over_all_faces(chunk):
    rng = np.random.default_rng(3)
    shape = (31, 23)
    centre = rng.uniform(-5, 35, (60, 1, 2))
    corners = centre + rng.normal(size=(60, 3, 2)) * np.exp(rng.uniform(-4, 4, (60, 1, 1)))
    order = rng.uniform(0, 1, (60, 1)) + 0.01 * rng.normal(size=(60, 3))
    rows, columns = np.mgrid[: shape[0], : shape[1]].astype(float)
    best, winner = np.full(shape, np.inf), np.full(shape, -1)
    near_edge = np.zeros(shape, bool)
    for k, (triangle, depth) in enumerate(zip(corners, order, strict=True)):
        (x0, y0), (x1, y1), (x2, y2) = triangle
        area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
        w = [
            ((x1 - columns) * (y2 - rows) - (x2 - columns) * (y1 - rows)) / area,
            ((x2 - columns) * (y0 - rows) - (x0 - columns) * (y2 - rows)) / area,
        ]
        w = np.stack([*w, 1 - w[0] - w[1]])
        if area >= 0:
            continue  # faces away
        near_edge |= np.abs(w * area).min(0) < 1e-2 * np.abs(triangle - triangle[[1, 2, 0]]).max()
        value = np.tensordot(depth, w, 1)
        closer = np.all(w >= 0, axis=0) & (value < best)
        best[closer], winner[closer] = value[closer], k
    got = jax.jit(
        lambda p, o: optics.rasterise(
            p, o, jnp.arange(180).reshape(60, 3), jnp.ones(180, bool), jnp.bool_(False), shape, chunk=chunk
        )
    )(jnp.asarray(corners.reshape(-1, 2), jnp.float32), jnp.asarray(order.ravel(), jnp.float32))
    assert np.array_equal(np.asarray(got)[~near_edge], winner[~near_edge])
    assert (~near_edge).mean() > 0.5


@pytest.mark.parametrize("number", [100, 1500])  # one group of faces, and two groups that overlap
def test_a_surface_has_no_cracks(number):
    # A fan of slivers that meet in one point covers every pixel inside.
    angles = np.linspace(0, 2 * np.pi, number + 1)[:-1]
    rim = np.stack([32.3 + 29 * np.cos(angles), 31.7 + 29 * np.sin(angles)], -1)
    points = jnp.asarray(np.concatenate([rim, [[32.3, 31.7]]]), jnp.float32)
    k = np.arange(number)
    faces = jnp.asarray(np.stack([np.full(number, number), (k + 1) % number, k], -1))
    winner = jax.jit(
        lambda p: optics.rasterise(
            p, jnp.ones(number + 1), faces, jnp.ones(number + 1, bool), jnp.bool_(False), (64, 64)
        )
    )(points)
    rows, columns = np.mgrid[:64, :64]
    inside = np.hypot(columns - 32.3, rows - 31.7) < 28.9
    assert np.all(np.asarray(winner)[inside] >= 0)


def test_faces_from_behind_and_with_a_vertex_that_is_not_kept_are_not_drawn():
    points = jnp.array([[2.0, 2.0], [12.0, 2.0], [2.0, 12.0]] * 3)
    order = jnp.repeat(jnp.array([3.0, 2.0, 1.0]), 3).at[8].set(1.5)
    faces = jnp.arange(9).reshape(3, 3)

    draw = jax.jit(lambda keep, two_sided: optics.rasterise(points, order, faces, keep, two_sided, (16, 16)))

    def nearest(keep, two_sided=True):
        return int(draw(keep, jnp.bool_(two_sided))[4, 4])

    keep = jnp.ones(9, bool)
    assert nearest(keep, two_sided=False) == -1
    assert nearest(keep) == 2
    assert nearest(keep.at[7].set(False)) == 1
    assert nearest(keep.at[jnp.array([7, 3])].set(False)) == 0
