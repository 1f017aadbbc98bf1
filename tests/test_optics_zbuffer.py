"""The rasteriser against embree and against a loop over all faces and pixels."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from optics_bodies import body_mesh, embree, from_trimesh, interior, public_meshes

from sts_jax import geometry, objects, optics

pytestmark = pytest.mark.usefixtures("strict_ranks")

CAMERA = optics.Camera()
SHAPES = [(64, 64), (97, 53), (200, 200)]


def draw(vertices, faces, two_sided, pose, shape):
    points = geometry.transform(pose, vertices)
    pixels, depth = optics.to_pixels(CAMERA, optics.full_window(CAMERA, shape), shape, points)
    inverse = 1 / jnp.maximum(depth, CAMERA.near)
    winner = optics.rasterise(pixels, -inverse, faces, depth > CAMERA.near, two_sided, shape)
    corners = pixels[faces][jnp.maximum(winner, 0)]
    places = [(corners[..., k, 0], corners[..., k, 1]) for k in range(3)]
    weights = optics.barycentrics(places, *optics.pixel_centres(shape))
    corners = inverse[faces][jnp.maximum(winner, 0)]
    return jnp.where(winner >= 0, 1 / sum(w * corners[..., k] for k, w in enumerate(weights)), jnp.inf), winner


drawn = jax.jit(draw, static_argnames="shape")


def bodies():
    rng = np.random.default_rng(0)
    bumpy = trimesh.creation.icosphere(subdivisions=4, radius=0.03)
    bumpy.vertices *= 1 + 0.2 * np.sin(300 * bumpy.vertices[:, :1])
    slivers = trimesh.creation.cylinder(radius=0.004, height=0.12, sections=200)
    slivers.apply_transform(trimesh.transformations.rotation_matrix(1.1, [0.3, 1, 0.2]))
    ring = trimesh.creation.torus(0.03, 0.008)
    yield "bumpy", from_trimesh(bumpy)
    yield "slivers", from_trimesh(slivers)
    yield "ring", from_trimesh(ring)
    meshes = public_meshes()
    yield "potion", objects.load(meshes / "potion.obj", longest_side=0.08, up="y", texture=meshes / "potion.png")
    for category in ("bottle", "fork", "watch"):
        yield category, objects.make(jax.random.key(int(rng.integers(100))), category)


BODIES = dict(bodies())


def some_pose(rng):
    place = [*rng.uniform(-0.03, 0.03, 2), rng.uniform(0.04, 0.09)]
    quat = rng.normal(size=4)
    return jnp.asarray([*place, *quat / np.linalg.norm(quat)], jnp.float32)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("name", BODIES)
def test_depth_equals_embrees(name, shape):
    body = BODIES[name]
    rng = np.random.default_rng(1)
    for _ in range(2):
        pose = some_pose(rng)
        depth, _ = drawn(body.vertices, body.faces, body.two_sided, pose, shape)
        depth = np.asarray(depth)
        truth = embree(body_mesh(body, pose), CAMERA, shape)
        inner = interior(truth)
        error = np.abs(depth[inner] - truth[inner])
        assert np.sum(error > 1e-5) <= 0.001 * error.size
        assert error.max(initial=0) < 1e-4
        # The silhouette may differ where the pixels around a pixel differ.
        differs = np.isfinite(depth) != np.isfinite(truth)
        hit = np.isfinite(truth)
        padded = np.pad(hit, 1, mode="edge")
        around = np.stack([padded[i : i + shape[0], j : j + shape[1]] for i in range(3) for j in range(3)])
        boundary = np.any(around, 0) & ~np.all(around, 0)
        assert not np.any(differs & ~boundary)
        assert differs.sum() <= max(2, 0.01 * boundary.sum())


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

    def nearest(keep, two_sided=True):
        return int(optics.rasterise(points, order, faces, keep, jnp.bool_(two_sided), (16, 16))[4, 4])

    keep = jnp.ones(9, bool)
    assert nearest(keep, two_sided=False) == -1
    assert nearest(keep) == 2
    assert nearest(keep.at[7].set(False)) == 1
    assert nearest(keep.at[jnp.array([7, 3])].set(False)) == 0
