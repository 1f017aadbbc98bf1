"""Normals, coupling, lights, shadows and Phong reflectance against LAPACK and loops in NumPy float64, and gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

import sts_jax as sts
from sts_jax import tactile

pytestmark = pytest.mark.usefixtures("strict_ranks")

SHAPES = [(64, 64), (97, 53), (480, 640)]
phong, couple, shadows = map(jax.jit, (tactile.phong, tactile.couple, tactile.shadows))


def bumpy(shape):
    """A grid of points (m) on a surface with one large and many small bumps, and noise."""
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(np.linspace(-0.075, 0.075, shape[1]), np.linspace(-0.075, 0.075, shape[0]))
    z = -0.002 * np.exp(-((x - 0.01) ** 2 + y**2) / 0.015**2) + 2e-4 * np.sin(300 * x) * np.cos(200 * y)
    return np.stack([x, y, z], -1) + 1e-5 * rng.normal(size=(*shape, 3))


@jax.jit
def normals_of(points):
    """Normals of a grid of points, with its border repeated beyond it."""
    planes = jnp.moveaxis(jnp.asarray(points), -1, 0)
    return tactile.surface_normals(tuple(jnp.pad(plane, 1, mode="edge") for plane in planes))


def some_pixels(shape, number=200):
    """Random pixels and the four corners."""
    rng = np.random.default_rng(1)
    inner = [(rng.integers(shape[0]), rng.integers(shape[1])) for _ in range(number)]
    return [*inner, (0, 0), (0, shape[1] - 1), (shape[0] - 1, 0), (shape[0] - 1, shape[1] - 1)]


def test_normals_of_flat_steep_and_empty_grids_are_unit_vectors_with_finite_gradients():
    x, y = np.meshgrid(np.arange(5.0), np.arange(6.0))
    slope = jax.jit(jax.grad(lambda points: jnp.sum(jnp.sin(normals_of(points)))))
    for points in ([x, y, 0 * x], [x, 2 * y, 0 * x], [x, 0 * x, 0 * x], [0 * x] * 3, [0 * x, y, x], [x, y, x % 2]):
        points = jnp.asarray(np.stack(points, -1), jnp.float32)
        np.testing.assert_allclose(jnp.linalg.norm(normals_of(points), axis=-1), 1, atol=1e-6)
        assert np.all(np.isfinite(slope(points)))
    np.testing.assert_allclose(normals_of(jnp.asarray(np.stack([x, y, 0 * x], -1))), [[[0, 0, -1]] * 5] * 6, atol=1e-6)


@pytest.mark.parametrize("shape", SHAPES)
def test_normals_equal_the_axis_of_least_covariance(shape):
    points = bumpy(shape)
    got = np.asarray(normals_of(jnp.asarray(points, jnp.float32)))
    for i, j in some_pixels(shape):
        rows = np.clip([i - 1, i, i + 1], 0, shape[0] - 1)
        columns = np.clip([j - 1, j, j + 1], 0, shape[1] - 1)
        around = points[np.ix_(rows, columns)].reshape(-1, 3)
        normal = np.linalg.eigh(np.cov(around.T, bias=True))[1][:, 0]
        normal *= -np.sign(normal[2])
        np.testing.assert_allclose(got[i, j], normal, atol=2e-3)


WINDOW = np.array([-0.08, -0.07, 0.16, 0.14])  # m
LEDS = tactile.Leds(
    positions=jnp.array([[-0.09, 0.01, -0.004], [0.085, -0.02, -0.02], [0.01, -0.02, -0.06], [0.0, 0.1, 0.0]]),
    colors=jnp.array([[1.0, 0.1, 0], [0, 0.8, 0.2], [0.2, 0, 0.9], [0.5, 0.6, 0.7]]),
    falloff=1.7,
    reference=0.06,
)
SKIN = tactile.Skin(shadow_steps=12, shadow_reach=0.03, penumbra=0.08)


def places(shape):
    """x and y of pixel centres on the part of the gel's face in `WINDOW` (m)."""
    x = WINDOW[0] + (np.arange(shape[1]) + 0.5) / shape[1] * WINDOW[2]
    y = WINDOW[1] + (np.arange(shape[0]) + 0.5) / shape[0] * WINDOW[3]
    return np.meshgrid(x, y)


def pressed(shape):
    """Depth of the imprints of a ball, a box and a ridge (m)."""
    x, y = places(shape)
    ball = np.sqrt(np.maximum(0.02**2 - (x + 0.03) ** 2 - (y - 0.01) ** 2, 0)) - 0.0185
    box = np.where((np.abs(x - 0.03) < 0.012) & (np.abs(y + 0.02) < 0.02), 0.0012, 0)
    ridge = 0.002 - np.abs(x + y - 0.05) / 4
    return np.maximum(np.maximum(ball, box), np.maximum(ridge, 0))


