"""Depth, pressure and imprint of objects at rest agree within 5 % for all image sizes, crops and grids."""

import dataclasses
import functools
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from optics_bodies import from_trimesh

import sts_jax as sts
from experiments.shared.laying import Config, lay
from sts_jax import geometry, objects, sense, tactile

pytestmark = pytest.mark.slow

SENSOR = sts.Sensor()
FINE = dataclasses.replace(SENSOR, gel=dataclasses.replace(SENSOR.gel, cells=(300, 300)))
RADIUS = 0.03  # m
FORCE = 0.5  # N, on the sphere
SIZES = (64, 200, 640)  # as in test_frame.py: one program each
NAMES = ("sphere", "bottle", "scissors", "box")


@functools.cache
def rest(name):
    """An object, its pose at first touch, off the centre and turned against the grid, and the wrench on it."""
    if name == "sphere":  # of rings that are fine where it touches the gel
        angle = np.radians([*range(0, 27, 2), 60, 120, 180])
        profile = RADIUS * np.stack([np.sin(angle), -np.cos(angle)], -1)
        body = from_trimesh(trimesh.creation.revolve(profile, sections=32))
        x, y = 0.0113, -0.0071
        return body, np.array([x, y, RADIUS, 1, 0, 0, 0]), np.array([0, 0, FORCE, FORCE * y, -FORCE * x, 0])
    if name == "box":
        body = from_trimesh(trimesh.creation.box((0.05, 0.03, 0.02)))
    else:
        body = objects.make(jax.random.key(3), name)
    return body, *lay(Config(name, position=(0.0113, -0.0071), turn=17.0), sts.Sensor(), body)[:2]


def seen(name, sensor, size, crop=False):
    body, pose, wrench = rest(name)
    given = jnp.asarray(pose, jnp.float32), jnp.asarray(wrench, jnp.float32)
    frame = sense(sensor, body, *given, resolution=(size, size), crop=crop)
    assert bool(frame.balanced)
    return types.SimpleNamespace(**{name: np.asarray(value) for name, value in vars(frame).items()})


def heights(name, frame):
    """Heights of the object's vertices in the balanced pose (m)."""
    return np.asarray(geometry.transform(jnp.asarray(frame.pose), rest(name)[0].vertices))[:, 2]


def figures(name, sensor):
    """Motion, deepest and mean compression (m) and contact area (m^2), and the frame."""
    frame = seen(name, sensor, 64)
    lengths = frame.pressure / sensor.gel.stiffness
    area = np.sum(lengths > 0) * float(tactile.cell_area(sensor.gel))
    return np.array([rest(name)[1][2] - frame.pose[2], lengths.max(), lengths[lengths > 0].mean(), area]), frame


@pytest.mark.parametrize("name", NAMES)
def test_grids_of_1_and_half_a_millimetre_agree(name):
    (coarse, one), (fine, two) = (figures(name, sensor) for sensor in (SENSOR, FINE))
    np.testing.assert_allclose(coarse, fine, rtol=0.05)
    assert np.abs(heights(name, one) - heights(name, two)).max() < 0.05 * fine[0]  # tilts too
    if name == "sphere":
        roots = np.roots([-np.pi / 3, np.pi * RADIUS, 0, -FORCE / SENSOR.gel.stiffness])  # of the cap's volume
        depth = min(root.real for root in roots if abs(root.imag) < 1e-9 and root.real > 0)
        for found in (coarse, fine):
            np.testing.assert_allclose(found[:3], [depth, depth, depth / 2], rtol=0.05)


def imprint(frame):
    """Depth of the drawn imprint (m), 0 outside of it."""
    return np.clip(np.nan_to_num(SENSOR.camera.distance - frame.depth, neginf=0), 0, None)


@pytest.mark.parametrize("name", NAMES)
def test_whole_and_cropped_images_of_all_sizes_agree(name):
    finest = seen(name, SENSOR, 640, crop=True)
    fine = imprint(finest)
    left, top, width, height = finest.window
    for size in SIZES:
        for crop in (False, True):
            frame = seen(name, SENSOR, size, crop)
            np.testing.assert_array_equal(frame.pressure, finest.pressure)
            np.testing.assert_array_equal(frame.pose, finest.pose)
            depth, middles = imprint(frame), (np.arange(size) + 0.5) / size
            volume = depth.sum() * np.prod(frame.window[2:] / size)
            assert volume == pytest.approx(fine.sum() * width * height / 640**2, rel=0.05)
            # At few pixels, the deepest one lies beside the ridge of the blades.
            sharp = name == "scissors" and size == 64 and not crop
            assert depth.max() / fine.max() == pytest.approx(0.928 if sharp else 1, abs=0.01 if sharp else 0.05)
            # Each pixel is as deep as the four pixels of the finest image around its place, or between them.
            x = (frame.window[0] + middles * frame.window[2] - left) / width * 640 - 0.5
            y = (frame.window[1] + middles * frame.window[3] - top) / height * 640 - 0.5
            rows, columns = ((v >= 0) & (v < 639) for v in (y, x))
            i, j = np.floor(y[rows]).astype(int)[:, None], np.floor(x[columns]).astype(int)[None, :]
            around = np.stack([fine[i, j], fine[i, j + 1], fine[i + 1, j], fine[i + 1, j + 1]])
            here = depth[rows][:, columns]
            beyond = np.maximum(around.min(0) - here, here - around.max(0))
            assert beyond.max() < 0.05 * fine.max()
            assert np.sum(here > 0) > 0.99 * np.sum(depth > 0) > 50
