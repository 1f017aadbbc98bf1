"""Several bodies in one frame, against single frames composed by depth, planes and embree."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from optics_bodies import at, ball, from_trimesh, weight
from scipy.spatial.transform import Rotation

import sts_jax as sts
from benchmarks.instruments.truth import body_mesh, embree, interior
from sts_jax import sense

SENSOR = sts.Sensor()
SIZE = (48, 48)
NOTHING = jnp.zeros(6)
BALL, BOX = ball(0.02), from_trimesh(trimesh.creation.box((0.03, 0.03, 0.02)), color=(0.2, 0.6, 0.3))
PRESSED = [(at(-0.03, 0, 0.01), weight(1.0, -0.031, 0.001)), (at(0.03, 0.01, 0.02), weight(0.5, 0.03, 0.01))]
# The sensor of a finger tip: whatever lies inside its housing is not seen.
TIP = dataclasses.replace(SENSOR, camera=dataclasses.replace(SENSOR.camera, near=0.095))


draw = jax.jit(functools.partial(sense, resolution=(24, 24)))


def textured(size, seed=0):
    """A plate with a texture that differs in each texel."""
    body = from_trimesh(trimesh.creation.box((0.04, 0.04, 0.01)))
    texture = np.random.default_rng(seed).uniform(0.1, 1, (size, size, 3))
    uv = 0.5 + np.asarray(body.vertices)[np.asarray(body.faces)][..., :2] / 0.05
    return dataclasses.replace(body, uv=jnp.asarray(uv), texture=jnp.asarray(texture, jnp.float32))


def stacked(*placements):
    """Poses and wrenches of several bodies."""
    poses, wrenches = zip(*placements, strict=True)
    return jnp.stack(poses), jnp.stack(wrenches)


def many(*items, sensor=SENSOR, **options):
    """The frame of several (body, pose, wrench)."""
    bodies, *placements = zip(*items, strict=True)
    return sense(sensor, list(bodies), *map(jnp.stack, placements), **{"resolution": SIZE, **options})


def alone(body, pose, wrench, **options):
    return sense(SENSOR, body, pose, wrench, **{"resolution": SIZE, **options})


def check_composed(frame, singles, *, visual=None):
    """Depth, body and imprint are those of the nearest of single frames. `visual` is a tolerance, or None."""
    depth = np.stack([single.depth for single in singles])
    nearest = np.where(np.isfinite(depth).any(0), depth.argmin(0), -1)
    np.testing.assert_array_equal(frame.body, nearest)
    np.testing.assert_array_equal(frame.segmentation, nearest >= 0)
    np.testing.assert_allclose(frame.depth, depth.min(0), rtol=1e-6)
    np.testing.assert_allclose(frame.pose, jnp.stack([single.pose for single in singles]), atol=1e-7)
    np.testing.assert_array_equal(frame.balanced, [bool(single.balanced) for single in singles])
    np.testing.assert_allclose(frame.pressure, sum(single.pressure for single in singles), atol=1e-3)
    blank = sense(SENSOR, BALL, at(0, 0, -1), NOTHING, resolution=SIZE)
    np.testing.assert_allclose(
        frame.tactile - blank.tactile, sum(single.tactile - blank.tactile for single in singles), atol=1e-6
    )
    if visual is not None:
        images = np.stack([single.visual for single in singles])
        inner = interior_of(nearest)
        chosen = np.take_along_axis(images, np.maximum(nearest, 0)[None, ..., None], 0)[0]
        assert np.abs(np.asarray(frame.visual) - chosen)[inner].max() < visual
        assert inner.sum() > 100


def interior_of(body):
    """Pixels of a body whose neighbours show the same body, so that the filter mixes no others into them."""
    around = np.stack([np.roll(body, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)])
    return (body >= 0) & (around == body).all(0)


@pytest.mark.slow
def test_two_bodies_equal_two_single_frames_composed_by_depth():
    items = [(body, *placement) for body, placement in zip((BOX, BALL), PRESSED, strict=True)]
    frame = many(*items)
    check_composed(frame, [alone(*item) for item in items])
    assert set(np.unique(frame.body)) == {-1, 0, 1}
    assert float(frame.pressure.max()) > 1000
    # Away from the sky that the other body hides
    far = [(body, pose.at[0].multiply(1.9), wrench) for body, pose, wrench in items]
    far = [(body, pose, wrench.at[4].multiply(1.9)) for body, pose, wrench in far]
    check_composed(many(*far), [alone(*item) for item in far], visual=0.02)


def test_one_body_in_a_list_equals_the_body():
    item = BOX, *PRESSED[0]
    one, listed = alone(*item), many(item)
    for field in (field for field in dataclasses.fields(one) if field.name != "shear"):
        value = np.asarray(getattr(listed, field.name))
        value = value[0] if field.name in ("pose", "balanced") else value
        np.testing.assert_allclose(value, getattr(one, field.name), atol=2e-6, err_msg=field.name)
    assert set(np.unique(one.body)) == {-1, 0}


@pytest.mark.slow
def test_a_body_behind_another_is_hidden():
    screen = from_trimesh(trimesh.creation.box((0.06, 0.06, 0.005)))
    front, behind = (screen, at(0, 0, 0.0025), NOTHING), (BALL, at(0, 0, 0.04), NOTHING)
    both, only = many(front, behind), many(front, (BALL, at(0, 0, -1), NOTHING))
    assert not np.any(both.body == 1)
    np.testing.assert_array_equal(both.depth, only.depth)
    swapped = many(behind, front)
    np.testing.assert_array_equal(swapped.body == 1, both.body == 0)
    np.testing.assert_allclose(swapped.visual, both.visual, atol=1e-6)


@pytest.mark.slow
def test_a_press_changes_only_the_imprint_of_its_body():
    box, pressed = (BOX, *PRESSED[0]), (BALL, *PRESSED[1])
    touching = many(box, (BALL, PRESSED[1][0], NOTHING))
    both = many(box, pressed)
    changed = np.any(both.tactile != touching.tactile, axis=-1)
    y, x = (0.15 * ((place + 0.5) / SIZE[0] - 0.5) for place in np.nonzero(changed))
    assert len(x) > 5
    assert np.hypot(x - 0.03, y - 0.01).max() < 0.02  # m, the contact of 9 mm and the filter
    np.testing.assert_array_equal(both.pose[0], touching.pose[0])
    np.testing.assert_array_equal(touching.pose[1], PRESSED[1][0])
    # Deep in the gel, but without a force: it is seen, and leaves no imprint
    sunk = many((BOX, at(0, 0, -1), NOTHING), (BALL, at(0, 0, 0.019), NOTHING))
    assert np.ptp(np.asarray(sunk.tactile), axis=(0, 1)).max() == 0
    assert float(sunk.depth.min()) < 0.1


@pytest.mark.slow
def test_bodies_of_different_size_classes_and_textures():
    fine = from_trimesh(trimesh.creation.icosphere(subdivisions=4, radius=0.015))
    items = [
        (textured(256), at(-0.03, -0.03, 0.03), NOTHING),
        (textured(1), at(0.03, -0.03, 0.03), NOTHING),
        (fine, at(0.04, 0.04, 0.03), NOTHING),
    ]
    assert len({len(body.faces) for body, *_ in items}) == 2
    room = dataclasses.replace(SENSOR.room, milk=0.0, crease=0.0)  # without the sky that the others hide
    clear = dataclasses.replace(SENSOR, room=room)
    frame = many(*items, sensor=clear)
    for index, item in enumerate(items):
        inner = interior_of(np.where(np.asarray(frame.body) == index, index, -1))
        single = sense(clear, *item, resolution=SIZE)
        np.testing.assert_allclose(frame.visual[inner], single.visual[inner], atol=2e-4)
        assert inner.sum() > 15


TILTS = [(90, 0, 0), (90, 0, 45), (80, 5, 30), (120, 10, 10), (180, 0, 0)]


@pytest.mark.slow
@pytest.mark.parametrize("sensor", [SENSOR, TIP])
def test_a_floor_that_begins_before_the_pinhole_equals_its_plane(sensor):
    floor, distance = from_trimesh(trimesh.creation.box((10, 8, 0.02))), 0.12
    x, y = np.meshgrid(*2 * [1.5 * ((np.arange(SIZE[0]) + 0.5) / SIZE[0] - 0.5)])
    for tilt in TILTS:
        turn = Rotation.from_euler("xyz", tilt, degrees=True)
        normal = turn.apply([0, 0, 1.0])
        middle = -(distance + 0.01) * normal
        pose = at(*middle, turn.as_quat(scalar_first=True))
        frame = many((floor, pose, NOTHING), (BALL, at(0, 0, 0.02), NOTHING), sensor=sensor)
        facing = np.stack([x, y, np.ones_like(x)], -1) @ normal
        depth = (0.1 * normal[2] - distance) / np.where(facing == 0, 1, facing)
        points = np.stack([depth * x, depth * y, depth - 0.1], -1) - middle
        local = np.abs(turn.apply(points.reshape(-1, 3), inverse=True)[:, :2].reshape(*SIZE, 2))
        inside = (facing < 0) & (depth > float(sensor.camera.near)) & (local < [4.9, 3.9]).all(-1)
        seen = np.asarray(frame.body) == 0
        assert np.array_equal(seen, inside & (np.asarray(frame.body) != 1)) or abs(seen.sum() - inside.sum()) < 300
        assert not np.any(inside & (np.asarray(frame.body) == -1))
        np.testing.assert_allclose(np.asarray(frame.depth)[seen & inside], depth[seen & inside], rtol=1e-3)
        assert (seen & inside).sum() > 500


@pytest.mark.slow
def test_a_scene_of_large_and_small_faces_equals_embree():
    wall = from_trimesh(trimesh.creation.box((2.0, 1.5, 0.3)))
    turns = [Rotation.from_euler("xyz", angles, degrees=True) for angles in ((95, 20, 0), (10, 20, 30))]
    poses = [
        at(0.1, 0.35, 0.1, turns[0].as_quat(scalar_first=True)),
        at(-0.03, -0.03, 0.05, turns[1].as_quat(scalar_first=True)),
    ]
    fine = from_trimesh(trimesh.creation.box((0.03, 0.03, 0.02)).subdivide().subdivide().subdivide())
    for small, pose in ((fine, poses[1]), (BALL, at(0.02, -0.02, 0.021))):  # one program
        frame = many((wall, poses[0], NOTHING), (small, pose, NOTHING))
        meshes = [body_mesh(body, pose) for body, pose in zip((wall, small), frame.pose, strict=True)]
        truth = embree(trimesh.util.concatenate(meshes), SENSOR.camera, SIZE)
        seen = np.isfinite(frame.depth)
        assert np.mean(seen != np.isfinite(truth)) < 0.005
        inner = interior(truth, span=0.3) & seen
        np.testing.assert_allclose(np.asarray(frame.depth)[inner], truth[inner], rtol=1e-4)
        assert inner.sum() > 500
        assert set(np.unique(frame.body)) == {-1, 0, 1}


@pytest.mark.slow
def test_vmap_equals_a_loop_and_gradients_equal_finite_differences():
    bodies = [BOX, BALL]
    poses, wrenches = stacked(*PRESSED)
    # Outlines that move across pixels have no gradient.
    inner = interior_of(np.asarray(sense(SENSOR, bodies, poses, wrenches, resolution=(24, 24)).body))

    def total(poses, wrenches):
        frame = sense(SENSOR, bodies, poses, wrenches, resolution=(24, 24))
        weights = jax.random.uniform(jax.random.key(0), frame.depth.shape)
        return jnp.sum(weights * jnp.where(inner & frame.segmentation, frame.depth, 0)), frame

    batch = jnp.stack([poses, poses.at[:, 0].add(0.004)]), jnp.stack([wrenches, wrenches.at[1].set(0)])
    _, frames = jax.vmap(total)(*batch)
    for index in range(2):
        single = total(*(leaf[index] for leaf in batch))[1]
        for field in (field for field in dataclasses.fields(single) if field.name != "shear"):
            np.testing.assert_allclose(
                getattr(frames, field.name)[index], getattr(single, field.name), rtol=1e-4, atol=1e-6
            )
    gradients = jax.grad(lambda *given: total(*given)[0], argnums=(0, 1))(poses, wrenches)
    for k, step in ((0, 1e-4), (1, 0.05)):  # m along z, N
        for body in (0, 1):
            given = [poses, wrenches]
            ends = []
            for sign in (1, -1):
                moved = list(given)
                moved[k] = moved[k].at[body, 2].add(sign * step)
                ends.append(float(total(*moved)[0]))
            numeric = (ends[0] - ends[1]) / (2 * step)
            assert float(gradients[k][body, 2]) == pytest.approx(numeric, rel=0.05, abs=2e-2)


@pytest.mark.slow
def test_traced_bodies_are_drawn_and_have_gradients():
    poses, wrenches = stacked(*PRESSED)
    frame, concrete = (
        draw(SENSOR, [BOX, BALL], poses, wrenches),
        sense(SENSOR, [BOX, BALL], poses, wrenches, resolution=(24, 24)),
    )
    np.testing.assert_array_equal(frame.body, concrete.body)
    np.testing.assert_allclose(frame.visual, concrete.visual, atol=1e-5)
    broken = dataclasses.replace(BALL, vertices=BALL.vertices.at[3, 1].set(jnp.nan))
    empty = draw(SENSOR, [BOX, broken], poses, wrenches)
    assert not np.any(empty.balanced)
    assert not np.any(empty.segmentation)


def test_an_invalid_pose_or_wrench_removes_only_its_body():
    poses, wrenches = stacked(*PRESSED)
    for given in ((poses.at[1, 4].set(jnp.nan), wrenches), (poses, wrenches.at[1, 0].set(jnp.inf))):
        frame = draw(SENSOR, [BOX, BALL], *given)
        assert frame.balanced.tolist() == [True, False]
        assert set(np.unique(frame.body)) == {-1, 0}
        assert np.isfinite(frame.visual).all()
        assert np.isfinite(frame.tactile).all()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*pose puts")
def test_a_body_below_the_gel_is_never_drawn():
    above, below = (BALL, at(0, 0, 0.04), NOTHING), (BOX, at(0, 0, -0.05), NOTHING)
    frame = many(below, above)
    assert set(np.unique(frame.body)) == {-1, 1}
    np.testing.assert_allclose(frame.depth, alone(*above).depth, rtol=1e-6)


@pytest.mark.slow
def test_a_traced_sensor_draws_the_same_faces():
    tip = sts.Sensor.sized(0.02)
    wall = from_trimesh(trimesh.creation.box((0.004, 0.02, 0.03)))
    given = [wall], at(0.006, 0, 0)[None], NOTHING[None]  # from the housing far into the view
    traced = jax.jit(lambda sensor: sense(sensor, *given, resolution=SIZE).depth)(tip)
    expected = sense(tip, *given, resolution=SIZE).depth
    assert np.isfinite(expected).sum() > 100
    np.testing.assert_allclose(traced, expected, rtol=1e-4)


@pytest.mark.filterwarnings("ignore:.*pose puts")
def test_parts_beside_or_far_below_the_face_do_not_hide_what_presses():
    def box(*size, place):
        return trimesh.creation.box(size, trimesh.transformations.translation_matrix(place))

    bar = box(0.1, 0.02, 0.01, place=(0.05, 0, 0.005))  # reaches beyond the pad, whose edge is at x = 75 mm
    leg = box(0.01, 0.02, 0.07, place=(0.095, 0, -0.03))
    pressures = [
        sense(SENSOR, from_trimesh(shape), at(0, 0, -0.001), resolution=SIZE).pressure
        for shape in (bar, trimesh.util.concatenate([bar, leg]))
    ]
    assert np.sum(pressures[0] > 0) > 50
    np.testing.assert_allclose(pressures[1], pressures[0], atol=1)
    deep = sense(SENSOR, ball(0.005), at(0, 0, -0.003), resolution=SIZE)  # its centre is below the face
    cells = np.argwhere(np.asarray(deep.pressure) > 0)
    size = np.array(SENSOR.gel.size)[::-1] / np.array(SENSOR.gel.cells)
    across = np.ptp(cells, axis=0) * size
    np.testing.assert_allclose(across, 2 * np.sqrt(0.005**2 - 0.003**2), atol=2.1 * size.max())