def some_normals(shape):
    normals = np.random.default_rng(2).normal(size=(*shape, 3))
    normals[..., 2] = -np.abs(normals[..., 2])
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def reflected_light(constants, lights, normal, point, shares):
    """Phong's equation in float64 at one point, light by light."""
    view = np.array([0.0, 0.0, -1.0])
    near = isinstance(lights, tactile.Leds)
    total = float(constants.ambient) * np.array(constants.ambient_color, np.float64)
    rows = np.asarray(lights.positions if near else lights.directions, np.float64)
    for row, color, share in zip(rows, np.asarray(lights.colors, np.float64), shares, strict=True):
        towards = row - point if near else row
        distance = np.linalg.norm(towards)
        towards = towards / distance
        intensity = share * color * ((lights.reference / distance) ** lights.falloff if near else 1)
        incidence = towards @ normal
        reflected = 2 * incidence * normal - towards
        total = total + constants.diffuse * max(incidence, 0) * intensity
        total = total + constants.specular * max(reflected @ view, 0) ** constants.shininess * intensity
    return total


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("lights", [tactile.Lights(), LEDS], ids=["far", "near"])
def test_phong_equals_the_papers_equation(shape, lights):
    normals, points, constants = some_normals(shape), bumpy(shape), tactile.Phong()
    shares = np.random.default_rng(3).uniform(size=(4, *shape))
    inputs = [jnp.asarray(v, jnp.float32) for v in (normals, points, shares)]
    shaded = np.asarray(phong(constants, lights, *inputs))
    for i, j in some_pixels(shape):
        expected = reflected_light(constants, lights, normals[i, j], points[i, j], shares[:, i, j])
        np.testing.assert_allclose(shaded[i, j], expected, rtol=2e-5)
    whole, ones = phong(constants, lights, *inputs[:2]), jnp.ones((4, *shape))
    np.testing.assert_allclose(whole, phong(constants, lights, *inputs[:2], ones), rtol=1e-6)


@pytest.mark.parametrize("length", [0.0003, 0.001, 0.004])
@pytest.mark.parametrize("shape", SHAPES)
def test_coupling_equals_a_weighted_mean_over_the_image(shape, length):
    depth = pressed(shape) + 1e-4 * np.random.default_rng(4).uniform(size=shape)
    pitch = WINDOW[2:] / [shape[1], shape[0]]
    got = np.asarray(couple(jnp.asarray(depth, jnp.float32), length, jnp.asarray(pitch, jnp.float32)))
    y, x = np.arange(shape[0]) * pitch[1], np.arange(shape[1]) * pitch[0]
    for i, j in some_pixels(shape, 60):
        weights = np.exp(-((x[None] - x[j]) ** 2 + (y[:, None] - y[i]) ** 2) / (2 * length**2))
        assert got[i, j] == pytest.approx(np.sum(weights * depth) / np.sum(weights), rel=1e-4, abs=1e-9)


def test_zero_coupling_changes_nothing():
    shape = (97, 53)
    depth = jnp.asarray(pressed(shape), jnp.float32)
    pitch = jnp.asarray(WINDOW[2:] / [shape[1], shape[0]], jnp.float32)
    slope = jax.jit(jax.grad(lambda d, s: jnp.sum(tactile.couple(d, s, pitch) * depth), (0, 1)))
    for length in (0.0, 1e-6):
        np.testing.assert_array_equal(couple(depth, length, pitch), depth)
        by_depth, by_length = slope(depth, length)
        np.testing.assert_array_equal(by_depth, depth)
        assert float(by_length) == 0


def arriving(skin, lights, depth, i, j):
    """Share of each light at one pixel, in float64."""
    pitch = WINDOW[2:] / [depth.shape[1], depth.shape[0]]
    x, y = WINDOW[0] + (j + 0.5) * pitch[0], WINDOW[1] + (i + 0.5) * pitch[1]
    near = isinstance(lights, tactile.Leds)
    for row in np.asarray(lights.positions if near else lights.directions, np.float64):
        towards = row - [x, y, -depth[i, j]] if near else row
        away = np.hypot(*towards[:2])
        rise = [-1e3]
        for k in range(1, skin.shadow_steps + 1):
            t = skin.shadow_reach * (k / skin.shadow_steps) ** 2
            if away > 0 and (t < away or not near):
                place = [[i + t * towards[1] / away / pitch[1]], [j + t * towards[0] / away / pitch[0]]]
                there = map_coordinates(depth, place, order=1, mode="grid-constant")  # bilinear, 0 outside
                rise.append((there[0] - depth[i, j]) / t)
        elevation = np.arctan2(-towards[2], away)
        yield np.clip(1 - (np.arctan(max(rise)) - elevation) / skin.penumbra, 0, 1)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(
    "lights",
    [
        tactile.Lights(directions=jnp.array([[-1.0, 0.3, -0.05], [0.2, 2, 0], [0, 0, -1], [0.5, -0.5, -0.2]])),
        LEDS,
    ],
    ids=["far", "near"],
)
def test_shadows_equal_a_float64_loop(shape, lights):
    depth = pressed(shape)
    got = np.asarray(shadows(SKIN, lights, jnp.asarray(depth, jnp.float32), jnp.asarray(WINDOW, jnp.float32)))
    assert got.shape == (4, *shape)
    assert got.min() == 0
    assert got.max() == 1
    for i, j in some_pixels(shape, 60):
        np.testing.assert_allclose(got[:, i, j], list(arriving(SKIN, lights, depth, i, j)), atol=5e-3)


