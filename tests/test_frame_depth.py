"""Depth, pressure and imprint agree within 5 % for all sizes, crops and grids. Depth equals embree's."""

import dataclasses
import functools
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from optics_bodies import at, ball, from_trimesh
from scipy.spatial.transform import Rotation

import sts_jax as sts
from benchmarks import depth
from experiments.shared.laying import Placed, lay
from sts_jax import geometry, objects, sense, tactile

SENSOR = sts.Sensor()
FINE = dataclasses.replace(SENSOR, gel=dataclasses.replace(SENSOR.gel, cells=(300, 300)))
RADIUS = 0.03  # m
FORCE = 0.5  # N, on the sphere
SIZES = (64, 200, 640)  # as in test_frame.py: one program each
NAMES = ("sphere", "bottle", "scissors")


@functools.cache
def rest(name):
    """An object, its pose at first touch, off the centre and turned against the grid, and the wrench on it."""
    if name == "sphere":
        x, y = 0.0113, -0.0071
        return ball(RADIUS), np.array([x, y, RADIUS, 1, 0, 0, 0]), np.array([0, 0, FORCE, FORCE * y, -FORCE * x, 0])
    body = objects.make(jax.random.key(3), name)
    return body, *lay(Placed(name, position=(0.0113, -0.0071), turn=17.0), sts.Sensor(), body)[:2]


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


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_grids_of_1_and_half_a_millimetre_agree(name):
    (coarse, one), (fine, two) = (figures(name, sensor) for sensor in (SENSOR, FINE))
    np.testing.assert_allclose(coarse, fine, rtol=0.05)
    assert np.abs(heights(name, one) - heights(name, two)).max() < 0.05 * fine[0]  # tilts too
    if name == "sphere":
        roots = np.roots([-np.pi / 3, np.pi * RADIUS, 0, -FORCE / SENSOR.gel.stiffness])  # of the cap's volume
        sunk = min(root.real for root in roots if abs(root.imag) < 1e-9 and root.real > 0)
        for found in (coarse, fine):
            np.testing.assert_allclose(found[:3], [sunk, sunk, sunk / 2], rtol=0.05)


def imprint(frame):
    """Depth of the drawn imprint (m), 0 outside of it."""
    return np.clip(np.nan_to_num(SENSOR.camera.distance - frame.depth, neginf=0), 0, None)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_whole_and_cropped_images_of_all_sizes_agree(name):
    finest = seen(name, SENSOR, 640, crop=True)
    fine = imprint(finest)
    width, height = finest.window[2:]
    for size in SIZES:
        for crop in (False, True):
            frame = seen(name, SENSOR, size, crop)
            np.testing.assert_array_equal(frame.pressure, finest.pressure)
            np.testing.assert_array_equal(frame.pose, finest.pose)
            drawn = imprint(frame)
            volume = drawn.sum() * np.prod(frame.window[2:] / size)
            assert volume == pytest.approx(fine.sum() * width * height / 640**2, rel=0.05)
            # At few pixels, the deepest one lies beside the ridge of the blades.
            sharp = name == "scissors" and size == 64 and not crop
            assert drawn.max() / fine.max() == pytest.approx(0.928 if sharp else 1, abs=0.01 if sharp else 0.05)


@pytest.mark.parametrize("shape", [depth.SIZES[0], *(pytest.param(s, marks=pytest.mark.slow) for s in depth.SIZES[1:])])
def test_depth_equals_embrees(shape):
    """A part of the measurement of `benchmarks.depth`, with bodies of one size class, that is, one program a size."""
    names = [name for name in depth.PROCEDURAL + depth.LOADED + depth.MADE if name != "duckie"]
    errors = depth.total(list(depth.measure(names, shape, (2, 1, 1)).values()))
    assert errors.interior_beyond_10um <= 0.001 * errors.interior
    assert errors.interior_beyond_100um == 0
    assert errors.elsewhere_beyond_1mm <= 0.01 * errors.elsewhere
    assert errors.strays == 0
    assert errors.silhouette_differs <= 0.01 * errors.silhouette
    assert errors.elsewhere > 3000  # the comparison is not empty
    if min(shape) >= 200:
        assert errors.interior > 10000


@pytest.mark.slow
def test_a_textured_plane_in_perspective_equals_the_intersections_of_rays():
    # The texture of a leaning box is brightest, in red, at its right (+x) and, in green, towards the bottom (+y).
    body = from_trimesh(trimesh.creation.box((0.08, 0.08, 0.02)))
    ramp = (np.arange(64) + 0.5) / 64
    texture = np.stack([*np.meshgrid(ramp, ramp), np.zeros((64, 64))], -1)
    uv = 0.5 + np.asarray(body.vertices)[np.asarray(body.faces)][..., :2] / 0.09
    body = dataclasses.replace(
        body, colors=jnp.ones_like(body.colors), uv=jnp.asarray(uv), texture=jnp.asarray(texture, jnp.float32)
    )
    room = sts.optics.Room(
        milk=0.0, crease=0.0, haze=1e6, tint=jnp.ones(3), ambient=jnp.ones(3), colors=jnp.zeros((3, 3))
    )
    turn = Rotation.from_rotvec([0.5, -0.3, 0.2])
    pose = at(0.004, -0.003, 0.06, turn.as_quat(scalar_first=True))
    frame = sense(dataclasses.replace(SENSOR, room=room), body, pose, jnp.zeros(6), resolution=(97, 97))
    x, y = np.meshgrid(*2 * [0.15 * ((np.arange(97) + 0.5) / 97 - 0.5)])
    rays = turn.apply(np.stack([x, y, 0 * x + 0.1], -1).reshape(-1, 3), inverse=True)  # in the mesh frame
    eye = turn.apply(np.array([0, 0, -0.1]) - np.asarray(pose[:3]), inverse=True)
    there = (eye + (-0.01 - eye[2:]) / rays[:, 2:] * rays)[:, :2]  # on the lower face
    inside = np.abs(there).max(1) < 0.038
    shown = sts.optics.to_linear(frame.visual).reshape(-1, 3)[inside]
    assert inside.mean() > 0.08
    np.testing.assert_allclose(shown[:, :2], 0.5 + there[inside] / 0.09, atol=2e-3)


@pytest.mark.slow
def test_a_rod_narrower_than_a_pixel_may_cover_none_and_has_the_right_area_on_average():
    rod, places = from_trimesh(trimesh.creation.box((0.1, 0.001, 0.001))), np.linspace(0, 2 * 0.15 / 128, 14, False)
    for size, narrowest in ((128, 0), (256, 1)):  # pixels of 1.17 and 0.59 mm
        poses = jnp.asarray([at(0, y, 0.0005) for y in places], jnp.float32)
        frames = jax.vmap(lambda pose, n=size: sense(SENSOR, rod, pose, resolution=(n, n)))(poses)
        rows = np.asarray(frames.segmentation).any(axis=2).sum(axis=1)
        assert rows.min() == narrowest
        assert frames.segmentation.sum(axis=(1, 2)).mean() == pytest.approx(0.1 * 0.001 / (0.15 / size) ** 2, rel=0.05)
