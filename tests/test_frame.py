"""Whole frames: orientation, consistency, empty images, gradients, number of compilations."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from optics_bodies import at, ball, from_trimesh, weight

import sts_jax as sts
from benchmarks.instruments.truth import body_mesh
from sts_jax import objects, sense, tactile
from sts_jax.rendering import drawing, equilibrium

pytestmark = pytest.mark.usefixtures("strict_ranks")

SENSOR = sts.Sensor()
SIZES = [(64, 64), *(pytest.param(size, marks=pytest.mark.slow) for size in ((97, 53), (200, 200)))]
FLAT = np.array([178, 178, 204]) / 255


# The strokes of an F as a reader sees it who looks out through the gel. Sensor frame, mm: (left, right, top, bottom).
LETTER = [(-12, -6, -15, 15), (-12, 12, -15, -9), (-12, 4, -2, 4)]
ON_LETTER = [(-9, 10), (-9, -12), (9, -12), (1, 1)]  # (x, y) mm
OFF_LETTER = [(9, 10), (9, 1), (-3, 10), (9, -4), (-3, -6)]


def letter():
    """A white box with a raised red F under it. The F is 2 mm high, and its face lies in z = 0."""
    parts = []
    for left, right, top, bottom in LETTER:
        part = trimesh.creation.box((right - left, bottom - top, 2))
        part.apply_translation(((left + right) / 2, (top + bottom) / 2, 1))
        parts.append(part)
    plate = trimesh.creation.box((50, 50, 10))
    plate.apply_translation((0, 0, 7))
    mesh = trimesh.util.concatenate([*parts, plate])
    mesh.apply_scale(1e-3)
    colors = np.ones((len(mesh.faces), 3)) * 0.9
    colors[:36] = [0.8, 0.02, 0.02]
    return from_trimesh(mesh, colors=colors)


@pytest.mark.parametrize("resolution", SIZES)
def test_a_letter_is_not_mirrored_in_either_stream(resolution):
    frame = sense(SENSOR, letter(), at(0, 0, -0.0008), resolution=resolution)
    height, width = resolution
    for image in (frame.visual, frame.tactile):
        assert (image.dtype, image.shape) == (jnp.float32, (*resolution, 3))
        assert 0 <= float(jnp.min(image)) < float(jnp.max(image)) <= 1
    scale = height / 150  # pixels per mm on the gel's face

    def pixel(x, y):
        return round(height / 2 + y * scale - 0.5), round(width / 2 + x * scale - 0.5)

    for x, y in ON_LETTER:
        red, green, _ = np.asarray(frame.visual)[pixel(x, y)]
        assert red > green + 0.3
        assert np.asarray(frame.tactile)[pixel(x, y)].max() < FLAT.max() - 0.1
    for x, y in OFF_LETTER:
        red, green, _ = np.asarray(frame.visual)[pixel(x, y)]
        assert abs(red - green) < 0.1
        np.testing.assert_allclose(np.asarray(frame.tactile)[pixel(x, y)], FLAT, atol=0.02)


def test_tilt_of_the_balanced_pose_matches_its_pressure():
    body = from_trimesh(trimesh.creation.box((0.06, 0.04, 0.03)))
    x, y = 0.004, -0.003
    frame = sense(SENSOR, body, at(0, 0, 0.015), weight(1.5, x, y))
    assert bool(frame.balanced)
    grid_x, grid_y = sts.tactile.cell_centres(SENSOR.gel)
    inside = (jnp.abs(grid_x) < 0.028) & (jnp.abs(grid_y) < 0.018)
    # Depth of the box's underside below the face, from the pose alone.
    mesh = body_mesh(body, frame.pose)
    corners = mesh.vertices[mesh.vertices[:, 2] < 0.01]
    plane = np.linalg.lstsq(np.c_[corners[:, :2], np.ones(4)], corners[:, 2], rcond=None)[0]
    depth = -(plane[0] * grid_x + plane[1] * grid_y + plane[2])
    np.testing.assert_allclose(
        np.asarray(frame.pressure)[inside], (SENSOR.gel.stiffness * np.asarray(depth))[inside], atol=10
    )
    assert plane[0] < 0 < plane[1]  # deeper towards the centre of pressure


def test_a_hovering_object_is_visible_and_leaves_no_imprint():
    frame = sense(SENSOR, ball(), at(0.01, 0.0, 0.05), weight(0, 0, 0))
    assert np.any(frame.segmentation)
    assert np.ptp(np.asarray(frame.tactile), axis=(0, 1)).max() == 0
    assert bool(frame.balanced)
    np.testing.assert_allclose(frame.pose, at(0.01, 0.0, 0.05), atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("crop", [False, True])
def test_touch_equals_the_tactile_image_of_the_same_imprint(crop):
    skin = sts.tactile.Skin(coupling=0.0004, shadow_steps=8)
    sensor = sts.Sensor(lights=sts.tactile.Leds(), skin=skin)
    body = objects.make(jax.random.key(3), "watch")
    low = float(jnp.min(body.vertices[:, 2]))
    pose = jnp.array([0.01, -0.02, -low - 0.0006, 1, 0, 0, 0])
    frame = sense(sensor, body, pose, resolution=(150, 200), crop=crop)
    imprint = jnp.maximum(sensor.camera.distance - frame.depth, 0)
    drawn = sts.touch(sensor, imprint, frame.window)
    inner = np.s_[20:-20, 20:-20]  # near its border, a frame also shows shadows of the imprint beyond it
    np.testing.assert_allclose(np.asarray(drawn)[inner], np.asarray(frame.tactile)[inner], atol=2e-3)
    if not crop:
        np.testing.assert_array_equal(sts.touch(sensor, imprint), drawn)
    damaged = jnp.full((20, 30), jnp.nan).at[5:9, 6:12].set(0.1)
    assert np.isfinite(np.asarray(sts.touch(sensor, damaged))).all()


@pytest.mark.slow
def test_moving_edges_derivative_equals_finite_differences_at_upright_walls():
    # The derivative is accurate on average over pixels. The images are smoothed, and differences averaged over steps.
    sensor = dataclasses.replace(SENSOR, skin=sts.tactile.Skin(coupling=0.001))
    body, resolution, pitch = letter(), (120, 120), jnp.full(2, 0.15 / 120)

    def touch(shift):
        turn = jnp.stack([jnp.cos(shift[2] / 2), 0 * shift[2], 0 * shift[2], jnp.sin(shift[2] / 2)])
        pose = jnp.concatenate([jnp.array([0.0073, -0.0041]) + shift[:2], jnp.full(1, -0.0005), turn])
        image = sts.sense(sensor, body, pose, resolution=resolution, moving_edges=True).tactile
        return jnp.stack([sts.tactile.couple(image[..., k], 0.0015, pitch) for k in range(3)])

    here, image = jnp.array([0.0, 0.0, 0.4]), jax.jit(touch)
    exact = jax.jit(jax.jacfwd(touch))(here)
    for k, step in enumerate((1e-4, 1e-4, 5e-3)):
        steps = step * jnp.arange(1, 9)
        ways = [(image(here.at[k].add(s)) - image(here.at[k].add(-s))) / (2 * s) for s in steps]
        numeric = sum(ways) / len(ways)
        lengths = jnp.linalg.norm(exact[..., k]), jnp.linalg.norm(numeric)
        assert float(jnp.sum(exact[..., k] * numeric) / (lengths[0] * lengths[1])) > 0.98
        assert float(lengths[0] / lengths[1]) == pytest.approx(1, abs=0.05)


@pytest.mark.slow
def test_bodies_of_one_size_class_share_programs_and_a_new_resolution_compiles_only_the_drawing():
    body, fork, watch = (objects.make(jax.random.key(0), category) for category in ("bottle", "fork", "watch"))
    fork = dataclasses.replace(fork, hulls=fork.hulls[:, :32], interior=fork.interior[:8])  # these are not drawn
    sense(SENSOR, body, at(0, 0, 0.01), resolution=(24, 24))
    before = equilibrium.balance._cache_size(), drawing.draw._cache_size()
    for other in (fork, watch):
        sense(dataclasses.replace(SENSOR, phong=tactile.Phong(ambient=0.7)), other, at(0, 0, 0.01), resolution=(24, 24))
    assert (equilibrium.balance._cache_size(), drawing.draw._cache_size()) == before
    sense(SENSOR, body, at(0, 0, 0.01), resolution=(2, 3))
    assert (equilibrium.balance._cache_size(), drawing.draw._cache_size()) == (before[0], before[1] + 1)