def test_a_pressed_part_shades_the_flat_skin_behind_it():
    depth, light = np.zeros((96, 96)), jnp.array([[-1.0, 0.2, -0.1]])
    depth[32:64, 32:44] = 0.002
    sensors = [
        sts.Sensor(lights=tactile.Lights(light, jnp.array([[strength] * 3])), skin=skin)
        for strength, skin in ((0.4, SKIN), (0.4, tactile.Skin()), (0.0, SKIN))
    ]
    shaded, lit, dark = (np.asarray(sts.touch(s, depth, WINDOW))[..., 0].astype(float) for s in sensors)
    shares = np.array([[next(arriving(SKIN, sensors[0].lights, depth, 48, j))] for j in range(46, 92)])[:, 0]
    assert (shares == 0).any()
    assert (shares == 1).any()
    np.testing.assert_allclose((shaded - dark)[48, 46:92] / (lit - dark)[48, 46:92], shares, atol=0.02)


def test_shadows_of_32_bit_depths_in_64_bit_mode():
    depth, lights = jnp.asarray(pressed((20, 30)), jnp.float32), LEDS
    expected = np.asarray(shadows(SKIN, lights, depth, jnp.asarray(WINDOW, jnp.float32)))
    with jax.enable_x64(True):
        got = shadows(SKIN, lights, depth, jnp.asarray(WINDOW))
    np.testing.assert_allclose(got, expected, atol=1e-4)


def test_zero_steps_and_flat_skin_give_no_shadows():
    depth, window = jnp.asarray(pressed((20, 30)), jnp.float32), jnp.asarray(WINDOW, jnp.float32)
    for lights in (tactile.Lights(), LEDS):
        assert np.all(np.asarray(shadows(tactile.Skin(), lights, depth, window)) == 1)
        assert np.all(np.asarray(shadows(SKIN, lights, jnp.zeros((20, 30)), window)) == 1)


# Along the skin, from behind it, at right angles to the view (R . V is 0 to the last digits), and straight below.
DIRECTIONS = jnp.array([[1.0, 0, 0], [0, 0, 1], [1e-22, 0, -1e-25], [1, 0, -1e-30], [0, 0, -1]])
# On the skin at a pixel's centre, almost on it, straight below, and in the gel's plane.
POSITIONS = jnp.array([[0.0, 0, 0], [0, 0, -1e-12], [1e-20, 1e-20, 1e-20], [0, 0, -0.05], [0.1, 0, 0]])
DEGENERATE = [
    tactile.Lights(directions=DIRECTIONS, colors=jnp.ones((5, 3))),
    tactile.Leds(positions=POSITIONS, colors=jnp.ones((5, 3)), falloff=4.0, reference=0.1),
]


@pytest.mark.parametrize("lights", DEGENERATE, ids=["far", "near"])
def test_gradients_are_finite_for_degenerate_lights_and_normals(lights):
    normals = jnp.array([[0.0, 0, -1], [0, 0, -1], [1, 0, 0], [0, 0, 0]])

    def lit(lights, normals, points, phong):
        return jnp.sum(tactile.phong(phong, lights, normals, points))

    def shaded(lights, depth):
        window = jnp.asarray(WINDOW, jnp.float32)
        return jnp.sum(tactile.shadows(SKIN, lights, tactile.couple(depth, 0.001, window[2:] / 31), window))

    of_lit, of_shaded = jax.jit(jax.grad(lit, (0, 1, 2, 3))), jax.jit(jax.grad(shaded, (0, 1)))
    gradients = [
        of_lit(lights, normals, jnp.zeros((4, 3)), tactile.Phong(shininess=shininess)) for shininess in (0.5, 200.0)
    ]
    for depth in (pressed((21, 31)), np.zeros((21, 31))):  # a pixel's centre lies at the origin
        gradients.append(of_shaded(lights, jnp.asarray(depth, jnp.float32)))
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(gradients))
